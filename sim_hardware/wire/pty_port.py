"""A serial line made of a pseudo-terminal, with a stable path and the pace of a real line."""

from __future__ import annotations

import asyncio
import os
import tempfile
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path

BITS_PER_CHARACTER = 10
"""Start bit, eight data bits, stop bit."""
CHUNK = 4096


class PtyPort:
    """The far end of a serial line.

    The near end, for the program under test, is a pseudo-terminal that a symbolic link names. The link stays
    where it is when the line is unplugged and comes back as another pseudo-terminal.

    Parameters
    ----------
    received : callable
        Given what arrives, in the loop's thread.
    baud : float, optional
        Pace at which characters leave, 1/s times ten; without it they leave at once. A pseudo-terminal
        itself knows no baud rate.
    """

    def __init__(self, received: Callable[[bytes], None], baud: float | None = None) -> None:
        self._received = received
        self._character_s = None if baud is None else BITS_PER_CHARACTER / baud
        self._folder: Path | None = None
        self._master: int | None = None
        self._slave: int | None = None
        self._queue: deque[int] = deque()
        self._pacer: asyncio.TimerHandle | None = None
        self._next_s = 0.0

    @property
    def path(self) -> str:
        """Path to open, as of a serial port.

        Raises
        ------
        RuntimeError
            If the port has not been opened.
        """
        if self._folder is None:
            raise RuntimeError("the line is not open")
        return str(self._folder / "tty")

    @property
    def plugged(self) -> bool:
        """Whether there is a pseudo-terminal behind the path."""
        return self._master is not None

    def open(self) -> None:
        """Make the folder with the link, and plug the line in."""
        self._folder = Path(tempfile.mkdtemp(prefix="sim-line-"))
        self.plug()

    def close(self) -> None:
        """Unplug, and remove the folder."""
        self.unplug()
        if self._folder is not None:
            self._folder.rmdir()
            self._folder = None

    def plug(self) -> None:
        """Put a pseudo-terminal behind the path."""
        if self._master is not None:
            return
        # The slave's descriptor stays open: without it the master gets EIO whenever the client closes.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        link = Path(self.path)
        new = link.with_name("new")
        new.symlink_to(os.ttyname(self._slave))
        new.replace(link)
        asyncio.get_running_loop().add_reader(self._master, self._read)

    def unplug(self) -> None:
        """Remove the pseudo-terminal: programs that have it open get a hang-up, the path leads nowhere."""
        if self._master is None or self._slave is None:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        self._queue.clear()
        if self._pacer is not None:
            self._pacer.cancel()
            self._pacer = None
        Path(self.path).unlink()
        os.close(self._slave)
        os.close(self._master)
        self._master = self._slave = None

    def write(self, data: bytes) -> None:
        """Send characters, each in its time if the line has a pace."""
        if self._character_s is None:
            self._put(data)
            return
        self._queue.extend(data)
        if self._pacer is None and self._queue:
            loop = asyncio.get_running_loop()
            self._next_s = loop.time() + self._character_s
            self._pacer = loop.call_at(self._next_s, self._pace)

    def _pace(self) -> None:
        assert self._character_s is not None
        loop = asyncio.get_running_loop()
        due = bytearray()
        # A late timer catches up, so that a frame takes as long as on the wire whatever the load.
        while self._queue and self._next_s <= loop.time():
            due.append(self._queue.popleft())
            self._next_s += self._character_s
        self._put(bytes(due))
        self._pacer = loop.call_at(self._next_s, self._pace) if self._queue else None

    def _put(self, data: bytes) -> None:
        if self._master is None or not data:
            return
        try:
            os.write(self._master, data)
        except BlockingIOError:
            # No program reads and the terminal's buffer is full: on a real line these characters are lost.
            return

    def _read(self) -> None:
        assert self._master is not None
        try:
            data = os.read(self._master, CHUNK)
        except BlockingIOError:
            return
        if data:
            self._received(data)
