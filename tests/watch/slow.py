"""A client that sends its request byte after byte."""

from __future__ import annotations

import select
import socket
import time


def drip(connection: socket.socket, at_most_s: float) -> None:
    """Send a byte each hundredth of a second until the server ends the connection, which it must."""
    began = time.monotonic()
    while not select.select([connection], [], [], 0.01)[0]:
        assert time.monotonic() - began < at_most_s + 30.0, "still held"
        try:
            connection.sendall(b"x")
        except ConnectionError:
            return
    try:
        assert connection.recv(100) == b""
    except ConnectionError:
        return
