"""`delay`: a path or its sensor is late.

path     y += L(lag) · y_path(t − d) − y_path(t)
sensor   y += y_path(t + d) + lag · dy_path/dt (t + d) − y_path(t): the machine was where the late sensor is now
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compensator.arrays import Vector
from compensator.model.effects.base import Effect, Signals, register
from compensator.model.effects.hypothesis import (
    Free,
    Hypothesis,
    RecordSignals,
    Setting,
    late,
    lowpass,
    proposes,
    shown,
)
from compensator.model.effects.stream import Delay, Lag
from compensator.model.effects.table import Table

#: Samples that a path is run on beyond a record's end.
AHEAD = 64


@register("delay")
class DelayEffect:
    """The streaming side: a path that is late; a late sensor cannot be undone in real time."""

    kind = "delay"
    channels: tuple[str, ...] = ()

    def __init__(self, table: Mapping[str, Any], period_s: float) -> None:
        keys = Table("delay", table, ("path", "delay_min", "lag_min"))
        self._tdtf = keys.text("path", ("DTF", "TDTF")) == "TDTF"
        self._delay = Delay(keys.number("delay_min", 0.0, 1440.0), period_s / 60.0)
        self._lag = Lag(keys.number("lag_min", 0.0, 1440.0), period_s / 60.0)
        self._has_lag = keys.number("lag_min", 0.0, 1440.0) > 0.0

    @classmethod
    def from_table(cls, table: Mapping[str, Any], period_s: float) -> Effect:
        """Make the effect from its table in the model file."""
        return cls(table, period_s)

    def step(self, signals: Signals) -> float:
        """Advance by one sample."""
        share = signals.y_tdtf_um if self._tdtf else signals.y_dtf_um
        delayed = self._delay.step(share)
        return (self._lag.step(delayed) if self._has_lag else delayed) - share

    def snapshot(self) -> tuple[float, ...]:
        """Return the state."""
        return (*self._lag.state, *self._delay.state)

    def restore(self, state: tuple[float, ...]) -> None:
        """Take a state back."""
        self._lag.state, self._delay.state = tuple(state[:2]), tuple(state[2:])


@dataclass(frozen=True, slots=True, kw_only=True)
class LatePath(Hypothesis):
    """A path that is late."""

    kind: ClassVar[str] = "delay"

    def fixed(self, waves: RecordSignals, values: Sequence[float]) -> Vector | None:
        """Return the difference that the delay makes."""
        named = dict(zip((f.name for f in self.free), values, strict=True))
        share = waves.share(self.path)
        moved = late(share, named.get("delay_min", 0.0), waves.period_min)
        if "lag_min" in named:
            moved = lowpass(moved, named["lag_min"], waves.period_min)
        return np.asarray(moved - share)

    def table(self, values: Sequence[float], amplitudes: Sequence[float]) -> dict[str, Any]:
        """Return the table that the engine runs."""
        named = dict(zip((f.name for f in self.free), values, strict=True))
        return {"path": self.path, "delay_min": named.get("delay_min", 0.0), "lag_min": named.get("lag_min", 0.0)}

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what is late."""
        return f"The deformation follows the {self.path} {_words(named)} later than modelled ({rms_um:.2g} µm rms)."


@dataclass(frozen=True, slots=True, kw_only=True)
class LateSensor(LatePath):
    """A sensor that is late."""

    deployable: ClassVar[bool] = False

    def fixed(self, waves: RecordSignals, values: Sequence[float]) -> Vector | None:
        """Return what the share would have been at once, less what it is."""
        named = dict(zip((f.name for f in self.free), values, strict=True))
        share = waves.share(self.path)
        # Beyond the record's end the path goes on with its drive as it is.
        drive = waves.source(self.path)
        longer = waves.function(self.path).response(np.concatenate((drive, np.full(AHEAD, drive[-1]))))
        early = late(longer, -named.get("delay_min", 0.0), waves.period_min)
        early = early + named.get("lag_min", 0.0) * np.gradient(early, waves.period_min)
        return np.asarray(early[: share.size] - share)

    def explain(self, named: Mapping[str, float], rms_um: float) -> str:
        """Say what is late, and what to do about it."""
        sensor = "T_Q" if self.path == "TTF" else "AT"
        return (
            f"The sensor {sensor} is late by {_words(named)}: the model makes a large error at each switching "
            f"({rms_um:.2g} µm rms). That cannot be undone in real time; move the sensor closer to the source, or "
            "couple it better."
        )


def _words(named: Mapping[str, float]) -> str:
    parts = [f"{shown(named['delay_min'])} min"] if "delay_min" in named else []
    parts += [f"a lag of {shown(named['lag_min'])} min"] if "lag_min" in named else []
    return " and ".join(parts)


@proposes
def propose(setting: Setting) -> Iterator[Hypothesis]:
    """Propose a late path and a late sensor, by a dead time or a lag or both."""
    delay = Free(name="delay_min", low=0.0, high=60.0, grid=(0.5, 1.0, 2.0, 4.0, 7.0, 12.0, 20.0, 40.0), log=False)
    lag = Free(name="lag_min", low=0.05, high=60.0, grid=(0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0))
    for path in setting.paths:
        yield LatePath(path=path, form="dead time", free=(delay,))
        if path == "DTF" and setting.has_ttf:
            yield LateSensor(path="TTF", form="dead time", free=(delay,))
            yield LateSensor(path="TTF", form="lag", free=(lag,))
            yield LateSensor(path="TTF", form="dead time and lag", free=(delay, lag))
        elif path == "DTF":
            yield LateSensor(path="DTF", form="sensor, dead time", free=(delay,))
            yield LateSensor(path="DTF", form="sensor, lag", free=(lag,))
