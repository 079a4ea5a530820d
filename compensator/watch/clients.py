"""What one client may take of a server: a time for its request, and a share of the connections."""

from __future__ import annotations

import io
import socket
from time import monotonic
from typing import Any

#: Time for a whole request, and for its answer, s.
REQUEST_S = 5.0
#: Connections at once.
CONNECTIONS = 50


class Within(io.RawIOBase):
    """What a client sends within a time in all: who sends byte after byte holds no place for longer.

    Parameters
    ----------
    connection : socket.socket
        The connection; its own time-out, s, becomes the same time.
    seconds : float
        The time, s, from now on. After it a read raises TimeoutError.
    """

    def __init__(self, connection: socket.socket, seconds: float) -> None:
        self._connection, self._seconds, self._end = connection, seconds, monotonic() + seconds

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read what has come, waiting for something until the time is over."""
        left = self._end - monotonic()
        if left <= 0.0:
            raise TimeoutError(f"no whole request within {self._seconds:g} s")
        self._connection.settimeout(left)
        try:
            return self._connection.recv_into(buffer)
        finally:
            self._connection.settimeout(self._seconds)
