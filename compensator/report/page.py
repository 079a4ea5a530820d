"""A self-contained HTML page: verdict first, then the picture that carries it, then tables, then details to open.

Nothing is loaded from anywhere, no script runs. Pictures are SVG whose colours are CSS variables, so that one
page serves a light and a dark screen and paper.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import count
from pathlib import Path
from typing import Literal

from compensator.report.figure import Figure, Line, Marks, Span, Stems, svg

Tone = Literal["good", "warn", "bad"]
#: Widths of a picture alone and of one in a row, inches: the text of each stays readable in its place.
_WIDE_IN, _NARROW_IN = 9.0, 4.8
#: What a cell of a column of numbers looks like: digits, signs, errors, percent; a value that is missing.
_NUMBER = re.compile(
    r"[-+−±–]?\s*\d[\d.,\s]*([eE][-+−]?\d+)?(\s*±\s*\d[\d.,eE+−-]*)?\s*%?(\s*\(.*\))?|nan|[-+−]?(inf|∞)|[-–—]"
)
_TONE_WORDS: dict[Tone, str] = {"good": "✓ good", "warn": "⚠ mind", "bad": "✗ no"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Pictures side by side where there is room."""

    figures: tuple[Figure, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table, which scrolls in its own box where it is too wide.

    Parameters
    ----------
    title : str
        A heading; may be empty.
    head : sequence of str
        Names of the columns; without any, there is no header row.
    rows : sequence of sequence of str
        The first cell names the row. Columns of numbers stand right, others left.
    note : str
        A sentence below.
    """

    title: str = ""
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Words:
    """Sentences; a `warning` is marked as one."""

    title: str
    lines: Sequence[str]
    kind: Literal["warning", "plain"] = "plain"


@dataclass(frozen=True, slots=True, kw_only=True)
class Details:
    """Something to open."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Blocks below a heading."""

    title: str
    blocks: Sequence[Block]


Block = Figure | Row | Table | Words | Details | Section


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """A page.

    Parameters
    ----------
    title, verdict : str
        What it is about, and the one sentence to take away.
    blocks : sequence of Block
        What follows, in order.
    tone : {"good", "warn", "bad"}
        Shown beside the verdict as colour and as a word.
    """

    title: str
    verdict: str
    blocks: Sequence[Block] = field(default_factory=tuple)
    tone: Tone = "good"


def write_page(path: Path, page: Page) -> Path:
    """Write a page.

    Parameters
    ----------
    path : pathlib.Path
        The HTML file.
    page : Page
        What stands on it.

    Returns
    -------
    pathlib.Path
        The same path.
    """
    style = resources.files("compensator.report").joinpath("style.css").read_text(encoding="utf-8")
    title = html.escape(page.title)
    numbers = count(1)
    body = "".join(_block(block, numbers, 2) for block in page.blocks)
    path.write_text(
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{style}</style></head><body>'
        f'<main><h1>{title}</h1><p class="verdict {page.tone}"><b>{_TONE_WORDS[page.tone]}</b>'
        f"{html.escape(page.verdict)}</p>{body}</main></body></html>",
        encoding="utf-8",
    )
    return path


def _figure(figure: Figure, numbers: Iterator[int], width: float) -> str:
    note = f"<p>{html.escape(figure.note)}</p>" if figure.note else ""
    picture = svg(figure, f"f{next(numbers)}", width)
    if width > _NARROW_IN:
        picture = f'<div class="scroll" tabindex="0"><div class="wide">{picture}</div></div>'
    return f"<figure><figcaption>{html.escape(figure.title)}</figcaption>{picture}{note}</figure>"


def _block(block: Block, numbers: Iterator[int], level: int) -> str:
    if isinstance(block, Figure):
        return _figure(block, numbers, _WIDE_IN)
    if isinstance(block, Row):
        return f'<div class="row">{"".join(_figure(figure, numbers, _NARROW_IN) for figure in block.figures)}</div>'
    if isinstance(block, Table):
        return _table(block, level)
    if isinstance(block, Words):
        items = "".join(f"<li>{html.escape(line)}</li>" for line in block.lines)
        sign = '<span aria-hidden="true">⚠ </span>' if block.kind == "warning" else ""
        return f'<div class="words {block.kind}">{_heading(block.title, level, sign)}<ul>{items}</ul></div>'
    inner = "".join(_block(part, numbers, level + 1) for part in block.blocks)
    if isinstance(block, Details):
        return f"<details><summary>{_heading(block.title, level)}</summary>{inner}</details>"
    return f"<section>{_heading(block.title, level)}{inner}</section>"


def _heading(words: str, level: int, sign: str = "") -> str:
    tag = f"h{min(level, 6)}"
    return f"<{tag}>{sign}{html.escape(words)}</{tag}>"


def _table(table: Table, level: int) -> str:
    head = "".join(_cell(cell, "col") for cell in table.head) if any(table.head) else ""
    rows = "".join(
        "<tr>" + "".join(_cell(cell, "" if i else "row") for i, cell in enumerate(row)) + "</tr>" for row in table.rows
    )
    title = _heading(table.title, level) if table.title else ""
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    label = html.escape(table.title or "table")
    return (
        f'{title}<div class="scroll" role="region" aria-label="{label}" tabindex="0"><table class="{_words_in(table)}">'
        f"{f'<thead><tr>{head}</tr></thead>' if head else ''}<tbody>{rows}</tbody></table></div>{note}"
    )


def _words_in(table: Table) -> str:
    """Return the classes that set columns left whose cells are words for the most part, the first being one of them."""
    classes = ["text-1"]
    for i in range(1, max((len(row) for row in table.rows), default=0)):
        cells = [row[i] for row in table.rows if i < len(row) and row[i]]
        if 2 * sum(bool(_NUMBER.fullmatch(cell)) for cell in cells) < len(cells):
            classes.append(f"text-{i + 1}")
    return " ".join(classes)


def _cell(words: str, scope: str) -> str:
    """Write a cell; one that is empty heads nothing."""
    if scope and words:
        return f'<th scope="{scope}">{html.escape(words)}</th>'
    return f"<td>{html.escape(words)}</td>"


__all__ = [
    "Block",
    "Details",
    "Figure",
    "Line",
    "Marks",
    "Page",
    "Row",
    "Section",
    "Span",
    "Stems",
    "Table",
    "Tone",
    "Words",
    "write_page",
]
