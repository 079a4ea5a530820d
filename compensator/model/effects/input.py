"""`input`: a measured channel acts on Y that the model does not know of.

y += Σ_i gain_i · L(τ_i) · [f(c(t − d)) − f(c at the start)],   f(c) = c, c², |c| or |c|^(5/3)

The heat of a bearing is its speed times a friction torque that itself grows with the speed: by its power of 2/3 in a
lubricated one (Palmgren, Ball and Roller Bearing Engineering), by the speed itself where the fluid shears.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.model.effects.base import BankEffect, Effect, Run, channel_name, number, numbers, register, text
from compensator.model.effects.blocks import Block, Delay, FilterBank, FromStart, S
from compensator.model.effects.hypothesis import DEGC, Context, Free, Hypothesis, numbered, proposes
from compensator.model.effects.seen import Seen, digits, quantity, signed, unit_in
from compensator.model.effects.signals import Signals

#: Curves by name: of one sample, or of a record.
CURVES: Mapping[str, Callable[[Any], Any]] = {
    "linear": lambda c: c,
    "square": lambda c: c * c,
    "abs": abs,
    "power 5/3": lambda c: abs(c) ** (5.0 / 3.0),
}
_WORDS = {"linear": "", "square": " by its square", "abs": " by its magnitude", "power 5/3": " by its power 5/3"}
#: What an extended model that has the effect needs, at the end of its explanation.
NEEDS_CHANNEL = "; the extended model needs the channel"
_POWERS = {"linear": "", "square": "2", "abs": "", "power 5/3": "_5_3"}


@register
class Input(BankEffect, Effect):
    """A channel through a curve, a delay and lags."""

    kind = "input"
    linear = ("gain",)
    channel: str = channel_name()
    curve: str = text(*CURVES)
    tau_min: tuple[float, ...] = numbers(0.0, 1e5)
    gain: tuple[float, ...] = numbers()
    delay_min: float = number(0.0, 1440.0)

    @property
    def off_at_zero(self) -> tuple[str, ...] | None:
        return (self.channel,)

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        bank = FilterBank(self.tau_min, (self.gain,), period_min)
        return FromStart(), Delay(self.delay_min, period_min), bank

    def inputs(self, signals: Signals[S], run: Sequence[Run[S]]) -> tuple[S, ...]:
        from_start, delay, _ = run
        return (delay(from_start(CURVES[self.curve](signals.channels[self.channel]))),)

    def explain(self, seen: Seen) -> str:
        delay = f" and a dead time of {digits(self.delay_min)} min" if self.delay_min else ""
        return (
            f"{self.size_words(seen)}. The base model lacks this input, which acts{_WORDS[self.curve]} with "
            f"{self.lag_words()}{delay}{NEEDS_CHANNEL}."
        )

    def named(self, given: dict[str, float]) -> dict[str, float]:
        """Return the gain at rest first where there are several lags: near each other, only their sum is determined."""
        if len(self.gain) == 1:
            return given
        return {self._gain_name: math.fsum(self.gain), **given}

    @property
    def _gain_name(self) -> str:
        return f"gain_um_per_{unit_of(self.channel)}{_POWERS[self.curve]}"

    def lag_words(self) -> str:
        """Return the lags in words."""
        lags = " and ".join(map(digits, self.tau_min))
        return f"lags of {lags} min" if len(self.tau_min) > 1 else f"a lag of {lags} min"

    def size_words(self, seen: Seen) -> str:
        """Return the response at rest to the channel's range in words, and what was seen of it."""
        assert seen.channel is not None
        (low, high), curve = seen.channel.ends(self.channel), CURVES[self.curve]
        size_um = math.fsum(self.gain) * (curve(high) - curve(low))
        to = quantity(high, self.channel)
        at = f"at {to}" if low == 0.0 else f"from {digits(low)} to {to}"
        half = digits(self.half_time_min())
        return f"{signed(size_um)} µm {at} of {self.channel}, half of it after {half} min; in the data {seen.size}"

    def half_time_min(self) -> float:
        """Return the time to half of a step's response at rest, min."""
        return half_time_min(self.tau_min, self.gain, self.delay_min)


@register
class InputBank(Input):
    """A channel through a filter bank of given lags: for a response whose form is not known."""

    has_any_form = True

    def named(self, given: dict[str, float]) -> dict[str, float]:
        """Return the gain at rest of all lags together, and the time to half of a step's response."""
        return {self._gain_name: math.fsum(self.gain), "half_time_min": self.half_time_min()}

    def lag_words(self) -> str:
        return "several lags"


@proposes
def inputs(context: Context) -> Iterator[Hypothesis]:
    """Propose every channel: one lag, one lag and a delay, two lags, the square; filter banks if approximate."""
    one, two = (context.tau(),), (context.tau("tau_1_min"), context.tau("tau_2_min"))
    delay = Free(name="delay_min", low=0.0, high=60.0, grid=(2.0, 5.0, 10.0, 20.0, 40.0), log=False)
    for channel in context.channels:
        unit = unit_of(channel)
        gain, gains = (f"gain_um_per_{unit}",), (f"gain_1_um_per_{unit}", f"gain_2_um_per_{unit}")
        linear = Input(channel=channel, curve="linear", tau_min=(0.0,), gain=(1.0,), delay_min=0.0)
        both = dataclasses.replace(linear, tau_min=(0.0, 0.0), gain=(1.0, 1.0))
        square = dataclasses.replace(linear, curve="square")
        yield Hypothesis(effect=linear, form="lag", free=one, amplitudes=gain)
        yield Hypothesis(effect=linear, form="lag and delay", free=(*one, delay), amplitudes=gain)
        yield Hypothesis(effect=both, form="two lags", free=two, amplitudes=gains, ordered=True)
        if not channel.endswith(DEGC):
            yield Hypothesis(effect=square, form="square", free=one, amplitudes=(f"{gain[0]}2",))
    if context.approximate:
        yield from banks(context)


def banks(context: Context) -> list[Hypothesis]:
    """Return every channel through a filter bank; one with a zero of its own also through the curves."""
    taus = context.bank_min
    names, ones = numbered("gain", len(taus)), (1.0,) * len(taus)
    return [
        Hypothesis(
            effect=InputBank(channel=channel, curve=curve, tau_min=taus, gain=ones, delay_min=0.0),
            form=f"row, {curve}",
            amplitudes=names,
        )
        for channel in context.channels
        for curve in (("linear", "power 5/3", "square") if channel in context.zeroed else ("linear",))
    ]


def half_time_min(taus_min: Sequence[float], gains: Sequence[float], delay_min: float = 0.0) -> float:
    """Return the time to half of a step's response at rest of lags with gains, behind a delay, min."""
    t = np.geomspace(0.1, 10.0 * max(*taus_min, 1.0), 400)
    part: Vector = (1.0 - np.exp(-t[:, None] / np.maximum(taus_min, 1e-3))) @ np.array(gains)
    part = part / (math.fsum(gains) or 1.0)
    if not (part >= 0.5).any():
        return delay_min + float(t[-1])
    there = int(np.argmax(part >= 0.5))
    if there == 0:
        return delay_min + float(t[0])
    near = slice(there - 1, there + 1)
    return delay_min + float(np.exp(np.interp(0.5, part[near], np.log(t[near]))))


def unit_of(channel: str) -> str:
    """Return the unit that a channel's name carries; a temperature's gain is per kelvin."""
    unit = unit_in(channel) or "unit"
    return {"degc": "k"}.get(unit, unit)
