"""`delay`: a path or its sensor is delayed.

path     y += L(lag) · y_path(t − d) − y_path(t)
sensor   y += y_path(t + d) + lag · dy_path/dt (t + d) − y_path(t): the machine was where the delayed sensor is now
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from compensator.arrays import Matrix
from compensator.model.effects.base import Effect, Run, number, register, text
from compensator.model.effects.blocks import Block, Delay, Lag, S, shifted
from compensator.model.effects.hypothesis import Context, Free, Hypothesis, digits, proposes
from compensator.model.effects.signals import RecordSignals, Signals

#: Samples by which a path is continued beyond a record's end.
AHEAD = 64
DELAY = Free(name="delay_min", low=0.0, high=60.0, grid=(0.5, 1.0, 2.0, 4.0, 7.0, 12.0, 20.0, 40.0), log=False)
LAG = Free(name="lag_min", low=0.05, high=60.0, grid=(0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0))


@register
class DelayedPath(Effect):
    """A delayed path."""

    kind = "delay"
    path: str = text("DTF", "TDTF")
    delay_min: float = number(0.0, 1440.0)
    lag_min: float = number(0.0, 1440.0)

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        return Lag(self.lag_min, period_min), Delay(self.delay_min, period_min)

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        lag, delay = run
        share = signals.share(self.path)
        moved = delay(share)
        return (lag(moved) if self.lag_min > 0.0 else moved) - share

    def explain(self, rms_um: float) -> str:
        return f"The response of the {self.path} is delayed by {self._times()} ({rms_um:.2g} µm rms)."

    def _times(self) -> str:
        times = (("a dead time", self.delay_min), ("a lag", self.lag_min))
        return " and ".join(f"{what} of {digits(value)} min" for what, value in times if value)


@register
class DelayedSensor(DelayedPath):
    """A delayed sensor: the correction would need the future."""

    deployable = False

    def columns(self, record: RecordSignals, blocks: Sequence[Block]) -> Matrix:
        share, period_min = record.share(self.path), record.period_min
        # Beyond the end of the record the path continues with its last drive.
        drive = record.source(self.path)
        longer = record.function(self.path).response(np.concatenate((drive, np.full(AHEAD, drive[-1]))))
        early = shifted(longer, -self.delay_min / period_min)
        early = early + self.lag_min * np.gradient(early, period_min)
        return np.asarray(early[: share.size] - share)[:, None]

    def explain(self, rms_um: float) -> str:
        sensor = "T_Q" if self.path == "TTF" else "AT"
        return (
            f"The sensor {sensor} is delayed by {self._times()}, so the model is wrong after each change of the "
            f"heat ({rms_um:.2g} µm rms). That cannot be corrected in real time: move the sensor closer to the source, "
            "or mount it with better thermal contact."
        )


@proposes
def delays(context: Context) -> Iterator[Hypothesis]:
    """Propose a dead time of every path; T_Q with a dead time, a lag or both; in a direct model AT with one of them."""
    for path in context.paths:
        yield Hypothesis(effect=DelayedPath(path=path, delay_min=0.0, lag_min=0.0), form="dead time", free=(DELAY,))
    if "DTF" not in context.paths:
        return
    path, prefix = ("TTF", "") if context.has_ttf else ("DTF", "sensor, ")
    sensor = DelayedSensor(path=path, delay_min=0.0, lag_min=0.0)
    yield Hypothesis(effect=sensor, form=f"{prefix}dead time", free=(DELAY,))
    yield Hypothesis(effect=sensor, form=f"{prefix}lag", free=(LAG,))
    if context.has_ttf:
        yield Hypothesis(effect=sensor, form="dead time and lag", free=(DELAY, LAG))
