"""Ctrl-C and SIGTERM end a command in order."""

from __future__ import annotations

import os
import select
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_interrupted = False


def stoppable() -> None:
    """Let SIGINT and SIGTERM end this program however it was started; for entry points.

    A script starts its background jobs with SIGINT ignored, and whoever starts a program may ignore or block both.
    """
    global _interrupted  # noqa: PLW0603  a signal belongs to the process
    if threading.current_thread() is not threading.main_thread():
        return
    _interrupted = False
    if signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, signal.default_int_handler):
        signal.signal(signal.SIGINT, _interrupt)
    if signal.getsignal(signal.SIGTERM) is signal.SIG_IGN:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)  # last: one that waits would be lost were it still ignored


def was_interrupted() -> bool:
    """Return whether SIGINT has come, also where Python has dropped its exception, as in the callback of a weak one."""
    return _interrupted


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _interrupted  # noqa: PLW0603
    _interrupted = True
    signal.default_int_handler(number, frame)


def on_stop(stop: Callable[[], object]) -> None:
    """Call a function on each signal; only in the running event loop."""
    import asyncio  # not when every command starts

    for number in _SIGNALS:
        asyncio.get_running_loop().add_signal_handler(number, stop)


class Stop:
    """What a signal sets.

    A handler runs in the main thread, also while that thread holds the lock of a `threading.Event` that it waits for,
    and would then wait for it itself, for ever: so there is no lock here.
    """

    def __init__(self) -> None:
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)

    def set(self) -> None:
        """End every wait."""
        with suppress(BlockingIOError):  # it is full, so it is set
            os.write(self._write, b".")

    def wait(self, timeout_s: float) -> bool:
        """Wait for at most this time, s; return whether it is set."""
        return bool(select.select([self._read], [], [], timeout_s)[0])

    def close(self) -> None:
        """Close what it waits on."""
        os.close(self._read)
        os.close(self._write)


@contextmanager
def until_stopped() -> Iterator[Stop]:
    """Yield what each signal sets."""
    stop = Stop()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        stop.close()
