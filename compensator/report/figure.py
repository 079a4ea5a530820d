"""Figures of a page as data: curves with bands, points, stems, shaded spans, strips of time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from compensator.arrays import Indices, Vector

#: Buckets to which a long curve is thinned; each keeps its lowest and highest point.
_BUCKETS = 700
#: Up to this number of gaps each one is shown, however narrow.
_GAPS = 100


@dataclass(frozen=True, slots=True)
class Line:
    """A curve with its name.

    Parameters
    ----------
    name : str
        Entry of the legend.
    x, y : numpy.ndarray, shape (n,)
        Points; a value that is not finite leaves a gap.
    band : tuple of numpy.ndarray, optional
        Lower and upper limit of its uncertainty, each of shape (n,).
    weight : float
        Width of the line, points.
    """

    name: str
    x: Vector
    y: Vector
    band: tuple[Vector, Vector] | None = field(default=None, kw_only=True)
    weight: float = field(default=1.5, kw_only=True)


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


@dataclass(frozen=True, slots=True)
class Strip:
    """A row of time: when a state was active, when something happened.

    Parameters
    ----------
    name : str
        Label at the left.
    spans : tuple of (float, float)
        First and last x of each piece.
    line : int
        Index of the line colour.
    """

    name: str
    spans: tuple[tuple[float, float], ...]
    line: int = 1


@dataclass(frozen=True, slots=True)
class Edges:
    """Vertical lines that share an entry of the legend, such as the ends of blocks of time."""

    name: str
    at: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Bar:
    """A horizontal bar with its name and value at the left.

    Parameters
    ----------
    name, value : str
        Texts beside it, one below the other.
    first, last : float
        Where it begins and ends.
    line : int
        Index of the line colour.
    hatched : bool
        Hatched instead of filled.
    joined : bool
        Whether a line leads from its end to the next bar.
    """

    name: str
    value: str
    first: float
    last: float
    line: int = 0
    hatched: bool = field(default=False, kw_only=True)
    joined: bool = field(default=True, kw_only=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A figure with units on both axes.

    Parameters
    ----------
    title, x_label, y_label : str
        The labels name the unit.
    lines, marks, stems, spans, strips, edges, bars : tuple
        Content; strips are drawn alone, bars alone or with edges.
    below : tuple of Figure
        Panels below it on the same x axis, without titles and notes of their own.
    limits : tuple of float
        Dashed horizontal lines.
    x_log, y_log : bool
        Logarithmic axes.
    unit_circle : bool
        Draw the unit circle, with equal axes.
    clock : bool
        x is a time, s since 1970 UTC.
    local : bool
        Such a time is shown in this computer's zone, not in UTC.
    x_limits : tuple of float, optional
        Ends of the x axis, the same for figures below each other.
    note : str
        A sentence below.
    height : float
        Height at a width of 9, inches.
    """

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...] = ()
    marks: tuple[Marks, ...] = ()
    stems: tuple[Stems, ...] = ()
    spans: tuple[Span, ...] = ()
    strips: tuple[Strip, ...] = ()
    edges: tuple[Edges, ...] = ()
    bars: tuple[Bar, ...] = ()
    below: tuple[Figure, ...] = ()
    limits: tuple[float, ...] = ()
    x_log: bool = False
    y_log: bool = False
    unit_circle: bool = False
    clock: bool = False
    local: bool = False
    x_limits: tuple[float, float] | None = None
    note: str = ""
    height: float = 3.4

    @property
    def full_height(self) -> float:
        """Height with the panels below it, inches."""
        return self.height + sum(panel.full_height for panel in self.below)


def thinned(x: Vector, y: Vector, *, x_log: bool = False) -> Indices:
    """Return the indices that preserve a curve's shape: extremes of each bucket, both ends, and gaps.

    A gap narrower than a bucket is narrower than the line drawn. Where there are many such gaps they are omitted:
    scattered lost samples would otherwise reduce the curve to isolated points.

    Parameters
    ----------
    x, y : numpy.ndarray, shape (n,)
        The curve.
    x_log : bool
        Buckets of equal width in the logarithm of x; otherwise of equal numbers of samples.

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
    keep = {0, x.size - 1, *extremes(np.floor(place), y).tolist()}
    known = np.flatnonzero(np.isfinite(y))
    gaps = np.diff(known) > 1
    if np.count_nonzero(gaps) > _GAPS:
        gaps &= np.diff(place[known]) >= 1.0
    for i in np.flatnonzero(gaps).tolist():
        keep |= {int(known[i]), int(known[i]) + 1, int(known[i + 1])}
    return np.array(sorted(keep))


def extremes(column: Vector, y: Vector) -> Indices:
    """Return the indices of the lowest and highest finite value of each column; of its first point if it has none.

    Examples
    --------
    >>> extremes(np.array([0.0, 0.0, 0.0, 1.0]), np.array([2.0, np.nan, 1.0, np.inf]))
    array([0, 2, 3])
    """
    finite = np.isfinite(y)
    order = np.lexsort((np.where(finite, y, np.inf), column))
    starts = np.concatenate([[0], np.flatnonzero(np.diff(column[order])) + 1])
    known = np.add.reduceat(finite[order].astype(np.int_), starts)
    return np.unique(np.concatenate([order[starts], order[starts + np.maximum(known - 1, 0)]]))


def described(figure: Figure) -> str:
    """Describe a figure for screen readers: its axes and the range of each curve.

    Examples
    --------
    >>> x = np.array([0.0, 1.0])
    >>> described(Figure(title="t", x_label="time, h", y_label="Y, µm", lines=(Line("with", x, np.array([-1.0, 2])),)))
    'x: time, h; y: Y, µm. with: −1 to 2, at the end 2.'
    """
    words = [f"x: {figure.x_label}; y: {figure.y_label}."]
    for line in figure.lines:
        known = line.y[np.isfinite(line.y)]
        if known.size:
            words.append(
                f"{line.name}: {_short(known.min())} to {_short(known.max())}, at the end {_short(known[-1])}."
            )
        else:
            words.append(f"{line.name}: no values.")
    words += [f"{strip.name}: {len(strip.spans)} time(s)." for strip in figure.strips]
    words += [f"{bar.name}: {bar.value}." for bar in figure.bars]
    words += [f"Below: {described(panel)}" for panel in figure.below]
    return " ".join(words)


def _short(value: float) -> str:
    return f"{value:.3g}".replace("-", "−")
