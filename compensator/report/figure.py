"""Pictures of a page: curves with bands, points, stems and shaded spans, drawn as SVG in the page's own colours."""

from __future__ import annotations

import html
import io
import re
import textwrap
from dataclasses import dataclass, field
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

Vector = npt.NDArray[np.float64]

#: Placeholder colours that are drawn → CSS variables that stand in the page.
INK, GRID = "#010101", "#020202"
LINES = ("#030303", "#040404", "#050505", "#060606", "#070707")
COLOURS = {INK: "--ink", GRID: "--grid"} | {colour: f"--line-{i}" for i, colour in enumerate(LINES)}
_DASHES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)))
#: Buckets that a longer curve is thinned to; each keeps its lowest and highest point.
_BUCKETS = 700
#: Gaps up to which each is shown, however narrow.
_GAPS = 100
#: What a letter and what the sample of a legend's entry take, and what stands left of the axes, inches.
_LETTER_IN, _SAMPLE_IN, _LEFT_IN = 0.09, 0.65, 0.8


@dataclass(frozen=True, slots=True)
class Line:
    """A curve with its name.

    Parameters
    ----------
    name : str
        Stands in the legend.
    x, y : numpy.ndarray, shape (n,)
        Points; a value that is not finite leaves a gap.
    band : tuple of numpy.ndarray, optional
        What its uncertainty spans, lower and upper, each of shape (n,).
    """

    name: str
    x: Vector
    y: Vector
    band: tuple[Vector, Vector] | None = field(default=None, kw_only=True)


@dataclass(frozen=True, slots=True)
class Marks:
    """Points, such as poles (`x`) and zeros (`o`)."""

    name: str
    x: Vector
    y: Vector
    marker: Literal["x", "o"] = field(default="x", kw_only=True)


@dataclass(frozen=True, slots=True)
class Stems:
    """Bars from zero, such as correlations over lags."""

    name: str
    x: Vector
    y: Vector


@dataclass(frozen=True, slots=True)
class Span:
    """A shaded stretch of the x axis; stretches of one name share an entry of the legend."""

    name: str
    first: float
    last: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A picture with units on both axes.

    Parameters
    ----------
    title, x_label, y_label : str
        Words; the labels name the unit.
    lines, marks, stems, spans : tuple
        What is drawn.
    limits : tuple of float
        Dashed horizontal lines.
    x_log, y_log : bool
        Logarithmic axes.
    unit_circle : bool
        Draw it, with equal axes.
    note : str
        A sentence below.
    height : float
        In inches, at a width of 9.
    """

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...] = ()
    marks: tuple[Marks, ...] = ()
    stems: tuple[Stems, ...] = ()
    spans: tuple[Span, ...] = ()
    limits: tuple[float, ...] = ()
    x_log: bool = False
    y_log: bool = False
    unit_circle: bool = False
    note: str = ""
    height: float = 3.4


def thinned(x: Vector, y: Vector, *, x_log: bool = False) -> npt.NDArray[np.int_]:
    """Return the indices that keep a curve's look: lowest and highest of each bucket, its ends, and its gaps.

    A gap narrower than a bucket is narrower than the line that is drawn. Where there are many such, they are left
    out: samples lost here and there would otherwise leave nothing of the curve but lone points.

    Parameters
    ----------
    x, y : numpy.ndarray, shape (n,)
        The curve.
    x_log : bool
        Whether buckets are equally wide in the logarithm of x; else they hold equally many samples.

    Examples
    --------
    >>> y = np.zeros(100_000)
    >>> y[54_321] = 1.0
    >>> keep = thinned(np.arange(100_000.0), y)
    >>> keep.size < 1500, 54_321 in keep
    (True, True)
    """
    if x.size <= 2 * _BUCKETS:
        return np.arange(x.size)
    place = np.arange(x.size) * (_BUCKETS / x.size)
    if x_log and x[0] > 0.0 and bool(np.all(np.diff(x) > 0.0)):
        place = np.log(x / x[0]) / np.log(x[-1] / x[0]) * _BUCKETS
    finite = np.isfinite(y)
    keep = {0, x.size - 1}
    for bucket in np.split(np.arange(x.size), np.flatnonzero(np.diff(np.floor(place))) + 1):
        seen = bucket[finite[bucket]]
        if seen.size:
            keep |= {int(seen[np.argmin(y[seen])]), int(seen[np.argmax(y[seen])])}
    known = np.flatnonzero(finite)
    gaps = np.diff(known) > 1
    if np.count_nonzero(gaps) > _GAPS:
        gaps &= np.diff(place[known]) >= 1.0
    for i in np.flatnonzero(gaps).tolist():
        keep |= {int(known[i]), int(known[i]) + 1, int(known[i + 1])}
    return np.array(sorted(keep))


def svg(figure: Figure, prefix: str, width: float = 9.0) -> str:
    """Draw a figure.

    Parameters
    ----------
    figure : Figure
        What to draw.
    prefix : str
        Makes its identifiers different from those of other pictures on the page.
    width : float
        In inches: less where several stand side by side, so that the text stays readable.
    """
    style: dict[Any, Any] = {
        "svg.fonttype": "none", "svg.hashsalt": figure.title, "font.family": "sans-serif", "font.size": 10,
        "text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": INK, "xtick.color": INK, "ytick.color": INK,
        "grid.color": GRID, "figure.facecolor": "none", "axes.facecolor": "none", "legend.framealpha": 0.0,
    }  # fmt: skip
    with mpl.rc_context(style):
        canvas = Canvas(figsize=(width, figure.height), layout="constrained")
        axes = canvas.subplots()
        _draw(axes, figure)
        _legend(axes, width)
        buffer = io.StringIO()
        canvas.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    for colour, variable in COLOURS.items():
        text = text.replace(colour, f"var({variable})")
    text = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{prefix}-", text)
    label = html.escape(f"{figure.title}. {figure.note}".strip())
    return text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)


def _draw(axes: Axes, figure: Figure) -> None:
    named: set[str] = set()
    for span in figure.spans:
        label = "" if span.name in named else _plain(span.name)
        axes.axvspan(span.first, span.last, color=GRID, alpha=0.35, linewidth=0, label=label)
        named.add(span.name)
    if figure.unit_circle:
        angle = np.linspace(0.0, 2.0 * np.pi, 200)
        axes.plot(np.cos(angle), np.sin(angle), color=INK, linewidth=0.8)
        axes.set_aspect("equal", adjustable="datalim")
    for i, line in enumerate(figure.lines):
        _curve(axes, line, i, figure.x_log)
    drawn = len(figure.lines)
    for marks in figure.marks:
        hollow: dict[str, Any] = {"markerfacecolor": "none"} if marks.marker == "o" else {}
        colour = LINES[drawn % len(LINES)]
        axes.plot(marks.x, marks.y, marks.marker, color=colour, label=_plain(marks.name), **hollow)
        drawn += 1
    for stems in figure.stems:
        colour = LINES[drawn % len(LINES)]
        axes.vlines(stems.x, 0.0, stems.y, color=colour, label=_plain(stems.name), linewidth=2.0)
        drawn += 1
    if figure.stems:
        axes.axhline(0.0, color=INK, linewidth=0.8)
    for limit in figure.limits:
        axes.axhline(limit, color=INK, linewidth=0.8, linestyle="--")
    # A logarithmic axis without a positive value cannot be drawn.
    if figure.x_log and np.isfinite(axes.dataLim.minposx):
        axes.set_xscale("log")
    if figure.y_log and np.isfinite(axes.dataLim.minposy):
        axes.set_yscale("log")
    axes.set_xlabel(_plain(figure.x_label))
    axes.set_ylabel(_plain(figure.y_label))
    axes.grid(visible=True)


def _curve(axes: Axes, line: Line, i: int, x_log: bool) -> None:
    colour = LINES[i % len(LINES)]
    # The sixth curve has the first one's colour, but another dash.
    dash = _DASHES[(i + i // len(LINES)) % len(_DASHES)]
    keep = thinned(line.x, line.y, x_log=x_log)
    axes.plot(line.x[keep], line.y[keep], linestyle=dash, color=colour, label=_plain(line.name), linewidth=1.5)
    if line.band is not None:
        edges = [thinned(line.x, edge, x_log=x_log) for edge in line.band]
        keep = np.unique(np.concatenate([keep, *edges]))
        low, high = line.band
        axes.fill_between(line.x[keep], low[keep], high[keep], color=colour, alpha=0.2, linewidth=0)


def _legend(axes: Axes, width: float) -> None:
    """Put the names above the axes, in as many columns as there is room for."""
    handles, names = axes.get_legend_handles_labels()
    if not names:
        return
    room = width - _LEFT_IN
    names = [textwrap.fill(name, int((room - _SAMPLE_IN) / _LETTER_IN)) for name in names]
    longest = max(len(part) for name in names for part in name.splitlines())
    columns = min(3, max(1, int(room / (longest * _LETTER_IN + _SAMPLE_IN))))
    axes.legend(handles, names, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderaxespad=0.2)


def _plain(words: str) -> str:
    """Keep matplotlib from reading what stands between two dollar signs as a formula."""
    return words.replace("$", r"\$")
