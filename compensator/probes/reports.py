"""What sources report, each line with its code: a line that is not sent, a source that is lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from compensator.codes import ProbeSourceRemark, Remark
from compensator.errors import one_line

#: Called with each line for the log.
Report = Callable[[str], None]
#: Longest part of a line in a report, characters.
SHOWN = 120


def not_sent(code: ProbeSourceRemark, source: str | Path, line: str | None, why: str, *, count: str = "") -> str:
    """Return the report on what is not sent.

    Parameters
    ----------
    code : ProbeSourceRemark
        Why.
    source : str or pathlib.Path
        Control or file.
    line : str or None
        The line; None where it is not one line.
    why : str
        The reason in words.
    count : str
        How many there were.
    """
    shown = f"{line[:SHOWN]!r}: " if line is not None else ""
    return Remark(code, one_line(f"{source}: not sent{count}: {shown}{why}.")).marked


def lost(source: str | Path, why: object) -> str:
    """Return the report on a source that is lost."""
    return Remark(ProbeSourceRemark.SOURCE_LOST, one_line(f"{source}: {why}.")).marked
