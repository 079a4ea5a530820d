"""A model in free run over measured data: measured deformation is never fed back."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Vector
from compensator.data.record import SampledRecord, require
from compensator.errors import DataError
from compensator.model.engine import Engine, Estimate
from compensator.model.thermal_model import ThermalModel

#: A machine that is warmed for a time constant does not change any more after this many of them.
SETTLED = 8

#: Columns of a free run in the order of its CSV.
COLUMNS = ("t_s", "heat_w", "y_pred_um", "residual_um", "y_um", "y_dtf_um", "y_tdtf_um", "y_std_um")

#: Columns of `Scores.cells`.
SCORE_HEAD = ("rms µm", "peak to peak µm", "fit %")
#: Columns of `Scores.free_run_cells`.
FREE_RUN_HEAD = ("about zero", "about mean", "mean abs.", "peak to peak", "fit %")


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Errors of a prediction.

    Parameters
    ----------
    fit_pct : float
        100 · (1 − ‖y − ŷ‖ / ‖y − mean y‖), %.
    rms_um, peak_to_peak_um : float
        Of the error, µm; the rms about the zero.
    rms_about_mean_um, mean_abs_um : float
        Standard deviation and mean absolute value of the error, µm.
    """

    fit_pct: float
    rms_um: float
    peak_to_peak_um: float
    rms_about_mean_um: float = math.nan
    mean_abs_um: float = math.nan

    def cells(self) -> list[str]:
        """Return them as cells of a table below `SCORE_HEAD`."""
        return [f"{self.rms_um:.2f}", f"{self.peak_to_peak_um:.2f}", f"{self.fit_pct:.2f}"]

    def free_run_cells(self) -> list[str]:
        """Return them as cells of a table below `FREE_RUN_HEAD`."""
        values = (self.rms_um, self.rms_about_mean_um, self.mean_abs_um, self.peak_to_peak_um, self.fit_pct)
        return [f"{value:.2f}" for value in values]


def require_channels(model: ThermalModel, record: SampledRecord, name: str) -> None:
    """Refuse a record without a channel that an effect of a model needs: without it the effect would stay at zero.

    Raises
    ------
    DataError
        Naming data, channel and model.
    """
    require(name, record, model.channels, why=f", which an effect of model {model.name} needs")


def simulate(
    model: ThermalModel, record: SampledRecord, *, source: str = "", from_rest: bool = False
) -> dict[str, Vector]:
    """Run a model over a record.

    The first sample with both temperatures is the reference; measured deformation counts from its first value.

    Parameters
    ----------
    model : ThermalModel
        The model.
    record : SampledRecord
        Needs `t_q_degc` and `at_degc`.
    source : str
        Name of the data, for the message.
    from_rest : bool
        Whether the machine was warmed from rest, with T_Q = AT, until nothing changed at the first sample's
        temperatures, for effects that count from rest. Otherwise that sample is at rest.

    Returns
    -------
    dict of str to numpy.ndarray, shape (n,)
        `t_s`, `heat_w`, `y_pred_um`, the share of each path, `y_std_um`, and `y_um`, `residual_um` where measured.

    Raises
    ------
    DataError
        If no sample has both temperatures.
    """
    engine, first = engine_at_start(model, record, source)
    t_q, at = record.columns["t_q_degc"][first:], record.columns["at_degc"][first:]
    channels = {name: record.columns[name][first:] for name in engine.channels if name in record.columns}
    at_start_um = _warmed(engine, t_q[0], at[0], {name: u[0] for name, u in channels.items()}) if from_rest else 0.0
    result = {"t_s": record.t_s} | columns_of(engine.run(t_q, at, channels), first)
    result["y_pred_um"] -= at_start_um
    if "y_um" in record.columns:
        result |= _residual(record.columns["y_um"], result["y_pred_um"])
    return result


def engine_at_start(model: ThermalModel, record: SampledRecord, source: str) -> tuple[Engine, int]:
    """Return the engine at rest, and the first sample with both temperatures, which is its reference.

    Raises
    ------
    DataError
        If no sample has both temperatures.
    """
    t_q, at = record.columns["t_q_degc"], record.columns["at_degc"]
    complete = np.flatnonzero(~(np.isnan(t_q) | np.isnan(at)))
    if complete.size == 0:
        raise DataError(f"{source or model.name}: no row has both t_q_degc and at_degc, expected one at least")
    first = int(complete[0])
    engine = Engine(model)
    engine.set_reference(float(t_q[first]), float(at[first]))
    return engine, first


def _warmed(engine: Engine, t_q_degc: float, at_degc: float, channels: Mapping[str, float]) -> float:
    """Warm a machine from rest until nothing changes, and return y there, µm."""
    engine.set_reference(at_degc, at_degc)
    model = engine.model
    paths = [path for path in (model.ttf, model.dtf, model.tdtf) if path is not None]
    taus = [tau for path in paths for tau in path.sampled.time_constants_min()]
    slowest = max([*taus, *(tau for effect in model.effects for tau in effect.time_constants_min)], default=0.0)
    samples = max(1, math.ceil(60.0 * slowest / model.period_s))
    share = np.minimum(np.arange(SETTLED * samples) / samples, 1.0)
    still = {name: np.full(share.size, value) for name, value in channels.items()}
    air = np.full(share.size, at_degc)
    return engine.run(air + share * (t_q_degc - at_degc), air, still)[-1].y_um


def columns_of(estimates: Sequence[Estimate], first: int) -> dict[str, Vector]:
    """Return heat, prediction, shares and standard deviation as columns, NaN in the rows before `first`."""
    lead = np.full(first, math.nan)
    fields = {"y_pred_um": "y_um"} | {name: name for name in ("heat_w", "y_dtf_um", "y_tdtf_um", "y_std_um")}
    return {
        column: np.concatenate((lead, [getattr(estimate, field) for estimate in estimates]))
        for column, field in fields.items()
    }


def _residual(y: Vector, y_pred: Vector) -> dict[str, Vector]:
    known = np.flatnonzero(~(np.isnan(y) | np.isnan(y_pred)))
    if known.size == 0:
        return {"y_um": y, "residual_um": np.full(y.size, math.nan)}
    start = int(known[0])
    changed = y - y[start] + y_pred[start]
    return {"y_um": changed, "residual_um": changed - y_pred}


def scores(y: Vector, y_pred: Vector) -> Scores:
    """Score a prediction on the samples where both are known.

    Examples
    --------
    >>> scores(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 2.0])).fit_pct
    100.0
    """
    known = ~(np.isnan(y) | np.isnan(y_pred))
    y, error = y[known], (y - y_pred)[known]
    if y.size == 0:
        return Scores(fit_pct=math.nan, rms_um=math.nan, peak_to_peak_um=math.nan)
    spread = float(np.linalg.norm(y - y.mean()))
    return Scores(
        fit_pct=100.0 * (1.0 - float(np.linalg.norm(error)) / spread) if spread > 0 else math.nan,
        rms_um=float(np.sqrt(np.mean(error**2))),
        peak_to_peak_um=float(np.ptp(error)),
        rms_about_mean_um=float(np.std(error)),
        mean_abs_um=float(np.mean(np.abs(error))),
    )


def csv_rows(columns: dict[str, Vector]) -> Iterator[list[str]]:
    """Yield a header and rows, each value as it reads back to the last digit; a missing one is an empty cell."""
    yield list(columns)
    for i in range(columns["t_s"].size):
        yield [_shown(values[i]) for values in columns.values()]


def _shown(value: float) -> str:
    return "" if math.isnan(value) else repr(float(value))
