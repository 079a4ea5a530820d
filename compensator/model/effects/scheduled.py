"""`scheduled`: a measured channel changes a path's strength or speed.

share    y += change · c · y_path
drive    y += change · G · (c · drive)
speed    y += change · c · (L(τ) − 1) · y_path
row      y += Σ_i L(τ_i) · (gain_i · c · drive + gain_share_i · c · y_path)

with c the channel in units of its own span: as it is where it has a zero of its own (a speed, a flow), as its
change from the start where it has none (a temperature).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compensator.arrays import Matrix
from compensator.model.effects.base import Effect, Signals, register
from compensator.model.effects.hypothesis import (
    ROW_RIDGE,
    Hypothesis,
    RecordSignals,
    Setting,
    lowpass,
    proposes,
    row,
    shown,
)
from compensator.model.effects.stream import Function, Lag, Row
from compensator.model.effects.table import Table
from compensator.model.transfer_function import SampledTransferFunction

FORMS = ("share", "drive", "speed", "row")
ORIGINS = ("start", "zero")


@register("scheduled")
class ScheduledEffect:
    """The streaming side."""

    kind = "scheduled"

    def __init__(self, table: Mapping[str, Any], period_s: float) -> None:
        numbers = ("change", "span", "tau_min", "gain", "gain_share", "b", "a")
        keys = Table("scheduled", table, ("path", "channel", "origin", *numbers))
        self.channels = (keys.text("channel"),)
        self._tdtf = keys.text("path", ("DTF", "TDTF")) == "TDTF"
        self._form = keys.text("form", FORMS)
        self._span = keys.number("span", 1e-12)
        self._change = 1.0 if self._form == "row" else keys.number("change")
        self._inner: Function | Lag | Row | None = None
        self._by_share: Row | None = None
        if self._form == "drive":
            function = SampledTransferFunction(b=keys.numbers("b"), a=keys.numbers("a"), period_s=period_s)
            self._inner = Function(function)
        elif self._form == "speed":
            self._inner = Lag(keys.number("tau_min", 0.0, 1e5), period_s / 60.0)
        elif self._form == "row":
            taus = keys.numbers("tau_min", 0.0, 1e5)
            self._inner = Row(taus, keys.numbers("gain"), period_s / 60.0)
            self._by_share = Row(taus, keys.numbers("gain_share"), period_s / 60.0)
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
        drive = signals.ambient_k if self._tdtf else signals.drive
        if self._by_share is not None:
            return self._inner.step(c * drive) + self._by_share.step(c * share)
        if self._form == "drive":
            return self._change * self._inner.step(c * drive)
        return self._change * c * (self._inner.step(share) - share)

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""
        return (self._start, *(v for part in (self._inner, self._by_share) if part is not None for v in part.state))

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""
        self._start = state[0]
        if self._inner is not None:
            end = 1 + len(self._inner.state)
            self._inner.state = tuple(state[1:end])
            if self._by_share is not None:
                self._by_share.state = tuple(state[end:])


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduledHypothesis(Hypothesis):
    """The side of a whole record."""

    kind: ClassVar[str] = "scheduled"
    law: str = "share"
    origin: str = "start"
    span: float = 1.0
    function: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
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


@dataclass(frozen=True, slots=True, kw_only=True)
class RowScheduled(ScheduledHypothesis):
    """A path that another channel drives, too, behind a row of lags."""

    ridge: ClassVar[float] = ROW_RIDGE
    taus_min: tuple[float, ...] = ()

    @property
    def parameters(self) -> int:
        """Number of parameters that the data spends on it: fewer than gains, because they are held together."""
        return 7

    def columns(self, waves: RecordSignals, values: Sequence[float]) -> Matrix:
        """Return what drives the path, times the channel, behind each lag."""
        channel = waves.channels[self.channel]
        c = (channel - (channel[0] if self.origin == "start" else 0.0)) / self.span
        sources = waves.source(self.path), waves.share(self.path)
        return np.hstack([row(c * u, self.taus_min, waves.period_min) for u in sources])

    def named(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, float]:
        """Return how much the gain at rest changes over the channel's span, as a share of it."""
        count, gain = len(self.taus_min), math.fsum(self.function[0]) / math.fsum(self.function[1])
        return {"change": math.fsum(amplitudes[:count]) / gain + math.fsum(amplitudes[count:])}

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        return {
            "path": self.path,
            "channel": self.channel,
            "form": "row",
            "origin": self.origin,
            "span": self.span,
            "tau_min": list(self.taus_min),
            "gain": list(amplitudes[: len(self.taus_min)]),
            "gain_share": list(amplitudes[len(self.taus_min) :]),
        }


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose every channel that moves on every path."""
    for channel in setting.channels:
        for path in setting.paths:
            origin = "zero" if channel in setting.zeroed else "start"
            span, function = setting.spans.get(channel, 1.0), setting.functions.get(path, ((), ()))
            if setting.rough:
                taus = setting.row_min
                yield RowScheduled(
                    path=path,
                    channel=channel,
                    form="row",
                    law="row",
                    origin=origin,
                    span=span,
                    function=function,
                    taus_min=taus,
                    amplitudes=tuple(f"{name}_{i}" for name in ("gain", "gain_share") for i in range(1, len(taus) + 1)),
                )
            for law in ("share", "drive", "speed"):
                yield ScheduledHypothesis(
                    path=path,
                    channel=channel,
                    form=law,
                    law=law,
                    origin=origin,
                    span=span,
                    function=function,
                    free=(setting.tau(),) if law == "speed" else (),
                    amplitudes=("change",),
                )
