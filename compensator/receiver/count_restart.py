"""When a service evidently counts from a lower number, as after a new installation or a forged number.

A lower number alone is a replay. A service that counts from there publishes on: its numbers and times increase, and
its messages arrive as far apart as they were measured, about half of their validity. A recording that is replayed
faster, and a burst, do not look like that; against one that is replayed at its own speed only `check_clock` helps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

#: Number of messages in a row that restart the count.
MESSAGES = 3
#: Shortest time between two of them, as a part of their validity: a message is valid for two to three samples.
SHORTEST_PART = 0.2
#: Largest difference between the times of arrival and of measurement, as a part of the validity.
DIFFERENCE_PART = 0.1


class Numbered(Protocol):
    """What is known of a message here."""

    @property
    def seq(self) -> int:
        """Its number; never repeats for a machine."""

    @property
    def time_utc_ns(self) -> int:
        """Time of the measurement, ns since 1970 UTC."""


@dataclass(slots=True)
class CountRestart:
    """Looks for messages in a row whose numbers are below the last one."""

    _last: Numbered | None = None
    _received_s: float = 0.0
    _count: int = 0

    def clear(self) -> None:
        """Forget the messages so far."""
        self._last, self._count = None, 0

    def is_shown_by(self, now_s: float, message: Numbered, valid_for_s: float) -> bool:
        """Return whether the count restarts with this message.

        Parameters
        ----------
        now_s : float
            Arrival by the monotonic clock, s.
        message : Numbered
            A message that is usable but for its number.
        valid_for_s : float
            Validity that it was published with, s: two to three samples.
        """
        last = self._last
        if last is not None and message.seq > last.seq and message.time_utc_ns > last.time_utc_ns:
            arrived_s, measured_s = now_s - self._received_s, (message.time_utc_ns - last.time_utc_ns) / 1e9
            if arrived_s < SHORTEST_PART * valid_for_s:
                return False  # a burst says nothing, and must not hide those that count
            in_row = arrived_s <= valid_for_s and abs(arrived_s - measured_s) <= DIFFERENCE_PART * valid_for_s
            self._count = self._count + 1 if in_row else 1
        else:
            self._count = 1
        self._last, self._received_s = message, now_s
        return self._count >= MESSAGES
