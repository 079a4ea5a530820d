"""A self-contained HTML page: verdict first, then the picture that carries it, then tables, then details to open.

Nothing is loaded from anywhere, no script runs. Pictures are SVG whose colours are CSS variables, so that one
page serves a light and a dark screen and paper. What a code means and what to do stands at the end of each page that
shows one, and every code leads there.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import count
from pathlib import Path
from typing import Literal

from compensator.reasons import Remark, explain
from compensator.report.drawing import svg
from compensator.report.figure import Figure, Line, Marks, Span, Stems, Strip

Tone = Literal["good", "warn", "bad"]
#: Widths of a picture alone and of one in a row, inches: the text of each stays readable in its place.
_WIDE_IN, _NARROW_IN = 9.0, 4.8
#: What a cell of a column of numbers looks like: digits, signs, errors, percent; a value that is missing.
_NUMBER = re.compile(
    r"[-+−±–]?\s*\d[\d.,\s]*([eE][-+−]?\d+)?(\s*±\s*\d[\d.,eE+−-]*)?\s*%?(\s*\(.*\))?|nan|[-+−]?(inf|∞)|[-–—]"
)
#: Longest cell that stays on one line, letters.
_SENTENCE = 36
#: Longest name of a file, or hash, that stays on one line, letters.
_UNBROKEN = 24
#: Heading of what the codes on a page mean.
GLOSSARY = "What the words mean, and what to do"
TONE_WORDS: dict[Tone, str] = {"good": "✓ good", "warn": "⚠ mind", "bad": "✗ no"}


@dataclass(frozen=True, slots=True)
class Code:
    """A state, reason, quality or warning; leads to its sentences at the end of the page.

    Parameters
    ----------
    code : str
        Such as `hold`, or `outside_validity:t_q_degc`.
    """

    code: str

    @property
    def word(self) -> str:
        """The code without what it applies to."""
        return self.code.split(":", maxsplit=1)[0]


@dataclass(frozen=True, slots=True)
class Link:
    """Leads to another page.

    Parameters
    ----------
    text, href : str
        What is read, and a relative address.
    """

    text: str
    href: str


#: What stands in a cell or a line: words, or words with codes and links between them.
Cell = str | Code | Link | tuple[str | Code | Link, ...]


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
    rows : sequence of sequence of Cell
        The first cell names the row. Columns of numbers stand right, others left.
    note : str
        A sentence below.
    """

    title: str = ""
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Words:
    """Sentences; a `warning` is marked as one."""

    title: str
    lines: Sequence[Cell]
    kind: Literal["warning", "plain"] = "plain"


def warnings_of(cautions: Iterable[Remark]) -> Words:
    """Return warnings as a block; each leads to its sentences at the end of the page."""
    return Words(title="Warnings", lines=[sentence_of(said) for said in cautions], kind="warning")


def sentence_of(caution: Remark) -> Cell:
    """Return a warning or remark as a line; its code leads to its sentences at the end of the page."""
    return (str(caution), " ", Code(caution.code))


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


def html_of(page: Page) -> str:
    """Return a page as HTML.

    Parameters
    ----------
    page : Page
        What stands on it.
    """
    style = resources.files("compensator.report").joinpath("style.css").read_text(encoding="utf-8")
    title = html.escape(page.title)
    numbers = count(1)
    body = "".join(_block(block, numbers, 2) for block in page.blocks)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{style}</style></head><body>'
        f'<main><h1>{title}</h1><p class="verdict {page.tone}"><b>{TONE_WORDS[page.tone]}</b>'
        f"{html.escape(page.verdict)}</p>{body}{_glossary(page.blocks)}</main></body></html>"
    )


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
    path.write_text(html_of(page), encoding="utf-8")
    return path


def codes_of(blocks: Iterable[Block]) -> list[str]:
    """Return the words of all codes in blocks that have an explanation, in the order in which they come."""
    words: dict[str, None] = {}
    for block in blocks:
        for cell in _cells(block):
            for part in cell if isinstance(cell, tuple) else (cell,):
                if isinstance(part, Code) and explain(part.code) is not None:
                    words[part.word] = None
    return list(words)


def text_of(cell: Cell) -> str:
    """Return a cell as words."""
    if isinstance(cell, tuple):
        return "".join(map(text_of, cell))
    return cell if isinstance(cell, str) else cell.code if isinstance(cell, Code) else cell.text


def _cells(block: Block) -> Iterator[Cell]:
    if isinstance(block, Table):
        for row in block.rows:
            yield from row
    elif isinstance(block, Words):
        yield from block.lines
    elif isinstance(block, (Details, Section)):
        for part in block.blocks:
            yield from _cells(part)


def _glossary(blocks: Sequence[Block]) -> str:
    """Say of every code on the page what it means and what to do."""
    entries = []
    for word in codes_of(blocks):
        means, do = explain(word) or ("", "")
        entries.append(
            f'<div id="word-{html.escape(word)}"><dt><code>{html.escape(word)}</code></dt><dd>{html.escape(means)}</dd>'
            f"<dd><b>To do:</b> {html.escape(do)}</dd></div>"
        )
    return f"<section><h2>{GLOSSARY}</h2><dl>{''.join(entries)}</dl></section>" if entries else ""


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
        items = "".join(f"<li>{_inline(line)}</li>" for line in block.lines)
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
        f'{title}<div class="scroll" role="region" aria-label="{label}" tabindex="0"><table class="{_classes(table)}">'
        f"{f'<thead><tr>{head}</tr></thead>' if head else ''}<tbody>{rows}</tbody></table></div>{note}"
    )


def columns_of_words(table: Table) -> set[int]:
    """Return which columns hold words for the most part, the first being one of them; they stand left."""
    found = {0}
    for i in range(1, max((len(row) for row in table.rows), default=0)):
        cells = [text_of(row[i]) for row in table.rows if i < len(row) and row[i]]
        if 2 * sum(bool(_NUMBER.fullmatch(cell)) for cell in cells) < len(cells):
            found.add(i)
    return found


def _classes(table: Table) -> str:
    """Return the classes that set columns of words left, and break lines in those of sentences."""
    words = sorted(columns_of_words(table))
    long = [
        i for i in words if max((len(text_of(row[i])) for row in table.rows if i < len(row)), default=0) > _SENTENCE
    ]
    broken = [
        i for i in words if i not in long and any(_has_long_word(text_of(row[i])) for row in table.rows if i < len(row))
    ]
    return " ".join(
        [*(f"text-{i + 1}" for i in words), *(f"long-{i + 1}" for i in long), *(f"name-{i + 1}" for i in broken)]
    )


def _has_long_word(text: str) -> bool:
    return any(len(word) > _UNBROKEN for word in text.split())


def _cell(cell: Cell, scope: str) -> str:
    """Write a cell; one that is empty heads nothing."""
    if scope and cell:
        return f'<th scope="{scope}">{_inline(cell)}</th>'
    return f"<td>{_inline(cell)}</td>"


def _inline(cell: Cell) -> str:
    if isinstance(cell, tuple):
        return "".join(map(_inline, cell))
    if isinstance(cell, Link):
        return f'<a href="{html.escape(cell.href)}">{html.escape(cell.text)}</a>'
    if isinstance(cell, Code):
        code = f"<code>{html.escape(cell.code)}</code>"
        return code if explain(cell.code) is None else f'<a href="#word-{html.escape(cell.word)}">{code}</a>'
    return html.escape(cell)


__all__ = [
    "Block",
    "Cell",
    "Code",
    "Details",
    "Figure",
    "Line",
    "Link",
    "Marks",
    "Page",
    "Row",
    "Section",
    "Span",
    "Stems",
    "Strip",
    "Table",
    "Tone",
    "Words",
    "codes_of",
    "columns_of_words",
    "html_of",
    "text_of",
    "warnings_of",
    "write_page",
]
