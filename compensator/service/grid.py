"""The grid of samples: whole multiples of the period in UTC, paced by a clock that nobody sets.

Waiting always aims at the next point of the grid, so nothing adds up. A wall clock that is set back or
forward moves the labels, never the pace: the step is told, and the grid is laid anew.
"""

from __future__ import annotations

from compensator.clock import NS, Clock


class Grid:
    """Points of time of the polls and samples.

    Parameters
    ----------
    clock : Clock
        Wall and monotonic clock.
    period_s : float
        Length of a sample, s.
    polls : int
        Polls in a sample; the last one falls on its end.
    """

    def __init__(self, clock: Clock, period_s: float, polls: int) -> None:
        self._clock = clock
        self._period_ns = round(period_s * NS)
        self._polls = polls
        self._index = 0
        self._lay()

    def _lay(self) -> None:
        """Take the next whole multiple of the period as the end of the present sample."""
        utc, monotonic = self._clock.utc_ns(), self._clock.monotonic_ns()
        self.label_ns = (utc // self._period_ns + 1) * self._period_ns
        self._end_ns = monotonic + self.label_ns - utc
        gone = self._period_ns - (self.label_ns - utc)
        self._index = min(gone * self._polls // self._period_ns, self._polls - 1)

    def seconds_to_next_poll(self) -> float:
        """Return how long to wait for the next poll, s."""
        point = self._end_ns - self._period_ns + (self._index + 1) * self._period_ns // self._polls
        return (point - self._clock.monotonic_ns()) / NS

    def polled(self) -> bool:
        """Count a poll; tell whether it was the last one of its sample."""
        self._index += 1
        return self._index == self._polls

    def next_sample(self) -> float:
        """Go on to the next sample.

        Returns
        -------
        float
            By how much the wall clock was set since the last sample, s; 0 for the usual small corrections.
        """
        off_ns = self._clock.utc_ns() - self._clock.monotonic_ns() - (self.label_ns - self._end_ns)
        self._index = 0
        late_ns = self._clock.monotonic_ns() - self._end_ns
        if abs(off_ns) > NS or late_ns >= self._period_ns:
            self._lay()
            return off_ns / NS if abs(off_ns) > NS else 0.0
        # Small differences are the slewing of a disciplined clock: follow it, the labels stay on the grid.
        self.label_ns += self._period_ns
        self._end_ns += self._period_ns - off_ns
        return 0.0
