"""The service: polls devices, makes samples, runs the compensation, records, publishes.

The order within a sample is fixed: everything is on disk before the offset is published.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgspec.structs import asdict
from msgspec.structs import replace as replace_fields

from compensator import __version__
from compensator.axes import FIRST, label_of
from compensator.clock import NS, Clock
from compensator.config import Config
from compensator.events import EventKind, Note, PauseData
from compensator.messages import SCHEMA, Offset, Probe, Sample, Status, encode
from compensator.messages_axes import AxesStatus, AxisOffset, AxisState
from compensator.service.commands import Commands
from compensator.service.compensation import Compensation, Outcome
from compensator.service.disk_writer import DiskWriter, Entry, Recorder
from compensator.service.event_log import EventLog
from compensator.service.journal import Journal
from compensator.service.loop.live import LoopParts, ServiceLoop
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.probing import ReceivedProbe
from compensator.service.probing.received import undecided_probe
from compensator.service.publisher import UNNAMED, Reply, Sender
from compensator.service.sampling import Grid, Sampler
from compensator.service.transfer.adoption import Adoption
from compensator.service.transfer.model_store import ModelStore
from drivers.reading import Device

log = logging.getLogger("compensator")

#: How long the sampling loop waits for the disk: a fraction of the poll interval, so that no poll is late, and a limit
#: in s.
DISK_PART, DISK_S = 0.4, 2.0
#: How long an offset waits for the disk while polling continues: a fraction of the sample's period, at least `DISK_S`,
#: and a limit in s. An offset of that age is usable because its rate is published with it.
PATIENCE_PART, PATIENCE_S = 0.25, 15.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Decided:
    """A sample whose outcome is being written to disk; `began` is the start of its processing, s."""

    outcome: Outcome
    entry: Entry
    began: float


class Daemon:
    """The service of one machine.

    Parameters
    ----------
    config : Config
        Settings.
    compensation : Compensation
        Computes the offset.
    devices : mapping of str to Device
        Open or closed; a device opens itself when it is read.
    recorder : Recorder
        Writes every sample before its offset is published.
    publish : callable
        Publishes a message by name and JSON; never waits.
    clock : Clock
        Clock of the sampling loop.
    first_sequence : int
        Sequence number of the first sample.
    recordings : pathlib.Path
        Folder of the recordings, on which another model is warmed up.
    store : ModelStore, optional
        Adopted models; without it the commands `adopt` and `back` are refused.
    notes : sequence of Note
        Events from before the start.
    checkpoint : OffsetCheckpoint, optional
        Keeps an offset that is published before it is on disk.
    loop : LoopParts, optional
        Looks for better models; None without `[loop]`.
    """

    def __init__(
        self,
        *,
        config: Config,
        compensation: Compensation,
        devices: Mapping[str, Device],
        recorder: Recorder,
        publish: Callable[[str, bytes], None],
        clock: Clock,
        first_sequence: int,
        recordings: Path = Path(),
        store: ModelStore | None = None,
        notes: Sequence[Note] = (),
        checkpoint: OffsetCheckpoint | None = None,
        loop: LoopParts | None = None,
    ) -> None:
        self._config = config
        self._compensation = compensation
        self._publish = publish
        self._clock = clock
        self._events = EventLog(config.machine.name, publish, clock, first_sequence)
        self._writer = DiskWriter(recorder)
        self._journal = Journal(
            self._events,
            self._writer,
            clock,
            limit_s=min(DISK_PART * config.sampling.poll_interval_s, DISK_S),
            patience_s=min(max(PATIENCE_PART * compensation.model.period_s, DISK_S), PATIENCE_S),
            checkpoint=checkpoint,
        )
        self._sampler = Sampler(config, devices, clock, self._events.note)
        self._loop: ServiceLoop | None = None
        if loop is not None:
            self._loop = ServiceLoop(
                config,
                loop,
                recordings,
                events=self._events,
                journal=self._journal,
                clock=clock,
                is_adopting=lambda: self._adoption.is_under_way,
            )
        self._adoption = Adoption(
            config,
            recordings,
            store,
            self._events,
            self._journal,
            clock=clock,
            running=lambda: self._compensation,
            loop=self._loop,
        )
        self._commands = Commands(
            self._events,
            self._adoption,
            clock=clock,
            running=lambda: self._compensation,
            machine=config.machine.name,
            unproven=config.zenoh.accepts_unproven(),
            loop=self._loop,
        )
        #: Probes of the sample that is being processed, and those that cannot be read.
        self._deciding: list[ReceivedProbe] = []
        self._unread: list[Probe] = []
        self._stop = False
        #: The sleep until the next poll.
        self._sleep: asyncio.Future[None] | None = None
        self._started_utc_ns = clock.utc_ns()
        self._last_state = ""
        #: Outcomes that were published but not yet reported to the caller.
        self._unreported: list[Outcome] = []
        #: A sample that waits for the disk while polling continues.
        self._pending: asyncio.Task[None] | None = None
        self._earlier = notes
        self._first = True
        #: Samples since the last one that are not on record.
        self._missing = 0
        #: Whether the file so far cannot reproduce the state before the next sample: processing failed, or a pause.
        self._needs_file = False
        #: Seconds from the last byte read to the offset published, of the newest samples.
        self.latency_s: deque[float] = deque(maxlen=10_000)

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
            Number of samples to stop after.
        on_sample : callable, optional
            Called with the outcome after each sample was published.
        on_poll : callable, optional
            Called after each poll; if a sample ended with it, after that sample was published.
        """
        self._commands.open()
        period_s = self._compensation.model.period_s
        polls = self._config.sampling.polls_of(period_s)
        assert polls is not None  # checked with the model
        grid = Grid(self._clock, period_s, polls)
        self._events.note(EventKind.START, f"compensator {__version__} with model {self._compensation.model.name}")
        for kind, text, data in self._earlier:
            self._events.note(kind, text, data)
        done = 0
        try:
            while not self._stop and (samples is None or done < samples):
                await self._sleep_until_stopped(grid.seconds_to_next_poll())
                if self._stop:
                    break
                if await self._began_again(grid):
                    continue
                label_ns, last = grid.label_ns, grid.count_poll()
                await self._step(period_s / polls, label_ns if last else None)
                if last:
                    grid.next_sample()
                    await self._began_again(grid)
                    done += 1
                self._report(on_sample)
                if on_poll is not None:
                    on_poll()
        finally:
            await self._close()
            self._report(on_sample)

    async def _sleep_until_stopped(self, seconds: float) -> None:
        """Wait for the next poll, which may be an hour away, or for `stop`: a service manager kills what takes long."""
        self._sleep = asyncio.ensure_future(self._clock.sleep(seconds))
        try:
            await asyncio.wait([self._sleep])
            if not self._sleep.cancelled():
                self._sleep.result()
        finally:
            self._sleep.cancel()

    async def _began_again(self, grid: Grid) -> bool:
        """Follow a wall clock that was set, and account for samples while nothing ran; return whether that was so."""
        found = grid.begin_again()
        if found is None:
            return False
        step_s, missing = found
        if missing:
            self._sampler.close_sample()  # its readings are from before and from after
            await self._await_pending()
            self._events.sequence += missing
            self._missing += missing
        if step_s:
            self._events.note(EventKind.CLOCK, f"the wall clock was set by {step_s:+.1f} s", {"seconds": step_s})
        return True

    def _report(self, on_sample: Callable[[Outcome], None] | None) -> None:
        outcomes, self._unreported = self._unreported, []
        if on_sample is not None:
            for outcome in outcomes:
                on_sample(outcome)

    async def _step(self, interval_s: float, label_ns: int | None) -> None:
        """Poll, and process the sample if one ends; on any error hold the offset and report the error.

        This is the supervisor: a defect must neither stop the service nor move the offset.
        """
        try:
            await self._sampler.poll(interval_s)
            if label_ns is not None:
                await self._sample(label_ns)
        except Exception as error:
            log.exception("internal error")
            await self._await_pending()  # or its event had the number of that sample, and were recorded with the next
            self._fail(error)
            if label_ns is not None:
                await self._hold(label_ns)

    def _fail(self, error: Exception) -> None:
        """Report an error; the offset is held from the next one on."""
        self._events.note(EventKind.ERROR, f"internal error: {type(error).__name__}: {error}")
        self._compensation.fail()

    async def _hold(self, label_ns: int) -> None:
        """Publish that the last offset is held, without the sample that could not be processed."""
        self._sampler.close_sample()  # its readings belong to no later sample
        machine, sequence = self._config.machine.name, self._events.sequence
        held, *further = self._compensation.held_axes(machine, sequence, label_ns)
        undecided, self._deciding = [undecided_probe(machine, sequence, probe) for probe in self._deciding], []
        unread, self._unread = self._unread, []
        offsets = await self._journal.record(
            label_ns,
            self._compensation.state(),
            opening=self._opening(),
            probes=[*(replace_fields(probe, seq=sequence) for probe in unread), *undecided],
            offset=held,
            further=[one for one in further if isinstance(one, AxisOffset)],
        )
        for topic, offset in offsets.items():
            self._publish(topic, encode(offset))
        self._missing += 1
        self._events.sequence += 1

    @property
    def unfinished(self) -> str:
        """After the end of the run, what of the recording is not on disk; empty if it is complete."""
        return self._journal.unfinished

    def stop(self) -> None:
        """End the run, after the poll that is under way; the recording is finished."""
        self._stop = True
        if self._sleep is not None:
            self._sleep.cancel()

    async def _close(self) -> None:
        self.stop()
        self._commands.close()
        await self._await_pending()
        await self._adoption.end()
        if self._loop is not None:
            await self._loop.end()
        probes, unread = self._commands.drain_probes()
        machine, sequence = self._config.machine.name, self._events.sequence
        undecided = [undecided_probe(machine, sequence, probe, ends=True) for probe in probes]
        unread = [replace_fields(probe, seq=sequence) for probe in unread]
        if unread or undecided:
            await self._journal.record(
                self._clock.utc_ns(),
                self._compensation.state(),
                opening=self._opening(),
                probes=[*unread, *undecided],
            )
        self._commands.refuse_waiting()
        await self._journal.close(self._compensation.state(), self._opening())
        await self._sampler.close()

    # ------------------------------------------------------------------ one sample

    async def _sample(self, label_ns: int) -> None:
        """Process a sample and publish it once it is on disk; polling continues if this takes long."""
        await self._await_pending()
        began = time.perf_counter()
        self._compensation = self._adoption.swap()
        if self._loop is not None:
            self._compensation = self._loop.before_sample(self._compensation)
        self._pass_pause(label_ns)  # for all models: those that are new stand before it, too
        state, opening, needs_file = self._compensation.frozen(), self._opening(), self._needs_file
        self._needs_file = True
        self._commands.apply(self._compensation)
        if self._loop is not None:
            self._loop.hand_over(self._compensation)
        raw = Sample(
            schema=SCHEMA,
            machine=self._config.machine.name,
            seq=self._events.sequence,
            time_utc_ns=label_ns,
            period_s=self._compensation.model.period_s,
            channels=self._sampler.close_sample(),
        )
        self._deciding, self._unread = self._commands.drain_probes()
        self._compensation.receive_probes(self._deciding)
        outcome = self._compensation.process(raw)
        self._needs_file, self._deciding = False, []
        if needs_file:  # once for all consecutive samples that failed
            self._journal.start_new_file()
        for note in outcome.notes:
            self._events.note(*note)
        candidates = self._loop.process(outcome) if self._loop is not None else ()
        expected = self._journal.expected
        self._note_state(expected(outcome.offset), [expected(one) for one in outcome.further])
        sample, estimate = encode(outcome.sample), encode(outcome.estimate)
        probes = [*(replace_fields(probe, seq=raw.seq) for probe in self._unread), *outcome.probes]
        self._unread = []
        entry = self._journal.enqueue(
            label_ns,
            state,
            sample=sample,
            estimate=estimate,
            candidates=[encode(candidate) for candidate in candidates],
            opening=opening,
            probes=probes,
            offset=outcome.offset,
            further=outcome.further,
        )
        decided = _Decided(outcome=outcome, entry=entry, began=began)
        if await self._journal.wait_briefly(entry):
            self._publish_sample(decided)
        else:
            self._pending = asyncio.create_task(self._publish_later(decided))

    async def _publish_later(self, decided: _Decided) -> None:
        await self._journal.wait_patiently(decided.entry)
        self._publish_sample(decided)

    async def _await_pending(self) -> None:
        """Wait until the previous sample is published, on disk or not."""
        pending, self._pending = self._pending, None
        if pending is not None:
            await pending

    def _publish_sample(self, decided: _Decided) -> None:
        """Publish a sample, the offset first.

        It is on record: a defect must publish nothing else with its number.
        """
        entry = decided.entry
        self._adoption.follow(decided.outcome)
        try:
            offsets = self._journal.resolve(entry)
            offset = offsets["offset"]
            further = tuple(one for one in offsets.values() if isinstance(one, AxisOffset) and one.axis != FIRST)
            self._note_state(offset, further)
            for topic, message in offsets.items():
                self._publish(topic, encode(message))
        except Exception as error:
            log.exception("internal error")
            self._events.sequence += 1
            self._fail(error)
            return
        self.latency_s.append(time.perf_counter() - decided.began)
        self._events.sequence += 1
        outcome = replace_fields(decided.outcome, offset=offset, further=further)
        self._unreported.append(outcome)
        try:
            self._publish("sample", entry.sample)
            self._publish("estimate", entry.estimate)
            self._publish("status", encode(self._status(outcome)))
            if self._loop is not None:
                self._loop.after_sample()
        except Exception:
            log.exception("internal error after the offset was published")

    def _opening(self) -> Mapping[str, bytes]:
        """Return what a recording begins with beside the state of the compensation."""
        return self._loop.opening() if self._loop is not None else {}

    def _pause(self, samples: int | None, missed: int | None) -> None:
        """Let time pass: for the models in shadow, and for the present one, which may have followed some samples."""
        self._compensation.pause(missed)
        if self._loop is not None:
            self._loop.pause(samples)

    def _pass_pause(self, label_ns: int) -> None:
        """Account for the time without measurements before a sample."""
        first, self._first = self._first, False
        missing, self._missing = self._missing, 0
        last_ns, period_s = self._compensation.status.time_utc_ns, self._compensation.model.period_s
        if last_ns == 0 or not (first or missing):
            return
        if not first:
            self._needs_file = True
            self._pause(missing, min(missing, self._events.sequence - self._compensation.status.seq - 1))
            self._note_pause(f"{missing} sample(s) are missing since the last one", missing)
        elif label_ns <= last_ns:
            self._pause(None, None)
            text = "the wall clock is before the end of the last recording: how long the service was away is unknown"
            self._note_pause(text, None)
        else:
            missing = max(round((label_ns - last_ns) / (period_s * NS)) - 1, 0)
            self._pause(missing, missing)
            self._note_pause(f"{missing} sample(s) are missing between the last recording and now", missing)

    def _note_pause(self, text: str, missing: int | None) -> None:
        """Note a pause, whose length is unknown if `missing` is None."""
        std, bridged = self._compensation.status.std_um, self._compensation.bridge_max_min
        minutes = None if missing is None else missing * self._compensation.model.period_s / 60.0
        is_bridged = minutes is not None and minutes <= bridged
        if is_bridged:
            text += f"; {minutes:.0f} min are bridged"
        elif minutes is not None:
            longest = f"(restart.bridge_max_min, here {bridged:.0f} min)"
            text += f"; {minutes / 60.0:.1f} h cannot be bridged {longest}"
        data = PauseData(missing=missing, minutes=minutes, bridged=is_bridged, y_std_um=std)
        self._events.note(EventKind.RESTART, text, data.table())

    def _status(self, outcome: Outcome) -> Status:
        model = self._compensation.model
        status = Status(
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
            recording=self._writer.file,
            devices=self._sampler.device_states(),
            effects=[effect.label for effect in model.effects],
        )
        if outcome.further:
            axes = {one.axis: AxisState(state=one.state, reasons=one.reasons) for one in outcome.further}
            axes[FIRST] = AxisState(state=outcome.offset.state, reasons=outcome.offset.reasons)
            status = AxesStatus(**asdict(status), axes={name: axes[name] for name in self._compensation.outputs.names})
        loop = self._loop.status() if self._loop is not None else None
        if loop is not None:
            status = replace_fields(status, loop=loop)
        until_ns = self._compensation.predicts_until_ns
        if until_ns is not None:
            status = replace_fields(status, predicts_until_utc_ns=until_ns)
        wanted = self._compensation.wanted
        if wanted is None:
            return status
        return replace_fields(
            status,
            probe_wanted=wanted.is_wanted,
            wanted_by_ns=wanted.by_ns,
            wanted_why=wanted.why,
            wanted_std_um=wanted.std_um,
            wanted_tolerance_um=wanted.tolerance_um,
        )

    # ------------------------------------------------------------------ events and commands

    def _note_state(self, offset: Offset, further: Sequence[AxisOffset] = ()) -> None:
        """Note a change of the state; other axes are named where theirs is not that of Y."""
        own = " ".join([offset.state, *offset.reasons])
        others = {one.axis: " ".join([one.state, *one.reasons]) for one in further}
        now = "; ".join([own, *(f"{label_of(axis)} {text}" for axis, text in others.items() if text != own)])
        if now != self._last_state:
            data: dict[str, Any] = {"state": offset.state, "reasons": offset.reasons}
            if further:
                data["axes"] = {one.axis: {"state": one.state, "reasons": one.reasons} for one in further}
            self._events.note(EventKind.STATE, now, data)
            self._last_state = now

    def command(self, name: str, payload: bytes, sender: Sender = UNNAMED) -> Reply:
        """Accept a command from another thread; it acts at the next sample.

        Parameters
        ----------
        name : str
            `zero`, `hold`, `resume`, `adopt`, `back`, `dismiss` or `probe`.
        payload : bytes
            Empty or a JSON object. `zero` has `mode`: `auto`, `rest` or `warm`; `adopt` has `model`, the text of a
            model file, or `sha256`, that of one adopted before, or both, or `candidate`, true for the candidate of the
            loop, with `sha256` for the one of these first digits, as `dismiss` has; `adopt` and `back` have `force`.
            That of `probe` is a `ProbeRequest`.
        sender : Sender
            Sender; recorded in the event.

        Returns
        -------
        dict or Future of dict
            `ok` and `text`; a future of them for `adopt` and `back`, whose warm-up takes time, and for `probe`, which
            the event loop checks at once (with `code`).
        """
        return self._commands.receive(name, payload, sender)
