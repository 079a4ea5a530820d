"""The result of `tc.simulate`: columns by name, with their errors."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compensator.api.axis_results import AxisResults
from compensator.api.files import Plotted, write_curves
from compensator.arrays import Vector
from compensator.axes import AxisWords
from compensator.codes import Remark
from compensator.display import Table, Words, text_of_all, warnings_of
from compensator.model.free_run import NOTHING, in_words, table_of_scores
from compensator.model.simulation import SCORE_HEAD, Scores

if TYPE_CHECKING:
    from compensator.api.plotting import Panel


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class SimulationResult(Plotted, Mapping[str, Vector]):
    """Columns of a free or corrected run by name, as `compensator simulate` writes them.

    Parameters
    ----------
    table : dict of str to numpy.ndarray, shape (n,)
        `t_s`, `heat_w`, `y_pred_um`, `y_std_um`, the share of each path; `y_um`, `residual_um` if Y was measured.
    records : int
        Number of intervals without a long gap.
    remarks : tuple of Remark
        Remarks on the data, and on doubtful predictions.
    scores : Scores or None
        Fit, rms and peak to peak of the residual, if Y was measured.
    beside : dict of str to Scores
        Of a corrected run: the same without compensation, with the last measured Y held, and of the model alone.
        All are then of the measured rows after the first, each predicted from earlier rows.
    nothing : Scores or None
        Of a free run: the same without compensation.
    words : AxisWords
        Names of columns and texts of the axis.
    """

    table: dict[str, Vector]
    records: int
    remarks: tuple[Remark, ...]
    scores: Scores | None
    beside: dict[str, Scores] = field(default_factory=dict)
    nothing: Scores | None = None
    words: AxisWords = field(default_factory=AxisWords)

    def __getitem__(self, name: str) -> Vector:
        return self.table[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.table)

    def __len__(self) -> int:
        return len(self.table)

    def to_dict(self) -> dict[str, Any]:
        """Return the figures, as `compensator simulate --json` prints them."""
        found: dict[str, Any] = {"samples": int(self["t_s"].size), "records": self.records}
        if self.scores is not None:
            found |= asdict(self.scores)
        if self.beside:
            found["beside"] = {name: asdict(row) for name, row in self.beside.items()}
        if self.nothing is not None:
            found["no_compensation"] = asdict(self.nothing)
        return found

    def contents(self) -> list[str | Table | Words]:
        """Return the content: size and columns, errors if Y was measured, remarks."""
        size = f"{self['t_s'].size} samples in {self.records} record(s), columns {', '.join(self)}"
        parts: list[str | Table | Words] = [size]
        if self.scores is not None and self.beside:
            rows = [[name, *row.cells()] for name, row in (*self.beside.items(), ("model corrected", self.scores))]
            title = "Errors at the measured rows after the first, each predicted from earlier rows"
            parts.append(Table(title=title, head=["", *SCORE_HEAD], rows=rows))
        elif self.scores is not None and self.nothing is not None:
            by_name = {"model": self.scores, NOTHING: self.nothing}
            words = in_words({name: asdict(row) for name, row in by_name.items()}, "model")
            parts.append(f"{words[0].upper()}{words[1:]}.")
            parts.append(table_of_scores([by_name]))
        elif self.words("y_free_um") in self.table:
            parts.append("No errors: after the first measured Y, which is the zero, none was measured and taken.")
        return [size, *self.words(parts[1:]), *warnings_of(self.remarks, "Remarks")]

    def summary(self) -> str:
        """Return the content as text without the remarks, which `compensator simulate` writes to stderr."""
        return text_of_all(part for part in self.contents() if not isinstance(part, Words))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the columns as CSV.

        Raises
        ------
        CompensatorError
            If the file cannot be written.
        """
        return write_curves(path, self.table)

    def panels(self) -> list[Panel]:
        """Return the curves of the plot: measured and predicted deformation, and the residual."""
        hours = self["t_s"] / 3600.0
        words = self.words
        curves = [("predicted", hours, self[words("y_pred_um")])]
        if self.scores is None:
            return [(words("Y, µm"), curves)]
        curves.insert(0, ("measured", hours, self[words("y_um")]))
        residual = [("measured − predicted", hours, self[words("residual_um")])]
        return [(words("Y, µm"), curves), ("residual, µm", residual)]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class SimulatedAxes(AxisResults[SimulationResult]):
    """Columns of several axes, as `simulate` writes them into one table; by axis the result of each.

    `out["z_pred_um"]` is a column, `out["z"]` the SimulationResult of an axis.
    """

    def __getitem__(self, name: str) -> Any:
        return self.results[name] if name in self.results else self.table[name]

    @property
    def scores(self) -> dict[str, Scores | None]:
        """Fit, rms and peak to peak of the residual of each axis, if it was measured."""
        return {axis: result.scores for axis, result in self.results.items()}

    @property
    def table(self) -> dict[str, Vector]:
        """All columns by name; time and heat once."""
        return {name: values for result in self.results.values() for name, values in result.table.items()}

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """Remarks on the data and on doubtful predictions, each once."""
        return tuple(dict.fromkeys(remark for result in self.results.values() for remark in result.remarks))

    def summary(self) -> str:
        """Return the content as text without the remarks."""
        return text_of_all(part for part in self.contents() if not isinstance(part, Words))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the columns as CSV.

        Raises
        ------
        CompensatorError
            If the file cannot be written.
        """
        return write_curves(path, self.table)
