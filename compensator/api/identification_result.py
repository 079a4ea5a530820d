"""The result of `tc.identify`: the model and all results of the identification."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compensator.api.files import Paged
from compensator.arrays import NAN
from compensator.axes import AxisWords
from compensator.data.frames import frame_of
from compensator.display import Table, Words, is_determined
from compensator.errors import of_files
from compensator.identify.calibration import Calibration, joined
from compensator.identify.coefficients import Row
from compensator.identify.criticism import Criticism
from compensator.identify.summary import contents, estimates, figures
from compensator.model.free_run import FreeRunErrors
from compensator.model.model_writer import write_model
from compensator.model.thermal_model import ThermalModel

if TYPE_CHECKING:
    from compensator.api.plotting import Panel, Plot
    from compensator.report.page import Page


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class IdentificationResult(Paged):
    """An identified model with all results of the identification.

    Parameters
    ----------
    model : ThermalModel
        The model, as read back from its file.
    calibration : Calibration
        Runs, fits, residuals.
    criticism : Criticism
        Step, impulse and frequency responses, correlations of the residuals, warnings.
    comparison : tuple of Row
        Coefficients compared with those of a reference model; empty without one.
    free_run : tuple of FreeRunErrors
        Errors in free run as the service runs, on each of the data.
    in_frame : bool
        Whether tables are DataFrames.
    words : AxisWords
        Names of columns and texts of the axis.
    """

    model: ThermalModel
    calibration: Calibration
    criticism: Criticism
    comparison: tuple[Row, ...] = ()
    free_run: tuple[FreeRunErrors, ...] = ()
    in_frame: bool = False
    words: AxisWords = field(default_factory=AxisWords)

    @property
    def sha256(self) -> str:
        """Hash of the model file."""
        return self.model.sha256

    @property
    def params(self) -> dict[str, float]:
        """Gains at rest and time constants by name, such as `dtf_gain_um_per_w`, `dtf_tau_1_min`."""
        return {name: one.value for name, one in estimates(self.criticism).items()}

    @property
    def std_errors(self) -> dict[str, float]:
        """Standard errors of `params`, by the same names; NaN where the data do not determine the parameter."""
        found = estimates(self.criticism)
        return {name: one.std if is_determined(one.value, one.std) else NAN for name, one in found.items()}

    @property
    def predictions(self) -> Any:
        """Measured and predicted deformation of every part, fitted or held out; a dict of columns, or a DataFrame."""
        parts = self.calibration.parts
        columns: dict[str, Any] = {
            "data": np.repeat([part.name for part in parts], [part.t_s.size for part in parts]),
            "part": np.repeat([part.role for part in parts], [part.t_s.size for part in parts]),
        }
        for name in ("t_s", "y_um", "y_pred_um"):
            columns[name] = np.concatenate([getattr(part, name) for part in parts])
        columns["residual_um"] = columns["y_um"] - columns["y_pred_um"]
        columns = self.words.table(columns)
        return frame_of(columns) if self.in_frame else columns

    def contents(self) -> list[str | Table | Words]:
        """Return the content: verdict, parameters, errors in free run, warnings."""
        return self.words(list(contents(self.calibration, self.criticism, self.comparison, self.free_run)))

    def to_dict(self) -> dict[str, Any]:
        """Return all figures, as `compensator identify --json` prints them."""
        found = self.words(figures(self.calibration, self.criticism, self.free_run))
        if self.comparison:
            found["comparison"] = [dataclasses.asdict(row) for row in self.comparison]
        return found

    @of_files()
    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the model file.

        Raises
        ------
        CompensatorError
            If the folder does not exist, or the file cannot be written.
        """
        write_model(Path(path), self.model)
        return Path(path)

    def as_page(self) -> Page:
        """Return the content of the page."""
        from compensator.report.identification import page_of

        return self.words(page_of(self.calibration, self.criticism, self.model, self.comparison, self.free_run))

    def plot(self) -> Plot:
        """Plot measured and predicted deformation, and the residual; held-out parts are shaded."""
        from compensator.api.plotting import stacked

        figure, axes = stacked(self.panels())
        for axis in axes:
            for first, last in joined(self.calibration.parts)[3]:
                axis.axvspan(first, last, color="0.9")
        return figure

    def panels(self) -> list[Panel]:
        """Return the curves of the plot."""
        hours, y, predicted, _ = joined(self.calibration.parts)
        curves = [("measured", hours, y), ("predicted, free run", hours, predicted)]
        return [(self.words("Y, µm"), curves), ("residual, µm", [("measured − predicted", hours, y - predicted)])]
