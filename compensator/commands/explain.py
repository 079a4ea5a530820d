"""`compensator explain`: a state, reason or warning in words."""

from __future__ import annotations

import argparse

from compensator.commands import Answer
from compensator.errors import UsageError
from compensator.reasons import WORDS, explain
from compensator.receiver.reasons import WORDS as RECEIVER_WORDS


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command.

    Raises
    ------
    UsageError
        If there is no such code.
    """
    words = explain(arguments.code) or RECEIVER_WORDS.get(arguments.code)
    if words is None:
        known = ", ".join(dict.fromkeys([*WORDS, *RECEIVER_WORDS]))
        raise UsageError(f"{arguments.code}: unknown, expected one of: {known}")
    return Answer({"code": arguments.code, "means": words[0], "do": words[1]}, f"{words[0]}\n{words[1]}")
