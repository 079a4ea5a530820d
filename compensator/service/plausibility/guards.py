"""Guards of the channels: an implausible value is not used, and its quality in the sample gives the reason.

The guards use only the recorded sample and their own state, so an audit repeats them on recorded values.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import msgspec

from compensator.codes import SampleQuality
from compensator.config import Channel, Guards
from compensator.messages import ChannelSample, number

#: Channels whose jumps the model can judge, because it expects their values.
TEMPERATURES = ("at_degc", "t_q_degc")
#: Estimated heat, W, above which the machine counts as heated if heat is not measured.
HEATED_W = 10.0

GuardState = tuple[float, float, float, float]


class ChannelGuard:
    """Guard of range, rate and constant values of one channel; `period_min` is the length of a sample, min.

    With `suspects_jumps` the permitted change grows with the square root of the time without a value, and is at least
    `jump_min_k`, K.
    """

    def __init__(
        self, channel: Channel, period_min: float, *, suspects_jumps: bool = False, jump_min_k: float = 0.0
    ) -> None:
        self._suspects_jumps, self._jump_min_k = suspects_jumps, jump_min_k
        self._channel = channel
        self._period_min = period_min
        self._last_good = math.nan
        self._since_good_min = 0.0
        self._still_at = math.nan
        self._still_min = 0.0

    def check(self, sample: ChannelSample, *, suspect: bool = False) -> str:
        """Return the quality of a sample and update the state; a `suspect` channel is not good, whatever it is."""
        self._since_good_min += self._period_min
        if sample.device_quality != SampleQuality.GOOD:
            return sample.device_quality
        quality = self._quality(number(sample.mean), sample)
        if suspect and quality in (SampleQuality.GOOD, SampleQuality.TOO_FAST):
            return SampleQuality.SUSPECT
        if quality == SampleQuality.GOOD:
            self._last_good, self._since_good_min = number(sample.mean), 0.0
        return quality

    def _quality(self, mean: float, sample: ChannelSample) -> SampleQuality:
        channel = self._channel
        if not math.isfinite(mean):
            return SampleQuality.INVALID
        if channel.range is not None and not channel.range[0] <= mean <= channel.range[1]:
            return SampleQuality.OUT_OF_RANGE
        if self._is_stuck(sample):
            return SampleQuality.STUCK
        if channel.rate_max_per_min is not None and not math.isnan(self._last_good):
            # The permitted change grows with the time since the last good value: a sensor that returns after a long
            # loss is accepted again, a jump is not.
            # A change below the smallest jump is none, however short a sample is: the noise of a sensor does not shrink
            # with it, and the return from so small a jump could not be told.
            allowed = max(channel.rate_max_per_min * self._growth_min, self._jump_min_k)
            if abs(mean - self._last_good) > allowed:
                return SampleQuality.TOO_FAST
        return SampleQuality.GOOD

    @property
    def _growth_min(self) -> float:
        """Factor of the largest rate in the permitted change, min: the time since the last good value.

        Where jumps are watched, a sample times the square root of the number of samples since then.
        """
        if not self._suspects_jumps:
            return self._since_good_min
        # The straight growth would permit any fault after an open contact of a few samples.
        return self._period_min * math.sqrt(self._since_good_min / self._period_min)

    def accept(self, value: float) -> None:
        """Continue from a value (NaN: from the next one, whatever it is)."""
        self._last_good, self._since_good_min = value, 0.0

    def _is_stuck(self, sample: ChannelSample) -> bool:
        low, high = number(sample.min), number(sample.max)
        if low == high == self._still_at:
            self._still_min += self._period_min
        else:
            self._still_at = low if low == high else math.nan
            self._still_min = 0.0
        limit = self._channel.stuck_after_min
        return limit is not None and self._still_min >= limit

    def pass_time(self, minutes: float) -> None:
        """Account for time in which nothing was measured."""
        self._since_good_min += minutes

    def snapshot(self) -> GuardState:
        """Return the state."""
        return self._last_good, self._since_good_min, self._still_at, self._still_min

    def restore(self, state: GuardState) -> None:
        """Restore a state."""
        self._last_good, self._since_good_min, self._still_at, self._still_min = state


class SensorGuards:
    """All guards of a machine; `period_min` is the length of a sample, min."""

    def __init__(self, channels: list[Channel], guards: Guards, period_min: float) -> None:
        watched = TEMPERATURES if guards.suspect_jumps else ()
        self._guards = {
            channel.name: ChannelGuard(channel, period_min, suspects_jumps=True, jump_min_k=guards.jump_min_k or 0.0)
            if channel.name in watched
            else ChannelGuard(channel, period_min)
            for channel in channels
        }
        self._limits = guards

    def check(
        self, channels: Mapping[str, ChannelSample], heat_w: float, suspects: Collection[str] = ()
    ) -> dict[str, ChannelSample]:
        """Return the channels with their final quality.

        Parameters
        ----------
        channels : mapping of str to ChannelSample
            Samples with the devices' qualities.
        heat_w : float
            The model's estimate before this sample, W; NaN if there is none.
        suspects : collection of str
            Channels that have jumped and are not used (`JumpWatch`).
        """
        qualities = {
            name: self._guards[name].check(sample, suspect=name in suspects) for name, sample in channels.items()
        }
        if self._t_q_below_at(channels, qualities, heat_w):
            # It is unknown which of the two is wrong, so neither is used.
            qualities["t_q_degc"] = qualities["at_degc"] = SampleQuality.T_Q_BELOW_AT
        return {
            name: sample
            if qualities[name] == sample.quality
            else msgspec.structs.replace(sample, quality=qualities[name])
            for name, sample in channels.items()
        }

    def _t_q_below_at(self, channels: Mapping[str, ChannelSample], qualities: Mapping[str, str], heat_w: float) -> bool:
        if qualities.get("t_q_degc") != SampleQuality.GOOD or qualities.get("at_degc") != SampleQuality.GOOD:
            return False
        below_k = number(channels["at_degc"].mean) - number(channels["t_q_degc"].mean)
        known = channels.get("heat_w")
        heat = number(known.mean) if known is not None and qualities["heat_w"] == SampleQuality.GOOD else heat_w
        return below_k > self._limits.t_q_below_at_max_k and heat > HEATED_W

    def accept(self, name: str, value: float) -> None:
        """Continue a channel from a value (NaN: from the next one, whatever it is)."""
        self._guards[name].accept(value)

    def pass_time(self, minutes: float) -> None:
        """Account for time in which nothing was measured."""
        for guard in self._guards.values():
            guard.pass_time(minutes)

    def snapshot(self) -> dict[str, GuardState]:
        """Return the state of every guard."""
        return {name: guard.snapshot() for name, guard in self._guards.items()}

    def restore(self, state: Mapping[str, GuardState]) -> None:
        """Restore the states."""
        for name, guard_state in state.items():
            self._guards[name].restore(guard_state)
