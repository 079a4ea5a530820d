"""Heat, path states and their uncertainty from T_Q and AT, one sample at a time.

The three paths form one state vector, each in observer canonical form, together with the drive *q* (heat, W, or
T_Q − AT, K, in a direct model) and the ambient change *a* as random walks:

    x[k+1] = F x[k] + w,   w_q ~ N(0, drive_walk²),  w_a ~ N(0, at_walk²)
    AT     = a + v_a
    T_Q    = C₁ x₁ + D₁ q + C₄ x₄ + D₄ a + v_q
    y      = C₂ x₂ + D₂ q + C₃ x₃ + D₃ a

The fourth path leads from the ambient to T_Q: 1, or the lag of a late T_Q, which is then in the first path, too.
Further parts of a model, such as those of other axes, add a DTF and a TDTF each, driven by the same *q* and *a*;
nothing leads from them to T_Q, so they leave the estimates of the others as they are.

Both ways to estimate the heat are observers of this system; only their gains differ:

- `inverse`: a = AT and q = (T_Q − AT − C₁ x₁) / D₁, which is exactly the paper's TTF⁻¹;
- `kalman`: the optimal gains for white sensor noise.

A missing measurement skips its update: the drive keeps its value, the state moves on, and the
covariance *P* grows. Arithmetic is scalar float or element-wise, never a matrix product of a BLAS, whose
order of summation depends on the processor: the same inputs give the same bits on every machine, which is
what lets an audit compare bit by bit. Once *P* has settled, its recursion is skipped until a sample is
missing. *P* depends on no measured value, only on which are missing: observers of one design share its steps.

Source: Simon, Optimal State Estimation (2006), chapters 5 and 7 (sequential update, general gain).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from compensator.arrays import Matrix
from compensator.model.thermal_model import ThermalModel
from compensator.model.transfer_function import SampledTransferFunction

#: P counts as settled when no element moves by more than this, relative to its standard deviations.
SETTLED = 1e-7

#: So many steps of the covariance are kept for each of so many designs: it is the same in every run from rest. About
#: 1,000 lead to the steady state, as many after a gap; one takes 3 to 7 kB.
_KEPT_STEPS, _KEPT_DESIGNS = 2048, 4

_UNITY = SampledTransferFunction(b=(1.0,), a=(1.0,), period_s=60.0)
_ZERO = SampledTransferFunction(b=(0.0,), a=(1.0,), period_s=60.0)


@dataclass(frozen=True, slots=True)
class ObserverState:
    """What the observer keeps between two samples.

    Parameters
    ----------
    x : tuple of float
        State vector after the last update.
    p : tuple of float
        Upper triangle of its covariance, row by row.
    settled : bool
        Whether the covariance has reached its steady value.
    started : bool
        Whether there was a sample since it was at rest.
    """

    x: tuple[float, ...]
    p: tuple[float, ...]
    settled: bool
    started: bool = True


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a sample is expected to measure.

    Parameters
    ----------
    t_q_k, t_q_std_k : float
        T_Q as a change from its reference, and the standard deviation of what is measured around it, K.
    at_k, at_std_k : float
        The same of AT.
    """

    t_q_k: float
    t_q_std_k: float
    at_k: float
    at_std_k: float


@dataclass(slots=True)
class _Ahead:
    """What follows from a covariance alone, as far as it has been asked for.

    Parameters
    ----------
    of : numpy.ndarray, shape (n, n)
        The covariance after a sample; never changed once it is set.
    p : numpy.ndarray, shape (n, n), optional
        That of one sample later, before its measurements.
    with_at : tuple of list of float and numpy.ndarray, optional
        Gain of an AT that is measured then, and the covariance with it.
    t_q_std : dict of bool to float
        Standard deviation of what T_Q will measure, K, with AT measured and without.
    """

    of: Matrix
    p: Matrix | None = None
    with_at: tuple[list[float], Matrix] | None = None
    t_q_std: dict[bool, float] = field(default_factory=dict)


class _Step(NamedTuple):
    """A step of the covariance, which depends on no measured value: shared by all observers of the same design.

    Parameters
    ----------
    ahead : _Ahead
        Covariance after the sample, and what follows from it.
    gain_at, gain_tq : list of float
        Gains for AT and T_Q; empty where missing.
    y_var : float
        Variance of y, µm².
    settled : bool
        Whether the covariance has reached its steady value.
    """

    ahead: _Ahead
    gain_at: list[float]
    gain_tq: list[float]
    y_var: float
    settled: bool


@lru_cache(maxsize=_KEPT_DESIGNS)
def _steps_of(design: tuple[object, ...]) -> dict[tuple[object, ...], _Step]:
    """Return the steps that observers of a design have made."""
    return {}


def _corrected(p: Matrix, gain: Matrix, column: Matrix, s: float) -> Matrix:
    """Return P − K L' − L K' + K S K' with L = P H', which is right for any gain K."""
    cross = np.multiply.outer(gain, column)
    corrected: Matrix = p - (cross + cross.T) + s * np.multiply.outer(gain, gain)
    return corrected


class Observer:
    """The augmented observer of a thermal model.

    Parameters
    ----------
    model : ThermalModel
        Paths, noise levels and the method of estimating the heat.
    """

    def __init__(self, model: ThermalModel) -> None:
        ttf = model.ttf.sampled if model.ttf else _UNITY
        ambient = _UNITY
        late = model.late_t_q
        if late is not None:
            lag = late.within_a_sample(model.period_s, invertible=model.estimator.method == "inverse")
            ttf = ttf.times(lag)
            ambient = lag if late.of_ambient else _UNITY
        tdtf = model.tdtf.sampled if model.tdtf else _ZERO
        estimator = model.estimator
        self._kalman = estimator.method == "kalman"
        self._r_tq = estimator.t_q_noise_std_k**2
        self._r_at = estimator.at_noise_std_k**2
        further = [
            function
            for part in model.parts
            for function in (part.dtf.sampled, part.tdtf.sampled if part.tdtf else _ZERO)
        ]
        self._lay_out(ttf, model.dtf.sampled, tdtf, ambient, *further)
        self._outputs = self._output_rows(model)
        self._walk = np.zeros(self.size)
        self._walk[self._q] = estimator.drive_walk_std**2
        self._walk[self._a] = estimator.at_walk_std_k**2
        upper, right = np.triu_indices(self.size)
        self._upper, self._lower = upper * self.size + right, right * self.size + upper
        #: States of y and their weights.
        weights = ((self._first[1], 1.0), (self._q, self._d[1]), (self._first[2], 1.0), (self._a, self._d[2]))
        self._of_y = [(index, weight) for index, weight in weights if index < self.size]
        noise = (self._kalman, self._r_tq, self._r_at, *self._walk.tolist())
        self._steps = _steps_of((noise, tuple(self._rows), tuple(self._first), tuple(self._d), tuple(self._of_y)))
        self.reset()

    def _lay_out(self, *functions: SampledTransferFunction) -> None:
        """Give every state its number and write F as rows (next, first, source, a, B)."""
        orders = [f.order for f in functions]
        total = sum(orders)
        self._q, self._a, self.size = total, total + 1, total + 2
        nil = self.size  # index of a state that is always zero
        self._first: list[int] = []
        self._d: list[float] = []
        rows: list[tuple[int, int, int, float, float]] = []
        start = 0
        sources = (self._q, self._q, self._a, self._a) + (self._q, self._a) * ((len(functions) - 4) // 2)
        for function, source in zip(functions, sources, strict=True):
            a, b, d = function.observer_form()
            n = function.order
            self._first.append(start if n else nil)
            self._d.append(d)
            rows += [(start + i + 1 if i + 1 < n else nil, start, source, a[i], b[i]) for i in range(n)]
            start += n
        rows += [(self._q, nil, nil, 0.0, 0.0), (self._a, nil, nil, 0.0, 0.0)]
        self._rows = rows
        next_row, first_row, source_row, a_column, b_column = (np.array(column) for column in zip(*rows, strict=True))
        self._gathered = np.array((next_row, first_row, source_row))
        self._factors = np.array((a_column, b_column))[:, :, None]
        self._padded: Matrix = np.zeros((self.size + 1, self.size))

    def _paths_of(self, part: int) -> tuple[int, int]:
        """Return the numbers of DTF and TDTF of a part of the model; 0 is the first."""
        return (1, 2) if part == 0 else (2 * part + 2, 2 * part + 3)

    def _output_rows(self, model: ThermalModel) -> list[list[tuple[int, float]]]:
        """Return for each further output the states that it consists of, with their factors."""
        numbers = {part.axis: i for i, part in enumerate((model, *model.parts))}
        rows = []
        for output in model.outputs:
            row: dict[int, float] = {}
            for name, weight in output.weights:
                for path, source in zip(self._paths_of(numbers[name]), (self._q, self._a), strict=True):
                    for index, factor in ((self._first[path], 1.0), (source, self._d[path])):
                        if index < self.size:
                            row[index] = row.get(index, 0.0) + weight * factor
            rows.append(list(row.items()))
        return rows

    def reset(self) -> None:
        """Return to rest: every state zero and known."""
        self._x = [0.0] * (self.size + 1)
        self._P: Matrix = np.zeros((self.size, self.size))
        self._ahead = _Ahead(self._P)
        self._settled = False
        self._started = False
        self._steady: tuple[list[float], list[float]] = ([], [])
        self._y_var = 0.0
        #: Variances of the further outputs; None where the covariance has changed since.
        self._output_vars: list[float] | None = None

    # ------------------------------------------------------------------ one sample

    def step(self, t_q_k: float, at_k: float, *, extra_t_q_k2: float = 0.0, extra_at_k2: float = 0.0) -> None:
        """Advance by one sample and its measurements.

        Parameters
        ----------
        t_q_k, at_k : float
            T_Q and AT as changes from their reference, K; NaN where missing.
        extra_t_q_k2, extra_at_k2 : float
            Variance added to that of the sensor, K², for a value that was interpolated.
        """
        has_tq, has_at = not math.isnan(t_q_k), not math.isnan(at_k)
        complete = has_tq and has_at and extra_t_q_k2 == extra_at_k2 == 0.0
        if self._started:
            self._x = self._moved(self._x)
        if self._settled and complete:
            gain_at, gain_tq = self._steady
        else:
            r_at = self._r_at + extra_at_k2 if has_at else None
            r_tq = self._r_tq + extra_t_q_k2 if has_tq else None
            gain_at, gain_tq = self._recurse(r_at, r_tq, complete)
        if has_at:
            self._correct(gain_at, at_k - self._x[self._a])
        if has_tq:
            self._correct(gain_tq, t_q_k - self._expected_t_q())
        self._started = True

    def _moved(self, x: list[float]) -> list[float]:
        moved = [x[n] - a * x[f] + b * x[s] for n, f, s, a, b in self._rows]
        moved.append(0.0)
        return moved

    def _correct(self, gain: list[float], innovation: float) -> None:
        x = [value + k * innovation for value, k in zip(self._x, gain, strict=False)]
        x.append(0.0)
        self._x = x

    def _expected_t_q(self) -> float:
        return self._t_q_of(self._x)

    def _t_q_of(self, x: list[float]) -> float:
        expected = x[self._first[0]] + self._d[0] * x[self._q] + self._d[3] * x[self._a]
        return expected + x[self._first[3]]

    def forecast(self, at_k: float) -> Forecast:
        """Return what the next sample is expected to measure, without advancing.

        Parameters
        ----------
        at_k : float
            AT of that sample as a change from its reference, K, from which T_Q is then expected; NaN where missing.
        """
        x = self._moved(self._x) if self._started else self._x
        p, has_at = self._moved_ahead(), not math.isnan(at_k)
        at_expected, at_variance = x[self._a], float(p[self._a, self._a]) + self._r_at
        if has_at:
            gain, p = self._ahead_with_at()
            innovation = at_k - at_expected
            x = [value + k * innovation for value, k in zip(x, gain, strict=False)]
            x.append(0.0)
        t_q_std = self._ahead.t_q_std.get(has_at)
        if t_q_std is None:
            t_q_std = self._ahead.t_q_std[has_at] = math.sqrt(max(self._t_q_column(p, self._r_tq)[1], 0.0))
        return Forecast(self._t_q_of(x), t_q_std, at_expected, math.sqrt(at_variance))

    def drive_for(self, t_q_k: float) -> float:
        """Return the drive that would explain a difference of T_Q, K, from what is expected, within one sample."""
        return self._x[self._q] + (t_q_k / self._d[0] if self._d[0] != 0.0 else math.copysign(math.inf, t_q_k))

    # ------------------------------------------------------------------ covariance

    def _recurse(self, r_at: float | None, r_tq: float | None, complete: bool) -> tuple[list[float], list[float]]:
        """Propagate the covariance by one sample and return the gains for AT and T_Q (None: missing)."""
        key = (self._P.tobytes(), self._started, r_at, r_tq, complete)
        step = self._steps.get(key)
        if step is None:
            step = self._computed_step(r_at, r_tq, complete)
            if len(self._steps) >= _KEPT_STEPS:
                self._steps.clear()
            self._steps[key] = step
        self._ahead, gain_at, gain_tq, self._y_var, self._settled = step
        self._P, self._output_vars = self._ahead.of, None
        if self._settled:
            self._steady = self._steady_gains()
        return gain_at, gain_tq

    def _computed_step(self, r_at: float | None, r_tq: float | None, complete: bool) -> _Step:
        p = self._moved_ahead()
        gain_at: list[float] = []
        gain_tq: list[float] = []
        if r_at is not None:
            gain_at, p = self._ahead_with_at() if r_at == self._r_at else self._update_at(p, r_at)
        if r_tq is not None:
            gain_tq, p = self._update_t_q(p, r_tq)
        settled = complete and self._started and _has_settled(self._P, p)
        return _Step(_Ahead(p), gain_at, gain_tq, _variance(self._of_y, p.tolist()), settled)

    def _steady_gains(self) -> tuple[list[float], list[float]]:
        """Compute the gains of the steady state, a function of *P* alone so that a restart finds the same."""
        gain_at, p = self._update_at(self._moved_covariance(self._P), self._r_at)
        gain_tq, _ = self._update_t_q(p, self._r_tq)
        return gain_at, gain_tq

    def _f_times(self, matrix: Matrix) -> Matrix:
        self._padded[:-1] = matrix
        rows = self._padded.take(self._gathered, axis=0)
        rows[1:] *= self._factors
        product: Matrix = rows[0]
        product -= rows[1]
        product += rows[2]
        return product

    def _moved_covariance(self, p: Matrix) -> Matrix:
        moved = self._f_times(self._f_times(p).T)
        # Symmetric to the bit, because a snapshot keeps the upper triangle only.
        flat = moved.reshape(-1)
        flat.put(self._lower, flat.take(self._upper))
        flat[:: self.size + 1] += self._walk
        return moved

    def _moved_ahead(self) -> Matrix:
        """Return the covariance one sample ahead, which forecasts and the next sample share."""
        if self._ahead.of is not self._P:
            self._ahead = _Ahead(self._P)
        if self._ahead.p is None:
            self._ahead.p = self._moved_covariance(self._P) if self._started else self._P
        return self._ahead.p

    def _ahead_with_at(self) -> tuple[list[float], Matrix]:
        """Return the gain of an AT that was measured, and the covariance one sample ahead with it."""
        p = self._moved_ahead()
        if self._ahead.with_at is None:
            self._ahead.with_at = self._update_at(p, self._r_at)
        return self._ahead.with_at

    def _update_at(self, p: Matrix, variance: float) -> tuple[list[float], Matrix]:
        column = p[:, self._a]
        s = float(column[self._a]) + variance
        if self._kalman:
            gain = column / s
        else:
            gain = np.zeros(self.size)
            gain[self._a] = 1.0
        return gain.tolist(), _corrected(p, gain, column, s)

    def _t_q_column(self, p: Matrix, variance: float) -> tuple[Matrix, float]:
        """Return the covariance of the states with T_Q, and the variance of T_Q as it is measured."""
        column = self._d[0] * p[:, self._q] + self._d[3] * p[:, self._a]
        states = [first for first in (self._first[0], self._first[3]) if first < self.size]
        for first in states:
            column = column + p[:, first]
        s = self._d[0] * float(column[self._q]) + self._d[3] * float(column[self._a]) + variance
        for first in states:
            s += float(column[first])
        return column, s

    def _update_t_q(self, p: Matrix, variance: float) -> tuple[list[float], Matrix]:
        column, s = self._t_q_column(p, variance)
        if self._kalman:
            gain = column / s
        else:
            gain = np.zeros(self.size)
            gain[self._q] = 1.0 / self._d[0]
        return gain.tolist(), _corrected(p, gain, column, s)

    def _variance_of_y(self) -> float:
        return _variance(self._of_y, self._P.tolist())

    # ------------------------------------------------------------------ estimates

    @property
    def x(self) -> list[float]:
        """State vector after the last update, and a zero."""
        return self._x

    @property
    def covariance(self) -> Matrix:
        """Its covariance."""
        return self._P

    @property
    def settled(self) -> bool:
        """Whether the covariance has reached its steady value."""
        return self._settled

    @property
    def started(self) -> bool:
        """Whether there was a sample since it was at rest."""
        return self._started

    @property
    def drive(self) -> float:
        """Estimated heat, W (T_Q − AT, K, in a direct model)."""
        return self._x[self._q]

    @property
    def ambient_k(self) -> float:
        """Estimated change of the ambient, K."""
        return self._x[self._a]

    @property
    def drive_std(self) -> float:
        """Standard deviation of the drive, in its unit."""
        return math.sqrt(max(float(self._P[self._q, self._q]), 0.0))

    @property
    def y_variance_um2(self) -> float:
        """Variance of y that sensor noise and missing samples cause, µm²."""
        return self._y_var

    @property
    def output_variances(self) -> list[float]:
        """Variance of each further output that sensor noise and missing samples cause, in its unit squared."""
        if self._output_vars is None:
            covariance = self._P.tolist()
            self._output_vars = [_variance(row, covariance) for row in self._outputs]
        return self._output_vars

    def shares_um(self) -> tuple[float, float]:
        """Return the shares of DTF and TDTF in y, µm."""
        return self.shares_of(0, self._x)

    def ahead(self) -> list[float]:
        """Return the state vector one sample ahead, with drive and ambient as they are, and a zero."""
        return self._moved(self._x)

    def shares_of(self, part: int, x: list[float]) -> tuple[float, float]:
        """Return the shares of DTF and TDTF of a part of the model in a state, µm; part 0 gives y."""
        first, second = self._paths_of(part)
        dtf = x[self._first[first]] + self._d[first] * x[self._q]
        tdtf = x[self._first[second]] + self._d[second] * x[self._a]
        return dtf, tdtf

    # ------------------------------------------------------------------ after a gap

    def covariance_ahead(self) -> Matrix:
        """Return the covariance one sample ahead, before its measurements."""
        return self._moved_ahead()

    def widen(self, ahead: Matrix) -> None:
        """Set the covariance after a gap whose inputs were interpolated.

        The errors of an interpolated drive are correlated over the whole gap and do not average out, as the repeated
        steps assume. A random walk that is measured again at the end of a gap has the straight line as its mean and the
        covariance of the optimal filter, which skipped the gap: that one is used, whatever the method, if it is larger.

        Parameters
        ----------
        ahead : numpy.ndarray, shape (n, n)
            Covariance before the measurements of the present sample, of an observer that skipped the gap.
        """
        column = ahead[:, self._a]
        gain = column / (float(column[self._a]) + self._r_at)
        p = _corrected(ahead, gain, column, float(column[self._a]) + self._r_at)
        column, s = self._t_q_column(p, self._r_tq)
        gain = column / s
        walked, walked_var = self._P, self._y_var
        self._P = _corrected(p, gain, column, s)
        self._y_var, self._output_vars = self._variance_of_y(), None
        if self._y_var > walked_var:
            self._settled = False
        else:
            self._P, self._y_var = walked, walked_var

    # ------------------------------------------------------------------ state

    def snapshot(self) -> ObserverState:
        """Return what must be kept to continue from here with the same bits."""
        return ObserverState(
            x=tuple(self._x[: self.size]),
            p=tuple(self._P.take(self._upper).tolist()),
            settled=self._settled,
            started=self._started,
        )

    def restore(self, state: ObserverState) -> None:
        """Continue from a snapshot.

        Raises
        ------
        ValueError
            If the snapshot belongs to a model of another size.
        """
        if len(state.x) != self.size or len(state.p) != self._upper.size:
            raise ValueError(f"snapshot of {len(state.x)} states, the model has {self.size}")
        self._x = [*state.x, 0.0]
        self._P = np.zeros((self.size, self.size))
        flat = self._P.reshape(-1)
        flat[self._upper] = flat[self._lower] = state.p
        self._started = state.started
        self._y_var, self._output_vars = self._variance_of_y(), None
        self._settled = state.settled
        if state.settled:
            self._steady = self._steady_gains()


def _has_settled(before: Matrix, p: Matrix) -> bool:
    variances = p.diagonal()
    deviation = np.sqrt(np.maximum(variances, 0.0))
    # The variances alone show most of the way that it has not.
    if (np.abs(variances - before.diagonal()) > SETTLED * (deviation * deviation)).any():
        return False
    scale = np.multiply.outer(deviation, deviation)
    return bool((np.abs(p - before) <= SETTLED * scale).all())


def _variance(terms: list[tuple[int, float]], covariance: list[list[float]]) -> float:
    """Return the variance of a sum of states with their weights."""
    total = 0.0
    for i, wi in terms:
        for j, wj in terms:
            total += wi * wj * covariance[i][j]
    return max(total, 0.0)
