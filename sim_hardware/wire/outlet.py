"""The output of a simulated device: faults applied to the bytes of a reply."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable

from sim_hardware.wire.faults import Layers, number

BYTE_FAULTS = frozenset({"silence", "garbage", "truncate", "late", "split", "join"})


class Outlet:
    """Send frames to one peer, through the faults.

    Parameters
    ----------
    loop : asyncio.AbstractEventLoop
        Loop that the peer's connection lives in; late bytes are scheduled there.
    write : callable
        Puts bytes on the wire at once. Must ignore bytes for a peer that has gone.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, write: Callable[[bytes], None]) -> None:
        self._loop = loop
        self._write = write
        self._held = b""
        self._random = random.Random(20)
        self._timers: set[asyncio.TimerHandle] = set()

    def send(self, frame: bytes, layers: Layers) -> None:
        """Send a frame, unless a fault changes, delays or drops it."""
        if layers.quiet and not self._held:
            self._write(frame)
            return
        if layers.use("silence") is not None:
            return
        if layers.use("garbage") is not None:
            frame = self._random.randbytes(len(frame))
        if layers.use("truncate") is not None:
            frame = frame[: len(frame) // 2]
        late = layers.use("late")
        if late is not None:
            self._later(number(late, "delay_s", 0.0), frame)
            return
        if layers.use("join") is not None and not self._held:
            self._held = frame
            return
        frame, self._held = self._held + frame, b""
        split = layers.use("split")
        if split is None:
            self._write(frame)
            return
        pieces, pause_s = max(1, int(number(split, "pieces", 2))), number(split, "pause_s", 0.005)
        size = -(-len(frame) // pieces)
        for i in range(0, len(frame), size):
            self._later(i // size * pause_s, frame[i : i + size])

    def close(self) -> None:
        """Drop what has not been sent."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        self._held = b""

    def _later(self, delay_s: float, data: bytes) -> None:
        if delay_s <= 0.0:
            self._write(data)
            return

        def fire() -> None:
            self._timers.discard(timer)
            self._write(data)

        timer = self._loop.call_later(delay_s, fire)
        self._timers.add(timer)
