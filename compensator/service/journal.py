"""What is said and kept of each sample: events that wait for the disk, the recording, and whether it is taken."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any, NamedTuple

from compensator.clock import Clock
from compensator.messages import SCHEMA, Event, Offset, degraded, encode
from compensator.reasons import Remark
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.recording_thread import FAILED, WAITING_EVENTS, Group, RecordingThread

log = logging.getLogger("compensator")

#: How it is said that the disk refuses the recording, takes it too late, and takes it again.
DISK_FAILED = "the disk does not take the recording"
DISK_LATE = "the disk takes the recording too late"
DISK_BACK = "the disk takes the recording again"
#: How often it is said that the service waits for the disk at its end, s.
CLOSING_S = 10.0


class Entry(NamedTuple):
    """What is on its way to the disk, and the attempt to bring it there."""

    group: Group
    attempt: asyncio.Future[None]


class Journal:
    """Brings records and events to disk and says when the disk does not take them.

    Parameters
    ----------
    machine : str
        Name of the machine.
    recorder : Recorder
        Where every sample goes first.
    publish : callable
        Takes a message's name and its JSON; never waits.
    clock : Clock
        For the time of events.
    sequence : int
        Number of the first sample.
    limit_s : float
        So long the loop stands still for the disk, s.
    patience_s : float
        So long an offset waits for the disk while polling goes on, s; not where the disk was late before.
    early : OffsetCheckpoint, optional
        Where an offset is noted that is published before it is on disk.
    """

    def __init__(
        self,
        *,
        machine: str,
        recorder: Any,
        publish: Callable[[str, bytes], None],
        clock: Clock,
        sequence: int,
        limit_s: float,
        patience_s: float,
        early: OffsetCheckpoint | None = None,
    ) -> None:
        self._machine = machine
        self._recorder = recorder
        self._publish = publish
        self._clock = clock
        self._limit_s = limit_s
        self._patience_s = patience_s
        self._early = early
        self._thread = RecordingThread(recorder)
        self._events: list[Event] = []
        #: What the next sample brings along: whether it opens a file, and another model.
        self._new_file, self._model = False, None  # type: tuple[bool, bytes | None]
        #: With which reason the last offset was published, and the last error of the disk.
        self._reason, self._error = "", None  # type: tuple[str, BaseException | None]
        #: Number of the sample under way; events carry it.
        self.sequence = sequence

    @property
    def file(self) -> str:
        """Name of the recording, empty where there is none."""
        return self._recorder.path.name if self._recorder.path else ""

    def note(self, kind: str, text: str, data: dict[str, Any] | None = None) -> None:
        """Keep an event for the recording and publish it."""
        event = Event(
            schema=SCHEMA,
            machine=self._machine,
            seq=self.sequence,
            time_utc_ns=self._clock.utc_ns(),
            kind=kind,
            text=text,
            data=data or {},
        )
        # Bounded, so that a loop that cannot record costs no memory.
        self._events = [*self._events[1 - WAITING_EVENTS :], event]
        self._publish("event", encode(event))

    def put(
        self,
        time_utc_ns: int,
        state: bytes,
        *,
        sample: bytes = b"",
        estimate: bytes = b"",
        offset: Offset | None = None,
    ) -> Entry:
        """Have a sample and the waiting events brought to disk.

        Parameters
        ----------
        time_utc_ns : int
            Time of the sample, ns since 1970 UTC.
        state : bytes
            State of the compensation before it.
        sample, estimate : bytes
            JSON; empty where there is none.
        offset : Offset, optional
            What the compensation decided.
        """
        group = Group(
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
        attempt = asyncio.wrap_future(self._thread.put(group))
        attempt.add_done_callback(lambda done: done.cancelled() or done.exception())  # seen, also when it ends later
        return Entry(group, attempt)

    async def tried(self, entry: Entry) -> bool:
        """Stand still for the disk, and not long; tell whether more waiting would be of no use."""
        await self._clock.settle([entry.attempt], self._limit_s)
        return entry.attempt.done() or bool(self._reason)

    async def waited(self, entry: Entry) -> None:
        """Wait on while others work."""
        await self._clock.settle([entry.attempt], self._patience_s)

    def settled(self, entry: Entry) -> Offset | None:
        """Return the offset as it is to be published now.

        Where the disk has not taken it, or refused, the offset says so; the sample waits and is written in its order.
        """
        reason, in_flight = self._thread.published(entry.group)
        self._tell_disk(reason, in_flight, entry.attempt.exception() if entry.attempt.done() else None)
        for text, data in self._recorder.remarks():
            self.note("recording", text, data)
        offset = entry.group.offset
        if self._early is not None and not reason:
            self._early.forget()
        elif self._early is not None and offset is not None:
            self._early.keep(offset)
        return degraded(offset, reason) if offset is not None and reason else offset

    async def record(self, time_utc_ns: int, state: bytes, *, offset: Offset | None = None) -> Offset | None:
        """Bring an offset without a sample, and the waiting events, to disk; return it as it is to be published."""
        entry = self.put(time_utc_ns, state, offset=offset)
        await self.tried(entry)
        return self.settled(entry)

    def expected(self, offset: Offset) -> Offset:
        """Return the offset as it is published if the disk does as it did with the sample before."""
        return degraded(offset, self._reason) if self._reason else offset

    def _tell_disk(self, reason: str, in_flight: bool, error: BaseException | None) -> None:
        """Note once when the disk does not take the recording, and once when it does again."""
        data = {"published_early": self.sequence, "reason": reason} if in_flight else {}
        if reason and (reason != self._reason or in_flight):
            if error is not None and not isinstance(error, OSError):
                log.error("internal error", exc_info=error)
                self.note("recording", f"{DISK_FAILED}: internal error: {type(error).__name__}: {error}", data)
            elif reason == FAILED:
                self.note("recording", f"{DISK_FAILED}: {error or self._error}", data)
            else:
                self.note("recording", f"{DISK_LATE}: not within {self._limit_s + self._patience_s:g} s", data)
        elif self._reason and not reason:
            lost, self._thread.lost = self._thread.lost, 0
            text = f"{DISK_BACK}; " + (f"{lost} sample(s) were not recorded" if lost else "nothing was lost")
            self.note("recording", text, {"lost": lost})
        self._reason, self._error = reason, error or self._error

    def start_new_file(self, model: bytes | None = None) -> None:
        """Let the next sample open a file of its own; with another model where one is given."""
        self._new_file = True
        self._model = model if model is not None else self._model

    async def close(self, state: bytes) -> None:
        """Say that the service ends, and finish the recording, however long the disk takes."""
        self.note("stop", "the service ends")
        await self.record(self._clock.utc_ns(), state)
        closing = asyncio.wrap_future(self._thread.close())
        while not (await asyncio.wait([closing], timeout=CLOSING_S))[0]:
            figures = f"The recording is being finished: the disk has not taken it for {CLOSING_S:g} s."
            log.warning("%s", Remark("disk_finishing", figures).marked)
        if self._thread.waiting:
            log.error("%d sample(s) are not on disk, which did not take them", self._thread.waiting)
        error = closing.exception()
        if isinstance(error, OSError):
            self.note("recording", f"the recording could not be finished: {error}")
        elif error is not None:
            raise error
