"""Clocks: the computer's own, or a virtual one in which a day takes seconds."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Collection
from typing import Any, Protocol

#: Nanoseconds of a second and of an hour.
NS, HOUR_NS = 1_000_000_000, 3_600_000_000_000


def duration(seconds: float) -> str:
    """Return a duration in a unit that suits it.

    Examples
    --------
    >>> duration(7.4), duration(900.0), duration(43_200.0), duration(200_000.0)
    ('7 s', '15 min', '12.0 h', '2.3 days')
    """
    for unit, length_s, most in (("s", 1.0, 120.0), ("min", 60.0, 120.0), ("h", 3600.0, 48.0)):
        if round(abs(seconds) / length_s) < most:
            return f"{seconds / length_s:.{1 if unit == 'h' else 0}f} {unit}"
    return f"{seconds / 86400.0:.1f} days"


class Clock(Protocol):
    """Interface of a clock for the service."""

    def utc_ns(self) -> int:
        """Return the wall clock, ns since 1970 UTC. It may be set back or forward."""

    def monotonic_ns(self) -> int:
        """Return a monotonic clock, ns, which goes on while the computer sleeps."""

    async def sleep(self, seconds: float) -> None:
        """Wait."""

    async def settle(self, tasks: Collection[asyncio.Future[Any]], timeout_s: float) -> None:
        """Wait until the tasks are done, or for a while; the tasks continue."""


#: Goes on while the computer sleeps, which the usual monotonic clock of Linux does not.
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


class SystemClock:
    """The clock of the computer."""

    def utc_ns(self) -> int:
        """Return the wall clock, ns since 1970 UTC."""
        return time.time_ns()

    def monotonic_ns(self) -> int:
        """Return the monotonic clock, ns; it goes on while the computer sleeps."""
        return time.clock_gettime_ns(_CLOCK)

    async def sleep(self, seconds: float) -> None:
        """Wait."""
        await asyncio.sleep(max(seconds, 0.0))

    async def settle(self, tasks: Collection[asyncio.Future[Any]], timeout_s: float) -> None:
        """Wait until the tasks are done, or for a while."""
        if tasks:
            await asyncio.wait(tasks, timeout=timeout_s)


class VirtualClock:
    """A clock that stands still during computations and jumps ahead on `sleep`.

    Only one task may sleep on it, the sampling loop. Tasks awaited with `settle` run in real time, within their own
    limits, while virtual time stands still.

    Parameters
    ----------
    start_utc_ns : int
        Start of the clock, ns since 1970 UTC.
    on_advance : callable, optional
        Awaited with the seconds since the start whenever time has advanced, to advance a simulated machine.
    """

    def __init__(self, start_utc_ns: int, on_advance: Callable[[float], Awaitable[None]] | None = None) -> None:
        self._start_ns = start_utc_ns
        self._elapsed_ns = 0
        self._step_ns = 0
        self._on_advance = on_advance

    def utc_ns(self) -> int:
        """Return the virtual wall clock, ns since 1970 UTC."""
        return self._start_ns + self._elapsed_ns + self._step_ns

    def monotonic_ns(self) -> int:
        """Return the virtual time since the start, ns."""
        return self._elapsed_ns

    def set_wall_clock(self, by_s: float) -> None:
        """Set the wall clock forward (or back), as an administrator would."""
        self._step_ns += round(by_s * NS)

    def stand_still(self, seconds: float) -> None:
        """Let time pass in which nothing runs: the computer sleeps, or is overloaded."""
        self._elapsed_ns += round(seconds * NS)

    async def sleep(self, seconds: float) -> None:
        """Jump ahead."""
        self._elapsed_ns += max(round(seconds * NS), 0)
        if self._on_advance is not None:
            await self._on_advance(self._elapsed_ns / NS)
        await asyncio.sleep(0)

    async def settle(self, tasks: Collection[asyncio.Future[Any]], timeout_s: float) -> None:
        """Wait until the tasks are done, without a limit in real time."""
        if tasks:
            await asyncio.wait(tasks)
