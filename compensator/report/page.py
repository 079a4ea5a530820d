"""A self-contained HTML page: verdict first, then the picture that carries it, then tables, then details to open.

Nothing is loaded from anywhere, no script runs. Pictures are SVG whose colours are CSS variables, so that one
page serves a light and a dark screen and paper.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import count
from pathlib import Path
from typing import Literal

from compensator.report.figure import Figure, Line, Marks, Span, Stems, svg

Tone = Literal["good", "warn", "bad"]
_TONE_WORDS: dict[Tone, str] = {"good": "✓ good", "warn": "⚠ mind", "bad": "✗ no"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Pictures side by side where there is room."""

    figures: tuple[Figure, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table with a header row; the first column is text, the others numbers."""

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
    return f"<figure><figcaption>{html.escape(figure.title)}</figcaption>{picture}{note}</figure>"


def _block(block: Block, numbers: Iterator[int], level: int) -> str:
    if isinstance(block, Figure):
        return _figure(block, numbers, 9.0)
    if isinstance(block, Row):
        return f'<div class="row">{"".join(_figure(figure, numbers, 4.8) for figure in block.figures)}</div>'
    if isinstance(block, Table):
        return _table(block, level)
    heading = html.escape(block.title)
    if isinstance(block, Words):
        items = "".join(f"<li>{html.escape(line)}</li>" for line in block.lines)
        return f'<div class="words {block.kind}"><h{level}>{heading}</h{level}><ul>{items}</ul></div>'
    inner = "".join(_block(part, numbers, level + 1) for part in block.blocks)
    if isinstance(block, Details):
        return f"<details><summary>{heading}</summary>{inner}</details>"
    return f"<section><h{level}>{heading}</h{level}>{inner}</section>"


def _table(table: Table, level: int) -> str:
    head = "".join(f'<th scope="col">{html.escape(cell)}</th>' for cell in table.head)
    rows = "".join(
        "<tr>"
        + "".join(
            f'<th scope="row">{html.escape(cell)}</th>' if i == 0 else f"<td>{html.escape(cell)}</td>"
            for i, cell in enumerate(row)
        )
        + "</tr>"
        for row in table.rows
    )
    title = f"<h{level}>{html.escape(table.title)}</h{level}>" if table.title else ""
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    return (
        f'{title}<div class="scroll" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>{note}"
    )


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
    "Words",
    "write_page",
]
