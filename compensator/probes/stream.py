"""Connections to controls that print: TCP and serial, and which bytes were waiting before they were read."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import termios
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import serial

from compensator.probes.printed import PrintedProbes
from compensator.probes.reports import Report, lost
from compensator.probes.sender import pause
from compensator.probes.settings import Dprnt, address_of
from compensator.receiver.client import monotonic_s

_CHUNK = 4096
#: How often the loop shows that it runs, s.
_BEAT_S = 0.2
#: A dead network is noticed within this, s: idle time, interval and number of TCP's probes. What a control prints
#: meanwhile arrives later, which nothing in the line would show.
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 2), (socket.TCP_KEEPINTVL, 1), (socket.TCP_KEEPCNT, 3))
_CONNECT_S = 5.0


class Freshness:
    """Knows whether bytes that are read now have just arrived.

    They have not where the connection is new (a converter or a control sends what it kept), or where this program
    stood still. Either lasts until nothing has arrived for `settle_s`.

    Parameters
    ----------
    settle_s, pause_s : float
        As in `Dprnt`.
    """

    def __init__(self, settle_s: float, pause_s: float) -> None:
        self._settle_s, self._pause_s = settle_s, pause_s
        self._alive_s = 0.0
        self._quiet_s: float | None = None

    def connected(self, now_s: float) -> None:
        """Begin a new connection."""
        self._alive_s = self._quiet_s = now_s

    def beat(self, now_s: float) -> None:
        """Note that the program runs."""
        if now_s - self._alive_s > self._pause_s:
            self._quiet_s = now_s
        self._alive_s = now_s

    def is_late(self, now_s: float) -> bool:
        """Return whether bytes that are read now may have been waiting."""
        self.beat(now_s)
        if self._quiet_s is None:
            return False
        if now_s - self._quiet_s > self._settle_s:
            self._quiet_s = None
            return False
        self._quiet_s = now_s
        return True


class Stream:
    """Reads a control's line, and connects again when it is lost.

    Parameters
    ----------
    settings : Dprnt
        The control.
    probes : PrintedProbes
        What its bytes go to.
    report : callable
        Called with a line when the control is lost and found.
    clock, utc_ns : callable, optional
        Monotonic clock, s, and wall clock, ns.
    """

    def __init__(
        self,
        settings: Dprnt,
        probes: PrintedProbes,
        report: Report,
        *,
        clock: Callable[[], float] = monotonic_s,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._settings = settings
        self._probes = probes
        self._report = report
        self._clock, self._utc_ns = clock, utc_ns
        self._trouble = ""

    async def run(self, stop: asyncio.Event) -> None:
        """Read until `stop` is set."""
        while not stop.is_set():
            try:
                async with _opened(self._settings) as reader:
                    self._report(f"{self._settings.name}: connected")
                    self._trouble = ""
                    await self._read(reader, stop)
            except (OSError, ValueError, termios.error, TimeoutError) as error:
                self._lost(str(error) or type(error).__name__)
            await pause(stop, self._settings.retry_s)

    async def _read(self, reader: asyncio.StreamReader, stop: asyncio.Event) -> None:
        freshness = Freshness(self._settings.settle_s, self._settings.pause_s)
        freshness.connected(self._clock())
        waits = asyncio.ensure_future(stop.wait())
        read: asyncio.Future[bytes] | None = None
        try:
            while not stop.is_set():
                read = read or asyncio.ensure_future(reader.read(_CHUNK))
                await asyncio.wait((read, waits), timeout=_BEAT_S, return_when=asyncio.FIRST_COMPLETED)
                if not read.done():
                    freshness.beat(self._clock())
                    continue
                data, read = read.result(), None
                if not data:
                    raise ConnectionError("the connection was closed")
                now_s = self._clock()
                self._probes.receive(data, now_s, self._utc_ns(), late=freshness.is_late(now_s))
        finally:
            waits.cancel()
            if read is not None:
                read.cancel()
            await asyncio.gather(*(task for task in (waits, read) if task is not None), return_exceptions=True)
            self._probes.disconnected()

    def _lost(self, why: str) -> None:
        if why != self._trouble:
            self._trouble = why
            self._report(lost(self._settings.name, why))


@asynccontextmanager
async def _opened(settings: Dprnt) -> AsyncIterator[asyncio.StreamReader]:
    if settings.address:
        host, port = address_of(settings.address)
        reader, writer = await asyncio.wait_for(asyncio.open_connection(host, port), _CONNECT_S)
        try:
            connected: socket.socket = writer.get_extra_info("socket")
            connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for option, value in _KEEPALIVE:
                connected.setsockopt(socket.IPPROTO_TCP, option, value)
            yield reader
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
        return
    # 7 bits and parity are 8 bits on the line; `Lines` checks the parity. XON and XOFF are characters here.
    with serial.Serial(settings.port, baudrate=settings.baud, timeout=0, exclusive=True) as port:
        try:
            yield _serial_reader(port)
        finally:
            asyncio.get_running_loop().remove_reader(port.fileno())


def _serial_reader(port: serial.Serial) -> asyncio.StreamReader:
    """Return a reader of a serial port, filled by the event loop."""
    reader = asyncio.StreamReader()
    loop = asyncio.get_running_loop()

    def readable() -> None:
        try:
            data = os.read(port.fileno(), _CHUNK)
        except BlockingIOError:
            return
        except OSError as error:
            loop.remove_reader(port.fileno())
            reader.set_exception(error)
            return
        if data:
            reader.feed_data(data)
        else:
            loop.remove_reader(port.fileno())
            reader.feed_eof()

    loop.add_reader(port.fileno(), readable)
    return reader
