"""Covariance of the observer's state, and the gains that follow from it.

With F, the noise of the drive and of the ambient, H and the variance R of a measurement, for any gain K:

    P ← F P Fᵀ + W
    P ← P − K Lᵀ − L Kᵀ + K S Kᵀ,   L = P Hᵀ,   S = H P Hᵀ + R

AT is taken first, then T_Q; one that is missing skips its update, and *P* grows. Gains: `kalman` K = L / S, `inverse`
what makes the estimate meet the measurement exactly. Once *P* has settled, its recursion is skipped until a sample is
incomplete; the gains are then those that follow from that *P*, so that a restart finds the same.

**Shared steps.** No measured value enters *P*, only which were measured, with what variance. A step is a pure function
of the design, of *P* before it and of these, in element-wise arithmetic of a fixed order. All of this is its key, to
the bit: a step that another observer has made has the bits that it would have here, whoever was first. What has been
found is never changed; two threads that find the same step at once find the same. A process keeps 8 MB (`_KEPT_BYTES`)
of steps, of all designs together. One that does not fit any more makes it forget all and begin again: until then a step
is kept, whether or not its observer still is. Some 1,000 samples lead from rest to the steady state, as many after a
gap: a step each. A settled observer adds none. 8 MB are 2,800 steps of `quill`, 1,470 of a machine of five parts. The
way of a late T_Q from its past to the present (`run_on`) is one shared step, however many samples it has; it is taken
only where somebody asks for the covariance.

Source: Simon, Optimal State Estimation (2006), chapters 5 and 7 (sequential update, general gain).
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from compensator.arrays import Matrix, Vector

#: P counts as settled when no element moves by more than this, relative to its standard deviations.
SETTLED = 1e-7

#: Memory for the steps that a process keeps, bytes.
_KEPT_BYTES = 8_000_000

#: States of a sum, and their weights.
Terms = list[tuple[int, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """What the covariance follows from; the last two of its n states are the drive and the ambient.

    Parameters
    ----------
    rows : tuple of (int, int, int, float, float), length n
        F, by rows (next, first, source, a, B): x_next − a x_first + B x_source. Index n is a state that is always zero.
    first : tuple of int
        First state of each path; n where it has none.
    feed : tuple of float
        What each path feeds through.
    of_y : tuple of (int, float)
        States of y and their weights.
    walk : tuple of float, length n
        Variance that each state gains in a sample, in its unit squared.
    t_q_var_k2, at_var_k2 : float
        Variances of the measurements, K².
    kalman : bool
        Whether the gains are the optimal ones; else those of the plain inverse.
    """

    rows: tuple[tuple[int, int, int, float, float], ...]
    first: tuple[int, ...]
    feed: tuple[float, ...]
    of_y: tuple[tuple[int, float], ...]
    walk: tuple[float, ...]
    t_q_var_k2: float
    at_var_k2: float
    kalman: bool


class Gains(NamedTuple):
    """Gains of the measurements of a sample, each of length n; empty where one is missing."""

    at: list[float]
    t_q: list[float]


@dataclass(slots=True)
class _Expected:
    """What forecasts need of the covariance one sample ahead, as far as it has been asked for."""

    at_std_k: float | None = None
    #: Gain of an AT that is measured then.
    gain_at: list[float] | None = None
    #: With AT measured and without.
    t_q_std_k: dict[bool, float] = field(default_factory=dict)


class _Step(NamedTuple):
    """A step: the covariance after it, how it was found, the variance of y (µm²), and what is expected next."""

    p: Matrix
    gains: Gains
    y_var: float
    settled: bool
    expected: _Expected


class _SharedSteps:
    """The steps that a process keeps, and how much memory they take at most."""

    def __init__(self) -> None:
        self.steps: dict[tuple[object, ...], _Step] = {}
        self.bytes = 0

    def add(self, key: tuple[object, ...], step: _Step) -> None:
        """Keep a step, and forget all others where there is no room for it."""
        size = _bytes_of(step)
        if self.bytes + size > _KEPT_BYTES:
            self.clear()
        self.bytes += size
        self.steps[key] = step

    def clear(self) -> None:
        """Forget all."""
        self.steps.clear()
        self.bytes = 0


def _bytes_of(step: _Step) -> int:
    # The array, two lists of gains and one of a forecast; with its key 1,030 bytes were measured beside them.
    return 8 * step.p.size + 96 * len(step.p) + 1_100


_shared = _SharedSteps()


class Covariance:
    """The covariance of a state vector, from rest, one sample at a time.

    Parameters
    ----------
    design : Design
        What it follows from.

    Attributes
    ----------
    started : bool
        Whether there was a sample since it was at rest, from which on a sample moves it; the observer says so.
    settled : bool
        Whether it has reached its steady value.
    """

    def __init__(self, design: Design) -> None:
        self._design = design
        # As text, because 0.0 == -0.0; one text for all observers of the design.
        self._key = sys.intern(repr(design))
        self.size = len(design.rows)
        self._drive, self._ambient = self.size - 2, self.size - 1
        self._upper, self._lower = _triangles(self.size)
        next_row, first_row, source_row, a, b = (np.array(column) for column in zip(*design.rows, strict=True))
        self._gathered = np.array((next_row, first_row, source_row))
        self._factors = np.array((a, b))[:, :, None]
        self._walk = np.array(design.walk)
        self._of_y = list(design.of_y)
        # Of its own, not of the design: another thread may run an observer of the same one.
        self._padded: Matrix = np.zeros((self.size + 1, self.size))
        self.reset()

    def reset(self) -> None:
        """Return to rest: every state known."""
        self._set(_read_only(np.zeros((self.size, self.size))), _Expected())
        self._y_var = 0.0
        self.started = self.settled = False
        self._steady = Gains([], [])

    def _set(self, p: Matrix, expected: _Expected) -> None:
        self._p = p
        self._of_next = expected
        self._moved_p: Matrix | None = None
        self._with_at: tuple[list[float], Matrix] | None = None
        #: Samples without T_Q that the covariance is still behind (`run_on`).
        self._behind: tuple[float | None, ...] = ()

    @property
    def p(self) -> Matrix:
        """The covariance, of shape (n, n)."""
        if self._behind:
            self._catch_up()
        return self._p

    @property
    def y_var(self) -> float:
        """Variance of y that sensor noise and missing samples cause, µm²."""
        if self._behind:
            self._catch_up()
        return self._y_var

    @property
    def _expected(self) -> _Expected:
        if self._behind:
            self._catch_up()
        return self._of_next

    def variances_of(self, sums: Iterable[Terms]) -> list[float]:
        """Return the variances of sums of states."""
        p = self.p.tolist()
        return [_variance(terms, p) for terms in sums]

    # ------------------------------------------------------------------ one sample

    def step(self, extra_at_k2: float | None, extra_t_q_k2: float | None) -> Gains:
        """Advance by one sample and return the gains of its measurements.

        Parameters
        ----------
        extra_at_k2, extra_t_q_k2 : float, optional
            Variance added to that of the sensor, K²; None where AT or T_Q is missing.
        """
        complete = extra_at_k2 == extra_t_q_k2 == 0.0
        if self.settled and complete:
            return self._steady
        r_at = None if extra_at_k2 is None else self._design.at_var_k2 + extra_at_k2
        r_tq = None if extra_t_q_k2 is None else self._design.t_q_var_k2 + extra_t_q_k2
        # The bytes are those that the array stands on.
        key = (self._key, self.p.base, self.started, r_at, r_tq, complete)
        step = _shared.steps.get(key)
        if step is None:
            step = self._computed(r_at, r_tq, complete=complete)
            _shared.add(key, step)
        self._take(step)
        self.settled = step.settled
        if self.settled:
            self._steady = self._steady_gains()
        return step.gains

    def _take(self, step: _Step) -> None:
        # After the first sample it is for the observer to say whether the next one moves it.
        self._set(step.p, step.expected if self.started else _Expected())
        self._y_var = step.y_var

    def _computed(self, r_at: float | None, r_tq: float | None, *, complete: bool) -> _Step:
        p = self.ahead()
        gains = Gains([], [])
        if r_at is not None:
            gain, p = self._ahead_with_at() if r_at == self._design.at_var_k2 else self._update_at(p, r_at)
            gains = Gains(gain, [])
        if r_tq is not None:
            gain, p = self._update_t_q(p, r_tq)
            gains = Gains(gains.at, gain)
        settled = complete and self.started and _has_settled(self.p, p)
        y_var = _variance(self._of_y, p.tolist())
        return _Step(_read_only(p), gains, y_var, settled, _Expected())

    def _steady_gains(self) -> Gains:
        """Compute the gains of the steady state, a function of *P* alone so that a restart finds the same."""
        gain_at, p = self._update_at(self._moved(self.p), self._design.at_var_k2)
        gain_tq, _ = self._update_t_q(p, self._design.t_q_var_k2)
        return Gains(gain_at, gain_tq)

    def _f_times(self, matrix: Matrix) -> Matrix:
        self._padded[:-1] = matrix
        rows = self._padded.take(self._gathered, axis=0)
        rows[1:] *= self._factors
        product: Matrix = rows[0]
        product -= rows[1]
        product += rows[2]
        return product

    def _moved(self, p: Matrix) -> Matrix:
        moved = self._f_times(self._f_times(p).T)
        # Symmetric to the bit, because a snapshot keeps the upper triangle only.
        flat = moved.reshape(-1)
        flat.put(self._lower, flat.take(self._upper))
        flat[:: self.size + 1] += self._walk
        return moved

    def _update_at(self, p: Matrix, variance: float) -> tuple[list[float], Matrix]:
        column = p[:, self._ambient]
        return self._update(p, column, float(column[self._ambient]) + variance, self._ambient, 1.0)

    def _update_t_q(self, p: Matrix, variance: float) -> tuple[list[float], Matrix]:
        return self._update(p, *self._t_q_column(p, variance), self._drive, self._design.feed[0])

    def _update(self, p: Matrix, column: Matrix, s: float, state: int, feed: float) -> tuple[list[float], Matrix]:
        """Return the gain of a measurement, which by the plain inverse sets the state that it is fed from, and P."""
        if self._design.kalman:
            gain = column / s
        else:
            gain = np.zeros(self.size)
            gain[state] = 1.0 / feed
        return gain.tolist(), _corrected(p, gain, column, s)

    def _t_q_column(self, p: Matrix, variance: float) -> tuple[Matrix, float]:
        """Return the covariance of the states with T_Q, and the variance of T_Q as it is measured."""
        first, feed = self._design.first, self._design.feed
        column = feed[0] * p[:, self._drive] + feed[3] * p[:, self._ambient]
        states = [state for state in (first[0], first[3]) if state < self.size]
        for state in states:
            column = column + p[:, state]
        s = feed[0] * float(column[self._drive]) + feed[3] * float(column[self._ambient]) + variance
        for state in states:
            s += float(column[state])
        return column, s

    # ------------------------------------------------------------------ one sample ahead

    def ahead(self) -> Matrix:
        """Return the covariance one sample ahead, before its measurements; forecasts and the next sample share it."""
        if self._moved_p is None:
            self._moved_p = self._moved(self.p) if self.started else self.p
        return self._moved_p

    def _ahead_with_at(self) -> tuple[list[float], Matrix]:
        """Return the gain of an AT that was measured, and the covariance one sample ahead with it."""
        if self._with_at is None:
            self._with_at = self._update_at(self.ahead(), self._design.at_var_k2)
        return self._with_at

    def expected_at_std_k(self) -> float:
        """Return the standard deviation of what AT will measure in the next sample, K."""
        if self._expected.at_std_k is None:
            variance = float(self.ahead()[self._ambient, self._ambient]) + self._design.at_var_k2
            self._expected.at_std_k = math.sqrt(variance)
        return self._expected.at_std_k

    def expected_gain_at(self) -> list[float]:
        """Return the gain of an AT that is measured in the next sample."""
        if self._expected.gain_at is None:
            self._expected.gain_at = self._ahead_with_at()[0]
        return self._expected.gain_at

    def expected_t_q_std_k(self, *, with_at: bool) -> float:
        """Return the standard deviation of what T_Q will measure in the next sample, K, with AT measured or without."""
        std = self._expected.t_q_std_k.get(with_at)
        if std is None:
            p = self._ahead_with_at()[1] if with_at else self.ahead()
            std = math.sqrt(max(self._t_q_column(p, self._design.t_q_var_k2)[1], 0.0))
            self._expected.t_q_std_k[with_at] = std
        return std

    # ------------------------------------------------------------------ from elsewhere

    def run_on(self, past: Covariance, extras_at_k2: tuple[float | None, ...]) -> list[list[float]]:
        """Continue from where another of the same design is, without T_Q, and return the gains of AT.

        Parameters
        ----------
        past : Covariance
            Where the other is.
        extras_at_k2 : tuple of (float or None), length n
            For each sample since then, the variance added to that of the sensor, K²; None where AT is missing.

        Returns
        -------
        list of list of float, length n
            Gains of AT in each sample; empty where it is missing.
        """
        p, self.started, self.settled = past.p, past.started, False
        self._set(p, _Expected())
        self._behind = extras_at_k2
        return self._gains_without_t_q(p[:, self._ambient].tolist(), extras_at_k2)

    def _gains_without_t_q(self, column: list[float], extras_at_k2: tuple[float | None, ...]) -> list[list[float]]:
        """Return the gains of AT in each sample, with the bits of `_computed`.

        They follow from the covariance of the states with the ambient, and that from itself: the ambient follows from
        no other state.
        """
        a, walk, gains = self._ambient, float(self._walk[-1]), list[list[float]]()
        for extra in extras_at_k2:
            if self.started:
                column.append(0.0)
                column = [column[n] - k * column[f] + b * column[s] for n, f, s, k, b in self._design.rows]
                column[a] += walk
            if extra is None:
                gains.append([])
                continue
            s_at = column[a] + (self._design.at_var_k2 + extra)
            gain = [c / s_at for c in column] if self._design.kalman else [0.0] * a + [1.0]
            of_a, own = gain[a], column[a]
            column = [c - (k * own + of_a * c) + s_at * (k * of_a) for c, k in zip(column, gain, strict=True)]
            gains.append(gain)
        return gains

    def _catch_up(self) -> None:
        """Take the samples that the covariance is behind."""
        extras_at_k2, self._behind = self._behind, ()
        key = (self._key, self._p.base, self.started, extras_at_k2)
        step = _shared.steps.get(key)
        if step is None:
            for extra in extras_at_k2:
                step = self._computed(None if extra is None else self._design.at_var_k2 + extra, None, complete=False)
                self._set(step.p, _Expected())
            assert step is not None
            _shared.add(key, step)
        self._take(step)

    def widen(self, ahead: Matrix) -> None:
        """Take the optimal filter's covariance after a sample, if the variance of y is larger with it.

        Parameters
        ----------
        ahead : numpy.ndarray, shape (n, n)
            Covariance before the measurements of the sample.
        """
        column = ahead[:, self._ambient]
        s = float(column[self._ambient]) + self._design.at_var_k2
        p = _corrected(ahead, column / s, column, s)
        column, s = self._t_q_column(p, self._design.t_q_var_k2)
        p = _corrected(p, column / s, column, s)
        y_var = _variance(self._of_y, p.tolist())
        if y_var > self.y_var:
            self._replace(p)

    def gain_of_y(self, variance_um2: float, of_y: Sequence[tuple[int, float]]) -> tuple[list[float], float]:
        """Return the gain of a measured y after the sample's other measurements, and the variance expected of it.

        Parameters
        ----------
        variance_um2 : float
            Variance of the value itself, µm².
        of_y : sequence of (int, float)
            States of y, and by how much it changes with each.
        """
        column, s = self._column_of_y(variance_um2, of_y)
        return (column / s).tolist(), s

    def measure_y(self, variance_um2: float, of_y: Sequence[tuple[int, float]]) -> list[float]:
        """Take a measured y, and return its gain, which is that of `gain_of_y`."""
        column, s = self._column_of_y(variance_um2, of_y)
        gain = column / s
        self._replace(_corrected(self.p, gain, column, s))
        found: list[float] = gain.tolist()
        return found

    def _column_of_y(self, variance_um2: float, of_y: Sequence[tuple[int, float]]) -> tuple[Vector, float]:
        column = np.zeros(self.size)
        for state, weight in of_y:
            column = column + weight * self.p[:, state]
        return column, variance_um2 + sum(weight * float(column[state]) for state, weight in of_y)

    def doubt(self, changes: Iterable[Sequence[float] | Vector]) -> None:
        """Widen it by errors of the state that are independent of each other, each of its own size.

        Parameters
        ----------
        changes : iterable of sequence of float, shape (n,)
            One standard deviation of each, as a change of the state.
        """
        p = self.p
        for change in changes:
            p = p + np.multiply.outer(np.array(change), np.array(change))
        self._replace(p)

    def _replace(self, p: Matrix) -> None:
        self._set(_read_only(p), _Expected())
        self._y_var, self.settled = _variance(self._of_y, p.tolist()), False

    def upper_triangle(self) -> tuple[float, ...]:
        """Return the upper triangle, row by row, which is all that there is: it is symmetric to the bit."""
        return tuple(self.p.take(self._upper).tolist())

    def restore(self, upper_triangle: tuple[float, ...], *, started: bool, settled: bool) -> None:
        """Continue from an upper triangle.

        Raises
        ------
        ValueError
            If it is of another size.
        """
        if len(upper_triangle) != self._upper.size:
            raise ValueError(f"snapshot of {len(upper_triangle)} covariances, the model has {self._upper.size}")
        p = np.zeros((self.size, self.size))
        flat = p.reshape(-1)
        flat[self._upper] = flat[self._lower] = upper_triangle
        self._set(_read_only(p), _Expected())
        self.started, self.settled = started, settled
        self._y_var = _variance(self._of_y, self.p.tolist())
        if settled:
            self._steady = self._steady_gains()


@functools.cache
def _triangles(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return where the upper triangle of a matrix is in its elements, row by row, and where its mirror image is."""
    upper, right = np.triu_indices(size)
    return upper * size + right, right * size + upper


def _read_only(p: Matrix) -> Matrix:
    """Return a copy that stands on bytes, which are also the key of the step after it."""
    return np.ndarray(p.shape, buffer=p.tobytes())


def _corrected(p: Matrix, gain: Matrix, column: Matrix, s: float) -> Matrix:
    """Return P − K L' − L K' + K S K' with L = P H', which is right for any gain K."""
    cross = np.multiply.outer(gain, column)
    corrected: Matrix = p - (cross + cross.T) + s * np.multiply.outer(gain, gain)
    return corrected


def _has_settled(before: Matrix, p: Matrix) -> bool:
    variances = p.diagonal()
    deviation = np.sqrt(np.maximum(variances, 0.0))
    # The variances alone show most of the way that it has not.
    if (np.abs(variances - before.diagonal()) > SETTLED * (deviation * deviation)).any():
        return False
    scale = np.multiply.outer(deviation, deviation)
    return bool((np.abs(p - before) <= SETTLED * scale).all())


def _variance(terms: Terms, covariance: list[list[float]]) -> float:
    """Return the variance of a sum of states with their weights."""
    total = 0.0
    for i, wi in terms:
        for j, wj in terms:
            total += wi * wj * covariance[i][j]
    return max(total, 0.0)


def may_be_covariance(p: Sequence[float]) -> bool:
    """Return whether numbers from elsewhere may be a covariance: its upper triangle, row by row.

    No variance is negative, and none of two states explains more of the other than all of it, but for rounding.
    """
    size = round((math.sqrt(8.0 * len(p) + 1.0) - 1.0) / 2.0)
    if not p or len(p) != size * (size + 1) // 2:
        return False
    full = np.zeros((size, size))
    full[np.triu_indices(size)] = p
    variances = np.diag(full)
    largest = np.outer(variances, variances)
    return bool(np.all(variances >= 0.0) and np.all(full**2 <= (1.0 + 1e-6) * largest + 1e-12 * np.max(largest)))
