"""A clock that starts in the past, catches up, and then runs in real time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection
from typing import Any

from compensator.clock import NS, Clock, SystemClock


class LateClock:
    """A clock that starts in the past, jumps until it has caught up with another clock, and then follows that.

    Like `VirtualClock`, it supports one sleeping task.

    Parameters
    ----------
    behind_s : float
        Time before the present at which it starts, s.
    on_advance : callable
        Awaited with the seconds since the start whenever the time has moved.
    on_time : callable
        Called once it has caught up.
    wall : Clock, optional
        The clock to catch up with; the system's by default.
    """

    def __init__(
        self,
        behind_s: float,
        on_advance: Callable[[float], Awaitable[None]],
        on_time: Callable[[], None],
        wall: Clock | None = None,
    ) -> None:
        self._wall: Clock = wall or SystemClock()
        self._start_ns = self._now_ns = self._wall.monotonic_ns() - round(behind_s * NS)
        # Constant, so that time does not advance during computations.
        self._utc_ns = self._wall.utc_ns() - self._wall.monotonic_ns()
        self._late = behind_s > 0
        self._on_advance = on_advance
        self._on_time = on_time

    def utc_ns(self) -> int:
        """Return the wall clock, or the simulated time until it has caught up, ns since 1970 UTC."""
        return self._utc_ns + self._now_ns if self._late else self._wall.utc_ns()

    def monotonic_ns(self) -> int:
        """Return the time since the start, ns."""
        return (self._now_ns if self._late else self._wall.monotonic_ns()) - self._start_ns

    @property
    def behind_s(self) -> float:
        """Time that it is behind the present, s; 0 once it has caught up."""
        return (self._wall.monotonic_ns() - self._now_ns) / NS if self._late else 0.0

    async def sleep(self, seconds: float) -> None:
        """Jump ahead, or wait once it has caught up."""
        ahead_ns = round(max(seconds, 0.0) * NS)
        if self._late:
            now_ns = self._wall.monotonic_ns()
            if self._now_ns + ahead_ns <= now_ns:
                self._now_ns += ahead_ns
                await self._on_advance(self.monotonic_ns() / NS)
                await asyncio.sleep(0)
                return
            ahead_ns -= now_ns - self._now_ns
            self._late = False
            self._on_time()
        await self._wall.sleep(ahead_ns / NS)
        await self._on_advance(self.monotonic_ns() / NS)

    async def settle(self, tasks: Collection[asyncio.Future[Any]], timeout_s: float) -> None:
        """Wait until the tasks are done, for at most `timeout_s` of real time."""
        if tasks:
            await asyncio.wait(tasks, timeout=None if self._late else timeout_s)
