"""Curves and strips of any length in bounded memory: only what a figure can show is kept."""

from __future__ import annotations

import math

import numpy as np

from compensator.arrays import Vector
from compensator.report.figure import Line, extremes

#: Least number of columns of a curve; each keeps its lowest and its highest point.
COLUMNS = 1000
#: Number of points at which a curve is thinned again.
_MOST = 8 * COLUMNS
#: From this column width on, the raw curve of a working machine would fill the figure; means are drawn instead, s.
_WIDE_S = 2048.0
#: Largest number of pieces of a strip.
_PIECES = 1000
#: Points farther apart than this number of periods or columns have a gap between them.
_GAP = 2.5


class Envelope:
    """A growing curve, reduced to the lowest and the highest point of each column, with their own times.

    Column widths are powers of two of a second and only grow, so thinning twice loses no more than thinning once.

    Parameters
    ----------
    period_s : float
        Sampling period, s.

    Examples
    --------
    >>> curve = Envelope(period_s=60.0)
    >>> t = np.arange(100_000) * 60.0
    >>> curve.add(t, np.where(t == 54_321 * 60.0, 1.0, 0.0))
    >>> t, y = curve.points()
    >>> t.size < 4500, float(t[np.argmax(y)]) / 60.0
    (True, 54321.0)
    """

    def __init__(self, *, period_s: float = 60.0) -> None:
        self._period_s = period_s
        self._width_s = 0.0
        #: Number, sum and count of each column, without the points since the last thinning.
        self._sums = np.empty((3, 0))
        self._summed_s = 0.0
        self._new: list[tuple[Vector, Vector]] = []
        self._t: list[Vector] = []
        self._y: list[Vector] = []
        self._size = 0

    def add(self, t_s: Vector, y: Vector) -> None:
        """Add points.

        Parameters
        ----------
        t_s : numpy.ndarray, shape (n,)
            Times, s.
        y : numpy.ndarray, shape (n,)
            Values; NaN where missing.
        """
        self._new.append((t_s, y))
        self._t.append(t_s)
        self._y.append(y)
        self._size += t_s.size
        if self._size > _MOST:
            self._thin()

    @property
    def known(self) -> bool:
        """Whether there is any value."""
        return any(bool(np.isfinite(y).any()) for y in self._y)

    def columns(self) -> tuple[Vector, Vector, Vector, Vector] | None:
        """Return time, mean, lowest and highest of each column; None if columns are narrow enough to draw the points.

        Returns
        -------
        tuple of numpy.ndarray, shape (n,), or None
            s, and the curve's unit; NaN where a column has no value.
        """
        self._thin()
        if self._width_s < _WIDE_S:
            return None
        t, y = self._t[0], self._y[0]
        numbers = np.floor(t / self._width_s)
        starts = np.concatenate([[0], np.flatnonzero(np.diff(numbers)) + 1])
        low, high = np.fmin.reduceat(y, starts), np.fmax.reduceat(y, starts)
        own, sums, counts = self._sums
        mean = np.full(starts.size, np.nan)
        np.divide(sums, counts, out=mean, where=counts > 0.0)
        at = (own + 0.5) * self._width_s
        gaps = np.flatnonzero(np.diff(own) > _GAP) + 1
        between = (at[gaps - 1] + at[gaps]) / 2.0
        mean, low, high = (np.insert(values, gaps, np.nan) for values in (mean, low, high))
        return np.insert(at, gaps, between), mean, low, high

    def points(self) -> tuple[Vector, Vector]:
        """Return the curve in order of time, with a NaN in each gap longer than a column."""
        self._thin()
        t, y = self._t[0], self._y[0]
        gaps = np.flatnonzero(np.diff(t) > _GAP * max(self._period_s, self._width_s))
        return np.insert(t, gaps + 1, (t[gaps] + t[gaps + 1]) / 2.0), np.insert(y, gaps + 1, np.nan)

    def _thin(self) -> None:
        t, y = np.concatenate([*self._t, np.empty(0)]), np.concatenate([*self._y, np.empty(0)])
        order = np.argsort(t, kind="stable")
        t, y = t[order], y[order]
        if t.size > 2 * COLUMNS or (self._width_s and self._new):
            span_s = max(float(t[-1] - t[0]), 1.0)
            self._width_s = max(self._width_s, 2.0 ** math.floor(math.log2(span_s / COLUMNS)))
            self._add_up()
            keep = extremes(np.floor(t / self._width_s), y)
            t, y = t[keep], y[keep]
        self._t, self._y, self._size = [t], [y], t.size

    def _add_up(self) -> None:
        """Add the new points to the sums, at the present column width."""
        if not self._new:
            return
        times = (np.concatenate([t for t, _ in self._new]), np.concatenate([y for _, y in self._new]))
        known = np.isfinite(times[1])
        fresh = np.array([np.floor(times[0] / self._width_s), np.where(known, times[1], 0.0), known.astype(np.float64)])
        old = self._sums.copy()
        if self._summed_s:
            old[0] = np.floor(old[0] * (self._summed_s / self._width_s))
        number, place = np.unique(np.concatenate([old[0], fresh[0]]), return_inverse=True)
        both = np.concatenate([old[1:], fresh[1:]], axis=1)
        sums = [np.bincount(place, weights=weights, minlength=number.size) for weights in both]
        self._sums, self._new, self._summed_s = np.array([number, *sums]), [], self._width_s


def line_of(name: str, curve: Envelope) -> Line:
    """Return a curve to draw: its points, or, over a long time, its means with the range as a band."""
    columns = curve.columns()
    if columns is None:
        return Line(name, *curve.points())
    t, mean, low, high = columns
    return Line(name, t, mean, band=(low, high))


class Stretches:
    """When something was active, as intervals of time; the nearest are joined when there are too many.

    Examples
    --------
    >>> held = Stretches()
    >>> for first, last in ((0.0, 60.0), (60.0, 120.0), (300.0, 360.0)):
    ...     held.add(first, last)
    >>> held.pieces
    [(0.0, 120.0), (300.0, 360.0)]
    """

    def __init__(self) -> None:
        self.pieces: list[tuple[float, float]] = []
        #: Number of starts.
        self.count = 0
        self._distance_s = 1.0

    def add(self, first_s: float, last_s: float) -> None:
        """Add an interval, s; one that continues the last extends it."""
        if self.pieces and 0.0 <= first_s - self.pieces[-1][1] <= 1.0:
            self.pieces[-1] = (self.pieces[-1][0], last_s)
            return
        self.count += 1
        if self.pieces and 0.0 <= first_s - self.pieces[-1][1] <= self._distance_s:
            self.pieces[-1] = (self.pieces[-1][0], last_s)
            return
        self.pieces.append((first_s, last_s))
        if len(self.pieces) > _PIECES:
            self._distance_s = 2.0 * max(self._distance_s, (last_s - self.pieces[0][0]) / _PIECES)
            self._join()

    def _join(self) -> None:
        joined = self.pieces[:1]
        for first, last in self.pieces[1:]:
            if 0.0 <= first - joined[-1][1] <= self._distance_s:
                joined[-1] = (joined[-1][0], last)
            else:
                joined.append((first, last))
        self.pieces = joined
