"""A page on paper: PDF with its pictures as vectors and its words as text, or a PNG of what it says first.

Made with matplotlib alone: no browser, nothing to install beside. What can be opened on a screen stands open here.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import matplotlib as mpl
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure as Canvas
from matplotlib.figure import SubFigure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from compensator.reasons import explain
from compensator.report.drawing import ON_PAPER, draw, style
from compensator.report.page import (
    GLOSSARY,
    TONE_WORDS,
    Block,
    Details,
    Figure,
    Page,
    Row,
    Section,
    Table,
    Words,
    codes_of,
    columns_of_words,
    text_of,
)

#: A4, its margin, and what is left between, inches.
_PAGE_IN, _MARGIN_IN = (8.27, 11.69), 0.7
_WIDTH_IN, _HEIGHT_IN = _PAGE_IN[0] - 2 * _MARGIN_IN, _PAGE_IN[1] - 2 * _MARGIN_IN
#: Sizes of letters, points; height of a line over the size of its letters.
_BODY_PT, _CELL_PT, _TITLE_PT, _LEADING = 9.0, 7.5, 15.0, 1.4
_HEADINGS_PT = {2: 12.0, 3: 10.5}
#: Lines and rows that stay together on a page.
_LINES, _ROWS = 12, 15
#: Between two columns, and the width that a column of words is pressed to at most, inches.
_GAP_IN, _LEAST_IN = 0.12, 0.9
#: A PNG's dots per inch.
_DPI = 150


@dataclass(frozen=True, slots=True)
class _Piece:
    """What stays together: its height in inches, and what draws it. `keep` binds it to the one that follows."""

    height: float
    draw: Callable[[SubFigure, float], None]
    keep: bool = False


@dataclass(frozen=True, slots=True)
class _Text:
    """A line of letters, `x` inches from the left; `right` ends there."""

    words: str
    x: float = 0.0
    right: bool = False
    bold: bool = False


def write_pdf(path: Path, page: Page) -> Path:
    """Write a page as PDF, A4.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    page : Page
        What stands on it.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    pieces = [*_head(page), *_blocks(page.blocks, 2), *_glossary(page)]
    # What fonts are made of while they are written is not for the terminal.
    logging.getLogger("fontTools").setLevel(logging.WARNING)
    # Type 42: letters stay letters, which can be searched and copied.
    settings = style(ON_PAPER) | {"pdf.fonttype": 42, "font.size": 9}
    about = {"Title": page.title, "Subject": page.verdict, "CreationDate": None, "Creator": None, "Producer": None}
    with mpl.rc_context(settings), PdfPages(path, metadata=about) as file:
        sheets = list(_sheets(pieces))
        for number, sheet in enumerate(sheets, start=1):
            canvas = _sheet(sheet, _HEIGHT_IN, _PAGE_IN[1])
            canvas.text(0.5, 0.3 / _PAGE_IN[1], f"{number} / {len(sheets)}", ha="center", size=8)
            file.savefig(canvas)
    return path


def write_png(path: Path, page: Page) -> Path:
    """Write title, verdict and first picture of a page as PNG.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    page : Page
        What stands on it.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    first = next((block for block in page.blocks if isinstance(block, Figure)), None)
    pieces = [*_head(page), *(_blocks([first], 2) if first is not None else ())]
    height = sum(piece.height for piece in pieces)
    with mpl.rc_context(style(ON_PAPER) | {"font.size": 9}):
        canvas = _sheet(pieces, height, height + 2 * _MARGIN_IN)
        canvas.savefig(path, dpi=_DPI, facecolor="white", metadata={"Software": None, "Title": page.title})
    return path


# ---------------------------------------------------------------------------- sheets


def _sheets(pieces: Iterable[_Piece]) -> Iterator[list[_Piece]]:
    """Fill sheet after sheet; what is bound to what follows does not stay behind at a sheet's foot."""
    sheet: list[_Piece] = []
    for group in _groups(pieces):
        used, more = (sum(piece.height for piece in part) for part in (sheet, group))
        if sheet and used + more > _HEIGHT_IN:
            yield sheet
            sheet = []
        sheet += group
    yield sheet


def _groups(pieces: Iterable[_Piece]) -> Iterator[list[_Piece]]:
    group: list[_Piece] = []
    for piece in pieces:
        group.append(piece)
        if not piece.keep:
            yield group
            group = []
    if group:
        yield group


def _sheet(pieces: Sequence[_Piece], height: float, whole: float) -> Canvas:
    """Draw pieces one below the other onto a sheet."""
    canvas = Canvas(figsize=(_PAGE_IN[0], whole))
    heights = [piece.height for piece in pieces]
    room = max(height - sum(heights), 1e-3)
    # Margins are rows and columns of their own: parts of a figure know no others.
    grid = canvas.add_gridspec(
        len(pieces) + 3,
        3,
        height_ratios=[_MARGIN_IN, *heights, room, _MARGIN_IN],
        hspace=0.0,
        wspace=0.0,
        width_ratios=[_MARGIN_IN, _WIDTH_IN, _MARGIN_IN],
    )
    for i, piece in enumerate(pieces, start=1):
        piece.draw(canvas.add_subfigure(grid[i, 1]), piece.height)
    return canvas


# ---------------------------------------------------------------------------- blocks


def _head(page: Page) -> Iterator[_Piece]:
    yield from _paragraph(page.title, _TITLE_PT, bold=True, keep=True)
    yield from _paragraph(f"{TONE_WORDS[page.tone].upper()}  {page.verdict}", 10.5, bold=True)


def _glossary(page: Page) -> Iterator[_Piece]:
    codes = codes_of(page.blocks)
    if codes:
        yield from _heading(GLOSSARY, 2)
    for code in codes:
        means, do = explain(code) or ("", "")
        yield from _paragraph(f"{code}: {means} To do: {do}", _BODY_PT)


def _blocks(blocks: Sequence[Block], level: int) -> Iterator[_Piece]:
    for block in blocks:
        if isinstance(block, Figure):
            yield from _figures((block,))
        elif isinstance(block, Row):
            # Two beside each other; a third one goes below.
            for i in range(0, len(block.figures), 2):
                yield from _figures(block.figures[i : i + 2])
        elif isinstance(block, Table):
            yield from _table(block, level)
        elif isinstance(block, Words):
            yield from _heading(("⚠ " if block.kind == "warning" else "") + block.title, level)
            for line in block.lines:
                yield from _paragraph(f"•  {text_of(line)}", _BODY_PT)
        elif isinstance(block, (Section, Details)):
            yield from _heading(block.title, level)
            yield from _blocks(block.blocks, level + 1)


def _figures(figures: Sequence[Figure]) -> Iterator[_Piece]:
    """Pictures side by side, their titles above and their notes below."""
    count = len(figures)
    width = _WIDTH_IN / count
    height = max(figure.height for figure in figures) * (0.9 if count == 1 else 0.75)

    def drawn(sheet: SubFigure, _: float) -> None:
        for i, figure in enumerate(figures):
            part = sheet.add_subfigure(sheet.add_gridspec(1, count, left=0, right=1, top=1, bottom=0, wspace=0)[0, i])
            _framed(part, figure, width, height)

    titles = [_wrapped(figure.title, width - 0.15, 9.5, bold=True) for figure in figures]
    yield from _beside(titles, width, 9.5, bold=True)
    yield _Piece(height, drawn, keep=any(figure.note for figure in figures))
    if any(figure.note for figure in figures):
        yield from _beside([_wrapped(figure.note, width - 0.15, 8.0) for figure in figures], width, 8.0)


def _framed(part: SubFigure, figure: Figure, width: float, height: float) -> None:
    """Draw a figure into its part of the sheet, with room for its labels and names."""
    draw(part, figure, width, ON_PAPER)
    (axes,) = part.axes
    legend = axes.get_legend()
    rows = 0.0
    if legend is not None:
        names = [text.get_text() for text in legend.get_texts()]
        rows = sum(name.count("\n") + 1 for name in names) / max(getattr(legend, "_ncols", 1), 1)
    labels = [label.get_text() for label in axes.get_yticklabels()] if figure.strips else []
    left = max([0.62, *(_width(label, 9.0) + 0.45 for label in labels)])
    axes.set_position(
        (left / width, 0.5 / height, 1.0 - (left + 0.15) / width, max(1.0 - (0.6 + 0.2 * -(-rows // 1)) / height, 0.2))
    )


def _beside(columns: Sequence[Sequence[str]], width: float, size: float, *, bold: bool = False) -> Iterator[_Piece]:
    """Lines of words in columns of one width; bold ones are titles and stay with what follows."""
    rows = [
        [_Text(lines[i], x=c * width, bold=bold) for c, lines in enumerate(columns) if i < len(lines)]
        for i in range(max(map(len, columns)))
    ]
    yield _lines(rows, size, above=0.12 if bold else 0.0, keep=bold)


def _table(table: Table, level: int) -> Iterator[_Piece]:
    if table.title:
        yield from _heading(table.title, level)
    head = [list(table.head)] if any(table.head) else []
    cells = [*head, *([text_of(cell) for cell in row] for row in table.rows)]
    if not cells:
        return
    words = columns_of_words(table)
    widths = _columns(cells, words)
    rows = [_row(row, widths, words, bold=bool(head) and i == 0) for i, row in enumerate(cells)]
    body = rows[len(head) :]
    for i in range(0, max(len(body), 1), _ROWS):
        last = i + _ROWS >= len(body)
        lines = [line for row in [*rows[: len(head)], *body[i : i + _ROWS]] for line in row]
        yield _lines(lines, _CELL_PT, above=0.06, keep=last and bool(table.note))
    if table.note:
        yield from _paragraph(table.note, 8.0)


def _columns(cells: Sequence[Sequence[str]], words: set[int]) -> list[float]:
    """Return the width of each column, inches; those of words give way where it is too much."""
    count = max(map(len, cells))
    widths = [
        max((_width(row[i], _CELL_PT, bold=True) for row in cells if i < len(row)), default=0.0) for i in range(count)
    ]
    soft = [i for i in range(count) if i in words] or list(range(count))
    room = _WIDTH_IN - _GAP_IN * (count - 1) - sum(width for i, width in enumerate(widths) if i not in soft)
    # The widest give way first, down to a width that they share.
    left = sorted(widths[i] for i in soft)
    while left and room / len(left) > left[0]:
        room -= left.pop(0)
    most = max(room / len(left), _LEAST_IN) if left else math.inf
    return [min(width, most) if i in soft else width for i, width in enumerate(widths)]


def _row(row: Sequence[str], widths: Sequence[float], words: set[int], *, bold: bool) -> list[list[_Text]]:
    """Return the lines of a row of a table."""
    wrapped = [_wrapped(cell, widths[i] + 0.02, _CELL_PT, bold=bold) for i, cell in enumerate(row)]
    lines = []
    for k in range(max(map(len, wrapped))):
        x, line = 0.0, []
        for i, parts in enumerate(wrapped):
            if k < len(parts):
                right = i not in words
                line.append(_Text(parts[k], x=x + (widths[i] if right else 0.0), right=right, bold=bold))
            x += widths[i] + _GAP_IN
        lines.append(line)
    return lines


# ---------------------------------------------------------------------------- words


def _heading(words: str, level: int) -> Iterator[_Piece]:
    size = _HEADINGS_PT.get(level, 9.5)
    rows = [[_Text(line, bold=True)] for line in _wrapped(words, _WIDTH_IN, size, bold=True)]
    yield _lines(rows, size, above=0.18 if level == 2 else 0.12, keep=True)


def _paragraph(words: str, size: float, *, bold: bool = False, keep: bool = False) -> Iterator[_Piece]:
    lines = [[_Text(line, bold=bold)] for line in _wrapped(words, _WIDTH_IN, size, bold=bold)]
    for i in range(0, len(lines), _LINES):
        yield _lines(lines[i : i + _LINES], size, above=0.06 if i == 0 else 0.0, keep=keep)


def _lines(rows: Sequence[Sequence[_Text]], size: float, *, above: float, keep: bool = False) -> _Piece:
    step = size * _LEADING / 72.0

    def drawn(sheet: SubFigure, height: float) -> None:
        for i, row in enumerate(rows):
            y = 1.0 - (above + (i + 0.78) * step) / height
            for text in row:
                weight, side = "bold" if text.bold else "normal", "right" if text.right else "left"
                words = text.words.replace("$", r"\$")
                sheet.text(text.x / _WIDTH_IN, y, words, size=size, weight=weight, ha=side, va="baseline")

    return _Piece(above + step * len(rows) + 0.04, drawn, keep)


def _wrapped(words: str, width: float, size: float, *, bold: bool = False) -> list[str]:
    """Break words into lines of a width, inches; a word that is longer than a line is cut."""
    lines = [""]
    for word in words.split(" "):
        longer = f"{lines[-1]} {word}" if lines[-1] else word
        if _width(longer, size, bold=bold) <= width:
            lines[-1] = longer
            continue
        parts = _cut(word, width, size, bold=bold)
        lines = [*(lines if lines[-1] else lines[:-1]), *parts]
    return lines


def _cut(word: str, width: float, size: float, *, bold: bool) -> list[str]:
    parts = [""]
    for letter in word:
        if parts[-1] and _width(parts[-1] + letter, size, bold=bold) > width:
            parts.append("")
        parts[-1] += letter
    return parts


@lru_cache(maxsize=20_000)
def _width(words: str, size: float, *, bold: bool = False) -> float:
    """Return how wide words are, inches."""
    font = FontProperties(family="sans-serif", size=size, weight="bold" if bold else "normal")
    return float(text_to_path.get_text_width_height_descent(words, font, False)[0]) / 72.0
