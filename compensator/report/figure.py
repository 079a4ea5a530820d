"""Pictures of a page: curves with bands, points, stems and shaded spans, drawn as SVG in the page's own colours."""

from __future__ import annotations

import html
import io
import re
from dataclasses import dataclass
from typing import Any

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


@dataclass(frozen=True, slots=True)
class Line:
    """A curve with its name; `band` is what its uncertainty spans, lower and upper."""

    name: str
    x: Vector
    y: Vector
    band: tuple[Vector, Vector] | None = None


@dataclass(frozen=True, slots=True)
class Marks:
    """Points, such as poles (`x`) and zeros (`o`)."""

    name: str
    x: Vector
    y: Vector
    marker: str = "x"


@dataclass(frozen=True, slots=True)
class Stems:
    """Bars from zero, such as correlations over lags."""

    name: str
    x: Vector
    y: Vector


@dataclass(frozen=True, slots=True)
class Span:
    """A shaded stretch of the x axis."""

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


def thinned(x: Vector, y: Vector) -> npt.NDArray[np.int_]:
    """Return the indices that keep a curve's look: lowest and highest of each bucket, its ends, and its gaps.

    Examples
    --------
    >>> y = np.zeros(100_000)
    >>> y[54_321] = 1.0
    >>> keep = thinned(np.arange(100_000.0), y)
    >>> keep.size < 2000, 54_321 in keep
    (True, True)
    """
    if x.size <= 2 * _BUCKETS:
        return np.arange(x.size)
    keep = {0, x.size - 1}
    for bucket in np.array_split(np.arange(x.size), _BUCKETS):
        values = y[bucket]
        missing = np.isnan(values)
        if missing.any():
            keep.add(int(bucket[np.argmax(missing)]))
        if not missing.all():
            keep |= {int(bucket[np.nanargmin(values)]), int(bucket[np.nanargmax(values)])}
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
        _draw(canvas.subplots(), figure)
        buffer = io.StringIO()
        canvas.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    for colour, variable in COLOURS.items():
        text = text.replace(colour, f"var({variable})")
    text = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{prefix}-", text)
    label = html.escape(f"{figure.title}. {figure.note}".strip())
    return text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)


def _draw(axes: Axes, figure: Figure) -> None:
    for span in figure.spans:
        axes.axvspan(span.first, span.last, color=GRID, alpha=0.35, linewidth=0, label=span.name)
    if figure.unit_circle:
        angle = np.linspace(0.0, 2.0 * np.pi, 200)
        axes.plot(np.cos(angle), np.sin(angle), color=INK, linewidth=0.8)
        axes.set_aspect("equal", adjustable="datalim")
    drawn = 0
    for line in figure.lines:
        keep = thinned(line.x, line.y)
        colour = LINES[drawn % len(LINES)]
        axes.plot(line.x[keep], line.y[keep], linestyle=_DASHES[drawn % len(_DASHES)], color=colour, label=line.name,
                  linewidth=1.5)  # fmt: skip
        if line.band is not None:
            low, high = line.band
            axes.fill_between(line.x[keep], low[keep], high[keep], color=colour, alpha=0.2, linewidth=0)
        drawn += 1
    for marks in figure.marks:
        hollow: dict[str, Any] = {"markerfacecolor": "none"} if marks.marker == "o" else {}
        axes.plot(marks.x, marks.y, marks.marker, color=LINES[drawn % len(LINES)], label=marks.name, **hollow)
        drawn += 1
    for stems in figure.stems:
        axes.vlines(stems.x, 0.0, stems.y, color=LINES[drawn % len(LINES)], label=stems.name, linewidth=2.0)
        drawn += 1
    for limit in figure.limits:
        axes.axhline(limit, color=INK, linewidth=0.8, linestyle="--")
    if figure.x_log:
        axes.set_xscale("log")
    if figure.y_log:
        axes.set_yscale("log")
    axes.set_xlabel(figure.x_label)
    axes.set_ylabel(figure.y_label)
    axes.grid(visible=True)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)
