"""The commands: one module each, listed in `catalog` and imported when called."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from compensator.codes import Remark

log = logging.getLogger("compensator")


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


def log_warnings(source: object, warnings: Iterable[Remark]) -> None:
    """Log warnings about a file, each with its code."""
    for warning in warnings:
        log.warning("%s: warning: %s", source, warning.marked)


def warnings_as_json(warnings: Sequence[Remark]) -> dict[str, Any]:
    """Return warnings and their codes for the JSON result of a command."""
    return {"warnings": list(warnings), "warning_codes": [warning.code for warning in warnings]}
