"""`tc.simulate`: a model in free run over measured data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from compensator.api.files import ModelLike, model_of
from compensator.api.simulation_result import SimulationResult
from compensator.arrays import Vector
from compensator.blas import one_thread
from compensator.codes import Reason, Remark, SampleQuality
from compensator.data.measurement import DataLike, measurements
from compensator.data.record import SampledRecord, require
from compensator.data.screening import DEAD_SAMPLES, check_scale
from compensator.model.simulation import COLUMNS, Scores, scores
from compensator.model.simulation import simulate as run_free
from compensator.model.thermal_model import ThermalModel

if TYPE_CHECKING:
    from compensator.api.simulation_frame import SimulationFrame


@one_thread
def simulate(
    model: ModelLike, data: DataLike, *, columns: Mapping[str, str] | None = None
) -> SimulationResult | SimulationFrame:
    """Run a model over measured data; measured Y is never fed back.

    Parameters
    ----------
    model : ThermalModel, path or name
        Model to run.
    data : DataLike
        Data with T_Q and AT.
    columns : mapping of str to str, optional
        Column name for each role that has another name.

    Returns
    -------
    SimulationResult or SimulationFrame
        One row for each sample of the model. For a DataFrame the result is a DataFrame with the same columns: its
        `result` is the SimulationResult, `plot()` plots that, and `to_dict` is that of pandas.

    Raises
    ------
    CompensatorError
        If model or data cannot be read.
    """
    what = model_of(model)
    measured = measurements(data, "data", columns, needed=True)
    remarks: list[Remark] = []
    parts = []
    for one in measured:
        gridded = one.at_period(what.period_s)
        remarks += gridded.remarks
        for record in gridded.records:
            require(one.name, record, ("t_q_degc", "at_degc"))
            remarks += doubts(one.name, what, record)
            parts.append(run_free(what, record, source=one.name))
    result = SimulationResult(
        table={name: _joined(parts, name) for name in COLUMNS if any(name in part for part in parts)},
        records=len(parts),
        remarks=tuple(remarks),
        scores=_scores(parts),
    )
    if not any(one.in_frame for one in measured):
        return result
    from compensator.api.simulation_frame import SimulationFrame

    start = measured[0].table.start_utc_s if len(measured) == 1 else None
    begin = start and start + float(measured[0].table.t_s.min())
    return SimulationFrame.of(result, begin, local=all(one.local_time for one in measured))


def _joined(parts: list[dict[str, Vector]], name: str) -> Vector:
    return np.concatenate([part.get(name, np.full(part["t_s"].size, np.nan)) for part in parts])


def _scores(parts: list[dict[str, Vector]]) -> Scores | None:
    if not any("y_um" in part for part in parts):
        return None
    return scores(_joined(parts, "y_um"), _joined(parts, "y_pred_um"))


def doubts(source: str, model: ThermalModel, record: SampledRecord) -> list[Remark]:
    """Return reasons why a prediction from these temperatures is doubtful.

    Parameters
    ----------
    source : str
        Name of the data.
    model : ThermalModel
        The model.
    record : SampledRecord
        The data.

    Raises
    ------
    DataError
        If a temperature is in kelvin, or below absolute zero.
    """
    found = []
    for name in ("t_q_degc", "at_degc"):
        values = record.columns[name]
        known = values[~np.isnan(values)]
        check_scale(source, name, values)
        if name == "t_q_degc" and known.size >= DEAD_SAMPLES and np.ptp(known) == 0.0:
            found.append(Remark(SampleQuality.STUCK, f"{source}: {name} = {known[0]:g} in every row."))
        low, high = model.validity.get(name, (-np.inf, np.inf))
        outside = int(np.sum((known < low) | (known > high)))
        if outside:
            words = f"{source}: {name} lies outside {low:g} to {high:g} °C in {outside} of {known.size} samples."
            found.append(Remark(Reason.OUTSIDE_VALIDITY, words))
    return found
