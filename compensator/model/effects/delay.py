"""`delay`: a path or its sensor is delayed.

path     y += L(lag) · y_path(t − d) − y_path(t)
T_Q      T_Q = L(lag) · (TTF · heat + a)(t − d), or the heat alone is late: corrected where the heat is estimated
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from compensator.arrays import Matrix
from compensator.errors import ModelError
from compensator.model.effects.base import Effect, Run, number, optional_number, register, text
from compensator.model.effects.blocks import Block, Delay, Lag, S, shifted
from compensator.model.effects.hypothesis import Context, Free, Hypothesis, proposes
from compensator.model.effects.lateness import Lateness
from compensator.model.effects.seen import Seen, digits
from compensator.model.effects.signals import RecordSignals, Signals

DELAY = Free(name="delay_min", low=0.0, high=60.0, grid=(0.5, 1.0, 2.0, 4.0, 7.0, 12.0, 20.0, 40.0), log=False)
LAG = Free(name="lag_min", low=0.05, high=60.0, grid=(0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0))


@register
class DelayedPath(Effect):
    """A delayed path."""

    kind = "delay"
    # The timing of an identified path has an error of its own.
    worth_with_others, removes_alone = 0.6, 0.5
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

    def explain(self, seen: Seen) -> str:
        return f"{seen.words} after changes: the response of the {self.path} is late by {self._times()}."

    def _times(self) -> str:
        times = (("a dead time", self.delay_min), ("a lag", self.lag_min))
        return " and ".join(f"{what} of {digits(value)} min" for what, value in times if value)


#: What a late T_Q says of its correction; left out where it is not corrected.
CORRECTED = " The model can correct this in real time, except for the first minutes after a change."


@register
class DelayedSensor(DelayedPath):
    """A late T_Q: the observer corrects it, so that every other effect gets corrected signals, too."""

    path: str = text("TTF", "DTF")
    form: str = text("sensor", "path")
    delay_min: float = number(0.0, 240.0)
    lag_min: float = number(0.0, 240.0)
    walk_times: float = optional_number(1e-2, 1e2, default=1.0)
    behind_min: float = optional_number(0.0, 240.0, default=0.0)

    def check_base(self, kind: str) -> None:
        if self.behind_min > 0.0 and kind != "direct":
            raise ModelError(f"effect delay of T_Q: behind_min = {self.behind_min!r}, expected 0 in a model with a TTF")

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        return ()

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        """Return 0: the shares of the paths are corrected already."""
        return signals.drive - signals.drive

    @property
    def lateness(self) -> Lateness:
        return Lateness(
            lag_min=self.lag_min,
            delay_min=self.delay_min,
            of_ambient=self.form == "sensor",
            walk_times=self.walk_times,
            behind_min=self.behind_min,
        )

    def columns(self, record: RecordSignals, blocks: Sequence[Block]) -> Matrix:
        """Return what the share would have been with an immediate sensor, less what it is; it uses the future."""
        share, period_min = record.share(self.path), record.period_min
        late = share + record.share_of_ambient if self.form == "sensor" else share
        early = shifted(late, -self.delay_min / period_min)
        early = early + self.lag_min * np.gradient(early, period_min)
        return np.asarray(early - late)[:, None]

    def explain(self, seen: Seen) -> str:
        what = "the sensor T_Q is late" if self.form == "sensor" else "the heat reaches T_Q late,"
        return (
            f"{seen.words} after changes of the heat: {what} by {self._times()}.{CORRECTED} Better: move the sensor "
            "closer to the source, or mount it with better thermal contact."
        )


@proposes
def delays(context: Context) -> Iterator[Hypothesis]:
    """Propose a dead time of every path; T_Q with a dead time, a lag or both, its share of the ambient late or not."""
    for path in context.paths:
        yield Hypothesis(effect=DelayedPath(path=path, delay_min=0.0, lag_min=0.0), form="dead time", free=(DELAY,))
    if "DTF" not in context.paths or context.has_late_t_q:
        return
    path = "TTF" if context.has_ttf else "DTF"
    searched = {"dead time": (DELAY,), "lag": (LAG,), "dead time and lag": (DELAY, LAG)}
    for form in ("sensor", "path"):
        late = DelayedSensor(path=path, form=form, delay_min=0.0, lag_min=0.0)
        for words, free in searched.items():
            yield Hypothesis(effect=late, form=f"{form}, {words}", free=free)
