"""Small streaming pieces that effects are made of; each starts at rest at its first input."""

from __future__ import annotations

import math
from collections.abc import Sequence

from compensator.errors import ModelError
from compensator.model.effects.hypothesis import lag_pole
from compensator.model.transfer_function import SampledTransferFunction

NAN = float("nan")


class Lag:
    """A first-order lag of gain 1 by Tustin's rule."""

    def __init__(self, tau_min: float, period_min: float) -> None:
        self._p = lag_pole(tau_min, period_min)
        self._half = (1.0 - self._p) / 2.0
        self.state: tuple[float, ...] = (NAN, 0.0)

    def step(self, u: float) -> float:
        """Advance by one sample."""
        before, y = self.state
        y = u if math.isnan(before) else self._p * y + self._half * (u + before)
        self.state = (u, y)
        return y


class Row:
    """A row of lags of one input, weighted and summed."""

    def __init__(self, taus_min: Sequence[float], gains: Sequence[float], period_min: float) -> None:
        if len(taus_min) != len(gains):
            raise ModelError(f"a row of lags: {len(taus_min)} tau_min for {len(gains)} gain, expected as many")
        self._lags = tuple(Lag(tau, period_min) for tau in taus_min)
        self._gains = tuple(gains)

    @property
    def state(self) -> tuple[float, ...]:
        """The states of all lags."""
        return tuple(value for lag in self._lags for value in lag.state)

    @state.setter
    def state(self, values: tuple[float, ...]) -> None:
        for i, lag in enumerate(self._lags):
            lag.state = tuple(values[2 * i : 2 * i + 2])

    def step(self, u: float) -> float:
        """Advance by one sample."""
        total = 0.0
        for gain, lag in zip(self._gains, self._lags, strict=True):
            total += gain * lag.step(u)
        return total


class Delay:
    """A delay of any number of samples, between two of them by a straight line."""

    def __init__(self, delay_min: float, period_min: float) -> None:
        self._samples = delay_min / period_min
        self._length = math.ceil(self._samples) + 1
        self.state: tuple[float, ...] = (NAN,) * self._length

    def step(self, u: float) -> float:
        """Advance by one sample."""
        kept = (u, *self.state[:-1]) if not math.isnan(self.state[0]) else (u,) * self._length
        self.state = kept
        whole = min(int(self._samples), self._length - 1)
        part = self._samples - whole
        return kept[whole] if part == 0.0 else kept[whole] + part * (kept[whole + 1] - kept[whole])


class Function:
    """A sampled transfer function from rest, transposed direct form II."""

    def __init__(self, function: SampledTransferFunction) -> None:
        n = function.order
        self._b = (*function.b, *([0.0] * (n + 1 - len(function.b))))
        self._a = (*function.a, *([0.0] * (n + 1 - len(function.a))))
        self.state: tuple[float, ...] = (0.0,) * n

    def step(self, u: float) -> float:
        """Advance by one sample."""
        w = (*self.state, 0.0)
        y = self._b[0] * u + w[0]
        self.state = tuple(w[i + 1] + self._b[i + 1] * u - self._a[i + 1] * y for i in range(len(self.state)))
        return y
