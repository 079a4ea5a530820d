"""Which messages are used: of this machine, new, fresh and within the limits. Without thread, clock or socket.

The same for the offset of one axis and for a sample of several: both have the machine, a number, a time and a validity.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from .count_restart import CountRestart, Numbered
from .limits import Acceptance
from .message import Rejected
from .reasons import Reason, printable


class Measured(Numbered, Protocol):
    """What is published of one sample."""

    @property
    def machine(self) -> str:
        """Machine that published it."""

    @property
    def valid_for_s(self) -> float:
        """Time for which it may be used, s."""


M = TypeVar("M", bound=Measured)


@dataclass(slots=True)
class Held(Generic[M]):
    """The newest message, and when it was measured on the monotonic clock."""

    message: M
    measured_s: float
    valid_s: float


@dataclass(slots=True)
class Gate(Generic[M]):
    """Accepts or drops messages.

    Parameters
    ----------
    machine : str
        Machine that is followed; messages of other machines are dropped.
    limits : Acceptance
        Limits of age and clock.
    check_size : callable
        Raises `Rejected` for a message that is beyond a limit of size.
    last_sequence : int
        Highest number used so far; −1 if unknown.

    Attributes
    ----------
    held : Held or None
        The newest message.
    dropped : dict
        Code → number of messages dropped.
    """

    machine: str
    limits: Acceptance
    check_size: Callable[[M], None]
    last_sequence: int = -1
    dropped: dict[str, int] = field(default_factory=dict)
    held: Held[M] | None = None
    _rejected: Reason | None = None
    _restart: CountRestart = field(default_factory=CountRestart)
    _restarted: Reason | None = None

    @property
    def reasons(self) -> list[Reason]:
        """Return why a message was dropped since the newest one, and whether the count has restarted."""
        return [reason for reason in (self._rejected, self._restarted) if reason is not None]

    def reject(self, reason: Reason) -> None:
        """Count a dropped message."""
        self._rejected = reason
        self.dropped[reason.code] = self.dropped.get(reason.code, 0) + 1

    def accept(self, now_s: float, message: M, age_s: float | None, *, asked: bool) -> bool:
        """Take a message as the newest one.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        message : Measured
            A message.
        age_s : float or None
            Its age, s, if that is to be checked; otherwise it counts as measured now.
        asked : bool
            Whether it is the answer to a query, which is not a replay even if a newer message arrived first.

        Returns
        -------
        bool
            Whether it is now the newest message.

        Raises
        ------
        Rejected
            If it must not be used.
        """
        if not self._check(now_s, message, age_s, asked):
            return False
        self._restarted = None
        if message.seq < self.last_sequence:
            self._restarted = Reason("count_restarted", f"number {message.seq} after {self.last_sequence}")
        self._restart.clear()
        self.held = Held(message, now_s - max(age_s or 0.0, 0.0), self._valid_s(message))
        self.last_sequence = message.seq
        self._rejected = None
        return True

    def _valid_s(self, message: M) -> float:
        return min(message.valid_for_s, self.limits.valid_max_s)

    def _check(self, now_s: float, message: M, age_s: float | None, asked: bool) -> bool:
        if message.machine != self.machine:
            raise Rejected(Reason("other_machine", f"{printable(message.machine, 64)}, expected {self.machine}"))
        # The query at the start may return a message twice. After a restart the newest one may be queried again; its
        # age is checked as for any other message.
        again = message.seq == self.last_sequence
        if again and (self.held is not None or not asked):
            if self.held is not None and message == self.held.message:
                return False
            raise Rejected(Reason("replayed", f"number {message.seq} was used before"))
        if message.seq < self.last_sequence:
            if asked:
                return False
            self._check_restart(now_s, message, age_s)
        self._check_value(message, age_s)
        return True

    def _check_restart(self, now_s: float, message: M, age_s: float | None) -> None:
        """Drop a message with a lower number, unless the service evidently counts from there."""
        detail = f"number {message.seq} after {self.last_sequence}"
        if self.held is not None and now_s - self.held.measured_s <= self.held.valid_s:
            raise Rejected(Reason("replayed", detail))
        try:
            self._check_value(message, age_s)
        except Rejected as rejected:
            raise Rejected(Reason("replayed", detail)) from rejected
        # Its own validity: `valid_max_s` says nothing of how far apart a service's messages are.
        if not self._restart.is_shown_by(now_s, message, message.valid_for_s):
            raise Rejected(Reason("replayed", detail))

    def _check_value(self, message: M, age_s: float | None) -> None:
        if age_s is not None:
            self._check_age(message, age_s)
        self.check_size(message)

    def _check_age(self, message: M, age_s: float) -> None:
        if not age_s >= -self.limits.clock_tolerance_s:
            raise Rejected(Reason("clock_disagrees", f"{-age_s:.1f} s ahead of the wall clock here"))
        if age_s > self._valid_s(message):
            raise Rejected(Reason("late", f"{age_s:.1f} s old, valid for {message.valid_for_s:g} s"))
