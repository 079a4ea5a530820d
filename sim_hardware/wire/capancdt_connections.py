"""Connections to the two ports of the capaNCDT 6200."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from sim_hardware.wire.outlet import Outlet
from sim_hardware.wire.tcp_port import Connection, TcpPort

BANNER = b"Welcome to DT6222\r\ncapaNCDT 6222\r\nSN 20061\r\n"
COMMAND_TIMEOUT_S = 10.0


class DataConnection(Connection):
    """A client of the data port."""

    def __init__(self, port: TcpPort) -> None:
        super().__init__(port)
        self.outlet = Outlet(asyncio.get_running_loop(), self.write)
        self._writable = asyncio.Event()
        self._writable.set()

    def opened(self) -> None:
        """Prepare the connection."""
        assert self.transport is not None
        self.transport.set_write_buffer_limits(0)

    def closed(self) -> None:
        """Stop pending sends."""
        self.outlet.close()
        self._writable.set()

    def pause_writing(self) -> None:
        """Handle a full socket."""
        self._writable.clear()

    def resume_writing(self) -> None:
        """Handle a socket that is empty again."""
        self._writable.set()

    async def drained(self) -> None:
        """Wait until the socket has accepted everything."""
        await self._writable.wait()


class CommandConnection(Connection):
    """A client of the command port: every character is echoed, and an answer follows each command.

    Parameters
    ----------
    execute : callable
        Returns what follows the echo of a command.
    mute : callable
        Returns whether the controller is to stay silent.
    """

    def __init__(self, port: TcpPort, execute: Callable[[str], str], mute: Callable[[], bool]) -> None:
        super().__init__(port)
        self._execute = execute
        self._mute = mute
        self._command: str | None = None
        self._timer: asyncio.TimerHandle | None = None

    def opened(self) -> None:
        """Prepare the connection."""
        self.write(BANNER)

    def closed(self) -> None:
        """Stop pending sends."""
        self._stop_timer()

    def data_received(self, data: bytes) -> None:
        """Process received characters."""
        if self._mute():
            return
        self._stop_timer()
        for character in data.decode("latin-1"):
            self._take(character)
        if self._command is not None:
            self._timer = asyncio.get_running_loop().call_later(COMMAND_TIMEOUT_S, self._timed_out)

    def _take(self, character: str) -> None:
        if character == "\n":
            return
        if character == "\r":
            command, self._command = self._command, None
            if command is not None:
                self.write(self._execute(command).encode("latin-1") + b"\r\n")
            return
        self.write(character.encode("latin-1"))
        if character == "$":
            self._command = ""
        elif self._command is not None:
            self._command += character

    def _timed_out(self) -> None:
        self._command = None
        self.write(b"$TIMEOUT\r\n")

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
