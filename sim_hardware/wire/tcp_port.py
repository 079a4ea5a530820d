"""A listening TCP port that can be closed and reopened."""

from __future__ import annotations

import asyncio
import select
import socket
from collections.abc import Callable

LOOPBACK = "127.0.0.1"


class Connection(asyncio.Protocol):
    """One accepted connection; subclasses handle what is received."""

    def __init__(self, port: TcpPort) -> None:
        self._port = port
        self.transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Register the connection, or drop it if the port is refusing."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self._port.connections[self] = None
        if not self._port.listening:
            transport.abort()
            return
        self.opened()

    def connection_lost(self, error: Exception | None) -> None:
        """Unregister the connection."""
        self._port.connections.pop(self, None)
        self.closed()

    def opened(self) -> None:
        """Handle a new connection."""

    def closed(self) -> None:
        """Handle a lost connection."""

    def write(self, data: bytes) -> None:
        """Send bytes, if the peer is still there."""
        if self.transport is not None and data and not self.transport.is_closing():
            self.transport.write(data)


class TcpPort:
    """Listen on the loopback address.

    Parameters
    ----------
    port : int
        Port number; 0 takes a free one, which is kept over `refuse` and `listen`.
    accept : callable
        Makes the protocol of a new connection.
    """

    def __init__(self, port: int, accept: Callable[[TcpPort], Connection]) -> None:
        self.host = LOOPBACK
        self.port = port
        self.listening = False
        # In order of arrival.
        self.connections: dict[Connection, None] = {}
        self._accept = accept
        self._server: asyncio.Server | None = None
        self._placeholder: socket.socket | None = None

    def pending(self) -> bool:
        """Return whether a client has connected that has not been accepted yet."""
        sockets = () if self._server is None else self._server.sockets
        return bool(sockets) and bool(select.select(sockets, (), (), 0)[0])

    async def listen(self) -> None:
        """Accept connections. Does nothing if the port does so already."""
        if self.listening:
            return
        bound = self._placeholder or self._bind()
        self._placeholder = None
        self.port = bound.getsockname()[1]
        self.listening = True
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: self._accept(self), sock=bound)

    async def refuse(self) -> None:
        """Drop all connections and refuse new ones, keeping the port number reserved."""
        if self.listening:
            await self.close()
            # Bound but not listening: the kernel answers a connection request with a reset.
            self._placeholder = self._bind()

    async def close(self) -> None:
        """Drop all connections and release the port."""
        self.listening = False
        if self._placeholder is not None:
            self._placeholder.close()
            self._placeholder = None
        server, self._server = self._server, None
        if server is not None:
            # First only stop accepting: a server that is closed while a connection is on its way from `accept` to
            # `connection_made`, a few turns of the loop, forgets the connection and leaves it open.
            loop = asyncio.get_running_loop()
            for listener in server.sockets:
                loop.remove_reader(listener.fileno())
            for _ in range(4):
                await asyncio.sleep(0)
            server.close()
        for connection in tuple(self.connections):
            if connection.transport is not None:
                connection.transport.abort()
        while self.connections:
            await asyncio.sleep(0)

    def _bind(self) -> socket.socket:
        bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((self.host, self.port))
        return bound
