"""A serial port for text lines, read by the event loop itself, without a thread."""

from __future__ import annotations

import asyncio
import contextlib
import termios
from collections import deque

import serial

from drivers.errors import failure_text
from drivers.lines.settings import SerialLine
from drivers.protocols.dcon import CR

# Far more than any reply: a stream without a CR must not fill the memory.
_MOST_BYTES = 4096


class PortLostError(Exception):
    """The port cannot be opened, or is gone; the text says why."""


class SerialPort:
    """An open port.

    Parameters
    ----------
    config : SerialLine
        Settings of the line.

    Raises
    ------
    PortLostError
        It is missing, in use by another program, or refuses the settings.
    """

    def __init__(self, config: SerialLine) -> None:
        self._loop = asyncio.get_running_loop()
        try:
            self._serial = serial.Serial(
                config.port,
                baudrate=config.baudrate,
                parity=config.parity,
                stopbits=config.stopbits,
                timeout=0,
                write_timeout=0,
                exclusive=True,
            )
        except (OSError, ValueError, termios.error) as error:
            raise PortLostError(failure_text(error)) from None
        self._lines: deque[bytes] = deque(maxlen=64)
        self._rest = bytearray()
        self._changed = asyncio.Event()
        self._lost = ""
        self.received_at_s = 0.0
        self._loop.add_reader(self._serial.fileno(), self._readable)

    @property
    def lost(self) -> str:
        """Why the port is gone; empty while it is there."""
        return self._lost

    def write(self, data: bytes) -> None:
        """Send a command; commands fit any output buffer.

        Raises
        ------
        PortLostError
            The port is gone.
        """
        try:
            sent = 0 if self._lost else self._serial.write(data)
        except (OSError, termios.error) as error:
            self._lose(str(error))
            sent = 0
        if sent != len(data):
            raise PortLostError(self._lost or "the port accepts no data")

    def discard_input(self) -> None:
        """Drop everything received so far."""
        self._readable()
        self._lines.clear()
        self._rest.clear()

    async def line(self) -> bytes:
        """Wait for the next line, without its CR. The caller limits the time.

        Raises
        ------
        PortLostError
            The port is gone.
        """
        while not self._lines:
            if self._lost:
                raise PortLostError(self._lost)
            self._changed.clear()
            await self._changed.wait()
        return self._lines.popleft()

    @property
    def rest(self) -> bytes:
        """Bytes received since the last CR."""
        return bytes(self._rest)

    def close(self) -> None:
        """Close the port; a pending wait for a line fails at once."""
        self._lose("closed")

    def _readable(self) -> None:
        """Read the bytes received."""
        if self._lost:
            return
        try:
            data = self._serial.read(_MOST_BYTES)
        except (OSError, termios.error) as error:
            self._lose(str(error))
            return
        if not data:
            return
        self.received_at_s = self._loop.time()
        *lines, rest = (bytes(self._rest) + data).split(CR)
        self._lines.extend(lines)
        self._rest[:] = rest[-_MOST_BYTES:]
        self._changed.set()

    def _lose(self, why: str) -> None:
        """Close the port, once."""
        if self._lost:
            return
        self._lost = why or "port lost"
        self._loop.remove_reader(self._serial.fileno())
        # Closing a port with unsent output would wait for it, up to half a minute.
        with contextlib.suppress(OSError, termios.error):
            self._serial.reset_output_buffer()
        with contextlib.suppress(OSError, termios.error):
            self._serial.close()
        self._changed.set()
