"""The commissioning guide: its table of states and reasons (`python -m tests.deploy.guide` renews it), its commands."""

from __future__ import annotations

import re
import shlex

from compensator.reasons import WORDS
from tests.deploy.conftest import ROOT

GUIDE = ROOT / "deploy/README.md"
_BEGIN = "<!-- states: made from compensator/reasons.py by `python -m tests.deploy.guide` -->\n"
_END = "<!-- end of states -->"


def table() -> str:
    """Return the table of every code."""
    rows = [f"| `{code}` | {means} | {do} |" for code, (means, do) in WORDS.items()]
    return "\n".join(["| code | what it means | what to do |", "| --- | --- | --- |", *rows]) + "\n"


def with_table(text: str) -> str:
    """Return the guide with the table as it should be."""
    before, _, rest = text.partition(_BEGIN)
    _, _, after = rest.partition(_END)
    return before + _BEGIN + table() + _END + after


def commands(text: str) -> list[list[str]]:
    """Return the command lines of the guide's blocks, without what only says who gives them."""
    blocks = re.findall(r"^```\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    lines = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines() if line.strip()]
    for words in lines:
        if words[0] == "sudo":
            del words[0 : 3 if words[1] == "-u" else 1]
    return lines


if __name__ == "__main__":
    GUIDE.write_text(with_table(GUIDE.read_text(encoding="utf-8")), encoding="utf-8")
