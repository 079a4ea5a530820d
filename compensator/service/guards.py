"""Guards of the sensors: a value that cannot be is not used, and the sample says why.

Each guard works on the record of the sample alone, so that an audit applies it again to the logged
values and finds the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from compensator.config import Channel, Guards
from compensator.messages import ChannelSample, number

#: Heat estimate, W, from which the machine counts as heated where no channel tells.
HEATED_W = 10.0


class ChannelGuard:
    """Range, rate and stuck guard of one channel.

    Parameters
    ----------
    channel : Channel
        Its limits.
    period_min : float
        Length of a sample, min.
    """

    def __init__(self, channel: Channel, period_min: float) -> None:
        self._channel = channel
        self._period_min = period_min
        self._last_good = math.nan
        self._since_good_min = 0.0
        self._still_at = math.nan
        self._still_min = 0.0

    def judge(self, sample: ChannelSample) -> str:
        """Return `good` or the code of what makes the sample unusable, and remember what is needed next."""
        self._since_good_min += self._period_min
        if sample.device_quality != "good":
            return sample.device_quality
        verdict = self._verdict(number(sample.mean), sample)
        if verdict == "good":
            self._last_good, self._since_good_min = number(sample.mean), 0.0
        return verdict

    def _verdict(self, mean: float, sample: ChannelSample) -> str:
        channel = self._channel
        if not math.isfinite(mean):
            return "invalid"
        if channel.range is not None and not channel.range[0] <= mean <= channel.range[1]:
            return "out_of_range"
        if self._is_stuck(sample):
            return "stuck"
        if channel.rate_max_per_min is not None and not math.isnan(self._last_good):
            # The allowance grows with the time since the last good value, so a sensor that comes back
            # from a long loss is believed again, and a jump is not.
            allowed = channel.rate_max_per_min * self._since_good_min
            if abs(mean - self._last_good) > allowed:
                return "too_fast"
        return "good"

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
        """Let time pass in which nothing was measured."""
        self._since_good_min += minutes

    def snapshot(self) -> tuple[float, float, float, float]:
        """Return the state."""
        return self._last_good, self._since_good_min, self._still_at, self._still_min

    def restore(self, state: tuple[float, float, float, float]) -> None:
        """Take a state back."""
        self._last_good, self._since_good_min, self._still_at, self._still_min = state


class SensorGuards:
    """All guards of a machine.

    Parameters
    ----------
    channels : list of Channel
        Channels with their limits.
    guards : Guards
        Limits between channels.
    period_min : float
        Length of a sample, min.
    """

    def __init__(self, channels: list[Channel], guards: Guards, period_min: float) -> None:
        self._guards = {channel.name: ChannelGuard(channel, period_min) for channel in channels}
        self._limits = guards

    def judge(self, channels: Mapping[str, ChannelSample], heat_w: float) -> dict[str, ChannelSample]:
        """Return the channels with their final quality.

        Parameters
        ----------
        channels : mapping of str to ChannelSample
            What the devices gave.
        heat_w : float
            The model's estimate before this sample, W; NaN where there is none.
        """
        verdicts = {name: self._guards[name].judge(sample) for name, sample in channels.items()}
        if self._t_q_below_at(channels, verdicts, heat_w):
            # Which of the two is wrong cannot be progress: neither is used.
            verdicts["t_q_degc"] = verdicts["at_degc"] = "t_q_below_at"
        return {
            name: sample
            if verdicts[name] == sample.quality
            else msgspec.structs.replace(sample, quality=verdicts[name])
            for name, sample in channels.items()
        }

    def _t_q_below_at(self, channels: Mapping[str, ChannelSample], verdicts: Mapping[str, str], heat_w: float) -> bool:
        if verdicts.get("t_q_degc") != "good" or verdicts.get("at_degc") != "good":
            return False
        below_k = number(channels["at_degc"].mean) - number(channels["t_q_degc"].mean)
        known = channels.get("heat_w")
        heat = number(known.mean) if known is not None and verdicts["heat_w"] == "good" else heat_w
        return below_k > self._limits.t_q_below_at_max_k and heat > HEATED_W

    def pass_time(self, minutes: float) -> None:
        """Let time pass in which nothing was measured."""
        for guard in self._guards.values():
            guard.pass_time(minutes)

    def snapshot(self) -> dict[str, tuple[float, float, float, float]]:
        """Return the state of every guard."""
        return {name: guard.snapshot() for name, guard in self._guards.items()}

    def restore(self, state: Mapping[str, tuple[float, float, float, float]]) -> None:
        """Take the states back."""
        for name, guard_state in state.items():
            self._guards[name].restore(guard_state)
