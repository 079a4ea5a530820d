"""A rack that must leave nothing behind, and clients that know nothing but bytes."""

import os
import select
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_hardware.wire import Rack

PATIENCE_S = 10.0


class Wire:
    """Raw bytes to and from a socket or a terminal."""

    def __init__(self, fd, close):
        self.fd, self.close = fd, close

    def send(self, data):
        os.write(self.fd, bytes.fromhex(data) if isinstance(data, str) else data)

    def receive(self, size, within_s=PATIENCE_S):
        """Return `size` bytes, or what came until time or the connection ended."""
        data = b""
        while len(data) < size and select.select([self.fd], [], [], within_s)[0]:
            piece = os.read(self.fd, size - len(data))
            if not piece:
                break
            data += piece
        return data

    def once(self):
        """Return what one read gives."""
        assert select.select([self.fd], [], [], PATIENCE_S)[0]
        return os.read(self.fd, 4096)

    def in_pieces(self, faults, ask, sizes):
        """Ask for a reply that is split into pieces of these sizes, and return what each read gives.

        A starved computer may read two pieces at once: only then is the pause between them made longer.
        """
        pieces = []
        for pause_s in (0.02, 0.2, 1.5):
            faults.set("split", times=1, pieces=len(sizes), pause_s=pause_s)
            ask()
            pieces = [self.once()]
            while pieces[-1] and sum(map(len, pieces)) < sum(sizes):
                pieces.append(self.once())
            if [len(piece) for piece in pieces] == sizes:
                break
        return pieces

    def ask(self, data, size):
        self.send(data)
        return self.receive(size).hex()

    def line(self, command):
        """Send a text and return the reply up to CR."""
        self.send(command.encode())
        reply = b""
        while not reply.endswith(b"\r"):
            piece = self.receive(1)
            assert piece, f"no answer to {command!r}, only {reply!r}"
            reply += piece
        return reply.decode()


def _open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.fixture
def rack() -> Iterator[Rack]:
    files, threads = _open_files(), threading.active_count()
    with Rack() as running:
        yield running
    assert threading.active_count() <= threads
    # What an earlier test left open may be collected meanwhile.
    assert _open_files() <= files


@pytest.fixture
def wires(rack):
    """Give a function that opens a TCP port or a terminal; what it opened is closed first."""
    opened = []

    def connect(where, port=None):
        if port is None:
            fd = os.open(where, os.O_RDWR | os.O_NOCTTY)
            wire = Wire(fd, lambda: os.close(fd))
        else:
            link = socket.create_connection((where, port), PATIENCE_S)
            link.setblocking(True)
            wire = Wire(link.fileno(), link.close)
        opened.append(wire)
        return wire

    yield connect
    for wire in opened:
        wire.close()


class Value:
    """A source whose value the test changes."""

    def __init__(self, value=0.0):
        self.value = value

    def __call__(self):
        return self.value


@pytest.fixture
def value():
    return Value
