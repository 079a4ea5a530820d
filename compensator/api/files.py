"""Models as their files hold them, and pages of every format."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from compensator.errors import UsageError
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model
from compensator.model.thermal_model import ThermalModel

ModelLike = ThermalModel | str | os.PathLike[str]


def model_of(model: ModelLike) -> ThermalModel:
    """Return a model: as it is, of a result that owns one, from a file, or the published one by its name.

    Raises
    ------
    ModelError
        If the file cannot be read.
    UsageError
        If it is something else.
    """
    own = getattr(model, "model", model)
    if isinstance(own, ThermalModel):
        return own
    if not isinstance(own, (str, os.PathLike)):
        raise UsageError(f"model: {type(model).__name__}, expected a model, a result, a path, or the name of a model")
    return load_model(Path(own))


def as_in_file(model: ThermalModel, provenance: Mapping[str, Any]) -> ThermalModel:
    """Return a model with more of where it comes from, as its file gives it back: with the file's hash.

    Raises
    ------
    ModelError
        If it holds what a file cannot.
    """
    whole = dataclasses.replace(model, provenance=dict(model.provenance) | dict(provenance))
    return parse_model(dump_model(whole).encode("utf-8"), source=model.name)


def page_in(path: str | os.PathLike[str], write_html: Callable[..., Path]) -> Path:
    """Write a page in the format that its name asks for: .html, .pdf, or .png.

    Parameters
    ----------
    path : path
        The file.
    write_html : callable
        Called with the HTML file, and with `also`, a file of another format.
    """
    from compensator.report.formats import checked

    page = checked(Path(path), option="page")
    if page.suffix.lower() == ".html":
        return write_html(page)
    with tempfile.TemporaryDirectory() as folder:
        write_html(Path(folder) / "report.html", also=page)
    return page
