"""What is said and kept of each sample: events that wait for the disk, the recording, and whether it is taken."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from compensator.clock import Clock
from compensator.messages import SCHEMA, Event, Offset, encode

#: So many events wait for the disk at most, so that a disk that is gone for long costs no memory; the newest are kept.
WAITING_EVENTS = 1000


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
    """

    def __init__(
        self, *, machine: str, recorder: Any, publish: Callable[[str, bytes], None], clock: Clock, sequence: int
    ) -> None:
        self._machine = machine
        self._recorder = recorder
        self._publish = publish
        self._clock = clock
        self._events: list[Event] = []
        self._failed = False
        #: Number of the sample under way; events carry it.
        self.sequence = sequence

    @property
    def file(self) -> str:
        """Name of the recording, empty where there is none."""
        return self._recorder.path.name if self._recorder.path else ""

    def note(self, kind: str, text: str, data: dict[str, Any] | None = None) -> None:
        """Keep an event for the recording and publish it."""
        event = Event(
            schema=SCHEMA, machine=self._machine, seq=self.sequence, time_utc_ns=self._clock.utc_ns(), kind=kind,
            text=text, data=data or {},
        )  # fmt: skip
        self._events = [*self._events[1 - WAITING_EVENTS :], event]
        self._publish("event", encode(event))

    def record(self, records: list[tuple[str, bytes]], time_utc_ns: int, state: bytes) -> bool:
        """Bring records and waiting events to disk; tell whether it worked.

        Parameters
        ----------
        records : list of (str, bytes)
            Topic and JSON.
        time_utc_ns : int
            Time of the records, ns since 1970 UTC.
        state : bytes
            State of the compensation before the sample among the records.
        """
        events = [("event", encode(event)) for event in self._events]
        try:
            self._recorder.write([*events, *records], time_utc_ns, state=state)
        except OSError as error:
            if not self._failed:
                self._failed = True
                self.note("recording", f"the disk does not take the recording: {error}")
            return False
        if self._failed:
            self._failed = False
            self.note("recording", "the disk takes the recording again")
        self._events = self._events[len(events) :]
        for text, data in self._recorder.remarks():
            self.note("recording", text, data)
        return True

    def marked(self, offset: Offset) -> Offset:
        """Return the offset with what the receiver must know of the disk."""
        if not self._failed or "recording_failed" in offset.reasons:
            return offset
        state = "degraded" if offset.state == "ok" else offset.state
        return msgspec.structs.replace(offset, state=state, reasons=[*offset.reasons, "recording_failed"])

    def start_new_file(self, model: bytes | None = None) -> None:
        """Finish the file, so that the next sample opens another; with another model where one is given."""
        if model is not None:
            self._recorder.attachments = {**self._recorder.attachments, "model.toml": model}
        try:
            self._recorder.start_new()
        except OSError as error:
            self.note("recording", f"the recording could not be finished: {error}")

    def close(self, state: bytes) -> None:
        """Say that the service ends, and finish the recording."""
        self.note("stop", "the service ends")
        self.record([], self._clock.utc_ns(), state)
        try:
            self._recorder.close()
        except OSError as error:
            self.note("recording", f"the recording could not be finished: {error}")
