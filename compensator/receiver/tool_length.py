"""The length of the tool from the key `thermal/tool_length`, every key checked."""

from __future__ import annotations

import math
from collections.abc import Callable

from .limits import LONGEST_MM
from .message import Rejected, check_schema, decode, integer, malformed, number, seconds
from .reasons import Reason, printable

#: Longest time that one message may be used, s: a tool can stay in the spindle for a day.
VALID_MAX_S = 86_400.0
#: Largest time by which a message may be ahead of the wall clock, s.
TOLERANCE_S = 5.0


class ToolLength:
    """The newest length of the tool in the spindle.

    Parameters
    ----------
    machine : str
        Machine whose tool it is; messages of other machines are dropped.

    Attributes
    ----------
    reasons : tuple of Reason
        Why the last message was dropped; empty where it was used.
    """

    def __init__(self, machine: str) -> None:
        self.machine = machine
        self.reasons: tuple[Reason, ...] = ()
        self._length_mm: float | None = None
        self._until_s = -math.inf
        self._time_utc_ns: int | None = None

    def at(self, now_s: float) -> float | None:
        """Return the length at a time of the monotonic clock, mm; None if none is known or the last has expired."""
        return self._length_mm if now_s <= self._until_s else None

    def receive(
        self, now_s: float, payload: bytes, *, utc_ns: Callable[[], int] | None = None, asked: bool = False
    ) -> bool:
        """Accept a message, or drop it with a reason; no payload raises an error.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        payload : bytes
            Payload as received.
        utc_ns : callable, optional
            The wall clock, ns since 1970 UTC, if the message's age is to be checked; otherwise it counts as measured
            now.
        asked : bool
            Whether it is the answer to a query, which a message overtakes.

        Returns
        -------
        bool
            Whether it is now the newest length.
        """
        is_valid = now_s <= self._until_s
        if asked and is_valid:
            return False
        try:
            length_mm, until_s, time_utc_ns = self._parse(now_s, payload, utc_ns)
            # Without a wall clock a time may be a forged one of next year, and nothing would replace it.
            last_ns = self._time_utc_ns if utc_ns is not None and (is_valid or asked) else None
            if last_ns is not None and time_utc_ns < last_ns:
                raise Rejected(Reason("replayed", f"{(last_ns - time_utc_ns) / 1e9:.1f} s older than the last"))
        except Rejected as rejected:
            self.reasons = (Reason(rejected.reason.code, f"tool_length: {rejected.reason.detail}"),)
            return False
        self._length_mm, self._until_s, self._time_utc_ns, self.reasons = length_mm, until_s, time_utc_ns, ()
        return True

    def _parse(self, now_s: float, payload: bytes, utc_ns: Callable[[], int] | None) -> tuple[float | None, float, int]:
        table = decode(payload)
        check_schema(table)
        machine = table.get("machine")
        if machine != self.machine:
            shown = printable(machine, 64) if isinstance(machine, str) else "no name"
            raise Rejected(Reason("other_machine", f"{shown}, expected {self.machine}"))
        length_mm = number(table, "tool_length_mm")
        if length_mm is not None and abs(length_mm) > LONGEST_MM:
            raise malformed("tool_length_mm", length_mm, f"at most {LONGEST_MM:g}")
        time_utc_ns, valid_s = integer(table, "time_utc_ns"), min(seconds(table), VALID_MAX_S)
        age_s = 0.0 if utc_ns is None else (utc_ns() - time_utc_ns) / 1e9
        if age_s < -TOLERANCE_S:
            raise Rejected(Reason("clock_disagrees", f"{-age_s:.1f} s ahead of the wall clock here"))
        if age_s > valid_s:
            raise Rejected(Reason("late", f"{age_s:.1f} s old by the wall clock, valid for {valid_s:g} s"))
        return length_mm, now_s + valid_s - max(age_s, 0.0), time_utc_ns
