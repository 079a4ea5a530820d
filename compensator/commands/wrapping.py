"""Text of a result for a terminal: sentences wrap at words, tables that are too wide are folded, lines to copy stay.

The style is that of `watch`: the result in bold, signs and warnings in colour, files in dim letters.
"""

from __future__ import annotations

import re
import textwrap
from itertools import groupby
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.text import Text

#: What a table has and no sentence: columns; and a line to copy: a key with its value.
_COLUMNS = re.compile(r"(?!\S+ = |\[).*\S {2,}\S")
_TO_COPY = re.compile(r"\S+ = |\[")
#: Narrowest terminal for which text is wrapped, characters.
_NARROWEST = 20
#: Beginnings of lines, and their style; the first that matches.
_STYLES = (
    (re.compile(r"✓ "), "bold green"),
    (re.compile(r"⚠ "), "bold yellow"),
    (re.compile(r"✗ "), "bold red"),
    (re.compile(r"Warnings:$"), "yellow"),
    (re.compile(r"(page|pages|table|model|folder|curves): "), "dim"),
)


def wrapped(text: str, width: int) -> str:
    r"""Wrap the sentences of a text at words, and fold tables that are wider than the terminal.

    Parameters
    ----------
    text : str
        Sentences, lists (`- …`) and tables.
    width : int
        Width of the terminal, characters.

    Examples
    --------
    >>> print(wrapped("- one two three four five\na  b", 20))
    - one two three four
      five
    a  b
    >>> print(wrapped("data     rms, µm  fit, %\nrun.csv    10.25    99.1", 20))
    run.csv
      rms, µm  10.25
      fit, %   99.1
    """
    if width < _NARROWEST or "\x1b" in text:
        return text
    parts: list[str] = []
    for is_table, group in groupby(text.split("\n"), lambda line: bool(_COLUMNS.match(line.strip()))):
        lines = list(group)
        if is_table and max(map(len, lines)) > width and len(lines) > 1:
            parts += _folded(lines, width)
        else:
            parts += [_line(line, width) for line in lines]
    return "\n".join(parts)


def styled(text: str) -> Text:
    """Return a text in the style of `watch`.

    Parameters
    ----------
    text : str
        Result of :func:`wrapped`.
    """
    from rich.text import Text

    if "\x1b" in text:
        return Text.from_ansi(text)
    found = Text()
    is_result = True
    for i, paragraph in enumerate(text.split("\n\n")):
        lines = paragraph.split("\n")
        is_table = [bool(_COLUMNS.match(line.strip())) for line in lines]
        # Above the first row stands the title; in a folded table the names of its rows do.
        titles = max((k for k, after in enumerate(is_table) if after), default=0)
        is_result = is_result and i == 0
        for k, line in enumerate(lines):
            style = next((style for start, style in _STYLES if start.match(line)), "")
            is_title = not is_table[k] and line[:1] not in " -" and (k < titles or is_result)
            found.append("\n" if k else "\n\n" if i else "")
            found.append(line, style or ("bold" if line and is_title else ""))
            # The result is the first sentence, however many lines it has.
            is_result = is_result and not line.endswith((".", ":")) and not is_table[k]
    return found


def _folded(lines: list[str], width: int) -> list[str]:
    """Return a table as lists: each row below its first cell, with the heads of the columns."""
    rows = _cells(lines)
    if len(rows[0]) < 2:
        return lines
    if len(rows[0]) == 2:
        return [part for name, value in rows for part in (name, *_below("", value, 0, width))]
    head, *body = rows
    longest = max(map(len, head[1:]))
    folded = []
    for name, *values in body:
        folded.append(name)
        for label, value in zip(head[1:], values, strict=True):
            folded += _below(label, value, longest, width)
    return folded


def _cells(lines: list[str]) -> list[list[str]]:
    """Split aligned lines where each of them has two blanks."""
    longest = max(map(len, lines))
    padded = [line.ljust(longest) for line in lines]
    blank = "".join(" " if all(line[i] == " " for line in padded) else "x" for i in range(longest))
    spans = [match.span() for match in re.finditer(r"x(?:x| (?=x))*", blank)]
    return [[line[first:last].strip() for first, last in spans] for line in padded]


def _below(label: str, value: str, longest: int, width: int) -> list[str]:
    if not value:
        return []
    start = f"  {label:<{longest}}  " if longest else "  "
    if label and len(start) + len(value) > width:
        start = f"  {label} "
    follows = "    " if label else "  "
    options = {"break_long_words": False, "break_on_hyphens": False}
    return textwrap.wrap(value, width, initial_indent=start, subsequent_indent=follows, **options)  # type: ignore[arg-type]


def _line(line: str, width: int) -> str:
    if len(line) <= width or _COLUMNS.match(line.strip()) or _TO_COPY.match(line):
        return line
    indent = re.match(r" *(- |• )?", line)
    assert indent is not None
    return textwrap.fill(
        line, width, subsequent_indent=" " * indent.end(), break_long_words=False, break_on_hyphens=False
    )
