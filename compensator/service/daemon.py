"""The service: polls devices, makes samples, lets the compensation decide, records, publishes.

The order within a sample is fixed: everything is on disk before the offset goes out.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from compensator import __version__
from compensator.clock import NS, Clock
from compensator.config import Config
from compensator.events import Note, PauseData
from compensator.messages import SCHEMA, Offset, Sample, Status, encode
from compensator.service.adoption import Adoption
from compensator.service.commands import Commands
from compensator.service.compensation import Compensation, Outcome
from compensator.service.grid import Grid
from compensator.service.journal import Entry, Journal
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.publisher import UNNAMED, Reply, Sender
from compensator.service.sampling import ChannelCollector
from compensator.service.takeover import Takeover
from drivers.errors import DriverError
from drivers.reading import Device, Reading

log = logging.getLogger("compensator")

#: Part of the poll interval that a sample waits for devices at most.
WAIT_PART = 0.5
#: So long the loop stands still for the disk: a part of the poll interval, so that no poll is late, at most so many s.
DISK_PART, DISK_S = 0.4, 2.0
#: So long an offset waits for the disk while polling goes on: a part of the sample's period, at least `DISK_S`, at most
#: so many s. A quarter of a minute old is no harm, the rate goes with it; an offset that is not on record may be.
PATIENCE_PART, PATIENCE_S = 0.25, 15.0


@dataclass(slots=True)
class _DeviceState:
    """A device with the poll that is under way and its last error."""

    device: Device
    task: asyncio.Task[Mapping[int, Reading]] | None = None
    error: str = ""
    answered: bool = True


@dataclass(slots=True)
class Latency:
    """Seconds from the last byte read to the offset published, for each sample."""

    seconds: list[float] = field(default_factory=list)

    def add(self, value: float, keep: int = 10_000) -> None:
        """Keep the newest values."""
        self.seconds.append(value)
        if len(self.seconds) > keep:
            del self.seconds[: keep // 2]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Decided:
    """A sample that is decided and on its way to the disk; `began` is when that was begun, s."""

    outcome: Outcome
    entry: Entry
    sample: bytes
    estimate: bytes
    began: float


class Daemon:
    """The service of one machine.

    Parameters
    ----------
    config : Config
        Settings.
    compensation : Compensation
        What decides.
    devices : mapping of str to Device
        Open or not; a device opens itself when it is read.
    recorder : Recorder
        Where every sample goes first.
    publish : callable
        Takes a message's name and its JSON; never waits.
    clock : Clock
        Handed in.
    first_sequence : int
        Sequence number of the first sample.
    adoption : Adoption, optional
        Prepares other models; without it the commands `adopt` and `back` are refused.
    notes : sequence of Note
        Events of what went before.
    early : OffsetCheckpoint, optional
        Where an offset is noted that is published before it is on disk.
    """

    def __init__(
        self,
        *,
        config: Config,
        compensation: Compensation,
        devices: Mapping[str, Device],
        recorder: Any,
        publish: Callable[[str, bytes], None],
        clock: Clock,
        first_sequence: int,
        adoption: Adoption | None = None,
        notes: Sequence[Note] = (),
        early: OffsetCheckpoint | None = None,
    ) -> None:
        self._config = config
        self._compensation = compensation
        self._devices = {name: _DeviceState(device) for name, device in devices.items()}
        self._publish = publish
        self._clock = clock
        fraction = config.sampling.min_good_fraction
        self._collectors = {channel.name: ChannelCollector(fraction) for channel in config.channel}
        self._journal = Journal(
            machine=config.machine.name,
            recorder=recorder,
            publish=publish,
            clock=clock,
            sequence=first_sequence,
            limit_s=min(DISK_PART * config.sampling.poll_interval_s, DISK_S),
            patience_s=min(max(PATIENCE_PART * compensation.model.period_s, DISK_S), PATIENCE_S),
            early=early,
        )
        self._takeover = Takeover(adoption, self._journal, clock, lambda: self._compensation)
        self._commands = Commands(self._journal, self._takeover, unproven=config.zenoh.takes_unproven())
        self._stop = False
        self._started_utc_ns = clock.utc_ns()
        self._last_state = ""
        #: Outcomes that were published and not yet told to whoever runs the service.
        self._said: list[Outcome] = []
        #: A sample that is decided and waits for the disk while polling goes on.
        self._pending: asyncio.Task[None] | None = None
        self._earlier = notes
        self._first = True
        #: Whether a sample broke off half-way, so that its file cannot give the state after it.
        self._broken_off = False
        self.latency = Latency()

    # ------------------------------------------------------------------ running

    async def run(
        self,
        *,
        samples: int | None = None,
        on_sample: Callable[[Outcome], None] | None = None,
        on_poll: Callable[[], None] | None = None,
    ) -> None:
        """Run until `stop` or for a number of samples.

        Parameters
        ----------
        samples : int, optional
            Stop after so many.
        on_sample : callable, optional
            Called with the outcome after each sample was published.
        on_poll : callable, optional
            Called after each poll, when its sample, if one ended there, is decided and published.
        """
        self._commands.open()
        period_s = self._compensation.model.period_s
        polls = max(1, round(period_s / self._config.sampling.poll_interval_s))
        grid = Grid(self._clock, period_s, polls)
        self._journal.note("start", f"compensator {__version__} with model {self._compensation.model.name}")
        for kind, text, data in self._earlier:
            self._journal.note(kind, text, data)
        done = 0
        try:
            while not self._stop and (samples is None or done < samples):
                await self._clock.sleep(grid.seconds_to_next_poll())
                if self._stop:
                    break
                label_ns, last = grid.label_ns, grid.polled()
                await self._turn(period_s / polls, label_ns if last else None)
                if last:
                    self._tell_clock_step(grid.next_sample())
                    done += 1
                self._tell(on_sample)
                if on_poll is not None:
                    on_poll()
        finally:
            await self._close()
            self._tell(on_sample)

    def _tell(self, on_sample: Callable[[Outcome], None] | None) -> None:
        said, self._said = self._said, []
        if on_sample is not None:
            for outcome in said:
                on_sample(outcome)

    async def _turn(self, interval_s: float, label_ns: int | None) -> None:
        """Poll, and make the sample where one ends here; whatever goes wrong, the offset is held and it is said.

        This is the supervisor, the one place that catches everything: a defect in any room must not leave the
        machine without a word, and must never move the offset.
        """
        try:
            await self._poll(interval_s)
            if label_ns is not None:
                await self._sample(label_ns)
        except Exception as error:
            log.exception("internal error")
            self._journal.note("error", f"internal error: {type(error).__name__}: {error}")
            self._compensation.fail()
            if label_ns is not None:
                await self._hold(label_ns)

    async def _hold(self, label_ns: int) -> None:
        """Publish that the last offset stands, without the sample that could not be worked on."""
        await self._pass_pending()
        held = self._compensation.held(self._config.machine.name, self._journal.sequence, label_ns)
        offset = await self._journal.record(label_ns, self._compensation.state(), offset=held)
        self._publish("offset", encode(offset or held))
        self._journal.sequence += 1

    def stop(self) -> None:
        """End the run after the poll under way; the recording is finished."""
        self._stop = True

    async def _close(self) -> None:
        self.stop()
        self._commands.close()
        await self._pass_pending()
        await self._takeover.end()
        await self._journal.close(self._compensation.state())
        for state in self._devices.values():
            if state.task is not None:
                state.task.cancel()
        tasks = [state.task for state in self._devices.values() if state.task is not None]
        await asyncio.gather(*tasks, return_exceptions=True)

    # ------------------------------------------------------------------ polling

    async def _poll(self, interval_s: float) -> None:
        """Ask every device once; wait for those that answered last time, and not long for them."""
        for state in self._devices.values():
            if state.task is None:
                state.task = asyncio.create_task(self._read(state.device))
        awaited = [state.task for state in self._devices.values() if state.task is not None and state.answered]
        await self._clock.settle(awaited, WAIT_PART * interval_s)
        results = {name: self._collect(state) for name, state in self._devices.items()}
        for channel in self._config.channel:
            readings, error = results[channel.device]
            self._collectors[channel.name].add(readings.get(channel.input) if readings else None, error)

    async def _read(self, device: Device) -> Mapping[int, Reading]:
        return await device.read()

    def _collect(self, state: _DeviceState) -> tuple[Mapping[int, Reading] | None, str | None]:
        """Take the result of a device's poll; one that is still under way counts as missing."""
        if state.task is None or not state.task.done():
            state.answered = False
            return None, "device_timeout"
        task, state.task = state.task, None
        state.answered = True
        error = task.exception()
        if error is None:
            self._tell_device(state, "")
            return task.result(), None
        if not isinstance(error, DriverError):
            raise error
        state.answered = error.code != "device_timeout"
        self._tell_device(state, str(error))
        return None, error.code

    def _tell_device(self, state: _DeviceState, error: str) -> None:
        """Note once when a device goes, and once when it comes back."""
        if bool(error) != bool(state.error):
            name = state.device.name
            self._journal.note("device", error or f"{name}: answers again", {"device": name, "ok": not error})
        state.error = error

    # ------------------------------------------------------------------ one sample

    async def _sample(self, label_ns: int) -> None:
        """Decide; publish once it is on disk, and poll on where that takes long."""
        await self._pass_pending()
        began = time.perf_counter()
        self._pass_pause(label_ns)
        self._compensation = self._takeover.swap()
        state, broke_off = self._compensation.state(), self._broken_off
        self._broken_off = True
        self._commands.obey(self._compensation)
        raw = Sample(
            schema=SCHEMA,
            machine=self._config.machine.name,
            seq=self._journal.sequence,
            time_utc_ns=label_ns,
            period_s=self._compensation.model.period_s,
            channels={name: collector.close() for name, collector in self._collectors.items()},
        )
        outcome = self._compensation.process(raw)
        self._broken_off = False
        if broke_off:  # once for all that broke off in a row
            self._journal.start_new_file()
        for note in outcome.notes:
            self._journal.note(*note)
        self._tell_state(self._journal.expected(outcome.offset))
        sample, estimate = encode(outcome.sample), encode(outcome.estimate)
        entry = self._journal.put(label_ns, state, sample=sample, estimate=estimate, offset=outcome.offset)
        decided = _Decided(outcome=outcome, entry=entry, sample=sample, estimate=estimate, began=began)
        if await self._journal.tried(entry):
            self._say(decided)
        else:
            self._pending = asyncio.create_task(self._say_later(decided))

    async def _say_later(self, decided: _Decided) -> None:
        await self._journal.waited(decided.entry)
        self._say(decided)

    async def _pass_pending(self) -> None:
        """Let the sample before be published first, on disk or not."""
        pending, self._pending = self._pending, None
        if pending is not None:
            await pending

    def _say(self, decided: _Decided) -> None:
        """Publish a sample, the offset first."""
        offset = self._journal.settled(decided.entry)
        assert offset is not None
        self._tell_state(offset)
        whole = decided.outcome
        outcome = Outcome(whole.sample, whole.estimate, offset, whole.notes)
        self._publish("offset", encode(offset))
        self.latency.add(time.perf_counter() - decided.began)
        self._publish("sample", decided.sample)
        self._publish("estimate", decided.estimate)
        self._publish("status", encode(self._status(outcome)))
        self._journal.sequence += 1
        self._takeover.follow(outcome)
        self._said.append(outcome)

    def _pass_pause(self, label_ns: int) -> None:
        """Tell the compensation, before its first sample, for how long nobody measured."""
        first, self._first = self._first, False
        _, last_ns = self._compensation.last
        if not first or last_ns == 0:
            return
        period_s = self._compensation.model.period_s
        missing = max(round((label_ns - last_ns) / (period_s * NS)) - 1, 0)
        bridged = self._compensation.bridge_max_min
        minutes = missing * period_s / 60.0
        text = f"{missing} sample(s) are missing between the last recording and now; "
        if label_ns <= last_ns:
            text = (
                "the wall clock stands before the end of the last recording: how long the service was away is unknown"
            )
            self._compensation.pause_of_unknown_length()
        else:
            self._compensation.pause(missing)
            text += (
                f"{minutes:.0f} min are bridged"
                if minutes <= bridged
                else f"{minutes / 60.0:.1f} h cannot be bridged (restart.bridge_max_min, here {bridged:.0f} min)"
            )
        known, std = label_ns > last_ns, self._compensation.std_um
        data = PauseData(
            missing=missing if known else None,
            minutes=minutes if known else None,
            bridged=known and minutes <= bridged,
            y_std_um=std,
        )
        self._journal.note("restart", text, data.table())

    def _status(self, outcome: Outcome) -> Status:
        model = self._compensation.model
        return Status(
            schema=SCHEMA,
            machine=self._config.machine.name,
            seq=outcome.offset.seq,
            time_utc_ns=outcome.offset.time_utc_ns,
            state=outcome.offset.state,
            reasons=outcome.offset.reasons,
            version=__version__,
            model=model.name,
            model_kind=model.kind,
            model_sha256=model.sha256,
            started_utc_ns=self._started_utc_ns,
            recording=self._journal.file,
            devices={name: state.error or "ok" for name, state in self._devices.items()},
            effects=[effect.label for effect in model.effects],
        )

    # ------------------------------------------------------------------ events and commands

    def _tell_state(self, offset: Offset) -> None:
        now = " ".join([offset.state, *offset.reasons])
        if now != self._last_state:
            self._journal.note("state", now, {"state": offset.state, "reasons": offset.reasons})
            self._last_state = now

    def _tell_clock_step(self, seconds: float) -> None:
        if seconds:
            self._journal.note("clock", f"the wall clock was set by {seconds:+.1f} s", {"seconds": seconds})

    def command(self, name: str, payload: bytes, sender: Sender = UNNAMED) -> Reply:
        """Take a command from another thread; it acts at the next sample.

        Parameters
        ----------
        name : str
            `zero`, `hold`, `resume`, `adopt` or `back`.
        payload : bytes
            Empty or a JSON object. `zero` takes `mode`: `auto`, `rest` or `warm`; `adopt` takes `model`, the text of a
            model file, or `sha256`, that of one adopted before, or both; `adopt` and `back` take `force`.
        sender : Sender
            Who sent it; stands in the event.

        Returns
        -------
        dict or Future of dict
            `ok` and `text`; a promise of them for `adopt` and `back`, whose warm-up takes its time.
        """
        return self._commands.take(name, payload, sender)
