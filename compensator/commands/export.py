"""`compensator export`: a recording as a table."""

from __future__ import annotations

import argparse

from compensator.commands import Answer
from compensator.export import export


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    CompensatorError
        If the recording cannot be read.
    """
    samples = export(arguments.recording, arguments.out, arguments.machine)
    return Answer({"samples": samples, "out": str(arguments.out)}, f"{samples} samples → {arguments.out}")
