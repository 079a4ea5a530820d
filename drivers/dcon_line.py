"""A serial line of DCON (ADAM ASCII) modules: one request at a time, and no late reply taken for the next.

Replies to `#AA` carry no address. What keeps them apart is that only one request is out at any time, that the
input is flushed before each, and what is done after a timeout; see `DconLine`.

Sources: ICP DAS I-7018 and Advantech ADAM-4000 user's manuals; pySerial documentation.
"""

from __future__ import annotations

import asyncio
import contextlib
import termios
import time
from concurrent.futures import ThreadPoolExecutor

import serial

from drivers.dcon_text import decode, encode, shown
from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout, DriverError
from drivers.family import LineSettings

FAILURES_BEFORE_REST = 3
FIRST_REST_S = 0.25
LONGEST_REST_S = 4.0
DRAIN_TIMEOUTS = 0.5
"""How long the line is listened to after a failure before it is used again, in time limits of the line."""
DISTRUST_S = 5.0
"""How long after a failure every `#AA` is followed by a question whose reply carries the address, s."""
LONGEST_REPLY = 256
# A vanished adapter raises any of these, according to the call that meets it first.
_PORT_ERRORS = (serial.SerialException, OSError, termios.error, TypeError)


class DconLine:
    """Exchange commands and replies over one serial port, in a thread of its own.

    After a failure the line is drained for half the time limit; then `$AAM`, whose reply carries the address,
    must be answered before `#AA` is sent. For `DISTRUST_S` more each `#AA` is followed by it too. A module
    answers in order, so a reply too many before the one with the address means that a late one has come
    between, and both are discarded.

    A module that failed three times rests for 0.25 s, doubling up to 4 s, so that it does not take the
    others' time.

    Parameters
    ----------
    settings : LineSettings
        Its table of the configuration; `port` is needed.
    """

    def __init__(self, settings: LineSettings) -> None:
        self._settings = settings
        self._executor: ThreadPoolExecutor | None = None
        self._port: serial.Serial | None = None
        self._closed = False
        self._unsynchronised = False
        self._drain_until_s = 0.0
        self._distrust_until_s = 0.0
        self._failures: dict[str, int] = {}
        self._rest_until_s: dict[str, float] = {}

    @property
    def settings(self) -> LineSettings:
        """Its table of the configuration."""
        return self._settings

    async def exchange(self, device: str, command: str, *, checksum: bool, probe: bool = False) -> str:
        """Send a command and return its reply, without checksum and CR.

        Parameters
        ----------
        device : str
            Name of the device, for errors.
        command : str
            Lead, two hex digits of the address, and the rest; `#AA` or `$AA...`.
        checksum : bool
            Whether command and reply carry a checksum.
        probe : bool
            Whether the module may well not know the command: silence then does not count as its failure.

        Raises
        ------
        DeviceTimeout
            If no reply came in time, or the module rests after failures.
        DeviceGarbled
            If what came is no reply to this command.
        DeviceRefused
            If the module answered `?AA`.
        DeviceDisconnected
            If the port is gone or cannot be opened, or the line has been closed.
        """
        if self._closed:
            raise DeviceDisconnected(device, "its line has been closed")
        rest_s = self._rest_until_s.get(command[1:3], 0.0) - time.monotonic()
        if rest_s > 0.0:
            count = self._failures[command[1:3]]
            raise DeviceTimeout(device, f"failed {count} times in a row, next attempt in {rest_s:.2f} s")
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, thread_name_prefix=f"dcon-{self._settings.name}")
        job = self._executor.submit(self._work, device, command, checksum, probe)
        return await asyncio.wrap_future(job)

    async def close(self) -> None:
        """Release the port and the thread. May be called twice."""
        self._closed = True
        executor, self._executor = self._executor, None
        if executor is None:
            return
        with contextlib.suppress(*_PORT_ERRORS):
            if self._port is not None:
                self._port.cancel_read()
        await asyncio.wrap_future(executor.submit(self._close_port))
        executor.shutdown(wait=True, cancel_futures=True)

    # Everything below runs in the line's thread.

    def _work(self, device: str, command: str, summed: bool, probe: bool) -> str:
        address = command[1:3]
        if self._closed:
            raise DeviceDisconnected(device, "its line has been closed")
        try:
            reply = self._conversation(device, command, summed)
        except _PORT_ERRORS as error:
            self._close_port()
            raise DeviceDisconnected(device, f"port {self._settings.port}: {error}") from error
        except DeviceRefused:
            self._failures.pop(address, None)
            raise
        except DeviceDisconnected:
            raise
        except DriverError:
            now_s = time.monotonic()
            self._unsynchronised = True
            self._drain_until_s = now_s + DRAIN_TIMEOUTS * self._settings.timeout_s
            self._distrust_until_s = now_s + DISTRUST_S
            if not probe:
                self._count_failure(address, now_s)
            raise
        self._failures.pop(address, None)
        self._rest_until_s.pop(address, None)
        return reply

    def _count_failure(self, address: str, now_s: float) -> None:
        count = self._failures.get(address, 0) + 1
        self._failures[address] = count
        if count >= FAILURES_BEFORE_REST:
            doublings = min(count - FAILURES_BEFORE_REST, 10)
            self._rest_until_s[address] = now_s + min(FIRST_REST_S * 2.0**doublings, LONGEST_REST_S)

    def _conversation(self, device: str, command: str, summed: bool) -> str:
        port = self._opened(device)
        self._drain(port)
        deadline_s = time.monotonic() + self._settings.timeout_s
        values = command.startswith("#")
        ask_name = f"${command[1:3]}M"
        if values and self._unsynchronised:
            self._ask(port, device, ask_name, summed, deadline_s)
            self._unsynchronised = False
        reply, _ = self._ask(port, device, command, summed, deadline_s)
        if values and time.monotonic() < self._distrust_until_s:
            _, alien = self._ask(port, device, ask_name, summed, deadline_s, flush=False)
            if alien:
                raise DeviceGarbled(device, f"{command} got more than one reply: one of them was late")
        if reply.startswith("?"):
            raise DeviceRefused(device, f"{command} is refused: {shown(reply)}")
        return reply

    def _ask(
        self,
        port: serial.Serial,
        device: str,
        command: str,
        summed: bool,
        deadline_s: float,
        *,
        flush: bool = True,
    ) -> tuple[str, int]:
        """Return the reply, and how many lines came before it that belong to something else."""
        if flush:
            port.reset_input_buffer()
        port.write(encode(command, summed=summed))
        address = command[1:3]
        expected = (">", f"?{address}") if command.startswith("#") else (f"!{address}", f"?{address}")
        alien = 0
        buffer = b""
        while True:
            line, mark, rest = buffer.partition(b"\r")
            if not mark:
                buffer += self._receive(port, device, command, deadline_s)
                if len(buffer) > LONGEST_REPLY and b"\r" not in buffer:
                    raise DeviceGarbled(device, f"{command}: {len(buffer)} characters without an end")
                continue
            buffer = rest
            text = decode(device, line, summed=summed)
            if text.startswith(expected):
                return text, alien
            if not text.startswith((">", "!", "?")):
                raise DeviceGarbled(device, f"{command}: reply {shown(text)}")
            # A sound reply to something else: late, and not this command's.
            alien += 1

    def _receive(self, port: serial.Serial, device: str, command: str, deadline_s: float) -> bytes:
        left_s = deadline_s - time.monotonic()
        if left_s <= 0.0 or self._closed:
            raise DeviceTimeout(device, f"no answer to {command} within {self._settings.timeout_s:g} s")
        port.timeout = left_s
        first: bytes = port.read(1)
        more: bytes = port.read(min(port.in_waiting, LONGEST_REPLY)) if first else b""
        return first + more

    def _drain(self, port: serial.Serial) -> None:
        while not self._closed and (left_s := self._drain_until_s - time.monotonic()) > 0.0:
            port.timeout = left_s
            port.read(LONGEST_REPLY)

    def _opened(self, device: str) -> serial.Serial:
        if self._port is None:
            settings = self._settings
            if settings.port is None:
                raise DeviceDisconnected(device, f"line {settings.name} has no port")
            self._port = serial.Serial(
                settings.port,
                settings.baudrate,
                parity=settings.parity,
                stopbits=settings.stopbits,
                timeout=settings.timeout_s,
                write_timeout=settings.timeout_s,
                exclusive=True,
            )
        return self._port

    def _close_port(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(*_PORT_ERRORS):
                port.close()
