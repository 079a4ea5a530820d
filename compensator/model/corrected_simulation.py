"""A model over measured data, corrected by the measured deformation as the service is by probes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Indices, Mask, Vector
from compensator.data.record import SampledRecord
from compensator.model.correction import BELIEVED, ProbeCorrection
from compensator.model.simulation import COLUMNS as FREE_COLUMNS
from compensator.model.simulation import columns_of, engine_at_start
from compensator.model.thermal_model import ThermalModel

#: Columns of a corrected run in the order of its CSV.
COLUMNS = (*FREE_COLUMNS, "y_free_um")


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedRun:
    """A corrected run over a record.

    Parameters
    ----------
    table : dict of str to numpy.ndarray, shape (n,)
        `COLUMNS` by name. `y_pred_um` uses the measured values of earlier rows and is on their level; `y_um` is as
        measured; `y_free_um` is what the model predicts alone.
    refused, believed : numpy.ndarray
        Rows whose measured value was refused; rows whose value was believed together with refused ones.
    """

    table: dict[str, Vector]
    refused: Indices
    believed: Indices


def simulate_corrected(model: ThermalModel, record: SampledRecord, y_std_um: Vector, *, source: str) -> CorrectedRun:
    """Run a model over a record; each row is corrected by the measured values of earlier rows.

    Before the first measured value the model runs free, from 0. From there on the standard deviation has what the
    probes leave unknown in place of the model's own error.

    Parameters
    ----------
    model : ThermalModel
        The model.
    record : SampledRecord
        Needs `t_q_degc`, `at_degc` and `y_um`.
    y_std_um : numpy.ndarray, shape (n,)
        Standard deviation of each measured value, µm.
    source : str
        Name of the data, for the message.

    Raises
    ------
    DataError
        If no sample has both temperatures.
    """
    engine, first = engine_at_start(model, record, source)
    correction = ProbeCorrection(engine.contribution_names)
    minutes = model.period_s / 60.0
    names = ["t_q_degc", "at_degc", "y_um", *(name for name in engine.channels if name in record.columns)]
    rows = zip(*(record.columns[name][first:].tolist() for name in names), strict=True)
    estimates = []
    added, deviation = np.zeros(record.t_s.size), np.full(record.t_s.size, math.nan)
    verdicts: dict[str, list[int]] = {"refused": [], "believed": []}
    for i, (t_q, at, y, *values) in enumerate(rows, start=first):
        estimate = engine.step(t_q, at, dict(zip(names[3:], values, strict=True)))
        estimates.append(estimate)
        shares = estimate.contributions_um
        correction.step(shares, minutes)
        added[i] = correction.correction_um(shares)
        if correction.active:
            deviation[i] = math.sqrt(correction.std_um(shares) ** 2 + engine.y_noise_std_um**2)
        if not math.isnan(y):
            verdict = correction.update(y, float(y_std_um[i]), estimate.y_um, shares)
            if not verdict.taken:
                verdicts["refused"].append(i)
            elif verdict.reason == BELIEVED:
                verdicts["believed"].append(i)
    table = {"t_s": record.t_s} | columns_of(estimates, first)
    table["y_free_um"] = table["y_pred_um"]
    table["y_pred_um"] = table["y_free_um"] + added
    table["y_std_um"] = np.where(np.isnan(deviation), table["y_std_um"], deviation)
    table["y_um"] = record.columns["y_um"]
    table["residual_um"] = table["y_um"] - table["y_pred_um"]
    return CorrectedRun(
        table={name: table[name] for name in COLUMNS},
        refused=np.array(verdicts["refused"], dtype=int),
        believed=np.array(verdicts["believed"], dtype=int),
    )


def compared(run: CorrectedRun) -> dict[str, tuple[Vector, Vector]]:
    """Return measured and predicted deformation by method at the measured rows after the first, µm.

    A row's prediction has used earlier rows alone, so its measured value judges it; refused values judge nothing. All
    count from the first measured value.
    """
    table = run.table
    known: Mask = np.isfinite(table["y_um"]) & np.isfinite(table["y_free_um"])
    known[run.refused] = False
    y, free, corrected = (table[name][known] for name in ("y_um", "y_free_um", "y_pred_um"))
    start, free_start = y[:1], free[:1]
    predicted = {
        "no compensation": np.broadcast_to(start, y[1:].shape),
        "last measured Y held": y[:-1],
        "model alone": (free - free_start + start)[1:],
        "model corrected": corrected[1:],
    }
    return {name: (y[1:], values) for name, values in predicted.items()}
