"""Counts lost and repeated messages by their sequence numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Sequence:
    """Sequence numbers of one kind of message of one machine.

    A skipped number is a lost message, unless the service was restarted or stood still in between: its numbers advance
    by the time that it was down. A restart is known only from later messages, so the last gap can still be revoked.

    Parameters
    ----------
    last : int
        Highest number that arrived, −1 before the first.
    received, missed, repeated : int
        Messages that arrived in order, that did not arrive, and that arrived with a repeated number.

    Examples
    --------
    >>> numbers = Sequence()
    >>> [numbers.update(n, 60 * n) for n in (5, 6, 9, 9)], numbers.missed, numbers.repeated
    ([True, True, True, False], 2, 1)
    >>> numbers.started(400)
    >>> numbers.missed
    0
    >>> numbers.stood_still(29)
    >>> numbers.update(40, 2400), numbers.missed
    (True, 1)
    """

    last: int = -1
    received: int = 0
    missed: int = 0
    repeated: int = 0
    _time_ns: int = 0
    _last_gap: tuple[int, int] = (0, 0)
    _never_sent: int = 0

    def update(self, number: int, time_ns: int) -> bool:
        """Count a message; return whether it is newer than all before.

        Parameters
        ----------
        number, time_ns : int
            Its number, and its own time, ns since 1970 UTC.
        """
        if number <= self.last:
            self.repeated += 1
            return False
        if self.last >= 0 and number > self.last + 1:
            skipped = max(number - self.last - 1 - self._never_sent, 0)
            self.missed += skipped
            self._last_gap = (skipped, self._time_ns)
        self.last, self._time_ns, self._never_sent = number, time_ns, 0
        self.received += 1
        return True

    def stood_still(self, missing: int) -> None:
        """Expect that the next message skips the numbers of samples that were never measured."""
        self._never_sent = max(missing, 0)

    def started(self, time_ns: int) -> None:
        """Revoke the last gap if the service was started within it.

        Parameters
        ----------
        time_ns : int
            ns since 1970 UTC.
        """
        skipped, before_ns = self._last_gap
        if skipped and time_ns > before_ns:
            self.missed -= skipped
            self._last_gap = (0, 0)
