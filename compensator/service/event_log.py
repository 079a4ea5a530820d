"""Events of a service: numbered, published at once, and kept until they are written with the next sample."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

from compensator.clock import Clock
from compensator.errors import one_line
from compensator.events import EventKind
from compensator.messages import SCHEMA, Event, encode

log = logging.getLogger("compensator")

#: Largest number of events that are kept for the recording; beyond that the oldest are dropped.
WAITING_EVENTS = 1000
#: Longest text of an event, characters: it may cite what somebody has sent.
LONGEST_TEXT = 2000


class EventLog:
    """Events of one machine; `sequence` is the number of the first sample, `publish` never waits."""

    def __init__(self, machine: str, publish: Callable[[str, bytes], None], clock: Clock, sequence: int) -> None:
        self._machine = machine
        self._publish = publish
        self._clock = clock
        self._events: list[Event] = []
        #: Number of the current sample; events carry it.
        self.sequence = sequence

    def note(self, kind: EventKind, text: str, data: Mapping[str, Any] | None = None) -> None:
        """Publish an event and keep it for the recording; its text is one line, whatever it cites."""
        event = Event(
            schema=SCHEMA,
            machine=self._machine,
            seq=self.sequence,
            time_utc_ns=self._clock.utc_ns(),
            kind=kind,
            text=one_line(text)[:LONGEST_TEXT],
            data=dict(data or {}),
        )
        # Bounded, so that memory does not grow if nothing can be recorded.
        self._events = [*self._events[1 - WAITING_EVENTS :], event]
        try:
            self._publish("event", encode(event))
        except Exception:
            log.exception("internal error of publishing an event, which is recorded")

    def drain(self) -> list[Event]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events
