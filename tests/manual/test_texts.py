"""Texts of users: all are found by the script that lists them, and none has words that the glossary has replaced."""

from __future__ import annotations

import re
from pathlib import Path

from compensator.commands.catalog import COMMANDS
from tests.manual.texts import codes, helps, in_live_page, in_sources, page, sentences

#: Words that had to be read twice, or mean nothing to an engineer who did not write them.
REPLACED = re.compile(
    r"\bMIND\b|\bNO\b|less than everything|behind the colon|after the colon|judged|\bin turn\b|went from|"
    r"hardly determined|at its heart|not to be had|goes with|nothing has spoken|next to nothing|needs? a person\b"
)


def test_no_text_has_a_word_that_was_replaced() -> None:
    found = [(where, text) for part in (codes, helps, in_live_page, in_sources) for where, text in part()]
    assert len(found) > 1500
    # "NO" alone is the name of a pin or a country; as an answer it is a word of its own.
    assert [pair for pair in found if REPLACED.search(pair[1])] == []


def test_every_command_is_listed() -> None:
    listed = {where.split()[1] for where, _ in helps() if where.count(" ") == 1}
    assert {command.name for command in COMMANDS} <= listed


def test_a_sentence_is_found_with_its_values_left_out_and_docstrings_are_not(tmp_path: Path) -> None:
    source = tmp_path / "a.py"
    source.write_text('"""A docstring of some words."""\nX = f"the value {x:.2f} is too large"\nY = "a key"\n')
    assert list(sentences(source)) == [(2, "the value … is too large")]


def test_the_page_has_all_parts() -> None:
    assert [block.title.split(":")[0] for block in page().blocks] == [
        "Codes",
        "Help of the commands",
        "The live page",
        "Sentences in the sources",
    ]
