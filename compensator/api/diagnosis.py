"""`tc.diagnose`: what a model lacks, and the extended model."""

from __future__ import annotations

import csv
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
from compensator.api.files import ModelLike, Paged, as_in_file, model_of
from compensator.arrays import Vector
from compensator.atomic_write import atomic_write, require_folder
from compensator.blas import in_one_thread, one_thread
from compensator.codes import DataRemark, Remark
from compensator.data.measurement import DataLike, Measurement, check_each_once, check_validation, measurements, runs_in
from compensator.data.screening import check_deformation_scale, require_y_noise, screen_temperatures
from compensator.diagnose.diagnosis import diagnose as find_effects
from compensator.diagnose.found_effect import FoundEffect
from compensator.diagnose.free_run import BASE, EXTENDED, HELD_OUT, SEARCHED
from compensator.diagnose.outcome import Diagnosis
from compensator.diagnose.series import series_of
from compensator.diagnose.summary import contents, figures
from compensator.display import Listing, Table, Words
from compensator.errors import UsageError
from compensator.model.free_run import FreeRunErrors
from compensator.model.model_writer import write_model
from compensator.model.simulation import csv_rows, require_channels
from compensator.model.thermal_model import ThermalModel
from compensator.progress import Progress, unreported

if TYPE_CHECKING:
    from compensator.api.plotting import Plot
    from compensator.report.page import Page

#: Files that `save` writes into a folder.
FILES = ("model.toml", "diagnosis.json", "report.html", "series.csv")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class DiagnosisResult(Paged):
    """Result of a diagnosis: what a model lacks.

    Parameters
    ----------
    model : ThermalModel
        The base model with every deployable effect, as read back from its file.
    diagnosis : Diagnosis
        Effects with their signals, residuals, errors before and after.
    remarks : tuple of Remark
        Remarks on the data.
    free_run : tuple of FreeRunErrors
        Errors of both models in free run as the service runs, on each of the data.
    """

    model: ThermalModel
    diagnosis: Diagnosis
    remarks: tuple[Remark, ...] = ()
    free_run: tuple[FreeRunErrors, ...] = ()

    @property
    def verdict(self) -> str:
        """`adequate`, `explained`, `partly_explained`, or `unexplained`."""
        return self.diagnosis.verdict

    @property
    def effects(self) -> tuple[FoundEffect, ...]:
        """The effects that the model lacks, in order of the error removed."""
        return self.diagnosis.effects

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`."""
        return figures(self.diagnosis, self.free_run)

    def contents(self) -> list[str | Table | Words | Listing]:
        """Return the content: verdict, errors, effects with their parameters, warnings."""
        return list(contents(self.diagnosis, self.remarks, self.free_run))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the extended model to a file, or everything to a folder as `compensator diagnose` does.

        Parameters
        ----------
        path : path
            A name that ends in .toml: the model file. Any other name: a folder for `model.toml`, `diagnosis.json`,
            `report.html` and `series.csv` (all curves), which is created if it does not exist.

        Raises
        ------
        UsageError
            If the parent folder does not exist.
        """
        target = Path(path)
        if target.suffix.lower() == ".toml":
            write_model(target, self.model)
        else:
            require_folder(target)
            self.save_all(target, series=True)
        return target

    def save_all(self, folder: Path, *, also: Path | None = None, series: bool = False) -> None:
        """Write model, `diagnosis.json`, page and, if wanted, curves into a folder; the page also to another file."""
        folder.mkdir(parents=True, exist_ok=True)
        model, found, page, curves = (folder / name for name in FILES)
        write_model(model, self.model)
        found.write_text(json.dumps(self.to_dict(), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        self.write_page(page, also=also)
        if series:
            with atomic_write(curves) as file:
                csv.writer(file, lineterminator="\n").writerows(csv_rows(series_of(self.diagnosis)))

    def as_page(self) -> Page:
        """Return the content of the page."""
        from compensator.report.diagnosis import page_of

        return page_of(self.diagnosis, self.model, self.remarks, self.free_run)

    def plot(self) -> Plot:
        """Plot the residual before and after on held-out data, one run after another."""
        from compensator.api.plotting import stacked

        found = self.diagnosis
        hours: Vector = np.arange(found.held_out_before.size, dtype=np.float64) * found.model.period_s / 3600.0
        before, after = ("before", hours, found.held_out_before), ("after", hours, found.held_out_after)
        return stacked([("residual on held-out blocks, µm", [before, after])])[0]


@one_thread
def diagnose(
    model: ModelLike,
    data: DataLike,
    *,
    columns: Mapping[str, str] | None = None,
    y_std_um: float | None = None,
    fit_until_h: float | None = None,
    validate: DataLike = (),
    progress: Progress = unreported,
    executor: Executor | None = None,
) -> DiagnosisResult:
    """Find what a model lacks.

    Parameters
    ----------
    model : ThermalModel, path or name
        The base model.
    data : DataLike
        Measured Y with every channel that was logged.
    columns : mapping of str to str, optional
        Column name for each role that has another name.
    y_std_um : float, optional
        Standard deviation of one measured Y, µm. Needed where Y was measured now and then, as by a touch probe;
        elsewhere neighbouring values show it.
    fit_until_h : float, optional
        Search up to this hour of each of the data; both models are validated on the rest.
    validate : DataLike
        Further data on which both models are validated.
    progress : callable
        Called with the steps done and their number.
    executor : concurrent.futures.Executor, optional
        Executor for the held-out blocks, such as a pool of processes; by default this process.

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
    whole = measurements(data, "data", columns, needed=True)
    validation = measurements(validate, "validate", columns)
    check_each_once(whole)
    check_validation(whole, validation)
    longest = max(one.hours for one in whole)
    if fit_until_h is not None and fit_until_h >= longest:
        raise UsageError(f"fit until {fit_until_h:g} h: the data end after {longest:.3g} h, expected an earlier hour")
    measured = whole if fit_until_h is None else [one.before(fit_until_h) for one in whole]
    runs, remarks = runs_in(measured, base.period_s, y_std_um=y_std_um, check=partial(require_channels, base))
    name = ", ".join(dict.fromkeys(run.name for run in runs))
    screen_temperatures(name, runs, quiet_air=True)
    require_y_noise(name, runs)
    check_deformation_scale(name, np.concatenate([run.y_um for run in runs]))

    def executor_map(function: Callable[..., Any], *values: Iterable[Any]) -> Iterable[Any]:
        assert executor is not None
        return executor.map(partial(in_one_thread, function), *values)

    found = find_effects(base, runs, progress=progress, executor_map=executor_map if executor else map)
    extended = as_in_file(found.model, _provenance(base, measured, found))
    models = {BASE: base} if found.model is base else {BASE: base, EXTENDED: extended}
    errors = partial(FreeRunErrors.of, from_rest=found.counts_from_rest)
    free_run = [errors(models, measured, SEARCHED)]
    if fit_until_h is not None:
        free_run += [errors(models, [one], HELD_OUT, from_h=fit_until_h) for one in whole]
    for one in validation:
        absent = [name for name in extended.channels if name not in one.table.columns]
        if absent:
            words = f"{one.label}: the extended model is not validated on it: no column {', '.join(absent)}."
            remarks.append(Remark(DataRemark.NOT_VALIDATED, words))
        free_run.append(errors({BASE: base} if absent else models, [one], HELD_OUT))
    shown = tuple(one for one in free_run if one.samples)
    return DiagnosisResult(model=extended, diagnosis=found, remarks=tuple(remarks), free_run=shown)


def _provenance(base: ThermalModel, measured: Sequence[Measurement], found: Diagnosis) -> dict[str, Any]:
    """Return the provenance of an extended model."""
    return {
        "diagnosis": {
            "source": f"compensator {__version__} diagnose",
            "base_model_sha256": base.sha256,
            "data": [origin.provenance() for one in measured for origin in one.origins],
            "verdict": found.verdict,
            "held_out_rms_um": {"before": found.before.rms_um, "after": found.after.rms_um},
        }
    }
