"""`compensator export`: write recordings as a table."""

from __future__ import annotations

import argparse

from compensator.commands import Answer
from compensator.commands.outputs import checked_file
from compensator.data.export import export
from compensator.recording.reading import recordings_in


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    out = checked_file(arguments.out, "--out", read=recordings_in(arguments.recording), ending=".csv")
    out.parent.mkdir(parents=True, exist_ok=True)
    samples = export(arguments.recording, out, arguments.machine)
    return Answer({"samples": samples, "out": str(out)}, f"{samples} samples → {out}")
