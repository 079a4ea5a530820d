"""The thread that writes the recording, so that a slow disk holds neither polling nor commands up.

Samples wait in their order. What waits is written together, with one sync, so that a slow disk catches up. What a
disk refuses goes on waiting and is written once it takes it.
"""

from __future__ import annotations

import threading
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from compensator.clock import NS
from compensator.messages import Event, Offset, degraded, encode

#: So many samples wait for the disk at most (four hours at one a minute), so that a disk that is gone for long costs
#: no memory; then the oldest are given up.
WAITING_SAMPLES = 240
#: So many events wait with them; the newest are kept.
WAITING_EVENTS = 1000

LATE, FAILED = "recording_late", "recording_failed"


@dataclass(slots=True, eq=False)
class Group:
    """What belongs to one sample and comes to disk together.

    Parameters
    ----------
    time_utc_ns : int
        Its time, ns since 1970 UTC.
    state : bytes
        State of the compensation before it.
    events : list of Event
        What happened since the sample before.
    sample, estimate : bytes
        JSON; empty where there is none.
    offset : Offset, optional
        What the compensation decided.
    new_file : bool
        Whether it must open a file of its own.
    model : bytes, optional
        Model file that travels from here on.
    """

    time_utc_ns: int
    state: bytes
    events: list[Event] = field(default_factory=list)
    sample: bytes = b""
    estimate: bytes = b""
    offset: Offset | None = None
    new_file: bool = False
    model: bytes | None = None
    #: Reason with which the offset was published before it was on disk, empty where it was not.
    reason: str = ""
    on_disk: bool = False

    def records(self) -> list[tuple[str, bytes]]:
        """Return topic and JSON of everything; the offset as it was published, where it was already."""
        records = [("event", encode(event)) for event in self.events]
        records += [(topic, data) for topic, data in (("sample", self.sample), ("estimate", self.estimate)) if data]
        if self.offset is not None:
            records.append(("offset", encode(degraded(self.offset, self.reason) if self.reason else self.offset)))
        return records

    @property
    def day(self) -> str:
        """Its day, UTC; a file holds one."""
        return datetime.fromtimestamp(self.time_utc_ns / NS, UTC).strftime("%Y%m%d")

    def succeed(self, lost: Group) -> None:
        """Take over what must not go with a sample that is given up."""
        self.events = [*lost.events, *self.events][-WAITING_EVENTS:]
        self.model = self.model if self.model is not None else lost.model
        self.new_file = True


class RecordingThread:
    """Writes groups in their order.

    Parameters
    ----------
    recorder : Recorder
        Used on the thread only.
    """

    def __init__(self, recorder: Any) -> None:
        self._recorder = recorder
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="recording")
        self._lock = threading.Lock()
        self._waiting: deque[Group] = deque()
        self._writing: list[Group] = []
        self._last: Future[None] | None = None
        self._failed = False
        #: Number of samples that were given up.
        self.lost = 0

    def put(self, group: Group) -> Future[None]:
        """Have a group written after those that wait; the future ends with the attempt, or with its error."""
        with self._lock:
            self._waiting.append(group)
            if len(self._waiting) > WAITING_SAMPLES:
                lost = self._waiting.popleft()
                self._waiting[0].succeed(lost)
                self.lost += bool(lost.sample)
            # One attempt that waits for its turn takes everything that came until then.
            if self._last is None or self._last.running() or self._last.done():
                self._last = self._thread.submit(self._write_waiting)
            return self._last

    def published(self, group: Group) -> tuple[str, bool]:
        """Settle with which reason the offset of a group is published now.

        Returns
        -------
        str
            Empty where the group is on disk, else the reason.
        bool
            Whether the disk may get the offset without the reason, because it is being written.
        """
        with self._lock:
            if not group.on_disk:
                group.reason = FAILED if self._failed else LATE
            return group.reason, bool(group.reason) and group in self._writing

    @property
    def waiting(self) -> int:
        """Number of samples that are not on disk."""
        with self._lock:
            return sum(bool(group.sample) for group in (*self._waiting, *self._writing))

    def close(self) -> Future[None]:
        """Finish the recording after everything that waits; nothing may be put afterwards."""
        future = self._thread.submit(self._finish)
        self._thread.shutdown(wait=False)
        return future

    def _finish(self) -> None:
        try:
            self._write_waiting()
        finally:
            self._recorder.close()

    def _write_waiting(self) -> None:
        while self._take():
            whole = False
            try:
                self._write(self._writing)
                whole = True
            finally:
                with self._lock:
                    if whole:
                        for group in self._writing:
                            group.on_disk = True
                    else:
                        self._waiting.extendleft(reversed(self._writing))
                    self._failed, self._writing = not whole, []

    def _take(self) -> bool:
        """Take the groups that come into the same file."""
        with self._lock:
            while self._waiting:
                group = self._waiting[0]
                if self._writing and (group.new_file or group.day != self._writing[0].day):
                    break
                self._writing.append(self._waiting.popleft())
            return bool(self._writing)

    def _write(self, groups: list[Group]) -> None:
        first = groups[0]
        if first.model is not None:
            self._recorder.attachments = {**self._recorder.attachments, "model.toml": first.model}
        if first.new_file:
            self._recorder.start_new()
        for group in groups:
            self._recorder.write(group.records(), group.time_utc_ns, state=group.state, sync=group is groups[-1])
