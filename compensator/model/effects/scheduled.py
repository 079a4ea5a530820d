"""`scheduled`: a measured channel changes the gain or the speed of a path.

share    y += change · c · y_path
drive    y += change · G · (c · drive)
speed    y += change · c · (L(τ) − 1) · y_path
row      y += Σ_i L(τ_i) · (gain_i · c · drive + gain_share_i · c · y_path)
film     y += Σ_i L(τ_i) · (gain_i · X(|c|, drive) + gain_share_i · X(|c|, y_path))

with X what a film exchanges whose surface follows (`Exchange`), and c the channel in units of its own span: as it is
where it has a zero of its own (a speed, a flow); where it has none (a temperature, a pump that always runs) as its
change from `origin`, the number at which the record of the diagnosis began, or with "start" its first value.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compensator.arrays import NAN
from compensator.model.effects.base import (
    BankEffect,
    Effect,
    Run,
    channel_name,
    number,
    numbers,
    only,
    register,
    text,
    text_or_number,
)
from compensator.model.effects.blocks import Block, FilterBank, FromStart, Function, Lag, S, exchanges
from compensator.model.effects.hypothesis import Context, Free, Hypothesis, numbered, proposes
from compensator.model.effects.seen import MOVES, Seen, digits, quantity, unit_in, with_unit
from compensator.model.effects.signals import Signals
from compensator.model.transfer_function import SampledTransferFunction


@dataclass(frozen=True, slots=True, kw_only=True)
class Scheduled(Effect):
    """Base of all forms: the channel as a share of its span."""

    kind = "scheduled"
    counts_from_rest = True
    linear: ClassVar[tuple[str, ...]] = ("change",)
    #: What of the path changes, in words.
    what: ClassVar[str] = "gain"
    path: str = text("DTF", "TDTF")
    channel: str = channel_name()
    origin: str | float = text_or_number("start", "zero")
    span: float = number(1e-12)

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        known = {"start": NAN, "zero": 0.0}
        return FromStart(known[self.origin] if isinstance(self.origin, str) else self.origin), *self.inner(period_min)

    def inner(self, period_min: float) -> tuple[Block, ...]:
        return ()

    def scale(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        """Return the channel in units of its span."""
        return run[0](signals.channels[self.channel]) / self.span

    def acting(self, value: float) -> float:
        """Return which part of the change a value of the channel makes in the end."""
        return value / self.span

    def explain(self, seen: Seen) -> str:
        assert seen.channel is not None
        low, high = seen.channel.ends(self.channel)
        change = self.named({"change": getattr(self, "change", 0.0)})["change"] * (self.acting(high) - self.acting(low))
        return (
            f"{seen.words}: the {self.what} of the {self.path}{seen.path_words} changes by {digits(100.0 * change)} % "
            f"from {digits(low)} to {quantity(high, self.channel)} of {self.channel}. The channel "
            "changes how much heat takes this path."
        )


@register
class ShareScheduled(Scheduled):
    """The share of the path, times the channel."""

    form: str = only(default="share")
    change: float = number()

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        return self.change * self.scale(signals, run) * signals.share_from_rest(self.path)


@register
class DriveScheduled(Scheduled):
    """The path's response to its drive times the channel."""

    form: str = only(default="drive")
    change: float = number()
    b: tuple[float, ...] = numbers()
    a: tuple[float, ...] = numbers()

    def inner(self, period_min: float) -> tuple[Block, ...]:
        return (Function(SampledTransferFunction(b=self.b, a=self.a, period_s=60.0 * period_min)),)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        return self.change * run[1](self.scale(signals, run) * signals.source_from_rest(self.path))


@register
class SpeedScheduled(Scheduled):
    """A lag of the path, times the channel."""

    what = "speed"
    form: str = only(default="speed")
    change: float = number()
    tau_min: float = number(0.0, 1e5)

    def inner(self, period_min: float) -> tuple[Block, ...]:
        return (Lag(self.tau_min, period_min),)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        share = signals.share_from_rest(self.path)
        return self.change * self.scale(signals, run) * (run[1](share) - share)


@register
class BankScheduled(BankEffect, Scheduled):
    """Drive and share of the path, times the channel, through a filter bank.

    Parameters
    ----------
    dc_gain : float
        Gain of the path at rest, to name the change by; not in the model file.
    """

    linear = ("gain", "gain_share")
    has_any_form = True
    form: str = only(default="row")
    tau_min: tuple[float, ...] = numbers(0.0, 1e5)
    gain: tuple[float, ...] = numbers()
    gain_share: tuple[float, ...] = numbers()
    dc_gain: float = 1.0

    def inner(self, period_min: float) -> tuple[Block, ...]:
        return (FilterBank(self.tau_min, (self.gain, self.gain_share), period_min),)

    def inputs(self, signals: Signals[S], run: Sequence[Run[S]]) -> tuple[S, ...]:
        c = self.scale(signals, run)
        return c * signals.source_from_rest(self.path), c * signals.share_from_rest(self.path)

    def named(self, given: dict[str, float]) -> dict[str, float]:
        """Return the change of the gain at rest over the channel's span, as a share of it."""
        return {"change": math.fsum(self.gain) / self.dc_gain + math.fsum(self.gain_share)}


@register
class FilmScheduled(BankScheduled):
    """The same of a film whose surface follows in temperature: the more it carries, the less is left to carry."""

    form: str = only(default="film")
    origin: str = only(default="zero")
    half: float = number(1e-6, 1e6)
    surface_min: float = number(0.0, 1e5)

    def named(self, given: dict[str, float]) -> dict[str, float]:
        """Return the change as `BankScheduled` does, the channel at half of it, and the surface's time constant."""
        half = {with_unit("half_effect", self.channel): self.half * self.span}
        return BankScheduled.named(self, given) | half | {"surface_min": self.surface_min}

    def acting(self, value: float) -> float:
        c = abs(value) / self.span
        return c * (1.0 + self.half) / (c + self.half)

    def inner(self, period_min: float) -> tuple[Block, ...]:
        return *exchanges(self.half, self.surface_min, period_min), *BankScheduled.inner(self, period_min)

    def inputs(self, signals: Signals[S], run: Sequence[Run[S]]) -> tuple[S, ...]:
        c = abs(self.scale(signals, run))
        return run[1](c, signals.source_from_rest(self.path)), run[2](c, signals.share_from_rest(self.path))


@proposes
def schedules(context: Context) -> Iterator[Hypothesis]:
    """Propose every form for every channel that moves and every path."""
    taus, change = context.bank_min, ("change",)
    ones = (1.0,) * len(taus)
    gains = (*numbered("gain", len(taus)), *numbered("gain_share", len(taus)))
    for channel, path in itertools.product(context.channels, context.paths):
        origin, (b, a) = "zero" if channel in context.zeroed else context.first[channel], context.functions[path]
        place: dict[str, Any] = {"path": path, "channel": channel, "origin": origin, "span": context.spans[channel]}
        sizes = (context.change(path),)
        if context.approximate:
            dc_gain = math.fsum(b) / math.fsum(a)
            both = tuple(np.repeat([context.gain_change(path), *sizes], len(taus)).tolist())
            bank = BankScheduled(**place, tau_min=taus, gain=ones, gain_share=ones, dc_gain=dc_gain)
            yield Hypothesis(effect=bank, form="row", amplitudes=gains, sizes=both)
            if origin == "zero" and unit_in(channel) in MOVES:
                film = FilmScheduled(
                    **place, half=1.0, surface_min=0.0, tau_min=taus, gain=ones, gain_share=ones, dc_gain=dc_gain
                )
                free = (Free(name="half", low=0.01, high=100.0, grid=(0.1, 1.0)), context.surface())
                yield Hypothesis(effect=film, form="film", free=free, amplitudes=gains, sizes=both)
        yield Hypothesis(effect=ShareScheduled(**place, change=1.0), form="share", amplitudes=change, sizes=sizes)
        yield Hypothesis(
            effect=DriveScheduled(**place, change=1.0, b=b, a=a), form="drive", amplitudes=change, sizes=sizes
        )
        speed = SpeedScheduled(**place, change=1.0, tau_min=0.0)
        yield Hypothesis(effect=speed, form="speed", free=(context.tau(),), amplitudes=change, sizes=sizes)
