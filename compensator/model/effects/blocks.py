"""Blocks that the laws of effects are composed of.

A block advances by one sample (`step`) or returns its response to a whole record from rest (`filter`). A law is given
either of them, so that the same law serves the engine and the fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from compensator.arrays import NAN, Matrix, Vector
from compensator.errors import ModelError
from compensator.model.transfer_function import SampledTransferFunction

#: One sample or a whole record: the arithmetic of a law is the same for both.
S = TypeVar("S", float, Vector)


class Block:
    """One input, one output, and a state of floats."""

    #: Everything that it must remember to continue with the same bits.
    state: tuple[float, ...] = ()

    def step(self, u: float) -> float:
        """Advance by one sample."""
        raise NotImplementedError

    def filter(self, u: Vector) -> Vector:
        """Return the response to a whole record from rest; the state stays as it is."""
        raise NotImplementedError


class FromStart(Block):
    """The change from the first sample, or from a given zero."""

    def __init__(self, zero: float = NAN) -> None:
        self._zero = zero
        self.state = (zero,)

    def step(self, u: float) -> float:
        """Advance by one sample."""
        if math.isnan(self.state[0]):
            self.state = (u,)
        return u - self.state[0]

    def filter(self, u: Vector) -> Vector:
        """Return the change over a record."""
        return np.asarray(u - (u[0] if math.isnan(self._zero) else self._zero))


class ChangeSeen(Block):
    """The change from the first value that was seen: 0 before that, the last change while a value is missing.

    Examples
    --------
    >>> ChangeSeen().filter(np.array([NAN, 5.0, 7.0, NAN, 6.0]))
    array([0., 0., 2., 2., 1.])
    """

    state = (NAN, 0.0)

    def step(self, u: float) -> float:
        """Advance by one sample."""
        start, change = self.state
        if not math.isnan(u):
            start = u if math.isnan(start) else start
            change = u - start
        self.state = (start, change)
        return change

    def filter(self, u: Vector) -> Vector:
        """Return the change over a record."""
        seen = ~np.isnan(u)
        values = u[seen]
        return np.asarray(np.concatenate(([0.0], values - values[:1]))[np.cumsum(seen)])


class Lag(Block):
    """A first-order lag of gain 1 by Tustin's rule, its pole not below 0, at rest at its first input.

    Examples
    --------
    >>> Lag(5.0, 1.0).filter(np.array([1.0, 1.0, 2.0])).round(3)
    array([1.   , 1.   , 1.091])
    """

    def __init__(self, tau_min: float, period_min: float) -> None:
        self.pole = max((2.0 * tau_min - period_min) / (2.0 * tau_min + period_min), 0.0)
        self._half = (1.0 - self.pole) / 2.0
        self.state = (NAN, 0.0)

    def step(self, u: float) -> float:
        """Advance by one sample."""
        before, y = self.state
        y = u if math.isnan(before) else self.pole * y + self._half * (u + before)
        self.state = (u, y)
        return y

    def filter(self, u: Vector) -> Vector:
        """Return the response to a record."""
        from scipy.signal import lfilter  # here, because the service never needs it and it costs 40 MB

        return np.asarray(lfilter([self._half, self._half], [1.0, -self.pole], u - u[0]) + u[0])


class Undelayed(Lag):
    """The input itself, with the state of a lag."""

    def step(self, u: float) -> float:
        """Advance by one sample."""
        self.state = (u, u)
        return u

    def filter(self, u: Vector) -> Vector:
        """Return the record itself."""
        return u


def lag_or_none(tau_min: float, period_min: float) -> Lag:
    """Return a lag; the input itself for a time constant of 0, where `Lag` takes the mean of two samples."""
    return (Lag if tau_min > 0.0 else Undelayed)(tau_min, period_min)


class FilterBank(Block):
    """First-order lags of one or more inputs, weighted and summed.

    Parameters
    ----------
    taus_min : sequence of float
        Time constants of the lags, min: the same for every input.
    gains : sequence of sequence of float
        For each input, the weight of each lag.
    period_min : float
        Sample period, min.
    lag : callable
        Makes a lag of its time constant and the sample period, both in min.

    Raises
    ------
    ModelError
        If there are not as many weights as lags.
    """

    def __init__(
        self,
        taus_min: Sequence[float],
        gains: Sequence[Sequence[float]],
        period_min: float,
        lag: Callable[[float, float], Lag] = Lag,
    ) -> None:
        for row in gains:
            if len(taus_min) != len(row):
                raise ModelError(f"a filter bank: {len(taus_min)} tau_min for {len(row)} gain, expected as many")
        self._rows = [[(gain, lag(tau, period_min)) for gain, tau in zip(row, taus_min, strict=True)] for row in gains]
        self._lags = [lag for row in self._rows for _, lag in row]

    @property
    def state(self) -> tuple[float, ...]:
        """The states of all lags, input by input."""
        return tuple(value for lag in self._lags for value in lag.state)

    @state.setter
    def state(self, values: tuple[float, ...]) -> None:
        for i, lag in enumerate(self._lags):
            lag.state = tuple(values[2 * i : 2 * i + 2])

    @property
    def outputs(self) -> list[float]:
        """What each lag gave at the last sample, unweighted, input by input; 0 before the first."""
        return [lag.state[1] for lag in self._lags]

    def step(self, *inputs: float) -> float:
        """Advance by one sample."""
        sums = []
        for u, row in zip(inputs, self._rows, strict=True):
            total = 0.0
            for gain, lag in row:
                total += gain * lag.step(u)
            sums.append(total)
        result = sums[0]
        for total in sums[1:]:  # not sum(): newer Pythons compensate it, and the bits would depend on the version
            result += total
        return result

    def filter(self, *inputs: Vector) -> Vector:
        """Return the response to records from rest; the state stays as it is."""
        return np.asarray(self.columns(*inputs) @ np.array([gain for row in self._rows for gain, _ in row]))

    def columns(self, *inputs: Vector) -> Matrix:
        """Return each input through each lag, unweighted, shape (n, inputs · lags)."""
        return np.column_stack([lag.filter(u) for u, row in zip(inputs, self._rows, strict=True) for _, lag in row])


class Exchange(Block):
    """Heat that a film exchanges with a surface, which follows in temperature and leaves the less to exchange.

    With c ≥ 0 the film's conductance as a share of its largest and d the difference that drives it, had the surface not
    followed:  q = (1 + κ) c d − κ c δ,  δ = L(τ) q,  so that q is d in the end where c is 1. The lag is by Tustin's
    rule; where a film of 1 settles within about a sample that would ring, and Euler's backward rule is taken. A record
    has no gaps.

    Parameters
    ----------
    half : float
        Conductance of what is behind the surface, 1/κ: at c = half the film carries half of what a large one would.
    surface_min : float
        Time constant τ of the surface without a film, min; 0 if it follows at once.
    period_min : float
        Sample period, min.

    Examples
    --------
    >>> Exchange(1.0, 10.0, 1.0).filter(np.array([0.0, 1.0, 1.0, 0.5]), np.ones(4)).round(3)
    array([0.   , 1.909, 1.744, 0.823])
    """

    def __init__(self, half: float, surface_min: float, period_min: float) -> None:
        self._kappa = 1.0 / half
        # surface = keep · surface before + new · heat + old · heat before
        self._keep, self._new = surface_min / (surface_min + period_min), period_min / (surface_min + period_min)
        self._old = 0.0
        lag = Lag(surface_min, period_min)
        weight = (1.0 - lag.pole) / 2.0
        if weight * self._kappa < lag.pole:
            self._keep, self._new, self._old = lag.pole, weight, weight
        self.state = (NAN, 0.0)

    def step(self, *inputs: float) -> float:
        """Advance by one sample of conductance and difference."""
        (conductance, difference), (surface, before) = inputs, self.state
        given, taken = (1.0 + self._kappa) * conductance * difference, self._kappa * conductance
        if math.isnan(surface):
            surface = given / (1.0 + taken)
        else:
            known = self._keep * surface + self._old * before
            surface = (known + self._new * given) / (1.0 + self._new * taken)
        heat = given - taken * surface
        self.state = (surface, heat)
        return heat

    def filter(self, *inputs: Vector) -> Vector:
        """Return the heat over a record of conductance and difference that begins in balance."""
        from scipy.linalg import solve_banded  # here, because the service never needs it

        conductance, difference = inputs
        given, taken = (1.0 + self._kappa) * conductance * difference, self._kappa * conductance
        # Each sample by the one before it, with the heat of that one written out.
        bands, right = np.zeros((3, given.size)), np.empty_like(given)
        bands[1] = 1.0 + self._new * taken
        bands[2, :-1] = self._old * taken[:-1] - self._keep
        right[1:] = self._new * given[1:] + self._old * given[:-1]
        bands[1, 0], right[0] = 1.0 + taken[0], given[0]
        # With a band above, which is empty, it is called tridiagonal, and ten times as fast.
        return np.asarray(given - taken * solve_banded((1, 1), bands, right, check_finite=False))


def exchanges(half: float, surface_min: float, period_min: float) -> tuple[Exchange, Exchange]:
    """Return a film's exchange for each of two differences."""
    return Exchange(half, surface_min, period_min), Exchange(half, surface_min, period_min)


class Limit(Block):
    """A value that goes no further than a limit to either side; the state is by how much it would have.

    Examples
    --------
    >>> Limit(2.0).filter(np.array([-3.0, 1.0, NAN, 5.0]))
    array([-2.,  1., nan,  2.])
    """

    state = (0.0,)

    def __init__(self, most: float) -> None:
        self._most = most

    def step(self, u: float) -> float:
        """Advance by one sample."""
        limited = min(max(u, -self._most), self._most)
        self.state = (u - limited,)
        return limited

    def filter(self, u: Vector) -> Vector:
        """Return the limited record; the state stays as it is."""
        return np.clip(u, -self._most, self._most)


class Delay(Block):
    """A delay of any number of samples, interpolated linearly; the ends of a record hold."""

    def __init__(self, delay_min: float, period_min: float) -> None:
        self._samples = delay_min / period_min
        self._length = math.ceil(self._samples) + 1
        self.state = (NAN,) * self._length

    def step(self, u: float) -> float:
        """Advance by one sample."""
        kept = (u, *self.state[:-1]) if not math.isnan(self.state[0]) else (u,) * self._length
        self.state = kept
        whole = min(int(self._samples), self._length - 1)
        part = self._samples - whole
        return kept[whole] if part == 0.0 else kept[whole] + part * (kept[whole + 1] - kept[whole])

    def filter(self, u: Vector) -> Vector:
        """Return the delayed record."""
        return shifted(u, self._samples)


def shifted(u: Vector, samples: float) -> Vector:
    """Return a record delayed by a number of samples (advanced, if negative); the ends hold."""
    k = np.arange(u.size, dtype=np.float64)
    return np.interp(k - samples, k, u)


class Function(Block):
    """A sampled transfer function from rest, transposed direct form II.

    Raises
    ------
    ModelError
        If it is unstable.
    """

    def __init__(self, function: SampledTransferFunction) -> None:
        function.check_stable()
        n = function.order
        self._function = function
        self._b = (*function.b, *([0.0] * (n + 1 - len(function.b))))
        self._a = (*function.a, *([0.0] * (n + 1 - len(function.a))))
        self.state = (0.0,) * n

    def step(self, u: float) -> float:
        """Advance by one sample."""
        w = (*self.state, 0.0)
        y = self._b[0] * u + w[0]
        self.state = tuple(w[i + 1] + self._b[i + 1] * u - self._a[i + 1] * y for i in range(len(self.state)))
        return y

    def filter(self, u: Vector) -> Vector:
        """Return the response to a record."""
        return self._function.response(u)


class Play(Block):
    """Play: the output follows once the play of a half-width is taken up."""

    def __init__(self, half_width: float) -> None:
        self._half = half_width
        self.state = (0.0,)

    def step(self, u: float) -> float:
        """Advance by one sample."""
        self.state = (self._followed(self.state[0], [u])[0],)
        return self.state[0]

    def filter(self, u: Vector) -> Vector:
        """Return the response to a record."""
        return np.array(self._followed(0.0, u.tolist()))

    def _followed(self, at: float, wanted: list[float]) -> list[float]:
        half = self._half  # one loop without calls: a search runs it some hundred times
        return [at := u - half if at < u - half else u + half if at > u + half else at for u in wanted]


class Stick(Play):
    """Stick-slip: the output jumps all the way once its input is off by more than a half-width."""

    def _followed(self, at: float, wanted: list[float]) -> list[float]:
        half = self._half
        return [at := u if abs(u - at) > half else at for u in wanted]
