"""Curves and strips of any length in little memory: no more is kept than a picture can show."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]

#: Columns of pixels that a curve has at least; each keeps its lowest and its highest point.
COLUMNS = 1000
#: Points that are kept before a curve is thinned again.
_MOST = 8 * COLUMNS
#: Pieces of a strip that are told apart.
_PIECES = 1000
#: A distance of so many periods or columns between two points is a gap.
_GAP = 2.5


class Envelope:
    """A curve that grows: of each column of pixels its lowest and its highest point, with their own times.

    Columns are a power of two of a second wide and only become wider, so that what is thinned twice loses nothing more
    than what is thinned once.

    Parameters
    ----------
    period_s : float
        Distance of its points where none is missing, s.

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
        self._t: list[Vector] = []
        self._y: list[Vector] = []
        self._size = 0

    def add(self, t_s: Vector, y: Vector) -> None:
        """Take points in.

        Parameters
        ----------
        t_s : numpy.ndarray, shape (n,)
            Times, s.
        y : numpy.ndarray, shape (n,)
            Values; NaN where one is missing.
        """
        self._t.append(t_s)
        self._y.append(y)
        self._size += t_s.size
        if self._size > _MOST:
            self._thin()

    @property
    def known(self) -> bool:
        """Whether there is any value."""
        return any(bool(np.isfinite(y).any()) for y in self._y)

    def points(self) -> tuple[Vector, Vector]:
        """Return the curve in the order of time, with a NaN wherever nothing is known for longer than a column."""
        self._thin()
        t, y = self._t[0], self._y[0]
        gaps = np.flatnonzero(np.diff(t) > _GAP * max(self._period_s, self._width_s))
        return np.insert(t, gaps + 1, (t[gaps] + t[gaps + 1]) / 2.0), np.insert(y, gaps + 1, np.nan)

    def _thin(self) -> None:
        t, y = np.concatenate([*self._t, np.empty(0)]), np.concatenate([*self._y, np.empty(0)])
        order = np.argsort(t, kind="stable")
        t, y = t[order], y[order]
        if t.size > 2 * COLUMNS:
            span_s = max(float(t[-1] - t[0]), 1.0)
            self._width_s = max(self._width_s, 2.0 ** math.floor(math.log2(span_s / COLUMNS)))
            keep = _extremes(np.floor(t / self._width_s), y)
            t, y = t[keep], y[keep]
        self._t, self._y, self._size = [t], [y], t.size


def _extremes(column: Vector, y: Vector) -> npt.NDArray[np.int_]:
    """Return where the lowest and the highest value of each column stand; of one without any, its first."""
    order = np.lexsort((y, column))
    starts = np.concatenate([[0], np.flatnonzero(np.diff(column[order])) + 1])
    known = np.add.reduceat(np.isfinite(y[order]).astype(np.int_), starts)
    return np.unique(np.concatenate([order[starts], order[starts + np.maximum(known - 1, 0)]]))


class Stretches:
    """When something stood, as pieces of time; where they are too many, the nearest are joined.

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
        #: How often it began.
        self.count = 0
        self._distance_s = 1.0

    def add(self, first_s: float, last_s: float) -> None:
        """Take a piece in, s; one that goes on from the last makes it longer."""
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
