"""`compensator explain`: the meaning and action of a state, reason or warning."""

from __future__ import annotations

import argparse
import difflib

from compensator.codes import SUFFIX_WORDS, SUFFIXES, WORDS
from compensator.commands import Answer
from compensator.errors import UsageError
from compensator.receiver.reasons import WORDS as RECEIVER_WORDS


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    known = {**WORDS, **{code: words for code, words in RECEIVER_WORDS.items() if code not in WORDS}}
    if arguments.code is None:
        lines = [f"{code:<22} {means}" for code, (means, _) in known.items()]
        return Answer({code: {"means": means, "do": do} for code, (means, do) in known.items()}, "\n".join(lines))
    code = arguments.code.lower()
    name, colon, suffix = code.partition(":")
    words = known.get(name)
    if words is None:
        near = difflib.get_close_matches(code, known, n=3)
        meant = f"did you mean {', '.join(near)}?" if near else "no similar code;"
        raise UsageError(f"{arguments.code[:60]!r}: unknown code, {meant} `compensator explain` lists all codes")
    suffixes = SUFFIXES.get(name)
    if colon and (suffixes is None or not suffix or (suffixes and suffix not in suffixes)):
        known_suffixes = () if suffixes is None else suffixes or ("CHANNEL",)
        expected = ", ".join([name, *(f"{name}:{one}" for one in known_suffixes)])
        raise UsageError(f"{arguments.code}: unknown suffix {suffix!r}, expected {expected}")
    words = SUFFIX_WORDS.get(code, words)
    return Answer({"code": code, "means": words[0], "do": words[1]}, f"{words[0]}\n{words[1]}")
