"""From single readings to samples: when devices are polled, and the robust mean of each channel's readings.

Samples end at whole multiples of the period in UTC. Each wait ends at the next point of this grid, so errors do not
accumulate. Setting the wall clock changes the labels, not the pace: the step is reported, and the grid starts again. So
it does where the service stood still for a sample or longer, and the samples that are missing are counted.

A reading far from the median of its sample, in robust standard deviations, is left out. Where more than half of the
readings are equal, the smallest difference from them takes the place of the standard deviation: the step of the
converter. A temperature or a displacement beyond any converter's step (`STEP_MAX`) is an outlier, however many there
are; the value of another channel, such as a speed or a power, may be switched within a sample.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median

from compensator.clock import NS, Clock
from compensator.codes import SampleQuality
from compensator.config import Config
from compensator.events import EventKind
from compensator.messages import READING_MAX, ChannelSample
from drivers.errors import DriverError
from drivers.reading import Device, Quality, Reading

#: A poll waits for devices that answered last time for at most this fraction of the poll interval.
WAIT_PART = 0.5
#: A reading farther from the median than this number of robust standard deviations is left out.
OUTLIER_SIGMA = 6.0
#: Largest step of a converter by the unit of its channel: whole degrees, and more than whole micrometres.
STEP_MAX = {"degc": 1.0, "um": 5.0}
#: Median absolute deviation of a normal distribution, as a fraction of its standard deviation.
_MAD_OF_SIGMA = 0.6745
_OUTLIER = str(SampleQuality.OUTLIER)


class Grid:
    """Times of the polls and samples: `polls` in each sample of `period_s` seconds, the last one at its end."""

    def __init__(self, clock: Clock, period_s: float, polls: int) -> None:
        self._clock = clock
        self._period_ns = round(period_s * NS)
        self._polls = polls
        self._restart()
        #: End of the last sample on the monotonic clock, ns.
        self._last_ns = self._end_ns - self._period_ns

    def _restart(self) -> None:
        """Let the current sample end at the next whole multiple of the period."""
        utc, monotonic = self._clock.utc_ns(), self._clock.monotonic_ns()
        self.label_ns = (utc // self._period_ns + 1) * self._period_ns
        self._end_ns = monotonic + self.label_ns - utc
        gone = self._period_ns - (self.label_ns - utc)
        self._index = min(gone * self._polls // self._period_ns, self._polls - 1)

    def seconds_to_next_poll(self) -> float:
        """Return the time until the next poll, s."""
        point = self._end_ns - self._period_ns + (self._index + 1) * self._period_ns // self._polls
        return (point - self._clock.monotonic_ns()) / NS

    def count_poll(self) -> bool:
        """Count a poll; return whether it is the last one of its sample."""
        self._index += 1
        return self._index == self._polls

    def next_sample(self) -> None:
        """Advance to the next sample."""
        off_ns = self._off_ns
        self._index, self._last_ns = 0, self._end_ns
        self.label_ns += self._period_ns
        self._end_ns += self._period_ns
        if abs(off_ns) <= NS:
            # Small differences come from a time service that slews the clock: follow it; the labels stay on the grid.
            self._end_ns -= off_ns

    @property
    def _off_ns(self) -> int:
        """By how much the wall clock has been set since the last restart, ns."""
        return self._clock.utc_ns() - self._clock.monotonic_ns() - (self.label_ns - self._end_ns)

    def begin_again(self) -> tuple[float, int] | None:
        """Start again before a sample where the wall clock was set, and in one where the next poll is late by a sample.

        Returns
        -------
        (float, int) or None
            Step of the wall clock, s (0 for the usual small corrections), and number of samples that are missing; None
            where the grid goes on.
        """
        off_ns, is_late = self._off_ns, -self.seconds_to_next_poll() * NS >= self._period_ns
        was_set = abs(off_ns) > NS
        if not (is_late or (was_set and self._index == 0)):
            return None
        self._restart()
        missing = round((self._end_ns - self._last_ns) / self._period_ns) - 1
        self._last_ns = self._end_ns - self._period_ns
        return off_ns / NS if was_set else 0.0, max(missing, 0) if is_late else 0


class ChannelCollector:
    """Collects the readings of one channel over one sample.

    Parameters
    ----------
    min_good_fraction : float
        Fraction of the polls that must give a good reading for the mean to be valid.
    step_max : float, optional
        Largest difference between equal readings and the others that a converter makes, in the unit of the channel.
    """

    def __init__(self, min_good_fraction: float, step_max: float = math.inf) -> None:
        self._min_good_fraction = min_good_fraction
        self._step_max = step_max
        self._readings: list[Reading] = []
        self._errors: Counter[str] = Counter()
        self._polls = 0

    def add(self, reading: Reading | None, error: str | None = None) -> None:
        """Add the result of one poll: a reading, or the code of the error."""
        self._polls += 1
        if reading is not None and reading.quality is Quality.GOOD:
            if all(abs(value) <= READING_MAX for value in (reading.value, reading.minimum, reading.maximum)):
                self._readings.append(reading)
            else:
                self._errors[str(Quality.INVALID)] += 1
        elif reading is not None:
            self._errors[str(reading.quality)] += 1
        else:
            self._errors[error or str(SampleQuality.DEVICE_ERROR)] += 1

    def close(self) -> ChannelSample:
        """Return the sample of the collected readings and start the next one."""
        readings, errors, polls = self._readings, self._errors, self._polls
        self._readings, self._errors, self._polls = [], Counter(), 0
        kept, outliers = _without_outliers(readings, self._step_max)
        if outliers:
            errors[_OUTLIER] += outliers
        enough = len(kept) >= max(1, math.ceil(self._min_good_fraction * polls))
        quality = str(SampleQuality.GOOD) if enough else _most_frequent(errors)
        values = [reading.value for reading in kept]
        mean = math.fsum(values) / len(values) if values else math.nan
        spread = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / len(values)) if values else math.nan
        return ChannelSample(
            mean=mean if enough else math.nan,
            min=min((r.minimum for r in kept), default=math.nan),
            max=max((r.maximum for r in kept), default=math.nan),
            spread=spread,
            count=len(kept),
            polls=polls,
            quality=quality,
            device_quality=quality,
            errors=dict(sorted(errors.items())),
        )


def _without_outliers(readings: list[Reading], step_max: float) -> tuple[list[Reading], int]:
    """Leave out single outliers; a slope over the sample is not an outlier."""
    if len(readings) < 5:
        return readings, 0
    values = [reading.value for reading in readings]
    middle = median(values)
    distance = [abs(value - middle) for value in values]
    sigma = median(distance) / _MAD_OF_SIGMA
    if sigma == 0.0:
        # Quantised and quiet: more than half of the values are equal; the step is the smallest difference.
        steps = [d for d in distance if d > 0.0]
        if len(steps) > 1:
            sigma = min(steps) if min(steps) <= step_max else 0.0
        else:
            sigma = math.inf if _near(values) else 0.0
    kept = [reading for reading, d in zip(readings, distance, strict=True) if d <= OUTLIER_SIGMA * sigma]
    return kept, len(readings) - len(kept)


def _near(values: list[float]) -> bool:
    """Return whether a single deviating reading among equal ones is a converter step, not an outlier."""
    return max(values) - min(values) <= 1e-3 * max(1.0, abs(median(values)))


def _most_frequent(errors: Mapping[str, int]) -> str:
    causes = {code: n for code, n in errors.items() if code != _OUTLIER}
    return max(sorted(causes), key=lambda code: causes[code]) if causes else str(SampleQuality.TOO_FEW)


@dataclass(slots=True)
class _DeviceState:
    """A device with its channels, its current poll and its last error."""

    device: Device
    channels: list[tuple[int, ChannelCollector]] = field(default_factory=list)
    task: asyncio.Task[Mapping[int, Reading]] | None = None
    #: Whether the sample in which the current poll began is still open.
    counts: bool = False
    error: str = ""
    answered: bool = True

    def add(self, readings: Mapping[int, Reading] | None, error: str | None = None) -> None:
        """Add the result of one poll to every channel of the device."""
        for number, collector in self.channels:
            collector.add(readings.get(number) if readings else None, error)


class Sampler:
    """Polls the devices and collects their readings.

    Parameters
    ----------
    config : Config
        Channels, and the number of readings in a sample.
    devices : mapping of str to Device
        Open or closed; a device opens itself when it is read.
    clock : Clock
        For waiting.
    note : callable
        Called with kind, text and data of an event when a device stops answering or answers again.
    """

    def __init__(
        self,
        config: Config,
        devices: Mapping[str, Device],
        clock: Clock,
        note: Callable[[EventKind, str, dict[str, object]], None],
    ) -> None:
        self._devices = {name: _DeviceState(device) for name, device in devices.items()}
        self._clock = clock
        self._note = note
        fraction = config.sampling.min_good_fraction
        self._collectors = {
            channel.name: ChannelCollector(fraction, STEP_MAX.get(channel.name.rpartition("_")[2], math.inf))
            for channel in config.channel
        }
        for channel in config.channel:
            self._devices[channel.device].channels.append((channel.input, self._collectors[channel.name]))

    async def poll(self, interval_s: float) -> None:
        """Poll every device once; wait briefly for those that answered last time.

        An answer belongs to the poll that asked for it. A late one counts as long as the sample of this poll is open,
        and is dropped afterwards: in the next sample it would be an old value with a new time.
        """
        for state in self._devices.values():
            self._collect(state)
            if state.task is None:
                state.task, state.counts = asyncio.create_task(state.device.read()), True
            else:
                state.add(None, SampleQuality.DEVICE_TIMEOUT)
        awaited = [state.task for state in self._devices.values() if state.task is not None and state.answered]
        await self._clock.settle(awaited, WAIT_PART * interval_s)
        for state in self._devices.values():
            self._collect(state)
            state.answered &= state.task is None

    def close_sample(self) -> dict[str, ChannelSample]:
        """Return the sample of every channel and start the next one; polls without an answer count as missing."""
        for state in self._devices.values():
            if state.task is not None and state.counts:
                state.add(None, SampleQuality.DEVICE_TIMEOUT)
                state.counts = False
        return {name: collector.close() for name, collector in self._collectors.items()}

    def device_states(self) -> dict[str, str]:
        """Return `ok` or the last error of each device."""
        return {name: state.error or "ok" for name, state in self._devices.items()}

    async def close(self) -> None:
        """Cancel the polls that are still running."""
        tasks = [state.task for state in self._devices.values() if state.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _collect(self, state: _DeviceState) -> None:
        """Add readings or error code of a finished poll, if its sample is open."""
        if state.task is None or not state.task.done():
            return
        task, state.task = state.task, None
        error = task.exception()
        if error is not None and not isinstance(error, DriverError):
            raise error
        state.answered = error is None or error.code != SampleQuality.DEVICE_TIMEOUT
        self._note_change(state, str(error) if error is not None else "")
        if state.counts:
            state.add(*((task.result(), None) if error is None else (None, error.code)))

    def _note_change(self, state: _DeviceState, error: str) -> None:
        """Note once when a device stops answering, and once when it answers again."""
        if bool(error) != bool(state.error):
            name = state.device.name
            self._note(EventKind.DEVICE, error or f"{name}: answers again", {"device": name, "ok": not error})
        state.error = error
