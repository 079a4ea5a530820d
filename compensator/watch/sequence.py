"""What was lost between a publisher and a listener, from the numbers of the messages."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Sequence:
    """Follows the numbers of one kind of message of one machine.

    A number that is left out was lost on the way, unless the service was started anew in between: its numbers go on
    with the time that it was away. Whether it was is known only from the messages behind the leap, so the last leap
    stays in doubt until one of them says so.

    Parameters
    ----------
    last : int
        Highest number that arrived, −1 before the first.
    received, missed, repeated : int
        Messages that arrived in order, that never arrived, and that arrived with a number that was there already.

    Examples
    --------
    >>> numbers = Sequence()
    >>> [numbers.take(n, 60 * n) for n in (5, 6, 9, 9)], numbers.missed, numbers.repeated
    ([True, True, True, False], 2, 1)
    >>> numbers.started(400)
    >>> numbers.missed
    0
    """

    last: int = -1
    received: int = 0
    missed: int = 0
    repeated: int = 0
    _time_ns: int = 0
    _doubt: tuple[int, int] = (0, 0)

    def take(self, number: int, time_ns: int) -> bool:
        """Take a message in; tell whether it is newer than all before.

        Parameters
        ----------
        number, time_ns : int
            Its number, and its own time, ns since 1970 UTC.
        """
        if number <= self.last:
            self.repeated += 1
            return False
        if self.last >= 0 and number > self.last + 1:
            left_out = number - self.last - 1
            self.missed += left_out
            self._doubt = (left_out, self._time_ns)
        self.last, self._time_ns = number, time_ns
        self.received += 1
        return True

    def started(self, time_ns: int) -> None:
        """Hear when the service was started; a leap over that time is nothing lost.

        Parameters
        ----------
        time_ns : int
            ns since 1970 UTC.
        """
        left_out, before_ns = self._doubt
        if left_out and time_ns > before_ns:
            self.missed -= left_out
            self._doubt = (0, 0)
