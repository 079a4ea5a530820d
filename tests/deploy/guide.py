"""The pages of deploy that have commands; their table of codes (`python -m tests.deploy.guide` renews it)."""

from __future__ import annotations

import re
import shlex

from compensator.codes import WORDS
from tests.deploy.conftest import ROOT

GUIDE = ROOT / "deploy/README.md"
OPERATING = ROOT / "deploy/OPERATING.md"
_BEGIN = "<!-- states: made from compensator/codes.py by `python -m tests.deploy.guide` -->\n"
_END = "<!-- end of states -->"


#: The last code of the service's messages; those after it belong to warnings and audits, which print them with words.
LAST = "t_q_below_at"


def table() -> str:
    """Return the table of the codes of the service's messages: states, reasons, qualities."""
    codes = list(WORDS)[: list(WORDS).index(LAST) + 1]
    rows = [f"| `{code}` | {WORDS[code][0]} | {WORDS[code][1]} |" for code in codes]
    return "\n".join(["| code | what it means | what to do |", "| --- | --- | --- |", *rows]) + "\n"


def with_table(text: str) -> str:
    """Return a page with the table as it should be."""
    before, _, rest = text.partition(_BEGIN)
    _, _, after = rest.partition(_END)
    return before + _BEGIN + table() + _END + after


def commands(text: str) -> list[list[str]]:
    """Return the command lines of a page's blocks, without what only says who gives them."""
    blocks = re.findall(r"^```\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    lines = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines() if line.strip()]
    for words in lines:
        if words[0] == "sudo":
            del words[0 : 3 if words[1] == "-u" else 1]
    return lines


if __name__ == "__main__":
    OPERATING.write_text(with_table(OPERATING.read_text(encoding="utf-8")), encoding="utf-8")
