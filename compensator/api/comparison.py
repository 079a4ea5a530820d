"""`tc.compare`: models, no compensation and persistence on the same samples."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compensator.api.axis_results import PagedAxes
from compensator.api.files import ModelLike, Paged, Plotted, models_of, write_curves
from compensator.api.simulation import doubts
from compensator.arrays import Vector
from compensator.axes import AxisWords
from compensator.blas import one_thread
from compensator.codes import Remark
from compensator.data.axes import AxisLike, axes_in, of_axis, words_of
from compensator.data.frames import frame_of
from compensator.data.measurement import DataLike, Measurement, check_each_once, measurements, screened_runs_in
from compensator.data.record import SampledRecord, require
from compensator.display import Table, Words, warnings_of
from compensator.errors import DataError, ModelError, UsageError
from compensator.model.free_run import NOTHING, PERSISTENCE, free_runs, in_words, table_of_scores
from compensator.model.simulation import Scores
from compensator.model.thermal_model import ThermalModel
from compensator.options import check_types

if TYPE_CHECKING:
    from compensator.api.plotting import Panel
    from compensator.report.page import Page


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class ComparisonResult(Plotted, Paged):
    """Errors of models in free run on the same samples.

    Parameters
    ----------
    scores : dict of str to Scores
        Scores of each model by name, of no compensation, and of persistence (the last Y measured before the samples).
    residuals : dict of str to numpy.ndarray, shape (n,)
        Measured − predicted of each, µm; NaN outside the samples.
    y_um : numpy.ndarray, shape (n,)
        Measured deformation from its first value, µm; NaN outside the samples.
    t_h : numpy.ndarray, shape (n,)
        Time, h; files follow each other.
    from_h : float
        Hour from which samples were compared.
    samples : int
        Number of samples compared.
    remarks : tuple of Remark
        Remarks on the data, and on doubtful predictions, as `simulate` has them.
    data : tuple of str
        Names of the files or tables.
    in_frame : bool
        Whether tables are DataFrames.
    words : AxisWords
        Names of columns and texts of the axis.
    """

    scores: dict[str, Scores]
    residuals: dict[str, Vector]
    y_um: Vector
    t_h: Vector
    from_h: float
    samples: int
    remarks: tuple[Remark, ...] = ()
    data: tuple[str, ...] = ()
    in_frame: bool = False
    words: AxisWords = field(default_factory=AxisWords)

    @property
    def predictions(self) -> dict[str, Vector]:
        """Predicted deformation of each model, shape (n,), µm; NaN outside the samples."""
        return {name: self.y_um - self.residuals[name] for name in self._models}

    @property
    def _models(self) -> list[str]:
        return [name for name in self.scores if name not in (NOTHING, PERSISTENCE)]

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
        found = {name: _without_nan(dataclasses.asdict(row)) for name, row in self.scores.items()}
        remarks = {
            "remarks": [str(remark) for remark in self.remarks],
            "remark_codes": [remark.code for remark in self.remarks],
        }
        return {"from_h": self.from_h, "samples": self.samples, "scores": found, **remarks}

    def contents(self) -> list[str | Table | Words]:
        """Return the content: the verdict, the number of samples, the errors of each model, remarks."""
        return [self._verdict(), self.words(table_of_scores([self.scores])), *self._remarks()]

    def _remarks(self) -> list[Words]:
        return warnings_of(self.remarks, "Remarks on the data")

    def _verdict(self) -> str:
        best = min(self.scores, key=lambda name: self.scores[name].rms_um)
        from_hour = f" from {self.from_h:g} h on" if self.from_h else ""
        words = best
        if best in self._models:
            words = f"{best}, {in_words({name: dataclasses.asdict(row) for name, row in self.scores.items()}, best)}"
        return f"Smallest error: {words}; {self.samples} samples{from_hour}."

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write time, measured Y, and each prediction and residual as CSV; cells outside the samples are empty.

        Raises
        ------
        CompensatorError
            If the file cannot be written.
        """
        return write_curves(path, self.columns)

    @property
    def columns(self) -> dict[str, Vector]:
        """Time, measured Y, and each prediction and residual, by the names that `save` writes."""
        columns = {"t_s": self.t_h * 3600.0, self.words("y_um"): self.y_um}
        for name, values in self.predictions.items():
            columns[f"{self.words('y_pred_um')} {name}"] = values
            columns[f"{self.words('residual_um')} {name}"] = self.residuals[name]
        return columns

    def as_page(self) -> Page:
        """Return the content of the page."""
        from compensator.report.page import Figure, Line, Page

        predicted = self.predictions
        lines = [Line("measured", self.t_h, self.y_um)]
        lines += [Line(name, self.t_h, values) for name, values in predicted.items()]
        residuals = Figure(
            title="",
            x_label="time, h",
            y_label="measured − predicted, µm",
            # The first colour is that of the measured curve above.
            lines=(
                Line("zero", self.t_h[[0, -1]], self.t_h[[0, -1]] * 0.0),
                *(Line(name, self.t_h, self.residuals[name]) for name in predicted),
            ),
            height=2.6,
        )
        figure = Figure(
            title="Measured and predicted deformation in free run, and the residuals",
            x_label="time, h",
            y_label=self.words("Y, µm"),
            lines=tuple(lines),
            below=(residuals,),
            note="Above measured and predicted deformation, below measured − predicted.",
        )
        best = min(self.scores, key=lambda name: self.scores[name].rms_um)
        tone: Any = None if best in self._models else "warn"
        return Page(
            title="Comparison of models",
            verdict=self._verdict(),
            blocks=[*self.tables(), figure, *self._remarks()],
            tone=tone,
            data=self.data,
        )

    def panels(self) -> list[Panel]:
        """Return the curves of the plot: measured and predicted deformation, and the error of each model."""
        curves = [("measured", self.t_h, self.y_um)]
        curves += [(name, self.t_h, values) for name, values in self.predictions.items()]
        residuals = [(name, self.t_h, values) for name, values in self.residuals.items()]
        return [(self.words("Y, µm"), curves), ("measured − predicted, µm", residuals)]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class ComparedAxes(PagedAxes[ComparisonResult]):
    """Comparisons of models of several axes, by axis."""

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the columns of all axes as one CSV."""
        columns = {name: values for result in self.results.values() for name, values in result.columns.items()}
        return write_curves(path, columns)


def _without_nan(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}


@one_thread
def compare(
    models: Mapping[str, ModelLike],
    data: DataLike,
    *,
    columns: Mapping[str, str] | None = None,
    axis: AxisLike = None,
    from_h: float = 0.0,
) -> ComparisonResult | ComparedAxes:
    """Compare models in free run on the samples that all of them predict.

    Parameters
    ----------
    models : mapping of str to (ThermalModel, path or name)
        Models to compare, by arbitrary names.
    data : DataLike
        Data with T_Q, AT and measured Y.
    columns : mapping of str to str, optional
        Column name for each role that has another name.
    axis : str or sequence of str, optional
        Axes to compare; by default all that every model and the data have.
    from_h : float
        Compare from this hour of each file on; the models run from its start.

    Returns
    -------
    ComparisonResult
        Errors of each model, of no compensation, and of persistence. Of several axes: one for each, in a ComparedAxes.

    Raises
    ------
    CompensatorError
        If there is no model or no measured Y, or the models have different sample periods.
    """
    check_types(from_h=from_h)
    if not isinstance(models, Mapping):
        raise UsageError(f'compare: {type(models).__name__}, expected a dict: {{"first": model, "second": other}}')
    if not models:
        raise UsageError("compare: no models, expected one at least")
    found = {str(name): models_of(model, axis) for name, model in models.items()}
    if taken := found.keys() & {NOTHING, PERSISTENCE}:
        raise UsageError(f"compare: {taken.pop()!r} is a row of its own, expected another name for the model")
    periods = {model.period_s for several in found.values() for model in several.values()}
    if len(periods) != 1:
        raise UsageError(f"compare: {len(found)} model(s) of {len(periods)} sample periods, expected models of one")
    measured = measurements(data, "data", columns, needed=True)
    check_each_once(measured)
    results = {}
    for name in _common_axes(list(found.values()), measured, axis):
        words = words_of(name, measured, models=found)
        with words.errors():
            own = {model: several[name] for model, several in found.items()}
            results[name] = _compare(own, of_axis(measured, name), from_h, words)
    if len(results) > 1:
        return ComparedAxes(results=results)
    [result] = results.values()
    return result


def _common_axes(
    models: Sequence[Mapping[str, ThermalModel]], measured: Sequence[Measurement], axis: AxisLike
) -> list[str]:
    """Return the axes that all models have; without a choice, those of them that the data have."""
    common = [name for name in models[0] if all(name in several for several in models)]
    if not common:
        raise ModelError(
            f"compare: models of {' and of '.join(', '.join(several) for several in models)}, no common axis"
        )
    if len(common) == 1 or axis is not None:
        return list(axes_in(measured, common))
    return [name for name in axes_in(measured) if name in common] or common[:1]


def _compare(
    found: Mapping[str, ThermalModel], measured: Sequence[Measurement], from_h: float, words: AxisWords
) -> ComparisonResult:
    """Compare the models of one axis on its data."""
    period_s = next(iter(found.values())).period_s
    remarks: list[Remark] = []

    def doubt(record: SampledRecord, name: str) -> None:
        require(name, record, ("t_q_degc", "at_degc"))
        for model in found.values():
            remarks.extend(doubts(name, model, record))

    for one in measured:
        remarks += screened_runs_in([one], period_s, check=doubt)[1]
    runs = free_runs(found, measured, from_h=from_h)
    if runs.samples < 2:
        count = "only one" if runs.samples else "no"
        raise DataError(f"{measured[0].name}: {count} y_um from {from_h:g} h on, expected measured Y")
    return ComparisonResult(
        scores=runs.scores,
        residuals=runs.residuals,
        y_um=runs.y_um,
        t_h=runs.t_h,
        from_h=from_h,
        samples=runs.samples,
        remarks=tuple(dict.fromkeys(words(remarks))),
        data=tuple(origin.name for one in measured for origin in one.origins),
        in_frame=any(one.in_frame for one in measured),
        words=words,
    )
