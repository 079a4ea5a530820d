"""`tc.compare`: models, no compensation and persistence on the same samples."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from compensator.api.files import ModelLike, Paged, model_of
from compensator.arrays import Mask, Vector
from compensator.blas import one_thread
from compensator.data.frames import frame_of
from compensator.data.measurement import DataLike, measurements
from compensator.data.record import require
from compensator.display import Table
from compensator.errors import DataError, UsageError
from compensator.model.simulation import SCORE_HEAD, Scores, require_channels, scores, simulate

if TYPE_CHECKING:
    from compensator.api.plotting import Plot
    from compensator.report.page import Page

#: References with which every model is compared.
NOTHING, PERSISTENCE = "no compensation", "persistence"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class ComparisonResult(Paged):
    """Errors of models in free run on the same samples.

    Parameters
    ----------
    scores : dict of str to Scores
        Scores of each model by name, of no compensation, and of persistence (the last Y measured before the samples).
    residuals : dict of str to numpy.ndarray, shape (n,)
        Measured − predicted of each, µm; NaN outside the samples.
    t_h : numpy.ndarray, shape (n,)
        Time, h; files follow each other.
    from_h : float
        Hour from which samples were compared.
    in_frame : bool
        Whether tables are DataFrames.
    """

    scores: dict[str, Scores]
    residuals: dict[str, Vector]
    t_h: Vector
    from_h: float
    in_frame: bool = False

    @property
    def samples(self) -> int:
        """Number of samples compared."""
        return int(np.sum(np.isfinite(self.residuals[NOTHING])))

    @property
    def table(self) -> Any:
        """The scores as columns by name; a DataFrame if the data were a DataFrame."""
        rows = list(self.scores.values())
        columns = {field.name: [getattr(row, field.name) for row in rows] for field in dataclasses.fields(Scores)}
        if self.in_frame:
            return frame_of(columns, index=list(self.scores))
        return {"name": list(self.scores), **columns}

    def to_dict(self) -> dict[str, Any]:
        """Return all figures."""
        found = {name: dataclasses.asdict(row) for name, row in self.scores.items()}
        return {"from_h": self.from_h, "samples": self.samples, "scores": found}

    def contents(self) -> list[str | Table]:
        """Return the content: the number of samples, and the errors of each model."""
        table = Table(
            title="Errors on the same samples",
            head=["", *SCORE_HEAD],
            rows=[[name, *row.cells()] for name, row in self.scores.items()],
        )
        return [f"{self.samples} samples in free run" + (f" from {self.from_h:g} h on" if self.from_h else ""), table]

    def as_page(self) -> Page:
        """Return the content of the page."""
        from compensator.report.page import Figure, Line, Page

        lines = tuple(Line(name, self.t_h, values) for name, values in self.residuals.items())
        figure = Figure(title="Error in free run", x_label="time, h", y_label="measured − predicted, µm", lines=lines)
        samples = self.contents()[0]
        best = min(self.scores, key=lambda name: self.scores[name].rms_um)
        words = f"Smallest error: {best}, {self.scores[best].rms_um:.2f} µm rms. {samples}."
        return Page(title="Comparison of models", verdict=words, blocks=[figure, *self.tables()], tone="good")

    def plot(self) -> Plot:
        """Plot the error of each model over time."""
        from compensator.api.plotting import stacked

        curves = [(name, self.t_h, values) for name, values in self.residuals.items()]
        return stacked([("measured − predicted, µm", curves)])[0]


@one_thread
def compare(
    models: Mapping[str, ModelLike], data: DataLike, *, columns: Mapping[str, str] | None = None, from_h: float = 0.0
) -> ComparisonResult:
    """Compare models in free run on the samples that all of them predict.

    Parameters
    ----------
    models : mapping of str to (ThermalModel, path or name)
        Models to compare, by arbitrary names.
    data : DataLike
        Data with T_Q, AT and measured Y.
    columns : mapping of str to str, optional
        Column name for each role that has another name.
    from_h : float
        Compare from this hour of each file on; the models run from its start.

    Returns
    -------
    ComparisonResult
        rms, peak to peak and fit of each model, of no compensation, and of persistence.

    Raises
    ------
    CompensatorError
        If there is no model or no measured Y, or the models have different sample periods.
    """
    if not isinstance(models, Mapping):
        raise UsageError(f'compare: {type(models).__name__}, expected a dict: {{"first": model, "second": other}}')
    found = {str(name): model_of(model) for name, model in models.items()}
    if taken := found.keys() & {NOTHING, PERSISTENCE}:
        raise UsageError(f"compare: {taken.pop()!r} is a row of its own, expected another name for the model")
    periods = {model.period_s for model in found.values()}
    if len(periods) != 1:
        raise UsageError(f"compare: {len(found)} model(s) of {len(periods)} sample periods, expected models of one")
    measured = measurements(data, "data", columns, needed=True)
    times: list[Vector] = []
    parts: dict[str, list[Vector]] = {name: [] for name in ("y", *found, NOTHING, PERSISTENCE)}
    begin_h = 0.0
    for one in measured:
        for record in one.at_period(periods.copy().pop()).records:
            require(one.name, record, ("t_q_degc", "at_degc", "y_um"))
            for model in found.values():
                require_channels(model, record, one.name)
            runs = {name: simulate(model, record, source=one.name) for name, model in found.items()}
            residuals = {name: run["residual_um"] for name, run in runs.items()}
            y = next(iter(runs.values()))["y_um"]
            known = np.all([np.isfinite(values) for values in (y, *residuals.values())], axis=0)
            scored = known & (record.t_s >= from_h * 3600.0)
            residuals |= {NOTHING: y, PERSISTENCE: y - _last_before(y, known, scored)}
            parts["y"].append(np.where(scored, y, np.nan))
            for name, values in residuals.items():
                parts[name].append(np.where(scored, values, np.nan))
            times.append(record.t_s / 3600.0 + begin_h)
        begin_h += one.hours
    joined = {name: np.concatenate(values) for name, values in parts.items()}
    y = joined.pop("y")
    if not np.isfinite(y).any():
        raise DataError(f"{measured[0].name}: no y_um from {from_h:g} h on, expected measured Y")
    return ComparisonResult(
        scores={name: scores(y, y - residual) for name, residual in joined.items()},
        residuals=joined,
        t_h=np.concatenate(times),
        from_h=from_h,
        in_frame=any(one.in_frame for one in measured),
    )


def _last_before(y: Vector, known: Mask, scored: Mask) -> float:
    """Return the last value measured before the scored samples; the first of all if there is none."""
    before = y[known & (np.arange(y.size) < (int(np.argmax(scored)) if scored.any() else y.size))]
    first = y[known][:1]
    return float(before[-1] if before.size else first[0] if first.size else np.nan)
