"""One time for the loops of several threads: it stands still while any of them works, and jumps when all wait.

A time-out then expires because no answer comes, never because computer or disk are busy; and nobody waits for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
import os
import selectors
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar
from unittest import mock

from compensator.service import disk_writer
from sim_hardware.wire import Rack

#: All loops have waited so long in real time before the time jumps: what is under way on loopback arrives first. Where
#: programs wait for a processor it takes longer (`quiet_s`).
QUIET_S = 0.01
#: What reading the time takes: who asks again and again whether a time has come sees it come.
READING_S = 1e-6

_Result = TypeVar("_Result")


def quiet_s() -> float:
    """Return how long a message on loopback may be under way on a computer as busy as this one, s."""
    return QUIET_S * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1) - 1.0)


class SharedTime:
    """The time of several loops, s.

    Examples
    --------
    >>> shared, began_s = SharedTime(), time.monotonic()
    >>> shared.run(asyncio.sleep(3600.0, "an hour later"))
    'an hour later'
    >>> time.monotonic() - began_s < 60.0
    True
    """

    def __init__(self) -> None:
        self.now_s = 0.0
        self._changed = threading.Lock()
        #: Until when each loop waits, and since when and when last it has looked, in real time; None while it works.
        self._waits: dict[object, tuple[float, float, float] | None] = {}

    def new_loop(self) -> asyncio.AbstractEventLoop:
        """Return a loop that has this time."""
        return _Loop(self)

    def run(self, coroutine: Coroutine[Any, Any, _Result]) -> _Result:
        """Run a coroutine in a loop of its own that has this time; while a service in it writes to disk, it works."""
        with (
            mock.patch.object(disk_writer, "ThreadPoolExecutor", functools.partial(_Executor, self)),
            asyncio.Runner(loop_factory=self.new_loop) as runner,
        ):
            return runner.run(coroutine)

    def read_s(self) -> float:
        """Return the time, s; it is later than at the call before."""
        with self._changed:
            self.now_s += READING_S
            return self.now_s

    def enter(self, loop: object) -> None:
        """Let a loop take part; it works."""
        with self._changed:
            self._waits[loop] = None

    def leave(self, loop: object) -> None:
        """Let a loop take part no longer; the others may be woken by what it has done, so their quiet counts anew."""
        with self._changed:
            self._waits.pop(loop, None)
            now_s = time.monotonic()
            for other, wait in self._waits.items():
                if wait is not None:
                    self._waits[other] = wait[0], now_s, wait[2]

    @contextlib.contextmanager
    def waiting(self, loop: object, until_s: float = math.inf, looked_s: float = -math.inf) -> Iterator[None]:
        """Count a loop as one that waits, until a time at most."""
        with self._changed:
            before = self._waits.get(loop)
            self._waits[loop] = until_s, time.monotonic(), looked_s
        try:
            yield
        finally:
            with self._changed:
                self._waits[loop] = before

    def saw_nothing(self, loop: object, looked_s: float) -> None:
        """Go on to the next time at which a loop has something to do, if all have waited and then found nothing."""
        with self._changed:
            if (wait := self._waits[loop]) is not None:
                self._waits[loop] = wait[0], wait[1], looked_s
            waits = [wait for wait in self._waits.values() if wait is not None]
            next_s = min(until_s for until_s, _, _ in waits)
            if len(waits) < len(self._waits) or next_s <= self.now_s or math.isinf(next_s):
                return
            waited_s = min(looked for _, _, looked in waits) - max(since_s for _, since_s, _ in waits)
            if waited_s >= min(quiet_s(), next_s - self.now_s):
                self.now_s = next_s


class _Selector(selectors.PollSelector):
    """Waits for files in real time, and until a time that is shared.

    `poll` looks at every file at each call. At a pseudo-terminal it also waits for bytes that the kernel has not handed
    over yet, which `epoll` does not.
    """

    def __init__(self, shared: SharedTime) -> None:
        super().__init__()
        self._shared = shared

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0.0):
            return ready
        until_s = math.inf if timeout is None else self._shared.now_s + timeout
        with self._shared.waiting(self, until_s):
            while self._shared.now_s < until_s:
                if ready := super().select(min(QUIET_S, until_s - self._shared.now_s)):
                    break
                looked_s = time.monotonic()
                if ready := super().select(0):
                    break
                self._shared.saw_nothing(self, looked_s)
        return ready


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self, shared: SharedTime) -> None:
        self._shared = shared
        self.waits = _Selector(shared)
        super().__init__(self.waits)
        shared.enter(self.waits)

    def time(self) -> float:
        return self._shared.read_s()

    def close(self) -> None:
        self._shared.leave(self.waits)
        super().close()


class _Executor(ThreadPoolExecutor):
    """Threads whose work is work for the shared time, too, from the moment in which it is handed over."""

    def __init__(self, shared: SharedTime, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._shared = shared

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **settings: Any) -> Future[Any]:
        """Hand work over; who waits for it is woken before the shared time goes on."""
        job, shown = object(), Future[Any]()

        def done(inner: Future[Any]) -> None:
            error = inner.exception()
            if error is not None:
                shown.set_exception(error)
            else:
                shown.set_result(inner.result())
            self._shared.leave(job)

        self._shared.enter(job)
        try:
            super().submit(work, *arguments, **settings).add_done_callback(done)
        except RuntimeError:
            self._shared.leave(job)
            raise
        return shown


class TimedRack(Rack):
    """Simulated devices that have the time of the service."""

    def __init__(self, shared: SharedTime) -> None:
        super().__init__(shared.new_loop)
        self._shared = shared

    def run(self, coroutine: Coroutine[Any, Any, _Result]) -> _Result | None:
        """Run a coroutine in the devices' thread; the loop of the caller waits for it."""
        try:
            caller = asyncio.get_running_loop()
        except RuntimeError:
            return super().run(coroutine)
        if not isinstance(caller, _Loop) or caller is self._loop:
            return super().run(coroutine)
        with self._shared.waiting(caller.waits, looked_s=math.inf):
            return super().run(coroutine)
