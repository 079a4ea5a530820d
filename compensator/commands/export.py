"""`compensator export`: write recordings as a table."""

from __future__ import annotations

import argparse

from compensator.commands import Answer
from compensator.data.export import export


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    out = arguments.out
    out.parent.mkdir(parents=True, exist_ok=True)
    samples = export(arguments.recording, out, arguments.machine)
    return Answer({"samples": samples, "out": str(out)}, f"{samples} samples → {out}")
