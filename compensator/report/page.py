"""A self-contained HTML page: the verdict, the figure that supports it, tables, and folded details.

A page loads nothing and runs no script but its own, which zooms plots and shows their values; its content security
policy enforces both. Without the script, and in print, a page shows the same. Figures are SVG with CSS variables as
colours, so that one page suits light and dark screens and paper. Each code on a page links to its meaning and action
at the end of the page.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import chain, count, repeat
from pathlib import Path
from typing import Any, Literal

from compensator import __version__
from compensator.atomic_write import atomic_write
from compensator.codes import explain
from compensator.display import Cell, CodeLink, Link, Listing, Table, Words, sentence_of, text_of, warnings_of
from compensator.report.cursor import script, script_hash
from compensator.report.drawing import WIDTH_IN, svg
from compensator.report.figure import Bar, Figure, Line, Marks, Span, Stems, Strip
from compensator.report.local_time import today

Tone = Literal["good", "warn", "bad"]
#: Width of a figure in a row of several, inches: the text stays readable.
_NARROW_IN = 4.8
#: Longest cell on one line, and longest unbroken word (a file name, a hash), characters.
_LONGEST_CELL, _LONGEST_WORD = 36, 24
TONE_WORDS: Mapping[Tone, str] = {"good": "✓ Passed", "warn": "⚠ Caution", "bad": "✗ Failed"}
#: Most names of files in the last line of a page; of more, the first and the last.
MOST_NAMES = 3
#: A command in a text, shown as the code that it is.
_COMMAND = re.compile(r"`([^`]+)`")
#: Who made a page, near its beginning in each format.
GENERATOR = f"quill-compensator {__version__}"
#: A page needs inline styles only, and the script by its hash.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Figures side by side where the page is wide enough."""

    figures: tuple[Figure, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Details:
    """Blocks that are folded on a screen and open on paper."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Blocks below a heading."""

    title: str
    blocks: Sequence[Block]


Block = Figure | Row | Table | Words | Listing | Details | Section


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """A page.

    Parameters
    ----------
    title, verdict : str
        The subject, and the result in one sentence.
    blocks : sequence of Block
        The content, in order.
    tone : {"good", "warn", "bad"} or None
        Shown with the verdict as a sign, a word and a colour.
    data : sequence of str
        Names of the files or tables that it is made from, for its last line.
    """

    title: str
    verdict: str
    blocks: Sequence[Block] = field(default_factory=tuple)
    tone: Tone | None = "good"
    data: Sequence[str] = ()


def html_of(page: Page, *, date: str = "", can_zoom: bool = True) -> str:
    """Return a page as HTML.

    Parameters
    ----------
    page : Page
        Its content.
    date : str
        Date for its last line.
    can_zoom : bool
        With the script that zooms its plots, where it has any; without, no script runs.
    """
    style = resources.files("compensator.report").joinpath("style.css").read_text(encoding="utf-8")
    title = html.escape(page.title)
    numbers = count(1)
    body = "".join(_block(block, numbers, 2) for block in page.blocks)
    zooms = can_zoom and " data-plot=" in body
    policy = f"{_POLICY}; script-src {script_hash()}" if zooms else _POLICY
    tone = f"<b>{TONE_WORDS[page.tone]}</b>" if page.tone else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta name="generator" content="{GENERATOR}"><title>{title}</title>'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{style}</style></head><body>'
        f'<main><h1>{title}</h1><p class="verdict {page.tone or "plain"}">{tone}'
        f"{html.escape(page.verdict)}</p>{body}{_glossary(page.blocks)}{_origin(page, date)}</main>"
        f"{f'<script>{script()}</script>' if zooms else ''}</body></html>"
    )


def files_of(provenance: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the names of files, or of tables in memory, that a model states as its data."""
    return tuple(str(one.get("file") or one["table"]) for one in provenance)


def _names(files: Sequence[str]) -> str:
    """Return the names of files, each once; of many the first and the last.

    Examples
    --------
    >>> _names(["a.csv", "b.csv", "a.csv"])
    'a.csv, b.csv'
    >>> _names(["monday.mcap", "tuesday.mcap", "wednesday.mcap", "friday.mcap"])
    'monday.mcap to friday.mcap (4 files)'
    """
    names = list(dict.fromkeys(files))
    return f"{names[0]} to {names[-1]} ({len(names)} files)" if len(names) > MOST_NAMES else ", ".join(names)


def _origin(page: Page, date: str) -> str:
    """Return the last line: version, date, data."""
    parts = [GENERATOR, date, f"data: {_names(page.data)}" if page.data else ""]
    return f'<p class="note">{html.escape(", ".join(filter(None, parts)))}.</p>'


def write_page(path: Path, page: Page) -> Path:
    """Write a page as HTML.

    Parameters
    ----------
    path : pathlib.Path
        The HTML file.
    page : Page
        Its content.

    Returns
    -------
    pathlib.Path
        The same path.
    """
    with atomic_write(path) as file:
        file.write(html_of(page, date=today()))
    return path


def codes_of(blocks: Iterable[Block]) -> list[str]:
    """Return all explained codes in blocks, in order of appearance."""
    words: dict[str, None] = {}
    for block in blocks:
        for cell in _cells(block):
            for part in cell if isinstance(cell, tuple) else (cell,):
                if isinstance(part, CodeLink) and explain(part.code) is not None:
                    words[part.word] = None
    return list(words)


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
    """Return meaning and action of every code on the page."""
    entries = []
    for word in codes_of(blocks):
        meaning, action = explain(word) or ("", "")
        entries.append(
            f'<div id="word-{html.escape(word)}"><dt><code>{html.escape(word)}</code></dt>'
            f"<dd>{_inline(meaning)}</dd><dd><b>Action:</b> {_inline(action)}</dd></div>"
        )
    return f"<section><h2>Codes</h2><dl>{''.join(entries)}</dl></section>" if entries else ""


def _figure(figure: Figure, numbers: Iterator[int], width: float) -> str:
    note = f"<p>{html.escape(figure.note)}</p>" if figure.note else ""
    picture = svg(figure, f"f{next(numbers)}", width)
    if width > _NARROW_IN:
        label = html.escape(figure.title or "plot")
        picture = (
            f'<div class="scroll" role="region" aria-label="{label}" tabindex="0">'
            f'<div class="wide">{picture}</div></div>'
        )
    return f"<figure><figcaption>{html.escape(figure.title)}</figcaption>{picture}{note}</figure>"


def _block(block: Block, numbers: Iterator[int], level: int) -> str:
    if isinstance(block, Figure):
        return _figure(block, numbers, WIDTH_IN)
    if isinstance(block, Row):
        return f'<div class="row">{"".join(_figure(figure, numbers, _NARROW_IN) for figure in block.figures)}</div>'
    if isinstance(block, Table):
        return _table(block, level)
    if isinstance(block, Words):
        items = "".join(f"<li>{_inline(line)}</li>" for line in block.lines)
        sign = '<span aria-hidden="true">⚠ </span>' if block.kind == "warning" else ""
        return f'<div class="words {block.kind}">{_heading(block.title, level, sign)}<ul>{items}</ul></div>'
    if isinstance(block, Listing):
        title = html.escape(block.title)
        return (
            f'<p>{title}:</p><div class="scroll" role="region" aria-label="{title}" tabindex="0">'
            f"<pre>{html.escape(block.lines)}</pre></div>"
        )
    inner = "".join(_block(part, numbers, level + 1) for part in block.blocks)
    if isinstance(block, Details):
        return f"<details><summary>{_heading(block.title, level)}</summary>{inner}</details>"
    return f"<section>{_heading(block.title, level)}{inner}</section>"


def _heading(words: str, level: int, sign: str = "") -> str:
    tag = f"h{min(level, 6)}"
    return f"<{tag}>{sign}{html.escape(words)}</{tag}>"


def _table(table: Table, level: int) -> str:
    classes = _classes(table)
    head = "".join(map(_cell, table.head, classes, repeat("col"))) if any(table.head) else ""
    rows = "".join(f"<tr>{''.join(map(_cell, row, classes, chain(['row'], repeat(''))))}</tr>" for row in table.rows)
    title = _heading(table.title, level) if table.title else ""
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    label = html.escape(table.title or "table")
    return (
        f'{title}<div class="scroll" role="region" aria-label="{label}" tabindex="0"><table>'
        f"{f'<thead><tr>{head}</tr></thead>' if head else ''}<tbody>{rows}</tbody></table></div>{note}"
    )


def _classes(table: Table) -> list[str]:
    """Return the class of each column: words, sentences, long names, or numbers."""
    classes = []
    for i, numeric in enumerate(table.numeric()):
        cells = [text_of(row[i]) for row in table.rows if i < len(row)]
        if numeric:
            classes.append("")
        elif max(map(len, cells), default=0) > _LONGEST_CELL:
            classes.append("text long")
        elif any(len(word) > _LONGEST_WORD for cell in cells for word in cell.split()):
            classes.append("text name")
        else:
            classes.append("text")
    return classes


def _cell(cell: Cell, kind: str, scope: str) -> str:
    """Return a cell; an empty cell is not a header."""
    style = f' class="{kind}"' if kind else ""
    return f'<th scope="{scope}"{style}>{_inline(cell)}</th>' if scope and cell else f"<td{style}>{_inline(cell)}</td>"


def _inline(cell: Cell) -> str:
    if isinstance(cell, tuple):
        return "".join(map(_inline, cell))
    if isinstance(cell, Link):
        return f'<a href="{html.escape(cell.href)}">{html.escape(cell.text)}</a>'
    if isinstance(cell, CodeLink):
        code = f"<code>{html.escape(cell.code)}</code>"
        return code if explain(cell.code) is None else f'<a href="#word-{html.escape(cell.word)}">{code}</a>'
    return _COMMAND.sub(r"<code>\1</code>", html.escape(cell))


# Figures are blocks of a page, too.
__all__ = [
    "Bar",
    "Block",
    "Cell",
    "CodeLink",
    "Details",
    "Figure",
    "Line",
    "Link",
    "Listing",
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
    "html_of",
    "sentence_of",
    "warnings_of",
    "write_page",
]
