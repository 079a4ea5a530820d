"""Split a byte stream into Modbus RTU requests, without the silence that separates them on a real line."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from sim_hardware.wire.modbus import crc16

SILENCE_S = 0.05
"""Silence that ends a frame of unknown length. A real slave takes 3.5 characters, which pseudo-terminals
and sockets do not keep apart."""


class RtuFrames:
    """Split a byte stream into RTU requests; garbled bytes are dropped up to the next silence.

    Parameters
    ----------
    loop : asyncio.AbstractEventLoop
        Loop whose clock times the silence.
    frame : callable
        Given each request whose CRC is right.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, frame: Callable[[bytes], None]) -> None:
        self._loop = loop
        self._frame = frame
        self._buffer = b""
        self._timer: asyncio.TimerHandle | None = None

    def feed(self, data: bytes) -> None:
        """Process received bytes."""
        self.close()
        self._buffer += data
        while self._buffer:
            length = rtu_request_length(self._buffer)
            if not length or len(self._buffer) < length:
                self._timer = self._loop.call_later(SILENCE_S, self._silence)
                return
            frame, self._buffer = self._buffer[:length], self._buffer[length:]
            if crc16(frame[:-2]) != frame[-2:]:
                self._buffer = b""
                return
            self._frame(frame)

    def close(self) -> None:
        """Stop waiting for silence."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _silence(self) -> None:
        frame, self._buffer = self._buffer, b""
        if len(frame) >= 4 and crc16(frame[:-2]) == frame[-2:]:
            self._frame(frame)


def rtu_request_length(buffer: bytes) -> int | None:
    """Return the length of the RTU request that `buffer` begins with; None while that is not known.

    A slave on a real line finds the end of a frame by 3.5 characters of silence, which neither a
    pseudo-terminal nor a socket preserves; the length follows from the function. 0 means that the
    function is not known, so that only silence can tell.
    """
    if len(buffer) < 2:
        return None
    function = buffer[1]
    if 1 <= function <= 6:
        return 8
    if function in {15, 16}:
        return None if len(buffer) < 7 else 9 + buffer[6]
    if function == 0x46 and len(buffer) < 3:
        return None
    return 5 if function == 0x46 and buffer[2] == 0 else 0
