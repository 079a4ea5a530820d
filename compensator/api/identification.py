"""`tc.identify`: from measured runs to a thermal model with its errors."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from compensator import __version__
from compensator.api.files import ModelLike, as_in_file, model_of, page_in
from compensator.blas import one_thread
from compensator.data.frames import frame_of
from compensator.data.measurement import PERIOD_S, Measurement, measurements, runs_in
from compensator.data.screening import screen_temperatures
from compensator.display import html_table
from compensator.errors import UsageError
from compensator.identify.calibration import Calibration, Part, calibrate
from compensator.identify.comparison import Row
from compensator.identify.comparison import compare as compare_coefficients
from compensator.identify.criticism import Criticism, criticise
from compensator.identify.settings import Method, Settings
from compensator.identify.summary import figures, text, verdict, with_std
from compensator.model.model_writer import write_model
from compensator.model.thermal_model import ThermalModel
from compensator.progress import Progress, unreported

if TYPE_CHECKING:
    from compensator.api.plotting import Plot

#: What a model file keeps of the figures, beside where it comes from.
_KEPT = ("method", "parts", "warnings", "remarks", "ttf")
_DEFAULT = Settings()


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


@one_thread
def identify(
    data: Any,
    *,
    validate: Any = (),
    etve: Any = (),
    columns: Mapping[str, str] | None = None,
    name: str = "model",
    kind: Literal["auto", "heat", "direct"] = "auto",
    method: Method = "IV",
    tdtf: Sequence[float] | None = None,
    etve_end_h: float = _DEFAULT.etve_end_h,
    ttf: Sequence[int] = _DEFAULT.ttf,
    order: Sequence[int] | None = None,
    drive: Literal["ttf", "known"] = "ttf",
    folds: int = _DEFAULT.folds,
    fit_until_h: float | None = None,
    reference: ModelLike | None = None,
    progress: Progress = unreported,
) -> IdentificationResult:
    """Identify a thermal model from measured runs.

    Parameters
    ----------
    data : path, DataFrame, mapping of str to array_like, Measurement, or list of those
        Runs that the model is fitted to; see `compensator.read`.
    validate, etve : as `data`, optional
        Runs that only judge the model; a test without heat source (methods II and III).
    columns : mapping of str to str, optional
        Column name for each role that has another name.
    name : str
        Name of the model.
    kind : {"auto", "heat", "direct"}
        With a TTF, or from T_Q − AT to the deformation; `auto`: with a TTF where `heat_w` is known.
    method : {"I", "II", "III", "IV"}
        TDTF given, from a whole ETVE, from its end, or fitted together with the DTF.
    tdtf : (float, float), optional
        Gain, µm/K, and time constant, min, of method I.
    etve_end_h : float
        Length of the end of the ETVE for method III, h.
    ttf : (int, int, int)
        nb, nf, nk of the TTF.
    order : (int, int, int), optional
        nf, nb of the DTF, nb of the TDTF; chosen on held-out blocks where it is not given.
    drive : {"ttf", "known"}
        Heat that the DTF is fitted with: from T_Q as in the service, or the known one.
    folds : int
        Number of held-out blocks.
    fit_until_h : float, optional
        Fit up to this hour; the rest is held out.
    reference : model, optional
        Another model to compare the coefficients with.
    progress : callable
        Called with the steps done and their number.

    Returns
    -------
    IdentificationResult
        Model, parameters, standard errors, errors in free run.

    Raises
    ------
    CompensatorError
        If the data or the options allow no model.
    """
    settings = Settings(
        kind=kind,
        method=method,
        ttf=(int(ttf[0]), int(ttf[1]), int(ttf[2])),
        order=(int(order[0]), int(order[1]), int(order[2])) if order else None,
        drive=drive,
        given_tdtf=(float(tdtf[0]), float(tdtf[1])) if tdtf else None,
        etve_end_h=float(etve_end_h),
        folds=folds,
    )
    sources = {
        role: measurements(given, name, columns)
        for role, name, given in (("fit", "data", data), ("etve", "etve", etve), ("validation", "validate", validate))
    }
    _check_validation(sources)
    remarks: list[str] = []
    runs = {}
    for role, measured in sources.items():
        runs[role], corrected = runs_in(measured, PERIOD_S)
        remarks += corrected
    for run in runs["validation"]:
        screen_temperatures(run.name, [run], quiet_air=True)
    calibration = calibrate(
        runs["fit"],
        settings,
        period_s=PERIOD_S,
        name=name,
        etve=runs["etve"],
        validation=runs["validation"],
        fit_until_s=None if fit_until_h is None else fit_until_h * 3600.0,
        provenance=_provenance(sources, settings, columns or {}, fit_until_h),
        remarks=remarks,
        progress=progress,
    )
    criticism = criticise(calibration)
    found = figures(calibration, criticism)
    model = as_in_file(calibration.model, {key: found[key] for key in _KEPT if key in found})
    return IdentificationResult(
        model=model,
        calibration=calibration,
        criticism=criticism,
        comparison=tuple(compare_coefficients(model, model_of(reference))) if reference is not None else (),
        in_frame=any(measured.in_frame for measured in sources["fit"]),
    )


def _check_validation(sources: Mapping[str, Sequence[Measurement]]) -> None:
    """Refuse to judge a model by what it was made of, wherever that was copied to."""
    fitted = {origin.sha256 for role in ("fit", "etve") for measured in sources[role] for origin in measured.origins}
    for measured in sources["validation"]:
        for origin in measured.origins:
            if origin.sha256 in fitted:
                named = origin.path or origin.name
                raise UsageError(f"--validate {named}: takes part in the fit, expected a run that does not")


def _provenance(
    sources: Mapping[str, Sequence[Measurement]],
    settings: Settings,
    columns: Mapping[str, str],
    fit_until_h: float | None,
) -> dict[str, Any]:
    """Return where a model comes from: every source with its hash, and what was asked for."""
    asked = {name: value for name, value in dataclasses.asdict(settings).items() if value is not None}
    if fit_until_h is not None:
        asked["fit_until_h"] = float(fit_until_h)
    every = [(role, measured) for role, group in sources.items() for measured in group]
    roles = [*columns.items(), *(pair for _, measured in every for pair in measured.roles.items())]
    asked["columns"] = [f"{role}={name}" for role, name in dict.fromkeys(roles)]
    data = [{"role": role} | origin.provenance() for role, measured in every for origin in measured.origins]
    return {"source": f"compensator {__version__} identify", "data": data, "asked": asked}
