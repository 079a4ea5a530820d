"""The result of `tc.identify`: it owns the model and everything that was found about it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compensator.api.files import page_in
from compensator.data.frames import frame_of
from compensator.display import html_table
from compensator.identify.calibration import Calibration, Part
from compensator.identify.comparison import Row
from compensator.identify.criticism import Criticism
from compensator.identify.summary import figures, text, verdict, with_std
from compensator.model.model_writer import write_model
from compensator.model.thermal_model import ThermalModel

if TYPE_CHECKING:
    from compensator.api.plotting import Plot


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class IdentificationResult:
    """An identified model with everything that was found about it.

    Parameters
    ----------
    model : ThermalModel
        The model, as its file gives it back.
    calibration : Calibration
        Runs, fits, residuals.
    criticism : Criticism
        Step, impulse and frequency responses, correlations of the residuals, warnings.
    comparison : tuple of Row
        Coefficients beside those of a reference model; empty without one.
    in_frame : bool
        Whether tables are DataFrames.
    """

    model: ThermalModel
    calibration: Calibration
    criticism: Criticism
    comparison: tuple[Row, ...] = ()
    in_frame: bool = False

    @property
    def params(self) -> dict[str, float]:
        """Gains at rest and time constants by name, such as `dtf_gain_um_per_w`, `dtf_tau_1_min`."""
        return {name: value for name, (value, _) in self._estimates().items()}

    @property
    def std_errors(self) -> dict[str, float]:
        """Standard errors of `params`, by the same names."""
        return {name: std for name, (_, std) in self._estimates().items()}

    def _estimates(self) -> dict[str, tuple[float, float]]:
        found = {}
        for view in self.criticism.paths:
            path, unit = view.name.lower(), view.unit.lower().replace("/", "_per_")
            found[f"{path}_gain_{unit}"] = (view.gain, view.gain_std)
            for i, estimate in enumerate(zip(view.taus_min, view.taus_std_min, strict=True), start=1):
                found[f"{path}_tau_{i}_min"] = estimate
        return found

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
        return frame_of(columns) if self.in_frame else columns

    def summary(self) -> str:
        """Return what `compensator identify` prints."""
        return text(self.calibration, self.criticism)

    def to_dict(self) -> dict[str, Any]:
        """Return all figures, as `compensator identify --json` prints them."""
        found = figures(self.calibration, self.criticism)
        if self.comparison:
            found["comparison"] = [dataclasses.asdict(row) for row in self.comparison]
        return found

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the model file.

        Raises
        ------
        UsageError
            If there is no such folder.
        OSError
            If it cannot be written there.
        """
        write_model(Path(path), self.model)
        return Path(path)

    def page(self, path: str | os.PathLike[str]) -> Path:
        """Write the page for the engineer who signs the model: .html, .pdf, or .png for its first picture."""
        return page_in(path, self.write_page)

    def write_page(self, path: Path, also: Path | None = None) -> Path:
        """Write the page as HTML, and in the format of another file too."""
        from compensator.report.identification import write_report

        return write_report(path, self.calibration, self.criticism, self.model, self.comparison, also=also)

    def plot(self) -> Plot:
        """Draw measured and predicted deformation, and the residual; what was held out is shaded."""
        from compensator.api.plotting import stacked

        def joined(name: str) -> np.ndarray[Any, Any]:
            return np.concatenate([np.append(getattr(part, name), np.nan) for part in parts])

        parts = self.calibration.parts
        starts = _starts(parts)
        hours = np.concatenate(
            [np.append(part.t_s / 3600.0 + start, np.nan) for part, start in zip(parts, starts, strict=True)]
        )
        y, predicted = joined("y_um"), joined("y_pred_um")
        figure, axes = stacked(
            [
                ("Y, µm", [("measured", hours, y), ("predicted, free run", hours, predicted)]),
                ("residual, µm", [("measured − predicted", hours, y - predicted)]),
            ]
        )
        for part, start in zip(parts, starts, strict=True):
            if part.role == "held out":
                for axis in axes:
                    axis.axvspan(start + part.t_s[0] / 3600.0, start + part.t_s[-1] / 3600.0, color="0.9")
        return figure

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        estimates = [[name, with_std(value, std)] for name, (value, std) in self._estimates().items()]
        errors = [
            [
                part.name,
                part.role,
                f"{part.model.fit_pct:.2f}",
                f"{part.model.rms_um:.2f}",
                f"{part.nothing.rms_um:.2f}",
            ]
            for part in self.calibration.parts
        ]
        return "".join(
            (
                f"<p><b>{self.model.name}</b>: {verdict(self.calibration)}</p>",
                html_table(["parameter", "value ± standard error"], estimates),
                html_table(["data", "part", "fit %", "rms µm", "no compensation µm"], errors),
                html_table(["warnings"], [[warning.marked] for warning in self.criticism.warnings]),
            )
        )


def _starts(parts: Sequence[Part]) -> list[float]:
    """Return where each part's time begins on a common axis, h: files follow each other."""
    starts: list[float] = []
    end, last = 0.0, ""
    for part in parts:
        starts.append(end if part.name != last and starts else (starts[-1] if starts else 0.0))
        last, end = part.name, starts[-1] + float(part.t_s[-1]) / 3600.0 + 0.5
    return starts
