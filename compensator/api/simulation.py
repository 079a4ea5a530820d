"""`tc.simulate`: a model over measured data, free or corrected by measured Y."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from compensator.api.files import ModelLike, models_of
from compensator.api.simulation_result import SimulatedAxes, SimulationResult
from compensator.arrays import Vector
from compensator.axes import AxisWords
from compensator.blas import one_thread
from compensator.codes import DataRemark, Reason, Remark, SampleQuality
from compensator.data.axes import AxisLike, with_axis, words_of
from compensator.data.measurement import DataLike, Measurement, measurements
from compensator.data.record import SampledRecord, require
from compensator.data.runs import is_sparse, noise_std
from compensator.data.screening import DEAD_SAMPLES, check_scale, check_y_std, y_noise_needed
from compensator.errors import UsageError
from compensator.model.corrected_simulation import COLUMNS as CORRECTED_COLUMNS
from compensator.model.corrected_simulation import CorrectedRun, compared, simulate_corrected
from compensator.model.simulation import COLUMNS, Scores, require_channels, scores
from compensator.model.simulation import simulate as run_free
from compensator.model.thermal_model import ThermalModel

if TYPE_CHECKING:
    from compensator.api.simulation_frame import SimulationFrame

#: Measured Y without any noise, as of a simulated sensor, is taken to have this standard deviation, µm.
_LEAST_STD_UM = 0.01
#: Number of rows that a remark lists.
_SHOWN = 3


@one_thread
def simulate(
    model: ModelLike,
    data: DataLike,
    *,
    columns: Mapping[str, str] | None = None,
    axis: AxisLike = None,
    correct: bool = False,
    y_std_um: float | None = None,
) -> SimulationResult | SimulationFrame | SimulatedAxes:
    """Run a model over measured data, free or corrected by measured Y.

    Parameters
    ----------
    model : ThermalModel, path or name
        Model to run.
    data : DataLike
        Data with T_Q and AT.
    columns : mapping of str to str, optional
        Column name for each role that has another name.
    axis : str or sequence of str, optional
        Axes to predict; by default all that the model has.
    correct : bool
        Whether each row's `y_pred_um` uses the measured Y of earlier rows, as the service uses probes; by default
        measured Y is never fed back.
    y_std_um : float, optional
        Standard deviation of one measured value of Y, µm; by default what neighbouring values show.

    Returns
    -------
    SimulationResult or SimulationFrame
        One row for each sample of the model. For a DataFrame the result is a DataFrame with the same columns: its
        `result` is the SimulationResult, `plot()` plots that, and `to_dict` is that of pandas. Of several axes the
        columns of all of them, in a SimulatedAxes, where the name of an axis gives its SimulationResult.

    Raises
    ------
    CompensatorError
        If model or data cannot be read, or Y is measured too sparsely to show its noise and `y_std_um` is missing.
    """
    models = models_of(model, axis)
    check_y_std(y_std_um)
    measured = measurements(data, "data", columns, needed=True)
    results = {}
    for name, what in models.items():
        words = words_of(name, measured, models=[what.name])
        with words.errors():
            results[name] = _simulate(what, with_axis(measured, name), words, correct=correct, y_std_um=y_std_um)
    result = SimulatedAxes(results=results) if len(results) > 1 else next(iter(results.values()))
    if not any(one.in_frame for one in measured):
        return result
    from compensator.api.simulation_frame import SimulationFrame

    start = measured[0].table.start_utc_s if len(measured) == 1 else None
    begin = start and start + float(measured[0].table.t_s.min())
    return SimulationFrame.of(result, begin, local=all(one.local_time for one in measured))


def _simulate(
    what: ThermalModel, measured: Sequence[Measurement], words: AxisWords, *, correct: bool, y_std_um: float | None
) -> SimulationResult:
    """Run the model of an axis over its data."""
    remarks: list[Remark] = []
    parts: list[dict[str, Vector]] = []
    corrected: list[CorrectedRun] = []
    for one in measured:
        gridded = one.at_period(what.period_s)
        remarks += gridded.remarks
        for record in gridded.records:
            require(one.name, record, ("t_q_degc", "at_degc"))
            require_channels(what, record, one.name)
            remarks += doubts(one.name, what, record)
            if not correct:
                parts.append(run_free(what, record, source=one.name))
                continue
            require(one.name, record, ("y_um",))
            run = simulate_corrected(what, record, _y_std(one, record, what.period_s, y_std_um), source=one.name)
            remarks += _remarks(one.name, run)
            corrected.append(run)
            parts.append(run.table)
    order = CORRECTED_COLUMNS if correct else COLUMNS
    methods = _methods(corrected)
    free = None if correct else _scores(parts)
    return SimulationResult(
        table=words.table({name: _joined(parts, name) for name in order if any(name in part for part in parts)}),
        records=len(parts),
        remarks=tuple(words(remarks)),
        scores=(methods[-1][1] if methods else None) if free is None else free[0],
        beside=words(dict(methods[:-1])),
        nothing=None if free is None else free[1],
        words=words,
    )


def _joined(parts: list[dict[str, Vector]], name: str) -> Vector:
    return np.concatenate([part.get(name, np.full(part["t_s"].size, np.nan)) for part in parts])


def _scores(parts: list[dict[str, Vector]]) -> tuple[Scores, Scores] | None:
    """Return the errors of the model and of no compensation on the same samples; None without measured Y."""
    y, predicted = _joined(parts, "y_um"), _joined(parts, "y_pred_um")
    if not np.isfinite(y - predicted).any():
        return None
    return scores(y, predicted), scores(y, np.where(np.isfinite(predicted), 0.0, np.nan))


def _y_std(one: Measurement, record: SampledRecord, period_s: float, given: float | None) -> Vector:
    """Return the standard deviation of the measured Y of each sample: of the mean of the values in it, µm.

    Raises
    ------
    UsageError
        If it is not given and Y has no neighbouring values that show it.
    """
    y = record.columns["y_um"]
    known = np.isfinite(y)
    if given is None:
        if is_sparse(y) or not known.any():
            raise UsageError(y_noise_needed(one.name, int(np.sum(known)), y.size))
        return np.full(y.size, max(noise_std(y), _LEAST_STD_UM))
    t_s, values = one.table.t_s - one.table.t_s.min(), one.table.columns["y_um"]
    inside = np.isfinite(values) & (t_s >= record.t_s[0]) & (t_s < record.t_s[-1] + period_s)
    return np.full(y.size, given / math.sqrt(max(float(np.sum(inside)) / max(float(np.sum(known)), 1.0), 1.0)))


def _remarks(name: str, run: CorrectedRun) -> Iterator[Remark]:
    """Yield remarks on measured values that did not fit."""
    t_s, y = run.table["t_s"], run.table["y_um"]
    for code, rows, words in (
        (DataRemark.Y_REFUSED, run.refused, "refused"),
        (DataRemark.Y_BELIEVED, run.believed, "believed together with refused ones"),
    ):
        if rows.size:
            where = ", ".join(f"{value:g}" for value in t_s[rows][:_SHOWN])
            more = f" and {rows.size - _SHOWN} more" if rows.size > _SHOWN else ""
            count = f"{rows.size} of {np.sum(np.isfinite(y))} measured y_um"
            yield Remark(code, f"{name}: {count} {words}, at t_s = {where}{more}.")


def _methods(runs: list[CorrectedRun]) -> list[tuple[str, Scores]]:
    """Return the errors at the measured rows by method; that of the corrected model comes last."""
    found: dict[str, list[tuple[Vector, Vector]]] = {}
    for run in runs:
        for name, pair in compared(run).items():
            found.setdefault(name, []).append(pair)
    joined = {name: [np.concatenate(side) for side in zip(*pairs, strict=True)] for name, pairs in found.items()}
    # A single measured value is the zero; nothing is left to compare.
    return [(name, scores(y, predicted)) for name, (y, predicted) in joined.items() if y.size]


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
