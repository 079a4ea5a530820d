"""Models as stored in their files, and pages in every format."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compensator.display import Shown
from compensator.errors import UsageError
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model
from compensator.model.thermal_model import ThermalModel

if TYPE_CHECKING:
    from compensator.report.page import Page

ModelLike = ThermalModel | str | os.PathLike[str]


def model_of(model: ModelLike) -> ThermalModel:
    """Return a model: a model itself, the model of a result, from a file, or the published one by its name.

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
    if not isinstance(own, (str, os.PathLike)):
        raise UsageError(f"model: {type(model).__name__}, expected a model, a result, a path, or the name of a model")
    return load_model(Path(own))


def as_in_file(model: ThermalModel, provenance: Mapping[str, Any]) -> ThermalModel:
    """Return a model with its provenance as read back from its file, with the file's hash.

    Raises
    ------
    ModelError
        If it cannot be stored in a file.
    """
    whole = dataclasses.replace(model, provenance=dict(model.provenance) | dict(provenance))
    return parse_model(dump_model(whole).encode("utf-8"), source=model.name)


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
            If the name has another ending, or there is no browser to print with.
        """
        from compensator.report.formats import checked

        return self.write_page(checked(Path(path), option="page"))

    def write_page(self, path: Path, also: Path | None = None) -> Path:
        """Write the page, and also to another file in the format of its suffix."""
        from compensator.report.formats import write

        page = self.as_page()
        for target in filter(None, (path, also)):
            write(target, page)
        return path
