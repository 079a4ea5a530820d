"""Ctrl-C and SIGTERM end a command in order."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def on_stop(stop: Callable[[], object]) -> None:
    """Call a function on each signal; only in the running event loop."""
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
