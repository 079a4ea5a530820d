"""`tc.diagnose`: what a model lacks, and the model with that added."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compensator import __version__
from compensator.api.files import ModelLike, as_in_file, model_of, page_in
from compensator.arrays import Vector
from compensator.blas import in_one_thread, one_thread
from compensator.codes import Remark
from compensator.data.measurement import Measurement, measurements, runs_in
from compensator.data.screening import screen_temperatures
from compensator.diagnose.diagnosis import diagnose as find_effects
from compensator.diagnose.outcome import Diagnosis, FoundEffect
from compensator.diagnose.summary import figures, text, verdict
from compensator.display import html_table
from compensator.identify.summary import with_std
from compensator.model.model_writer import write_model
from compensator.model.thermal_model import ThermalModel
from compensator.progress import Progress, unreported

if TYPE_CHECKING:
    from compensator.api.plotting import Plot

#: What `save` writes into a folder.
FILES = ("model.toml", "diagnosis.json", "report.html")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class DiagnosisResult:
    """What a model lacks.

    Parameters
    ----------
    model : ThermalModel
        The base model with every deployable effect, as its file gives it back.
    diagnosis : Diagnosis
        Effects with their signals, residuals, errors before and after.
    remarks : tuple of Remark
        What had to be corrected in the data.
    """

    model: ThermalModel
    diagnosis: Diagnosis
    remarks: tuple[Remark, ...] = ()

    @property
    def verdict(self) -> str:
        """`adequate`, `explained`, `partly_explained`, or `unexplained`."""
        return self.diagnosis.verdict

    @property
    def effects(self) -> tuple[FoundEffect, ...]:
        """What the model lacks, in order of the error removed."""
        return self.diagnosis.effects

    def to_dict(self) -> dict[str, Any]:
        """Return what `diagnosis.json` holds."""
        return figures(self.diagnosis)

    def summary(self) -> str:
        """Return what `compensator diagnose` prints."""
        remarks = f"\n\nremarks: {'; '.join(self.remarks)}" if self.remarks else ""
        return text(self.diagnosis) + remarks

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the extended model to a file, or everything to a folder as `compensator diagnose` does.

        Parameters
        ----------
        path : path
            A name that ends in .toml: the model file. Any other: a folder for `model.toml`, `diagnosis.json` and
            `report.html`.
        """
        target = Path(path)
        if target.suffix == ".toml":
            write_model(target, self.model)
        else:
            self.save_all(target)
        return target

    def save_all(self, folder: Path, *, also: Path | None = None) -> None:
        """Write model, `diagnosis.json` and page into a folder; the page in the format of another file too."""
        folder.mkdir(parents=True, exist_ok=True)
        model, found, page = (folder / name for name in FILES)
        write_model(model, self.model)
        found.write_text(json.dumps(self.to_dict(), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        self.write_page(page, also=also)

    def page(self, path: str | os.PathLike[str]) -> Path:
        """Write the page: .html, .pdf, or .png for its first picture."""
        return page_in(path, self.write_page)

    def write_page(self, path: Path, also: Path | None = None) -> Path:
        """Write the page as HTML, and in the format of another file too."""
        from compensator.report.diagnosis import write_report

        return write_report(path, self.diagnosis, self.model, self.remarks, also=also)

    def plot(self) -> Plot:
        """Draw the residual before and after on data that took no part, one run after another."""
        from compensator.api.plotting import stacked

        found = self.diagnosis
        hours: Vector = np.arange(found.held_out_before.size, dtype=np.float64) * found.model.period_s / 3600.0
        before, after = ("before", hours, found.held_out_before), ("after", hours, found.held_out_after)
        return stacked([("residual on held-out blocks, µm", [before, after])])[0]

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        rows = [
            [
                " ".join(filter(None, (effect.kind, effect.path, effect.channel))),
                ", ".join(f"{name} {with_std(v['value'], v['std'])}" for name, v in effect.parameters.items()),
                effect.explanation,
            ]
            for effect in self.effects
        ]
        errors = [
            [name, f"{scores.rms_um:.2f}", f"{scores.peak_to_peak_um:.2f}", f"{scores.fit_pct:.2f}"]
            for name, scores in (("before", self.diagnosis.before), ("after", self.diagnosis.after))
        ]
        return "".join(
            (
                f"<p><b>{self.verdict}</b>: {verdict(self.diagnosis)}</p>",
                html_table(["effect", "value ± standard error", "in words"], rows) if rows else "",
                html_table(["held out", "rms µm", "peak to peak µm", "fit %"], errors),
            )
        )


@one_thread
def diagnose(
    model: ModelLike,
    data: Any,
    *,
    columns: Mapping[str, str] | None = None,
    progress: Progress = unreported,
    executor: Executor | None = None,
) -> DiagnosisResult:
    """Find what a model lacks.

    Parameters
    ----------
    model : ThermalModel, path or name
        The base model.
    data : path, DataFrame, mapping of str to array_like, Measurement, or list of those
        Measured Y with every channel that was logged; see `compensator.read`.
    columns : mapping of str to str, optional
        Column name for each role that has another name.
    progress : callable
        Called with the steps done and their number.
    executor : concurrent.futures.Executor, optional
        Searches the held-out blocks, such as a pool of processes; this process where none is given.

    Returns
    -------
    DiagnosisResult
        Verdict, effects, extended model.

    Raises
    ------
    CompensatorError
        If model or data cannot be read, or there is too little data.
    """
    base = model_of(model)
    measured = measurements(data, "data", columns, needed=True)
    runs, remarks = runs_in(measured, base.period_s)
    screen_temperatures(", ".join(dict.fromkeys(run.name for run in runs)), runs, quiet_air=True)

    def executor_map(function: Callable[..., Any], *values: Iterable[Any]) -> Iterable[Any]:
        return executor.map(partial(in_one_thread, function), *values) if executor else map(function, *values)

    found = find_effects(base, runs, progress=progress, executor_map=executor_map)
    extended = as_in_file(found.model, _provenance(base, measured, found))
    return DiagnosisResult(model=extended, diagnosis=found, remarks=tuple(remarks))


def _provenance(base: ThermalModel, measured: Sequence[Measurement], found: Diagnosis) -> dict[str, Any]:
    """Return what an extended model says of its diagnosis."""
    return {
        "diagnosis": {
            "source": f"compensator {__version__} diagnose",
            "base_model_sha256": base.sha256,
            "data": [origin.provenance() for one in measured for origin in one.origins],
            "verdict": found.verdict,
            "held_out_rms_um": {"before": found.before.rms_um, "after": found.after.rms_um},
        }
    }
