"""The way of a sample to disk: samples and events in their order, written by a thread of their own.

A slow disk delays neither polling nor commands. What waits is written together, with one sync, so that a slow disk
catches up; what a disk refuses waits and is written once the disk accepts it. An offset that cannot wait any longer is
published with the reason `recording_late` or `recording_failed`.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from compensator.clock import Clock
from compensator.codes import Reason, Remark, ServiceWarning
from compensator.events import EventKind, RecordingCode, RecordingData
from compensator.messages import SCHEMA, Event, Offset, degraded, encode
from compensator.recording.naming import day_of
from compensator.service.offset_checkpoint import OffsetCheckpoint

log = logging.getLogger("compensator")

#: Largest number of samples that wait for the disk (four hours at one a minute), so that a lost disk costs no memory;
#: then the oldest are dropped.
WAITING_SAMPLES = 240
#: Largest number of events that wait with them; the newest are kept.
WAITING_EVENTS = 1000
#: Texts of the events when the disk refuses the recording, accepts it too late, and accepts it again.
DISK_FAILED = "the disk does not accept the recording"
DISK_LATE = "the disk accepts the recording too late"
DISK_BACK = "the disk accepts the recording again"
#: How often the log warns that the service waits for the disk at its end, s.
CLOSING_S = 10.0


class Recorder(Protocol):
    """What the journal needs of a recording; used on the journal's thread, except `path` and `remarks`."""

    @property
    def path(self) -> Path | None:
        """The file that is being written."""

    def write(
        self, records: Iterable[tuple[str, bytes]], time_utc_ns: int, *, state: bytes = b"", sync: bool = True
    ) -> None:
        """Write records, and bring them to disk unless `sync` is false."""

    def start_new(self, attachments: Mapping[str, bytes] | None = None) -> None:
        """Finish the file; the next write opens a new one, with attachments that replace those of the same name."""

    def remarks(self) -> list[tuple[str, dict[str, Any]]]:
        """Return text and data of events about finished files."""

    def close(self) -> None:
        """Finish the file."""


@dataclass(slots=True, eq=False, kw_only=True)
class Entry:
    """A sample on its way to the disk, with everything that is written together with it.

    Parameters
    ----------
    time_utc_ns : int
        Its time, ns since 1970 UTC.
    state : bytes
        State of the compensation before it.
    events : list of Event
        Events since the previous sample.
    sample, estimate : bytes
        JSON; empty if there is none.
    offset : Offset, optional
        As decided.
    new_file : bool
        Whether it must open a new file.
    model : bytes, optional
        Model file that is attached to recordings from here on.
    """

    time_utc_ns: int
    state: bytes
    events: list[Event] = field(default_factory=list)
    sample: bytes = b""
    estimate: bytes = b""
    offset: Offset | None = None
    new_file: bool = False
    model: bytes | None = None
    #: Reason with which the offset was published before it was on disk, empty otherwise.
    reason: str = ""
    on_disk: bool = False
    #: The attempt to bring it to disk.
    attempt: asyncio.Future[None] = field(init=False)

    def records(self) -> list[tuple[str, bytes]]:
        """Return topic and JSON of everything; the offset as it was published if it was already."""
        records = [("event", encode(event)) for event in self.events]
        records += [(topic, data) for topic, data in (("sample", self.sample), ("estimate", self.estimate)) if data]
        if self.offset is not None:
            records.append(("offset", encode(degraded(self.offset, self.reason) if self.reason else self.offset)))
        return records

    @property
    def day(self) -> str:
        """Its day, UTC; a file holds one."""
        return day_of(self.time_utc_ns)

    def inherit(self, dropped: Entry) -> None:
        """Keep what must not be lost with a sample that is dropped."""
        self.events = [*dropped.events, *self.events][-WAITING_EVENTS:]
        self.model = self.model if self.model is not None else dropped.model
        self.new_file = True


class Journal:
    """Brings samples and events to disk and reports when the disk does not accept them.

    Parameters
    ----------
    machine : str
        Name of the machine.
    recorder : Recorder
        Writes them.
    publish : callable
        Publishes a message by name and JSON; never waits.
    clock : Clock
        For the time of events.
    sequence : int
        Number of the first sample.
    limit_s : float
        So long the loop blocks for the disk, s.
    patience_s : float
        So long an offset waits for the disk while polling continues, s; not if the previous one was late already.
    checkpoint : OffsetCheckpoint, optional
        Keeps an offset that is published before it is on disk.
    """

    def __init__(
        self,
        *,
        machine: str,
        recorder: Recorder,
        publish: Callable[[str, bytes], None],
        clock: Clock,
        sequence: int,
        limit_s: float,
        patience_s: float,
        checkpoint: OffsetCheckpoint | None = None,
    ) -> None:
        self._machine = machine
        self._recorder = recorder
        self._publish = publish
        self._clock = clock
        self._limit_s = limit_s
        self._patience_s = patience_s
        self._checkpoint = checkpoint
        self._events: list[Event] = []
        #: What the next sample carries: whether it opens a file, and another model.
        self._new_file, self._model = False, None  # type: tuple[bool, bytes | None]
        #: Reason with which the last offset was published, and the last error of the disk.
        self._reason, self._error = "", None  # type: tuple[str, BaseException | None]
        #: Number of the current sample; events carry it.
        self.sequence = sequence
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="recording")
        self._lock = threading.Lock()  # for what follows, which both threads use
        self._waiting: deque[Entry] = deque()
        self._writing: list[Entry] = []
        self._failed = False
        self._attempt: Future[None] | None = None
        self._dropped = 0

    @property
    def file(self) -> str:
        """Name of the recording, empty if there is none."""
        return self._recorder.path.name if self._recorder.path else ""

    @property
    def waiting(self) -> int:
        """Number of samples that are not on disk."""
        with self._lock:
            return sum(bool(entry.sample) for entry in (*self._waiting, *self._writing))

    # ------------------------------------------------------------------ on the loop

    def note(self, kind: EventKind, text: str, data: Mapping[str, Any] | None = None) -> None:
        """Publish an event and keep it for the recording."""
        event = Event(
            schema=SCHEMA,
            machine=self._machine,
            seq=self.sequence,
            time_utc_ns=self._clock.utc_ns(),
            kind=kind,
            text=text,
            data=dict(data or {}),
        )
        # Bounded, so that a loop that cannot record costs no memory.
        self._events = [*self._events[1 - WAITING_EVENTS :], event]
        self._publish("event", encode(event))

    def start_new_file(self, model: bytes | None = None) -> None:
        """Let the next sample open a new file; with another model if one is given."""
        self._new_file = True
        self._model = model if model is not None else self._model

    def enqueue(
        self,
        time_utc_ns: int,
        state: bytes,
        *,
        sample: bytes = b"",
        estimate: bytes = b"",
        offset: Offset | None = None,
    ) -> Entry:
        """Enqueue a sample and the pending events to be written after everything that waits.

        Parameters
        ----------
        time_utc_ns : int
            Time of the sample, ns since 1970 UTC.
        state : bytes
            State of the compensation before it.
        sample, estimate : bytes
            JSON; empty if there is none.
        offset : Offset, optional
            As decided.
        """
        entry = Entry(
            time_utc_ns=time_utc_ns,
            state=state,
            events=self._events,
            sample=sample,
            estimate=estimate,
            offset=offset,
            new_file=self._new_file,
            model=self._model,
        )
        self._events, self._new_file, self._model = [], False, None
        with self._lock:
            self._waiting.append(entry)
            if len(self._waiting) > WAITING_SAMPLES:
                dropped = self._waiting.popleft()
                self._waiting[0].inherit(dropped)
                self._dropped += bool(dropped.sample)
            # An attempt that has not started yet writes everything that waits by then.
            if self._attempt is None or self._attempt.running() or self._attempt.done():
                self._attempt = self._executor.submit(self._write_waiting)
            attempt = self._attempt
        entry.attempt = asyncio.wrap_future(attempt)
        # Retrieve the error, also when the attempt ends later.
        entry.attempt.add_done_callback(lambda done: done.cancelled() or done.exception())
        return entry

    async def wait_briefly(self, entry: Entry) -> bool:
        """Block for the disk; return whether longer waiting would be useless."""
        await self._clock.settle([entry.attempt], self._limit_s)
        return entry.attempt.done() or bool(self._reason)

    async def wait_patiently(self, entry: Entry) -> None:
        """Wait longer while polling continues."""
        await self._clock.settle([entry.attempt], self._patience_s)

    def resolve(self, entry: Entry) -> Offset | None:
        """Return the offset to be published now.

        If the disk has not accepted it yet, or refused it, the offset carries the reason; the sample waits and is
        written in its order.
        """
        with self._lock:
            if not entry.on_disk:
                entry.reason = Reason.RECORDING_FAILED if self._failed else Reason.RECORDING_LATE
            # While it is being written, the disk may get the offset without the reason.
            in_flight = bool(entry.reason) and entry in self._writing
        self._note_disk(entry.reason, in_flight, entry.attempt.exception() if entry.attempt.done() else None)
        for text, data in self._recorder.remarks():
            self.note(EventKind.RECORDING, text, data)
        if self._checkpoint is not None and not entry.reason:
            self._checkpoint.remove()
        elif self._checkpoint is not None and entry.offset is not None:
            self._checkpoint.write(entry.offset)
        return degraded(entry.offset, entry.reason) if entry.offset is not None and entry.reason else entry.offset

    async def record(self, time_utc_ns: int, state: bytes, *, offset: Offset | None = None) -> Offset | None:
        """Bring the waiting events, and an offset without a sample, to disk; return the offset to be published."""
        entry = self.enqueue(time_utc_ns, state, offset=offset)
        await self.wait_briefly(entry)
        return self.resolve(entry)

    def expected(self, offset: Offset) -> Offset:
        """Return the offset as it will be published if the disk does as it did with the previous sample."""
        return degraded(offset, self._reason) if self._reason else offset

    def _note_disk(self, reason: str, in_flight: bool, error: BaseException | None) -> None:
        """Note once when the disk stops accepting the recording, and once when it accepts it again."""
        early = {"published_early": self.sequence, "reason": reason} if in_flight else {}
        code = RecordingCode.DISK_LATE if reason == Reason.RECORDING_LATE else RecordingCode.DISK_FAILED
        data = {"code": code, **early}
        if reason and (reason != self._reason or in_flight):
            if error is not None and not isinstance(error, OSError):
                log.error("internal error", exc_info=error)
                self.note(EventKind.RECORDING, f"{DISK_FAILED}: internal error: {type(error).__name__}: {error}", data)
            elif reason == Reason.RECORDING_FAILED:
                self.note(EventKind.RECORDING, f"{DISK_FAILED}: {error or self._error}", data)
            else:
                self.note(EventKind.RECORDING, f"{DISK_LATE}: not within {self._limit_s + self._patience_s:g} s", data)
        elif self._reason and not reason:
            lost, self._dropped = self._dropped, 0
            text = f"{DISK_BACK}; " + (f"{lost} sample(s) were not recorded" if lost else "nothing was lost")
            self.note(EventKind.RECORDING, text, RecordingData(code=RecordingCode.DISK_BACK, lost=lost).table())
        self._reason, self._error = reason, error or self._error

    async def close(self, state: bytes) -> None:
        """Note that the service ends, and finish the recording, however long the disk takes."""
        self.note(EventKind.STOP, "the service ends")
        await self.record(self._clock.utc_ns(), state)
        closing = asyncio.wrap_future(self._executor.submit(self._finish))
        self._executor.shutdown(wait=False)
        while not (await asyncio.wait([closing], timeout=CLOSING_S))[0]:
            figures = f"The disk has not accepted the rest of the recording for {CLOSING_S:g} s."
            log.warning("%s", Remark(ServiceWarning.DISK_FINISHING, figures).marked)
        if self.waiting:
            log.error("%d sample(s) are not on disk, which refused them", self.waiting)
        error = closing.exception()
        if isinstance(error, OSError):
            data = RecordingData(code=RecordingCode.NOT_FINISHED)
            self.note(EventKind.RECORDING, f"the recording could not be finished: {error}", data.table())
        elif error is not None:
            raise error

    # ------------------------------------------------------------------ on the writing thread

    def _finish(self) -> None:
        try:
            self._write_waiting()
        finally:
            self._recorder.close()

    def _write_waiting(self) -> None:
        while batch := self._next_batch():
            written = False
            try:
                self._write(batch)
                written = True
            finally:
                with self._lock:
                    if written:
                        for entry in batch:
                            entry.on_disk = True
                    else:
                        self._waiting.extendleft(reversed(batch))
                    self._failed, self._writing = not written, []

    def _next_batch(self) -> list[Entry]:
        """Return the entries that come next into one file."""
        with self._lock:
            while self._waiting:
                entry = self._waiting[0]
                if self._writing and (entry.new_file or entry.day != self._writing[0].day):
                    break
                self._writing.append(self._waiting.popleft())
            return self._writing

    def _write(self, batch: list[Entry]) -> None:
        first = batch[0]
        if first.new_file:
            self._recorder.start_new(None if first.model is None else {"model.toml": first.model})
        for entry in batch:
            self._recorder.write(entry.records(), entry.time_utc_ns, state=entry.state, sync=entry is batch[-1])
