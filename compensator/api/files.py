"""Models as stored in their files, curves as CSV, and pages in every format."""

from __future__ import annotations

import csv
import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compensator.arrays import Vector
from compensator.atomic_write import atomic_write
from compensator.axes import FIRST
from compensator.data.axes import AxisLike, asked_axes
from compensator.display import Shown
from compensator.errors import ModelError, UsageError, of_files
from compensator.model.model_file import load_axes, load_model, parse_axes
from compensator.model.model_writer import bytes_of
from compensator.model.simulation import csv_rows
from compensator.model.thermal_model import ThermalModel

if TYPE_CHECKING:
    from compensator.api.plotting import Panel, Plot
    from compensator.report.page import Page

ModelLike = ThermalModel | Mapping[str, ThermalModel] | str | os.PathLike[str]


def model_of(model: ModelLike) -> ThermalModel:
    """Return a model: a model itself, the model of a result, from a file, or the published one by its name.

    Of several axes, that of Y.

    Raises
    ------
    ModelError
        If the file cannot be read.
    UsageError
        If the argument has another type.
    """
    own = getattr(model, "model", model)
    if isinstance(own, ThermalModel):
        return own
    if isinstance(own, (str, os.PathLike)):
        return load_model(Path(own))
    return models_of(own, FIRST)[FIRST]


def models_of(model: ModelLike, axis: AxisLike = None) -> dict[str, ThermalModel]:
    """Return the models of all axes, or of those asked for, by axis; `model` as for `model_of`.

    Raises
    ------
    ModelError
        If the file cannot be read, or an axis that is asked for is missing.
    UsageError
        If the argument has another type.
    """
    own = getattr(model, "model", model)
    if isinstance(own, ThermalModel):
        found = {own.axis: own}
    elif isinstance(own, (str, os.PathLike)):
        found = load_axes(Path(own))
    elif isinstance(own, Mapping) and own and all(isinstance(one, ThermalModel) for one in own.values()):
        found = dict(own)
    else:
        raise UsageError(f"model: {type(model).__name__}, expected a model, a result, a path, or the name of a model")
    asked = asked_axes(axis)
    for name in asked:
        if name not in found:
            has = ", ".join(found)
            raise ModelError(f"model {next(iter(found.values())).name}: no axis {name}; it has: {has}")
    return {name: found[name] for name in asked or found}


def as_in_file(model: ThermalModel, provenance: Mapping[str, Any]) -> ThermalModel:
    """Return a model with its provenance as read back from its file, with the file's hash.

    Raises
    ------
    ModelError
        If it cannot be stored in a file.
    """
    whole = dataclasses.replace(model, provenance=dict(model.provenance) | dict(provenance))
    return axes_as_in_file({model.axis: whole})[model.axis]


def axes_as_in_file(models: Mapping[str, ThermalModel]) -> dict[str, ThermalModel]:
    """Return the models of all axes as read back from their file, with the file's hash.

    Raises
    ------
    ModelError
        If they cannot be stored in a file.
    """
    return parse_axes(bytes_of(models), source=next(iter(models.values())).name)


@of_files()
def write_curves(path: str | os.PathLike[str], columns: dict[str, Vector]) -> Path:
    """Write columns that have a `t_s` as CSV; a missing value is an empty cell.

    Raises
    ------
    CompensatorError
        If the file cannot be written.
    """
    with atomic_write(Path(path), may_stream=True) as file:
        csv.writer(file, lineterminator="\n").writerows(csv_rows(columns))
    return Path(path)


class Plotted(Shown):
    """A result that a notebook plots."""

    __slots__ = ()

    def panels(self) -> list[Panel]:
        """Return the curves of the plot."""
        raise NotImplementedError

    def plot(self) -> Plot:
        """Plot the curves of `panels` over time."""
        from compensator.api.plotting import stacked

        return stacked(self.panels())[0]


class Paged(Shown):
    """A result that also has a page."""

    __slots__ = ()

    def as_page(self) -> Page:
        """Return the content of the page."""
        raise NotImplementedError

    def page(self, path: str | os.PathLike[str]) -> Path:
        """Write the page: .html, .pdf, or .png for its first figure.

        Raises
        ------
        CompensatorError
            If the name has another ending, it cannot be written, or there is no browser to print with.
        """
        from compensator.report.formats import checked

        return self.write_page(checked(Path(path), option="page"))

    @of_files()
    def write_page(self, path: Path, also: Path | None = None) -> Path:
        """Write the page, and also to another file in the format of its suffix."""
        from compensator.report.formats import write

        page = self.as_page()
        for target in filter(None, (path, also)):
            write(target, page)
        return path
