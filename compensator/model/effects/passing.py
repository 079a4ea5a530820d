"""`drift`, `step`, `periodic`: what depends on time alone.

None of them can be deployed: a probe mount that drifts or slips is no error of the machine, and a period that no
channel shows has no phase that a model could know.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.model.effects.base import Effect, register
from compensator.model.effects.blocks import Block
from compensator.model.effects.hypothesis import Context, Free, Hypothesis, proposes
from compensator.model.effects.seen import Seen, digits, rounded, signed
from compensator.model.effects.signals import RecordSignals

#: No jump is looked for within this share of a record from its start.
START_SHARE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeOnly(Effect):
    """Base of effects of time alone: not deployed, and next to another effect they must explain more."""

    deployable = False
    worth_with_others = 0.75

    def course(self, record: RecordSignals) -> Vector:
        """Return the addition to y over a record, µm, shape (n,)."""
        raise NotImplementedError

    def columns(self, record: RecordSignals, blocks: Sequence[Block]) -> Matrix:
        return np.asarray(self.course(record))[:, None]


@register
class Drift(TimeOnly):
    """A ramp over the record."""

    kind = "drift"
    linear = ("um_per_h",)
    um_per_h: float = 1.0

    def course(self, record: RecordSignals) -> Vector:
        return self.um_per_h * (record.time_min / 60.0)

    def explain(self, seen: Seen) -> str:
        return (
            f"{seen.words}: Y drifts by {digits(self.um_per_h)} µm per hour whatever the inputs do. A creeping probe "
            "mount is no error of the machine: check the mount and measure against a fixed reference."
        )


@register
class Settling(TimeOnly):
    """A drift that decays."""

    kind = "drift"
    linear = ("size_um",)
    size_um: float = 1.0
    tau_min: float = 1.0

    def course(self, record: RecordSignals) -> Vector:
        return self.size_um * (1.0 - np.exp(-record.time_min / self.tau_min))

    def explain(self, seen: Seen) -> str:
        return (
            f"{seen.words}: Y drifts whatever the inputs do, by {signed(self.size_um)} µm in the end, with a time "
            f"constant of {digits(self.tau_min)} min. A mount or joint that settles is no error of the machine: check "
            "the mount and measure against a fixed reference."
        )


@register
class Jump(TimeOnly):
    """A jump at a time."""

    kind = "step"
    jumps = True
    linear = ("jump_um",)
    jump_um: float = 1.0
    at_min: float = 0.0

    def course(self, record: RecordSignals) -> Vector:
        return self.jump_um * np.clip((record.time_min - self.at_min) / record.period_min + 1.0, 0.0, 1.0)

    def explain(self, seen: Seen) -> str:
        return (
            f"{signed(self.jump_um)} µm from {self.at_min / 60.0:.2f} h on ({rounded(seen.rms_um)} µm rms): Y jumps "
            "and stays. Something was knocked or slipped: check the probe mount and the clamping, then zero again."
        )


@register
class Periodic(TimeOnly):
    """A period that no channel shows."""

    kind = "periodic"
    linear = ("sine_um", "cosine_um")
    sine_um: float = 1.0
    cosine_um: float = 1.0
    period_min: float = 1.0

    def columns(self, record: RecordSignals, blocks: Sequence[Block]) -> Matrix:
        angle = 2.0 * np.pi * record.time_min / self.period_min
        return np.column_stack((np.sin(angle), np.cos(angle)))

    def explain(self, seen: Seen) -> str:
        size = float(np.hypot(self.sine_um, self.cosine_um))
        return (
            f"±{rounded(size)} µm ({rounded(seen.rms_um)} µm rms): Y oscillates with a period of "
            f"{digits(self.period_min)} min that no channel shows. It may be air conditioning, lubrication or a "
            "cabinet cooler: log a channel of it."
        )


@proposes
def courses(context: Context) -> Iterator[Hypothesis]:
    """Propose a ramp, a drift of any time constant about the record's length, a jump at any time, any period."""
    minutes, period = context.span_min, context.period_min
    yield Hypothesis(effect=Drift(), form="ramp", amplitudes=("um_per_h",))
    taus = tuple(float(t) for t in np.geomspace(minutes / 8.0, 2.0 * minutes, 6))
    tau = Free(name="tau_min", low=minutes / 10.0, high=3.0 * minutes, grid=taus)
    yield Hypothesis(effect=Settling(), form="settling", free=(tau,), amplitudes=("size_um",))
    # What moves at the start of a record is its initial state.
    first = max(5.0 * period, START_SHARE * minutes)
    times = np.arange(first, minutes - first, max(period, minutes / 600.0))
    at = Free(name="at_min", low=first - period, high=minutes - first, grid=tuple(times.tolist()), log=False)
    yield Hypothesis(effect=Jump(), form="jump", free=(at,), amplitudes=("jump_um",))
    # Of a period the record must hold about two.
    frequencies = np.arange(2.0, minutes / (4.0 * period), 0.35) / minutes
    grid = tuple((1.0 / frequencies).tolist())
    length = Free(name="period_min", low=4.0 * period, high=minutes / 1.9, grid=grid)
    yield Hypothesis(effect=Periodic(), form="sine", free=(length,), amplitudes=("sine_um", "cosine_um"))
