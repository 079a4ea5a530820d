"""Writes samples to disk in order, on a separate thread.

A slow disk delays neither polling nor commands. All queued samples are written together, with one sync, so that a slow
disk catches up. After a write error the samples stay queued and are written once the disk accepts them.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from compensator.codes import Reason
from compensator.messages import Event, Offset, degraded, encode
from compensator.messages_axes import AxisOffset, recorded_offsets, topic_of
from compensator.recording.naming import day_of
from compensator.service.event_log import WAITING_EVENTS

#: Largest number of queued samples (four hours at one per minute), which bounds the memory if the disk fails; beyond
#: that the oldest are dropped.
WAITING_SAMPLES = 240


#: A state, or what encodes it where it is needed.
Saved = bytes | Callable[[], bytes]


class Recorder(Protocol):
    """Interface of a recording for the writer; used on its thread, except `path` and `remarks`."""

    @property
    def path(self) -> Path | None:
        """The file that is being written."""

    def write(
        self,
        records: Iterable[tuple[str, bytes]],
        time_utc_ns: int,
        *,
        state: Saved = b"",
        opening: Mapping[str, bytes] | None = None,
        sync: bool = True,
    ) -> None:
        """Write records, and sync them to disk unless `sync` is false."""

    def start_new(self, attachments: Mapping[str, bytes] | None = None) -> None:
        """Finish the file; the next write opens a new one, with attachments that replace those of the same name."""

    def remarks(self) -> list[tuple[str, dict[str, Any]]]:
        """Return text and data of events about finished files."""

    def close(self) -> None:
        """Finish the file."""


@dataclass(slots=True, eq=False, kw_only=True)
class Entry:
    """A sample to be written to disk, with everything that is written together with it.

    Parameters
    ----------
    time_utc_ns : int
        Its time, ns since 1970 UTC.
    state : bytes or callable
        State of the compensation before it, or what encodes it.
    events : list of Event
        Events since the previous sample.
    sample, estimate : bytes
        JSON; empty if there is none.
    candidates : sequence of bytes
        JSON of the models in shadow.
    opening : mapping of str to bytes
        What is attached beside the state if it opens a file.
    probes : list of bytes
        JSON of the probes that were decided with the sample.
    offset : Offset, optional
        The offset as decided, that of Y.
    further : sequence of AxisOffset
        Those of further axes, which belong to it.
    new_file : bool
        Whether it must open a new file.
    model : bytes, optional
        Model file that is attached to recordings from this sample on.
    """

    time_utc_ns: int
    state: Saved
    events: list[Event] = field(default_factory=list)
    sample: bytes = b""
    estimate: bytes = b""
    candidates: Sequence[bytes] = ()
    opening: Mapping[str, bytes] = field(default_factory=dict)
    probes: list[bytes] = field(default_factory=list)
    offset: Offset | None = None
    further: Sequence[AxisOffset] = ()
    new_file: bool = False
    model: bytes | None = None
    #: Reason with which the offset was published before it was on disk, empty otherwise.
    reason: str = ""
    on_disk: bool = False
    #: The attempt to write it.
    attempt: asyncio.Future[None] = field(init=False)

    def records(self) -> list[tuple[str, bytes]]:
        """Return topic and JSON of all records; the offset as published, if it was published already."""
        records = [("event", encode(event)) for event in self.events]
        records += [("probe", data) for data in self.probes]
        parts = [("sample", self.sample), ("estimate", self.estimate)]
        parts += [("candidate", data) for data in self.candidates]
        records += [(topic, data) for topic, data in parts if data]
        published = self.offsets()
        if self.further:
            further = recorded_offsets(one for one in published.values() if isinstance(one, AxisOffset))
            records.append(("offsets", encode(further)))
        if "offset" in published:
            records.append(("offset", encode(published["offset"])))
        return records

    def offsets(self) -> dict[str, Offset]:
        """Return the offset of each axis as published, by the name under which it is; that of Y is the last."""
        found: dict[str, Offset] = {topic_of(one.axis): one for one in self.further}
        if self.offset is not None:
            found["offset"] = self.offset
        return {name: degraded(offset, self.reason) if self.reason else offset for name, offset in found.items()}

    @property
    def day(self) -> str:
        """Day of the sample, UTC; a file contains one day."""
        return day_of(self.time_utc_ns)

    def inherit(self, dropped: Entry) -> None:
        """Take over from a dropped sample what must not be lost."""
        self.events = [*dropped.events, *self.events][-WAITING_EVENTS:]
        self.probes = [*dropped.probes, *self.probes][-WAITING_EVENTS:]
        self.model = self.model if self.model is not None else dropped.model
        self.new_file = True


class DiskWriter:
    """Writes entries with a recorder."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="recording")
        self._lock = threading.Lock()  # protects the following attributes, which both threads use
        self._waiting: deque[Entry] = deque()
        self._writing: list[Entry] = []
        self._failed = False
        self._attempt: Future[None] | None = None
        self._dropped = 0

    # ------------------------------------------------------------------ on the event loop

    @property
    def file(self) -> str:
        """Name of the recording; empty if there is none."""
        return self._recorder.path.name if self._recorder.path else ""

    @property
    def waiting(self) -> int:
        """Number of samples that are not on disk."""
        with self._lock:
            return sum(bool(entry.sample) for entry in (*self._waiting, *self._writing))

    def remarks(self) -> list[tuple[str, dict[str, Any]]]:
        """Return text and data of events about finished files."""
        return self._recorder.remarks()

    def enqueue(self, entry: Entry) -> None:
        """Append an entry to the queue."""
        with self._lock:
            self._waiting.append(entry)
            if len(self._waiting) > WAITING_SAMPLES:
                dropped = self._waiting.popleft()
                self._waiting[0].inherit(dropped)
                self._dropped += bool(dropped.sample)
            # An attempt that has not started yet writes everything that is queued by then.
            if self._attempt is None or self._attempt.running() or self._attempt.done():
                self._attempt = self._executor.submit(self._write_waiting)
            attempt = self._attempt
        entry.attempt = asyncio.wrap_future(attempt)
        # Retrieve the error even if the attempt ends later.
        entry.attempt.add_done_callback(lambda done: done.cancelled() or done.exception())

    def release(self, entry: Entry) -> bool:
        """Set the reason with which the offset of an entry is published now, if the entry is not on disk.

        Returns
        -------
        bool
            Whether the entry is already being written without that reason.
        """
        with self._lock:
            if not entry.on_disk:
                entry.reason = Reason.RECORDING_FAILED if self._failed else Reason.RECORDING_LATE
            return bool(entry.reason) and entry in self._writing

    def count_dropped(self) -> int:
        """Return the number of samples that were dropped since the last call."""
        dropped, self._dropped = self._dropped, 0
        return dropped

    def close(self) -> asyncio.Future[None]:
        """Write the queue and finish the recording; the future then completes, with the error if writing failed."""
        closing = asyncio.wrap_future(self._executor.submit(self._finish))
        self._executor.shutdown(wait=False)
        return closing

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
        """Return the next entries that belong into one file."""
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
            self._recorder.write(
                entry.records(), entry.time_utc_ns, state=entry.state, opening=entry.opening, sync=entry is batch[-1]
            )
