"""`tc.diagnose`: what a model lacks, and the extended model."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compensator import __version__
from compensator.api.axis_results import AxisModels
from compensator.api.files import ModelLike, Paged, Plotted, as_in_file, axes_as_in_file, models_of, write_curves
from compensator.arrays import Vector
from compensator.atomic_write import require_folder
from compensator.axes import FIRST, AxisWords, column_of, label_of
from compensator.blas import in_one_thread, one_thread
from compensator.codes import DataRemark, Remark
from compensator.data.axes import AxisLike, axes_in, of_axis, words_of
from compensator.data.measurement import (
    DataLike,
    Measurement,
    check_each_once,
    check_validation,
    measurements,
    name_of,
    screened_runs_in,
)
from compensator.data.runs import Run
from compensator.data.screening import require_y_noise
from compensator.diagnose.across import MachineEffect, across, missing_places
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.choice.outcome import Diagnosis
from compensator.diagnose.choice.verdict import BASE, EXTENDED, HELD_OUT, SEARCHED, verdict_of
from compensator.diagnose.diagnosis import DiagnosisOptions
from compensator.diagnose.diagnosis import diagnose as find_effects
from compensator.diagnose.words.summary import contents, figures
from compensator.display import Listing, Table, Words
from compensator.errors import UsageError, of_files
from compensator.identify.pairs import pairs
from compensator.model.effects.hypothesis import Place, place_in_words
from compensator.model.free_run import FreeRunErrors
from compensator.model.model_writer import write_axes, write_model
from compensator.model.simulation import require_channels
from compensator.model.thermal_model import ThermalModel
from compensator.options import check_types
from compensator.progress import ExecutorMap, Progress, after, unreported

if TYPE_CHECKING:
    from compensator.api.plotting import Panel
    from compensator.report.page import Page

#: Files that `save` writes into a folder.
FILES = ("model.toml", "diagnosis.json", "report.html", "series.csv")
#: Figures of one axis that `diagnosis.json` of several axes has at the top, too.
_TOP = ("before", "after", "held_out", "noise_floor_um", "remainder", "ceiling")


class _DiagnosisFiles(Paged):
    """A diagnosis with its files, of one axis or of several."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`."""
        raise NotImplementedError

    def write_model_file(self, path: Path) -> None:
        """Write the extended model."""
        raise NotImplementedError

    def write_series(self, path: Path) -> None:
        """Write all curves as CSV."""
        raise NotImplementedError

    @of_files()
    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the extended model to a file, or everything to a folder as `compensator diagnose` does.

        Parameters
        ----------
        path : path
            A name that ends in .toml: the model file. Any other name: a folder for `model.toml`, `diagnosis.json`,
            `report.html` and `series.csv` (all curves), which is created if it does not exist.

        Raises
        ------
        CompensatorError
            If the parent folder does not exist, or a file cannot be written.
        """
        target = Path(path)
        if target.suffix.lower() == ".toml":
            self.write_model_file(target)
        else:
            require_folder(target)
            self.save_all(target, series=True)
        return target

    @of_files()
    def save_all(self, folder: Path, *, also: Path | None = None, series: bool = False) -> None:
        """Write model, `diagnosis.json`, page and, if wanted, curves into a folder; the page also to another file."""
        folder.mkdir(parents=True, exist_ok=True)
        model, found, page, curves = (folder / name for name in FILES)
        self.write_model_file(model)
        found.write_text(json.dumps(self.to_dict(), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        self.write_page(page, also=also)
        if series:
            self.write_series(curves)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class DiagnosisResult(Plotted, _DiagnosisFiles):
    """Result of a diagnosis: what a model lacks.

    Parameters
    ----------
    model : ThermalModel
        The base model with every deployable effect, as read back from its file; the base where nothing was added.
    diagnosis : Diagnosis
        Effects with their signals, residuals, errors before and after.
    remarks : tuple of Remark
        Remarks on the data.
    free_run : tuple of FreeRunErrors
        Errors of both models in free run as the service runs, on each of the data.
    words : AxisWords
        Names of columns and texts of the axis.
    since_utc_s : float, optional
        When the first of the data begin, s since 1970 UTC, where it is known.
    sources : tuple of mapping
        Name and hash of the data, as a model file states them.
    """

    model: ThermalModel
    diagnosis: Diagnosis
    remarks: tuple[Remark, ...] = ()
    free_run: tuple[FreeRunErrors, ...] = ()
    words: AxisWords = field(default_factory=AxisWords)
    since_utc_s: float | None = None
    sources: tuple[Mapping[str, Any], ...] = ()

    @property
    def verdict(self) -> str:
        """`adequate`, `explained`, `partly_explained`, or `unexplained`."""
        return verdict_of(
            self.diagnosis.verdict, [one.to_dict() for one in self.free_run], self.diagnosis.noise_floor_um
        )

    @property
    def sha256(self) -> str:
        """Hash of the model file."""
        return self.model.sha256

    @property
    def effects(self) -> tuple[FoundEffect, ...]:
        """The effects that the model lacks, in order of the error removed."""
        return self.diagnosis.effects

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`."""
        return self.words(figures(self.diagnosis, self.free_run))

    def contents(self) -> list[str | Table | Words | Listing]:
        """Return the content: verdict, errors, effects with their parameters, warnings."""
        return self.words(list(contents(self.diagnosis, self.remarks, self.free_run)))

    def write_model_file(self, path: Path) -> None:
        """Write the extended model."""
        write_model(path, self.model)

    def write_series(self, path: Path) -> None:
        """Write all curves as CSV."""
        write_curves(path, self.words.table(self.diagnosis.series()))

    def as_page(self) -> Page:
        """Return the content of the page."""
        from compensator.report.diagnosis import page_of

        page = page_of(
            self.diagnosis,
            self.model,
            self.remarks,
            self.free_run,
            since_utc_s=self.since_utc_s,
            sources=self.sources,
        )
        return self.words(page)

    def panels(self) -> list[Panel]:
        """Return the curves of the plot: the residual before and after on held-out data, one run after another."""
        found = self.diagnosis
        hours: Vector = np.arange(found.held_out_before.size, dtype=np.float64) * found.model.period_s / 3600.0
        before, after = ("before", hours, found.held_out_before), ("after", hours, found.held_out_after)
        return [("residual on held-out blocks, µm", [before, after])]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class DiagnosedAxes(AxisModels[DiagnosisResult], _DiagnosisFiles):
    """What the models of several axes lack.

    Parameters
    ----------
    results : dict of str to DiagnosisResult
        Each axis.
    machine : tuple of MachineEffect
        Every effect with what it moves on each axis, the largest first.
    """

    results: Mapping[str, DiagnosisResult]
    machine: tuple[MachineEffect, ...] = ()

    @property
    def verdict(self) -> str:
        """The verdict of the axis that lacks most."""
        order = ("adequate", "explained", "partly_explained", "unexplained")
        return max((result.verdict for result in self.results.values()), key=order.index)

    @property
    def effects(self) -> tuple[FoundEffect, ...]:
        """The effects that the models lack, with their `axis`; axis by axis as in `diagnosis.json`."""
        return tuple(effect for result in self.results.values() for effect in result.effects)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`: effects and rivals with their axis, and all figures of each axis.

        What a reader of one axis looks for at the top (`_TOP`) is there that of Y, or without it of the first axis,
        which `figures_of` names.
        """
        axes = {axis: result.to_dict() for axis, result in self.results.items()}
        listed = {
            key: [{"axis": axis, **one} for axis, found in axes.items() for one in found[key]]
            for key in ("effects", "rivals")
        }
        machine = [
            {
                "kind": one.place[0],
                "path": one.place[1] or None,
                "channel": one.place[2] or None,
                "axes": [dataclasses.asdict(share) | {"seen": share.is_seen} for share in one.shares],
                "suspect_probe": one.suspect or None,
                "sentence": one.sentence,
            }
            for one in self.machine
        ]
        first = FIRST if FIRST in axes else next(iter(axes))
        top = {"figures_of": first, **{key: axes[first][key] for key in _TOP}}
        return {"verdict": self.verdict, **listed, **top, "machine": machine, "axes": axes}

    def sentences(self) -> list[str]:
        """Return what is said of the machine: each effect with its axes, and the verdict of each axis."""
        alike: dict[str, list[str]] = {}
        for axis, result in self.results.items():
            alike.setdefault(result.verdict.replace("_", " "), []).append(label_of(axis))
        return [*(one.sentence for one in self.machine), *(f"{', '.join(a)}: {word}." for word, a in alike.items())]

    def contents(self) -> Sequence[str | Table | Words | Listing]:
        """Return the content: what is said of the machine, a column for each axis, and the content of each axis."""
        parts: list[str | Table | Words | Listing] = [" ".join(self.sentences())]
        parts += [self.table()] if self.machine else []
        for axis, result in self.results.items():
            parts += [f"Axis {label_of(axis)}", *result.contents()]
        return parts

    def table(self) -> Table:
        """Return what each effect moves, with a column for each axis."""
        rows = []
        for one in self.machine:
            shares = {share.axis: share for share in one.shares}
            cells = (
                f"{shares[axis].moves_um:z.1f} ± {shares[axis].std_um:.1f}".replace("-", "−") for axis in self.results
            )
            rows.append([place_in_words(one.place), *cells])
        head = ["effect", *map(label_of, self.results)]
        note = "The same form on every axis, its size fitted; negative: against its channel."
        return Table(title="What each effect moves, µm peak to peak", head=head, rows=rows, note=note)

    def write_model_file(self, path: Path) -> None:
        """Write the extended models of all axes into one file."""
        write_axes(path, self.model)

    def write_series(self, path: Path) -> None:
        """Write the curves of each axis into a file of its own, such as `series-z.csv`."""
        for axis, result in self.results.items():
            result.write_series(path.with_stem(f"{path.stem}-{axis}"))

    def as_page(self) -> Page:
        """Return the page: what is said of the machine, a column for each axis, and a section for each."""
        from compensator.report.axes import page_of_axes

        pages = {axis: result.as_page() for axis, result in self.results.items()}
        return page_of_axes(pages, " ".join(self.sentences()), [self.table()] if self.machine else [])


@one_thread
def diagnose(
    model: ModelLike,
    data: DataLike,
    *,
    columns: Mapping[str, str] | None = None,
    axis: AxisLike = None,
    y_std_um: float | None = None,
    fit_until_h: float | None = None,
    validate: DataLike = (),
    keep_paths: bool = False,
    all_data: bool = False,
    progress: Progress = unreported,
    executor: Executor | None = None,
) -> DiagnosisResult | DiagnosedAxes:
    """Find what a model lacks.

    An effect that one axis shows is looked for on the others.

    Parameters
    ----------
    model : ThermalModel, path or name
        The base model.
    data : DataLike
        Measured Y with every channel that was logged.
    columns : mapping of str to str, optional
        Column name for each role that has another name.
    axis : str or sequence of str, optional
        Axes to diagnose; by default all that the model and the data have.
    y_std_um : float, optional
        Standard deviation of one measured Y, µm. Needed where Y was measured now and then, as by a touch probe;
        elsewhere neighbouring values show it.
    fit_until_h : float, optional
        Search up to this hour of each of the data; both models are validated on the rest.
    validate : DataLike
        Further data on which both models are validated.
    keep_paths : bool
        Keep the paths of the base model as they are. By default they are fitted anew together with the effects where
        the model misses much of its own calibration; data that it has not seen must show clearly that this is better.
    all_data : bool
        Search all of the data, also where an effect began within them, as with `fit_until_h` and of several axes. By
        default it is then looked for in the time since, if that explains itself clearly better.
    progress : callable
        Called with the steps done and their number.
    executor : concurrent.futures.Executor, optional
        Executor for the held-out blocks, such as a pool of processes; by default this process.

    Returns
    -------
    DiagnosisResult
        Verdict, effects, extended model. Of several axes: one for each, in a DiagnosedAxes.

    Raises
    ------
    CompensatorError
        If model or data cannot be read, or there is too little data.
    """
    check_types(fit_until_h=fit_until_h)
    bases = models_of(model, axis)
    given = measurements(data, "data", columns, needed=True)
    validation = measurements(validate, "validate", columns)
    check_each_once(given)
    check_validation(given, validation)
    longest = max(one.hours for one in given)
    if fit_until_h is not None and fit_until_h >= longest:
        raise UsageError(f"fit until {fit_until_h:g} h: the data end after {longest:.3g} h, expected an earlier hour")
    if axis is not None or len(bases) == 1:
        axes = axes_in(given, list(bases))
    else:
        axes = tuple(one for one in bases if one in axes_in(given, None)) or tuple(bases)[:1]

    def executor_map(function: Callable[..., Any], *values: Iterable[Any]) -> Iterable[Any]:
        assert executor is not None
        return executor.map(partial(in_one_thread, function), *values)

    total = 0

    def counted(done: int, steps: int) -> None:
        nonlocal total
        total = steps
        progress(done, steps)

    def diagnosed(
        one: str, number: int, of: int, report: Progress, expected: frozenset[Place] = frozenset()
    ) -> DiagnosisResult:
        words = words_of(one, given, validation, models=[bases[one].name])
        with words.errors():
            return _diagnose_axis(
                bases[one],
                of_axis(given, one),
                of_axis(validation, one),
                words,
                DiagnosisOptions(
                    expected=expected,
                    keep_paths=keep_paths,
                    all_data=all_data or fit_until_h is not None or len(axes) > 1,
                ),
                fit_until_h=fit_until_h,
                y_std_um=y_std_um,
                progress=lambda done, steps: report(number * steps + done, of * steps),
                executor_map=executor_map if executor else map,
            )

    results = {one: diagnosed(one, i, len(axes), counted) for i, one in enumerate(axes)}
    if len(results) > 1:
        missing = missing_places({one: result.diagnosis for one, result in results.items()})
        again = after(progress, total)
        for i, (one, places) in enumerate(missing.items()):
            results[one] = diagnosed(one, i, len(missing), again, places)
    models = axes_as_in_file({one: result.model for one, result in results.items()})
    results = {one: dataclasses.replace(result, model=models[one]) for one, result in results.items()}
    if len(results) == 1:
        return next(iter(results.values()))
    return DiagnosedAxes(results=results, machine=_machine(results, given, bases[axes[0]].period_s))


def _machine(
    results: Mapping[str, DiagnosisResult], given: Sequence[Measurement], period_s: float
) -> tuple[MachineEffect, ...]:
    """Return every effect with what it moves on each axis."""
    names = [one for one in results if all(column_of(one) in each.table.columns for each in given)]
    records = [record for each in given for record in each.at_period(period_s).records]
    values = {one: [record.columns[column_of(one)] for record in records] for one in names}
    partners = {a: b for pair in pairs(values, period_s) for a, b in pair.both_ways}
    return across({one: result.diagnosis for one, result in results.items()}, partners)


def _diagnose_axis(
    base: ThermalModel,
    given: Sequence[Measurement],
    validation: Sequence[Measurement],
    words: AxisWords,
    options: DiagnosisOptions,
    *,
    fit_until_h: float | None,
    y_std_um: float | None,
    progress: Progress,
    executor_map: ExecutorMap,
) -> DiagnosisResult:
    """Diagnose the model of an axis on its data."""
    measured = list(given) if fit_until_h is None else [one.before(fit_until_h) for one in given]
    screened = partial(
        screened_runs_in, period_s=base.period_s, y_std_um=y_std_um, check=partial(require_channels, base)
    )
    runs, remarks = screened(measured, whole_y=True)
    remarks += _several_zeros(runs)
    require_y_noise(name_of(runs), runs)
    for one in validation:  # refused before the search, which may take minutes
        remarks += screened([one])[1]
    options = dataclasses.replace(options, unseen=_is_unseen(base, measured))
    found = find_effects(base, runs, options, progress=progress, executor_map=executor_map)
    if words.axis != FIRST:
        effects = tuple(dataclasses.replace(effect, axis=words.axis) for effect in found.effects)
        found = dataclasses.replace(found, effects=effects)
    remarks += found.evidence.no_causes.values()
    is_extended = found.model is not base
    sources = [origin.provenance() for one in measured for origin in one.origins]
    stored = partial(_stored, base, sources, found)
    extended = stored(found.verdict) if is_extended else base
    models = {BASE: base, EXTENDED: extended} if is_extended else {BASE: base}
    errors = partial(FreeRunErrors.of, from_rest=found.counts_from_rest)
    free_run = [errors(models, measured, SEARCHED, from_h=found.since_h)]
    if fit_until_h is not None:
        free_run += [errors(models, [one], HELD_OUT, from_h=fit_until_h) for one in given]
    for one in validation:
        absent = [name for name in extended.channels if name not in one.table.columns]
        if absent:
            text = f"{one.label}: the extended model is not validated on it: no column {', '.join(absent)}."
            remarks.append(Remark(DataRemark.NOT_VALIDATED, text))
        free_run.append(errors({BASE: base} if absent else models, [one], HELD_OUT))
    result = DiagnosisResult(
        model=extended,
        diagnosis=found,
        remarks=tuple(remarks),
        free_run=tuple(one for one in free_run if one.samples),
        words=words,
        since_utc_s=measured[0].since_utc_s,
        sources=tuple(sources),
    )
    if not is_extended or result.verdict == found.verdict:
        return result
    # What runs that took no part leave of the verdict is known once the model has run over them.
    return dataclasses.replace(result, model=stored(result.verdict))


def _several_zeros(runs: Sequence[Run]) -> list[Remark]:
    """Return a remark on runs in which Y counts from several zeros."""
    zeros = {(run.recording, at_s) for run in runs for at_s in run.zeros_s}
    count = len(zeros) + len({recording for recording, _ in zeros})
    words = f"{name_of(runs)}: probes about {count} zeros; each has a level of its own in the search."
    return [Remark(DataRemark.SEVERAL_ZEROS, words)] if count else []


def _is_unseen(base: ThermalModel, measured: Sequence[Measurement]) -> bool:
    """Return whether a model was calibrated, and on none of these data. What only validated it was not seen.

    A record with further columns is the same record.
    """
    named = base.provenance.get("data")
    sources = [one for one in named if isinstance(one, dict)] if isinstance(named, list) else []
    used = [one for one in sources if one.get("role") != "validation"]
    known = [one.get(key) for one in used for key in ("sha256", "t_q_sha256")]
    return bool(used) and not any(origin.is_in(known) for one in measured for origin in one.origins)


def _stored(base: ThermalModel, sources: list[dict[str, Any]], found: Diagnosis, verdict: str) -> ThermalModel:
    """Return the extended model as in its file, with its provenance."""
    provenance = {
        "diagnosis": {
            "source": f"compensator {__version__} diagnose",
            "base_model_sha256": base.sha256,
            "data": sources,
            "verdict": verdict,
            "held_out": found.held_out,
            "held_out_rms_um": {"before": found.before.rms_um, "after": found.after.rms_um},
            **({"since_h": found.since_h} if found.since_h else {}),
        }
    }
    return as_in_file(found.model, provenance)
