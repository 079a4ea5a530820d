"""The commands: one file each, named in `compensator.cli` and loaded when they are called."""

from __future__ import annotations

from typing import Any, NamedTuple


class Answer(NamedTuple):
    """Result of a command.

    Parameters
    ----------
    result : dict
        For `--json`.
    text : str
        Text for people.
    code : int
        Exit code: 0 done, 1 failed, 3 an audit found a difference.
    """

    result: dict[str, Any]
    text: str
    code: int = 0
