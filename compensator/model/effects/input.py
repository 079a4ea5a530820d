"""`input`: a measured channel acts on Y that the model does not know of.

y += Σ_i gain_i · L(τ_i) · [f(c(t − d)) − f(c at the start)],   f(c) = c, c², |c| or |c|^(5/3)

The heat of a bearing is its speed times a friction torque that itself grows with the speed: by its power of 2/3 in a
lubricated one (Palmgren, Ball and Roller Bearing Engineering), by the speed itself where the fluid shears.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.model.effects.base import Effect, Signals, register
from compensator.model.effects.hypothesis import (
    ROW_RIDGE,
    Free,
    Hypothesis,
    RecordSignals,
    Setting,
    late,
    lowpass,
    proposes,
    row,
    shown,
)
from compensator.model.effects.stream import Delay, Lag
from compensator.model.effects.table import Table

CURVES = ("linear", "square", "abs", "power 5/3")
_STREAM: Mapping[str, Callable[[float], float]] = {
    "linear": lambda c: c,
    "square": lambda c: c * c,
    "abs": abs,
    "power 5/3": lambda c: abs(c) ** (5.0 / 3.0),
}
_BATCH: Mapping[str, Callable[[Vector], Vector]] = {
    "linear": lambda c: c,
    "square": np.square,
    "abs": np.abs,
    "power 5/3": lambda c: np.abs(c) ** (5.0 / 3.0),
}
_WORDS = {"linear": "", "square": " (its square)", "abs": " (its size)", "power 5/3": " (its size to the power of 5/3)"}


@register("input")
class InputEffect:
    """The streaming side."""

    kind = "input"

    def __init__(self, table: Mapping[str, Any], period_s: float) -> None:
        keys = Table("input", table, ("channel", "curve", "tau_min", "gain", "delay_min"))
        self.channels = (keys.text("channel"),)
        self._curve = _STREAM[keys.text("curve", CURVES)]
        taus, self._gains = keys.numbers("tau_min", 0.0, 1e5), keys.numbers("gain")
        period_min = period_s / 60.0
        self._lags = [Lag(tau, period_min) for tau in taus]
        self._delay = Delay(keys.number("delay_min", 0.0, 1440.0), period_min)
        self._start = math.nan

    @classmethod
    def from_table(cls, table: Mapping[str, Any], period_s: float) -> Effect:
        """Make the effect from its table in the model file."""
        return cls(table, period_s)

    def step(self, signals: Signals) -> float:
        """Advance by one sample; nothing acts before the channel was seen."""
        value = signals.channels.get(self.channels[0], math.nan)
        if math.isnan(value):
            return 0.0
        curved = self._curve(value)
        if math.isnan(self._start):
            self._start = curved
        delayed = self._delay.step(curved - self._start)
        total = 0.0
        for lag, gain in zip(self._lags, self._gains, strict=True):
            total += gain * lag.step(delayed)
        return total

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""
        return (self._start, *self._delay.state, *(value for lag in self._lags for value in lag.state))

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""
        n = len(self._delay.state)
        self._start, self._delay.state = state[0], tuple(state[1 : n + 1])
        for i, lag in enumerate(self._lags):
            lag.state = tuple(state[n + 1 + 2 * i : n + 3 + 2 * i])


@dataclass(frozen=True, slots=True, kw_only=True)
class InputHypothesis(Hypothesis):
    """The side of a whole record."""

    kind: ClassVar[str] = "input"
    curve: str = "linear"

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return the channel behind each lag."""
        named = dict(zip((f.name for f in self.free), values, strict=True))
        curved = _BATCH[self.curve](waves.channels[self.channel])
        moved = curved - curved[0]
        delay = named.get("delay_min", 0.0)
        if delay:
            moved = late(moved, delay, waves.period_min)
        taus = [value for name, value in named.items() if name.startswith("tau")]
        return np.column_stack([lowpass(moved, tau, waves.period_min) for tau in taus])

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        named = dict(zip((f.name for f in self.free), values, strict=True))
        taus = [value for name, value in named.items() if name.startswith("tau")]
        return {
            "channel": self.channel,
            "curve": self.curve,
            "tau_min": taus,
            "gain": list(amplitudes),
            "delay_min": named.get("delay_min", 0.0),
        }

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what acts."""
        taus = [shown(v) for n, v in named.items() if n.startswith("tau")]
        delay = f", {shown(named['delay_min'])} min late" if "delay_min" in named else ""
        return (
            f"The channel {self.channel}{_WORDS[self.curve]} moves Y by {rms_um:.2g} µm rms with a lag of "
            f"{' and '.join(taus)} min{delay}. The model has no such input; feed the channel in."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RowHypothesis(InputHypothesis):
    """A channel behind a row of lags that are given: what is fitted where the path's shape is not known.

    Parameters
    ----------
    taus_min : tuple of float
        The lags, min.
    """

    ridge: ClassVar[float] = ROW_RIDGE
    taus_min: tuple[float, ...] = ()

    @property
    def parameters(self) -> int:
        """Number of parameters that the data spends on it: fewer than gains, because they are held together."""
        return 5

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return the channel behind each lag."""
        curved = _BATCH[self.curve](waves.channels[self.channel])
        return row(curved - curved[0], self.taus_min, waves.period_min)

    def named(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, float]:
        """Return what the lags make together: the gain at rest, and when half of it is there after a step."""
        power = {"linear": "", "square": "2", "abs": "", "power 5/3": "_5_3"}[self.curve]
        total = math.fsum(amplitudes)
        return {f"gain_um_per_{unit_of(self.channel)}{power}": total, "half_time_min": self._half_time(amplitudes)}

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        return {
            "channel": self.channel,
            "curve": self.curve,
            "tau_min": list(self.taus_min),
            "gain": list(amplitudes),
            "delay_min": 0.0,
        }

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what acts."""
        return (
            f"The channel {self.channel}{_WORDS[self.curve]} moves Y by {rms_um:.2g} µm rms; half of it is there after "
            f"{shown(named['half_time_min'])} min. The model has no such input; feed the channel in."
        )

    def _half_time(self, amplitudes: Sequence[float]) -> float:
        t = np.geomspace(0.1, 10.0 * max(self.taus_min), 400)
        gains, taus = np.array(amplitudes), np.array(self.taus_min)
        part: Vector = (1.0 - np.exp(-t[:, None] / taus)) @ gains / math.fsum(amplitudes)
        if not (part >= 0.5).any():
            return float(t[-1])
        there = int(np.argmax(part >= 0.5))
        if there == 0:
            return float(t[0])
        return float(np.exp(np.interp(0.5, part[there - 1 : there + 1], np.log(t[there - 1 : there + 1]))))


def rows(setting: Setting) -> list[RowHypothesis]:
    """Return every channel that moves behind a row of lags; one with a zero of its own also through the curves."""
    taus = setting.row_min
    names = tuple(f"gain_{i}" for i in range(1, len(taus) + 1))
    return [
        RowHypothesis(channel=channel, form=f"row, {curve}", curve=curve, taus_min=taus, amplitudes=names)
        for channel in setting.channels
        for curve in (("linear", "power 5/3", "square") if channel in setting.zeroed else ("linear",))
    ]


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose every channel that moves: one lag, one lag and a delay, two lags, and the curves."""
    tau = setting.tau()
    one = (tau,)
    two = (setting.tau("tau_1_min"), setting.tau("tau_2_min"))
    delay = Free(name="delay_min", low=0.0, high=60.0, grid=(2.0, 5.0, 10.0, 20.0, 40.0), log=False)
    for channel in setting.channels:
        unit = unit_of(channel)
        yield InputHypothesis(channel=channel, form="lag", free=one, amplitudes=(f"gain_um_per_{unit}",))
        yield InputHypothesis(
            channel=channel, form="lag and delay", free=(tau, delay), amplitudes=(f"gain_um_per_{unit}",)
        )
        yield InputHypothesis(
            channel=channel, form="two lags", free=two, amplitudes=(f"gain_1_um_per_{unit}", f"gain_2_um_per_{unit}")
        )
        yield InputHypothesis(
            channel=channel, form="square", curve="square", free=one, amplitudes=(f"gain_um_per_{unit}2",)
        )
    if setting.rough:
        yield from rows(setting)


def unit_of(channel: str) -> str:
    """Return the unit that a channel's name carries; a temperature's gain is per kelvin."""
    unit = channel.rsplit("_", 1)[-1] if "_" in channel else "unit"
    return {"degc": "k"}.get(unit, unit)
