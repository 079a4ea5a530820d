"""`compensator compare`: models over the same measured data, in free run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from compensator.api.comparison import compare
from compensator.commands import Answer
from compensator.commands.outputs import pages_text
from compensator.data.table import roles_of
from compensator.errors import UsageError
from compensator.model.model_file import load_axes
from compensator.model.thermal_model import ThermalModel


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    given = arguments
    models = _by_name(given.model)
    columns = roles_of(given.column)
    found = compare(models, given.data, columns=columns, axis=given.axis, from_h=given.from_h)
    result, text = found.to_dict(), found.summary()
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        found.save(given.out)
        result, text = result | {"out": str(given.out)}, f"{text}\n\ntable: {given.out}"
    if given.page is not None:
        found.write_page(given.page)
        result, text = result | {"report": str(given.page)}, f"{text}\n{pages_text(given.page, None)}"
    return Answer(result, text)


def _by_name(files: Sequence[str]) -> dict[str, dict[str, ThermalModel]]:
    """Return the models of all axes by the names of the models, or by their files where names are the same.

    Raises
    ------
    UsageError
        If a file is given twice.
    """
    for file in files:
        if files.count(file) > 1:
            raise UsageError(f"--model {file}: given {files.count(file)} times, expected each model once")
    models = [load_axes(file) for file in files]
    names = [next(iter(several.values())).name for several in models]
    return {
        name if names.count(name) == 1 else file: several
        for file, name, several in zip(files, names, models, strict=True)
    }
