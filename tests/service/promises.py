"""What commands promise, and how long simulated time waits for the threads that work on it."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import Future
from typing import Any

#: Processor time, s, because the clock would give them less on a busy computer.
PATIENCE_S = 0.02
#: Real seconds with less than WORK_S of it after which they are not working, but waiting for the next sample. What only
#: ticks (a thread of Zenoh that another test left) gets less, a thread that works on a busy computer more.
IDLE_S = 0.4
WORK_S = 0.002


class Promises:
    """Promises of commands; while one is open simulated time does not run away from the thread that works on it.

    Parameters
    ----------
    patience_s : float
        Processor time that the threads get in each sample, s.
    """

    def __init__(self, patience_s: float = PATIENCE_S) -> None:
        self.patience_s = patience_s
        self.open: list[Future[Any]] = []

    def add(self, reply: Any) -> Any:
        """Keep a reply if it is a promise, and return it."""
        if isinstance(reply, Future):
            self.open.append(reply)
        return reply

    def _is_open(self) -> bool:
        # The same list stays: a test may clear it.
        self.open[:] = [promise for promise in self.open if not promise.done()]
        return bool(self.open)

    async def wait(self, part: float = 1.0) -> None:
        """Wait for a part of a sample: until the threads have had their processor time, or want none."""
        begin = seen = _of_others()
        idle_s = time.monotonic() + IDLE_S * part
        while self._is_open() and seen - begin < self.patience_s * part and time.monotonic() < idle_s:
            await asyncio.sleep(0.002)
            if _of_others() > seen + WORK_S * part:
                seen, idle_s = _of_others(), time.monotonic() + IDLE_S * part


def _of_others() -> float:
    """Return the processor time of all threads but this one, s."""
    return time.process_time() - time.thread_time()
