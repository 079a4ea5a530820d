"""`compensator simulate`: run a model over measured data."""

from __future__ import annotations

import argparse
import logging

from compensator.api.simulation import simulate
from compensator.commands import Answer
from compensator.data.table import roles_of

log = logging.getLogger("compensator")


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    given = arguments
    columns = roles_of(given.column)
    options = {"columns": columns, "axis": given.axis, "correct": given.correct, "y_std_um": given.y_std}
    found = simulate(given.model, given.data, **options)
    for remark in found.remarks:
        log.warning("%s", remark.marked)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    found.save(given.out)
    return Answer(found.to_dict() | {"out": str(given.out)}, f"{found.summary()}\ntable: {given.out}")
