"""`scheduled`: a measured channel changes a path's strength or speed.

share    y += change · c · y_path
drive    y += change · G · (c · drive)
speed    y += change · c · (L(τ) − 1) · y_path

with c the channel in units of its own span: as it is where it has a zero of its own (a speed, a flow), as its
change from the start where it has none (a temperature).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compensator.model.effects.base import Effect, Signals, register
from compensator.model.effects.hypothesis import Hypothesis, Matrix, Setting, Waves, lowpass, proposes, shown
from compensator.model.effects.stream import Function, Lag
from compensator.model.effects.table import Table
from compensator.model.transfer_function import SampledTransferFunction

FORMS = ("share", "drive", "speed")
ORIGINS = ("start", "zero")


@register("scheduled")
class ScheduledEffect:
    """The streaming side."""

    kind = "scheduled"

    def __init__(self, table: Mapping[str, Any], period_s: float) -> None:
        keys = Table("scheduled", table, ("path", "channel", "change", "span", "origin", "tau_min", "b", "a"))
        self.channels = (keys.text("channel"),)
        self._tdtf = keys.text("path", ("DTF", "TDTF")) == "TDTF"
        self._form = keys.text("form", FORMS)
        self._change, self._span = keys.number("change"), keys.number("span", 1e-12)
        self._inner: Function | Lag | None = None
        if self._form == "drive":
            function = SampledTransferFunction(b=keys.numbers("b"), a=keys.numbers("a"), period_s=period_s)
            self._inner = Function(function)
        elif self._form == "speed":
            self._inner = Lag(keys.number("tau_min", 0.0, 1e5), period_s / 60.0)
        self._start = 0.0 if keys.text("origin", ORIGINS) == "zero" else math.nan

    @classmethod
    def from_table(cls, table: Mapping[str, Any], period_s: float) -> Effect:
        """Make the effect from its table in the model file."""
        return cls(table, period_s)

    def step(self, signals: Signals) -> float:
        """Advance by one sample; nothing acts before the channel was seen."""
        value = signals.channels.get(self.channels[0], math.nan)
        if math.isnan(value):
            return 0.0
        if math.isnan(self._start):
            self._start = value
        c = (value - self._start) / self._span
        share = signals.y_tdtf_um if self._tdtf else signals.y_dtf_um
        if self._inner is None:
            return self._change * c * share
        if self._form == "drive":
            return self._change * self._inner.step(c * (signals.ambient_k if self._tdtf else signals.drive))
        return self._change * c * (self._inner.step(share) - share)

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""
        return (self._start, *(self._inner.state if self._inner is not None else ()))

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""
        self._start = state[0]
        if self._inner is not None:
            self._inner.state = tuple(state[1:])


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduledHypothesis(Hypothesis):
    """The side of a whole record."""

    kind: ClassVar[str] = "scheduled"
    law: str = "share"
    origin: str = "start"
    span: float = 1.0
    function: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())

    def columns(self, waves: Waves, values: Sequence[float]) -> Matrix:
        """Return the path's share, drive or lag, times the channel."""
        channel = waves.channels[self.channel]
        c = (channel - (channel[0] if self.origin == "start" else 0.0)) / self.span
        share = waves.share(self.path)
        if self.law == "share":
            return np.asarray(c * share)[:, None]
        if self.law == "drive":
            return waves.function(self.path).response(c * waves.source(self.path))[:, None]
        return np.asarray(c * (lowpass(share, values[0], waves.period_min) - share))[:, None]

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        extra: dict[str, Any] = {}
        if self.law == "drive":
            extra = {"b": list(self.function[0]), "a": list(self.function[1])}
        elif self.law == "speed":
            extra = {"tau_min": values[0]}
        place = {"path": self.path, "channel": self.channel, "form": self.law, "origin": self.origin}
        return {**place, "change": amplitudes[0], "span": self.span, **extra}

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what changes what."""
        what = "speed" if self.law == "speed" else "strength"
        return (
            f"The {what} of the {self.path} changes with {self.channel}, by {shown(100.0 * named['change'])} % over "
            f"the channel's span of {shown(self.span)} ({rms_um:.2g} µm rms): more or less of the heat goes another "
            "way while it runs."
        )


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose every channel that moves on every path."""
    for channel in setting.channels:
        for path in setting.paths:
            for law in FORMS:
                yield ScheduledHypothesis(
                    path=path, channel=channel, form=law, law=law,
                    origin="zero" if channel in setting.zeroed else "start",
                    free=(setting.tau(),) if law == "speed" else (), amplitudes=("change",),
                    span=setting.spans.get(channel, 1.0), function=setting.functions.get(path, ((), ())),
                )  # fmt: skip
