"""A gate in front of a WebSocket server: pages of other sites cannot connect.

A browser lets every page connect to loopback and states the page's origin in the request. The library of Foxglove does
not check it, so the gate does, and then passes the bytes on.
"""

from __future__ import annotations

import selectors
import socket
import socketserver
import threading
from collections.abc import Collection
from contextlib import suppress
from typing import Any

from compensator.watch.clients import CONNECTIONS, REQUEST_S, Within

#: Origins of the viewer itself: its page, and its desktop application, whose page is a file.
VIEWERS = ("https://app.foxglove.dev", "file://")
#: Largest head of a request, bytes.
HEAD_BYTES = 16_384
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_END = b"\r\n\r\n"


def permitted(head: bytes, origins: Collection[str]) -> bool:
    r"""Return whether a request may pass: no page sent it, or the page of a viewer.

    Examples
    --------
    >>> permitted(b"GET / HTTP/1.1\r\nOrigin: https://elsewhere.example\r\n\r\n", VIEWERS)
    False
    >>> permitted(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", VIEWERS)
    True
    """
    lines = head.decode("latin-1").split("\r\n")[1:]
    found = [value.strip() for name, _, value in (line.partition(":") for line in lines) if name.lower() == "origin"]
    return len(found) < 2 and all(origin in origins for origin in found)


class OriginGate(socketserver.ThreadingTCPServer):
    """Passes connections on to a server on loopback. Use it as a context manager.

    Parameters
    ----------
    address : tuple of (str, int)
        Where it listens.
    inner : tuple of (str, int)
        The server.
    origins : collection of str
        Origins of pages that may connect.

    Raises
    ------
    OSError, OverflowError
        If the address cannot be used.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], inner: tuple[str, int], origins: Collection[str]) -> None:
        self.inner, self.origins = inner, frozenset(origins)
        self.free = threading.BoundedSemaphore(CONNECTIONS)
        self.ended = threading.Event()
        super().__init__(address, _Passing)
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), name="origin gate")

    def __enter__(self) -> OriginGate:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.shutdown()
        self._thread.join()
        self.server_close()

    @property
    def port(self) -> int:
        """Port on which it listens."""
        return int(self.server_address[1])

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Drop a connection that fails: the viewer connects again."""


class _Passing(socketserver.BaseRequestHandler):
    """One connection."""

    server: OriginGate

    def handle(self) -> None:
        """Check the head, then pass bytes on in both directions until one side ends."""
        if not self.server.free.acquire(blocking=False):
            return
        try:
            head = self._head()
            if _END not in head:
                return
            if not permitted(head.partition(_END)[0], self.server.origins):
                self.request.sendall(_REFUSED)
                return
            with socket.create_connection(self.server.inner, timeout=REQUEST_S) as inner:
                inner.sendall(head)
                self._pass(inner)
        finally:
            self.server.free.release()

    def _head(self) -> bytes:
        within = Within(self.request, REQUEST_S)
        head = b""
        with suppress(OSError):
            while _END not in head and len(head) < HEAD_BYTES and (more := within.read(4096)):
                head += more
        return head

    def _pass(self, inner: socket.socket) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self.request, selectors.EVENT_READ, inner)
            selector.register(inner, selectors.EVENT_READ, self.request)
            while not self.server.ended.is_set():
                for key, _ in selector.select(0.5):
                    source: Any = key.fileobj
                    data = source.recv(65_536)
                    if not data:
                        return
                    key.data.sendall(data)
