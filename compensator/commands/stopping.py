"""Ctrl-C and SIGTERM end a command in order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def stoppable() -> None:
    """Let SIGINT and SIGTERM end this program however it was started; for entry points.

    A script starts its background jobs with SIGINT ignored, and whoever starts a program may ignore or block both.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)


def on_stop(stop: Callable[[], object]) -> None:
    """Call a function on each signal; only in the running event loop."""
    import asyncio  # not when every command starts

    for number in _SIGNALS:
        asyncio.get_running_loop().add_signal_handler(number, stop)


@contextmanager
def until_stopped() -> Iterator[threading.Event]:
    """Yield an event that each signal sets."""
    stopped = threading.Event()
    before = {number: signal.signal(number, lambda *_: stopped.set()) for number in _SIGNALS}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
