"""Draws figures with matplotlib as SVG with CSS variables, so that one file suits light and dark screens and paper."""

from __future__ import annotations

import html
import io
import re
import textwrap
from typing import Any

import matplotlib as mpl
import matplotlib.dates as mdates
import numpy as np
from dateutil.tz import tzlocal  # type: ignore[import-untyped]
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D

from compensator.report.cursor import axes_id, can_be_read, line_id, plot_data
from compensator.report.figure import Bar, Edges, Figure, Line, described, thinned

#: Placeholder colours of text and axes, of grid and spans, and of curves; the page's CSS variables replace them.
INK, GRID = "#010101", "#020202"
LINES = ("#030303", "#040404", "#050505", "#060606", "#070707")
COLOURS = {INK: "--ink", GRID: "--grid"} | {colour: f"--line-{i}" for i, colour in enumerate(LINES)}
_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": GRID,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "legend.framealpha": 0.0,
    "svg.fonttype": "none",
}
_DASHES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)))
#: Seconds of a day, matplotlib's unit of time.
_DAY_S = 86400.0
#: Narrowest piece of a strip, as a share of the figure: an event of one minute in a year remains visible.
_NARROWEST = 1.0 / 500.0
#: Digits of a coordinate beyond a hundredth of a point, which nobody sees.
_DIGITS = re.compile(r"(\.\d\d)\d+")
#: Longest line of a bar's name, letters.
_NAME_LETTERS = 34
#: Width of a figure alone in its row, inches.
WIDTH_IN = 9.0
#: Width of a letter, of a legend's sample line, and of the margin left of the axes, inches.
_LETTER_IN, _SAMPLE_IN, _LEFT_IN = 0.09, 0.65, 0.88


def svg(figure: Figure, prefix: str, width: float = WIDTH_IN) -> str:
    """Draw a figure.

    Parameters
    ----------
    figure : Figure
        What to draw.
    prefix : str
        Prefix that makes its identifiers unique on the page.
    width : float
        Width, inches; smaller for figures side by side, so that the text stays readable.
    """
    with mpl.rc_context(_STYLE | {"svg.hashsalt": figure.title}):
        panels = (figure, *figure.below)
        heights = [panel.height for panel in panels]
        canvas = Canvas(figsize=(width, figure.full_height), layout="constrained")
        rows = canvas.subplots(len(panels), sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        colours: dict[str, int] = {}
        for i, (axes, panel) in enumerate(zip(rows, panels, strict=True)):
            axes.set_gid(axes_id(i))
            _draw(axes, panel, colours, i)
            axes.label_outer()
            if panel.strips:
                _strips(axes, panel)
            if panel.bars:
                _bars(axes, panel.bars)
            _legend(axes, width)
        _lay_out(canvas, rows[0], align=width == WIDTH_IN)
        buffer = io.StringIO()
        canvas.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r' d="[^"]*"', lambda path: _DIGITS.sub(r"\1", path[0]), text)
    for colour, variable in COLOURS.items():
        text = text.replace(colour, f"var({variable})")
    text = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{prefix}-", text)
    label = html.escape(f"{figure.title}. {figure.note}".strip())
    data = f' data-plot="{html.escape(plot_data(figure, list(rows), prefix))}"' if can_be_read(figure) else ""
    opening, _, rest = text.partition(">")
    opening = opening.replace("<svg ", f'<svg role="img" aria-label="{label}"{data} ', 1)
    return f"{opening}><desc>{html.escape(described(figure))}</desc>{rest}"


def _lay_out(canvas: Canvas, axes: Axes, *, align: bool) -> None:
    """Place the axes once and for all: matplotlib would draw everything first, for each layout.

    With `align` they get the left margin that all figures of a page have, so that figures below each other line up.
    """
    engine, width, dpi = canvas.get_layout_engine(), canvas.get_figwidth(), canvas.get_dpi()
    assert engine is not None
    if align:
        engine.execute(canvas)
        missing = _LEFT_IN / width - axes.get_position().x0
        if missing > 0.0:
            engine.set(rect=(missing, 0.0, 1.0 - missing, 1.0))  # type: ignore[call-arg]
    # The letters are as wide as those of the file.
    FigureCanvasSVG(canvas)
    engine.execute(canvas)
    canvas.set_layout_engine(None)
    canvas.set_dpi(dpi)


def _draw(axes: Axes, figure: Figure, colours: dict[str, int], panel: int) -> None:
    """Draw a panel; a name that a panel above it has keeps its number, by which it has its colour."""
    named: set[str] = set()
    above, drawn = dict(colours), len(colours)

    def number(name: str) -> int:
        nonlocal drawn
        if name in above:
            return above[name]
        drawn += 1
        colours[name or f"curve {drawn}"] = drawn - 1
        return drawn - 1

    unit = _DAY_S if figure.clock else 1.0
    for span in figure.spans:
        label = "" if span.name in named else _plain(span.name)
        axes.axvspan(span.first / unit, span.last / unit, color=GRID, alpha=0.35, linewidth=0, label=label)
        named.add(span.name)
    if figure.unit_circle:
        angle = np.linspace(0.0, 2.0 * np.pi, 200)
        axes.plot(np.cos(angle), np.sin(angle), color=INK, linewidth=0.8)
        axes.set_aspect("equal", adjustable="datalim")
    for i, line in enumerate(figure.lines):
        _curve(axes, line, i, number(line.name), figure).set_gid(line_id(panel, i))
    for marks in figure.marks:
        hollow: dict[str, Any] = {"markerfacecolor": "none"} if marks.marker == "o" else {}
        colour = LINES[number(marks.name) % len(LINES)]
        axes.plot(marks.x / unit, marks.y, marks.marker, color=colour, label=_plain(marks.name), **hollow)
    for stems in figure.stems:
        colour = LINES[number(stems.name) % len(LINES)]
        axes.vlines(stems.x, 0.0, stems.y, color=colour, label=_plain(stems.name), linewidth=2.0)
    if figure.stems:
        axes.axhline(0.0, color=INK, linewidth=0.8)
    for limit in figure.limits:
        axes.axhline(limit, color=INK, linewidth=0.8, linestyle="--")
    _edges(axes, figure.edges, unit)
    # A logarithmic axis without a positive value cannot be drawn.
    if figure.x_log and np.isfinite(axes.dataLim.minposx):
        axes.set_xscale("log")
    if figure.y_log and np.isfinite(axes.dataLim.minposy):
        axes.set_yscale("log")
    _axes(axes, figure, unit)


def _axes(axes: Axes, figure: Figure, unit: float) -> None:
    if figure.x_limits is not None:
        axes.set_xlim(figure.x_limits[0] / unit, figure.x_limits[1] / unit)
    if figure.clock:
        zone = tzlocal() if figure.local else "UTC"
        locator = mdates.AutoDateLocator(tz=zone, minticks=3, maxticks=9)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        formatter = mdates.ConciseDateFormatter(locator, tz=zone)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_formatter(formatter)
    axes.set_xlabel(_plain(figure.x_label))
    axes.set_ylabel(_plain(figure.y_label))
    axes.grid(visible=True)


def _strips(axes: Axes, figure: Figure) -> None:
    """Draw rows of time, the first on top; each piece has a minimum width, so that it remains visible."""
    unit = _DAY_S if figure.clock else 1.0
    first, last = figure.x_limits or (
        min((a for s in figure.strips for a, _ in s.spans), default=0.0),
        max((b for s in figure.strips for _, b in s.spans), default=1.0),
    )
    least = (last - first) * _NARROWEST
    for row, strip in enumerate(figure.strips):
        pieces = [(a / unit, max(b - a, least) / unit) for a, b in strip.spans]
        axes.broken_barh(pieces, (row - 0.35, 0.7), color=LINES[strip.line % len(LINES)], linewidth=0)
    axes.set_axisbelow(True)
    axes.set_yticks(range(len(figure.strips)), [_plain(strip.name) for strip in figure.strips])
    axes.set_ylim(len(figure.strips) - 0.5, -0.5)


def _edges(axes: Axes, edges: tuple[Edges, ...], unit: float) -> None:
    """Draw vertical lines; each kind has its own dash."""
    for i, edge in enumerate(edges):
        for k, x in enumerate(edge.at):
            label = "" if k else _plain(edge.name)
            axes.axvline(x / unit, color=INK, linewidth=1.0, linestyle=_DASHES[(i + 1) % len(_DASHES)], label=label)


def _bars(axes: Axes, bars: tuple[Bar, ...]) -> None:
    """Draw bars from top to bottom, names and values at the left, where nothing covers them on a small screen."""
    for row, bar in enumerate(bars):
        colour = LINES[bar.line % len(LINES)]
        look: dict[str, Any] = {"facecolor": colour, "linewidth": 0}
        if bar.hatched:
            look = {"facecolor": "none", "edgecolor": colour, "hatch": "///", "linewidth": 1.5}
        axes.broken_barh([(min(bar.first, bar.last), abs(bar.last - bar.first))], (row - 0.3, 0.6), **look)
        if row + 1 < len(bars) and bar.joined:
            axes.vlines(bar.last, row - 0.3, row + 1.3, color=INK, linewidth=0.8)
    names = [f"{textwrap.fill(_plain(bar.name), _NAME_LETTERS)}\n{_plain(bar.value)}" for bar in bars]
    axes.set_yticks(range(len(bars)), names)
    axes.set_ylim(len(bars) - 0.4, -0.6)
    # The last tick's label has room: a browser's letters are wider than those of the layout.
    axes.set_xlim(left=0.0, right=1.1 * max(max(bar.first, bar.last) for bar in bars) or 1.0)
    axes.grid(visible=False, axis="y")
    axes.set_axisbelow(True)
    axes.set_ylabel("")


def _curve(axes: Axes, line: Line, i: int, number: int, figure: Figure) -> Line2D:
    """Draw the i-th curve of a panel with a dash of its own, in the colour of its number on the figure."""
    colour = LINES[number % len(LINES)]
    # The sixth curve has the colour of the first, but another dash.
    dash = _DASHES[(i + i // len(LINES)) % len(_DASHES)]
    x = line.x / _DAY_S if figure.clock else line.x
    keep = thinned(line.x, line.y, x_log=figure.x_log)
    label = _plain(line.name)
    (drawn,) = axes.plot(x[keep], line.y[keep], linestyle=dash, color=colour, label=label, linewidth=line.weight)
    if line.band is not None:
        edges = [thinned(line.x, edge, x_log=figure.x_log) for edge in line.band]
        keep = np.unique(np.concatenate([keep, *edges]))
        low, high = line.band
        axes.fill_between(x[keep], low[keep], high[keep], color=colour, alpha=0.2, linewidth=0)
    return drawn


def _legend(axes: Axes, width: float) -> None:
    """Place the legend above the axes, in as many columns as fit."""
    handles, names = axes.get_legend_handles_labels()
    if not names:
        return
    room = width - _LEFT_IN
    names = [textwrap.fill(name, int((room - _SAMPLE_IN) / _LETTER_IN)) for name in names]
    longest = max(len(part) for name in names for part in name.splitlines())
    columns = min(3, max(1, int(room / (longest * _LETTER_IN + _SAMPLE_IN))))
    axes.legend(handles, names, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderaxespad=0.2)


def _plain(words: str) -> str:
    """Escape dollar signs, which matplotlib reads as mathematics."""
    return words.replace("$", r"\$")
