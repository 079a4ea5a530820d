"""The result of `tc.identify` for several axes: their models, and what they have in common."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compensator.api.axis_results import AxisModels
from compensator.api.identification_result import IdentificationResult
from compensator.axes import label_of
from compensator.codes import Remark
from compensator.display import Listing, Table, Words, listed, warnings_of, with_std
from compensator.errors import of_files
from compensator.identify.pairs import Pair
from compensator.identify.summary import MODEL, estimates
from compensator.model.free_run import NOTHING
from compensator.model.model_writer import write_axes
from compensator.tilt_lines import tilt_lines

if TYPE_CHECKING:
    from compensator.report.page import Page


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class IdentifiedAxes(AxisModels[IdentificationResult]):
    """Identified models of several axes of a machine.

    Parameters
    ----------
    results : dict of str to IdentificationResult
        Each axis.
    shared : tuple of tuple of str
        Axes that have common time constants.
    alone_rms_um : dict of str to float
        Error of each axis on held-out blocks of time with time constants of its own, µm.
    pairs : tuple of Pair
        Probes that are probably two of one direction.
    """

    results: Mapping[str, IdentificationResult]
    shared: tuple[tuple[str, ...], ...] = ()
    alone_rms_um: Mapping[str, float] = field(default_factory=dict)
    pairs: tuple[Pair, ...] = ()

    @property
    def params(self) -> dict[str, dict[str, float]]:
        """Gains at rest and time constants of each axis, as `model` by axis: `found.params["z"]["dtf_gain_um_per_w"]`.

        The names are those of one axis alone.
        """
        return {axis: result.params for axis, result in self.results.items()}

    @property
    def std_errors(self) -> dict[str, dict[str, float]]:
        """Standard errors of `params`, by the same names."""
        return {axis: result.std_errors for axis, result in self.results.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return all figures, as `compensator identify --json` prints them."""
        return {
            "axes": {axis: result.to_dict() for axis, result in self.results.items()},
            "shared_time_constants": [list(group) for group in self.shared],
            "alone_folds_rms_um": dict(self.alone_rms_um),
            "pairs": [
                {
                    "probes": [one.first, one.second],
                    "correlation": one.correlation,
                    "ratio": one.ratio,
                    "apart_um": one.apart_um,
                    "why": str(one),
                }
                for one in self.pairs
            ],
            "tilt_lines": self.tilt_lines(),
        }

    def contents(self) -> Sequence[str | Table | Words | Listing]:
        """Return the content: the sentence on the machine, a column for each axis, pairs, warnings of each axis."""
        name = next(iter(self.results.values())).model.name
        parts: list[str | Table | Words | Listing] = [
            f"model {name} of the axes {_names(self.results)}",
            self.verdict(),
        ]
        parts.append(self.table())
        if self.pairs:
            parts.append(Words(title="Pairs of probes", lines=[str(one) for one in self.pairs]))
            parts.append(
                Listing(
                    title="Lines for the configuration, if a pair measures a tilt; fill in what the data do not show",
                    lines=self.tilt_lines(),
                )
            )
        warned: dict[Remark, list[str]] = {}
        for axis, result in self.results.items():
            for warning in result.words(result.criticism.warnings):
                warned.setdefault(warning, []).append(axis)
        parts += warnings_of(warning.worded(f"{_names(axes)}: {warning}") for warning, axes in warned.items())
        remarks = dict.fromkeys(text for one in self.results.values() for text in one.words(one.calibration.remarks))
        return [*parts, *([Words(title="Remarks on the data", lines=list(remarks))] if remarks else [])]

    def tilt_lines(self) -> str:
        """Return the lines of a configuration for the tilts that the pairs measure; empty without pairs."""
        against = [(one.first, one.second) for one in self.pairs if one.correlation < 0.0]
        return tilt_lines(((one.first, one.second, one.apart_um) for one in self.pairs), against=against)

    def verdict(self) -> str:
        """Return what is said of the machine, in a few sentences."""
        alone = [axis for axis in self.results if not any(axis in group for group in self.shared)]
        words = [f"{_names(group)} have common time constants, {self._times(group[0])} min" for group in self.shared]
        words += [f"{label_of(axis)} has its own, {self._times(axis)} min" for axis in alone]
        errors = ", ".join(
            f"{label_of(axis)} {result.calibration.folds_rms_um:.2f} µm" for axis, result in self.results.items()
        )
        return f"{'; '.join(words)}. Errors on held-out blocks of time, rms: {errors}."

    def _times(self, axis: str) -> str:
        return listed([f"{float(f'{tau:.3g}'):g}" for tau in self.results[axis].calibration.deformation.main.taus_min])

    def table(self) -> Table:
        """Return gains, time constants and errors, with a column for each axis."""
        results = list(self.results.values())
        found = [estimates(result.criticism) for result in results]
        names = dict.fromkeys(name for one in found for name in one)
        labels = {name: one[name] for one in found for name in one}
        rows = [
            [
                f"{labels[name].label}, {labels[name].unit}",
                *(with_std(one[name].value, one[name].std) if name in one else "" for one in found),
            ]
            for name in sorted(names, key=lambda each: (each.split("_")[0] == "tdtf", each.split("_")[0] == "dtf"))
        ]
        groups = {axis: group for group in self.shared for axis in group}
        others = {axis: [one for one in groups.get(axis, ()) if one != axis] for axis in self.results}
        rows.append(["time constants shared with", *(_names(others[axis]) or "–" for axis in self.results)])
        rows.append(["held-out blocks, rms µm", *(f"{one.calibration.folds_rms_um:.2f}" for one in results)])
        rows.append(["the same alone", *(f"{self.alone_rms_um.get(axis, np.nan):.2f}" for axis in self.results)])
        for label, name in (("free run about the zero, rms µm", MODEL), (f"the same, {NOTHING}", NOTHING)):
            rows.append([label, *(_worst(result, name) for result in results)])
        return Table(
            title="Axes",
            head=["", *map(label_of, self.results)],
            rows=rows,
            note="The heat is estimated once for all axes. Held-out blocks: zero and initial state are fitted. Alone: "
            "with time constants of its own. Free run: as the service runs, the worst of all data.",
        )

    @of_files()
    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the model file of all axes.

        Raises
        ------
        CompensatorError
            If the folder does not exist, or the file cannot be written.
        """
        write_axes(Path(path), self.model)
        return Path(path)

    def as_page(self) -> Page:
        """Return the page: what is said of the machine, a column for each axis, and a section for each."""
        from compensator.report.axes import page_of_axes

        pages = {axis: result.as_page() for axis, result in self.results.items()}
        blocks = [part for part in self.contents()[2:] if not isinstance(part, str)]
        return page_of_axes(pages, self.verdict(), blocks)


def _names(axes: Sequence[str] | Mapping[str, Any]) -> str:
    """Return axes by name, such as "X, Y and Z"."""
    return listed([label_of(axis) for axis in axes])


def _worst(result: IdentificationResult, name: str) -> str:
    values = [one.scores[name].rms_um for one in result.free_run if name in one.scores]
    return f"{max(values):.2f}" if values else "–"
