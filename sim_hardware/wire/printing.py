"""A control that prints with `POPEN`, `DPRNT[…]` and `PCLOS`, over TCP or on a pseudo-terminal.

Sources: Haas mill operator's manual 96-8000 (May 2010, formatted output; RS-232 and DC codes). Fanuc and Mitsubishi
from memory: blanks for leading zeros come after the sign, and a parameter suppresses them.
"""

from __future__ import annotations

import random
import re
from collections.abc import Mapping
from decimal import ROUND_HALF_UP, Decimal
from typing import Literal

from sim_hardware.wire.pty_port import PtyPort
from sim_hardware.wire.rack import Server
from sim_hardware.wire.tcp_port import Connection, TcpPort

Maker = Literal["fanuc", "fanuc-no-blanks", "haas", "mitsubishi"]
XON, PUNCH_ON, XOFF, PUNCH_OFF = b"\x11", b"\x12", b"\x13", b"\x14"
_LINE_ENDS = {"fanuc": b"\n", "fanuc-no-blanks": b"\n\r\r", "haas": b"\r", "mitsubishi": b"\r\n"}
_PART = re.compile(r"#(\d+)\[(\d)(\d)\]")
_LONGEST_FIELD = 8


def formatted(maker: Maker, template: str, variables: Mapping[int, float | None]) -> str:
    """Return what `DPRNT[template]` prints, without the line end.

    Parameters
    ----------
    maker : str
        Whose control it is.
    template : str
        Letters, digits, + - / and * for a blank, and variables such as `#101[43]`: 4 places before and 3 after the
        point.
    variables : mapping of int to float or None
        Their values; None is a vacant one.

    Raises
    ------
    ValueError
        If the control would refuse the block.

    Examples
    --------
    >>> formatted("fanuc", "X#2[53]*Y#5[53]*T#30[20]", {2: 128.47398, 5: -91.2, 30: 123.456})
    'X  128.474 Y-   91.200 T123'
    >>> formatted("haas", "X#1[44]*Z#1[03]*T#1[40]", {1: 1.5436})
    'X   1.5436 Z1.544 T   2'
    """
    if not re.fullmatch(r"[A-Z0-9+\-/*. ]*", _PART.sub("", template)):
        raise ValueError(f"{template}: characters that DPRNT does not print")
    return _PART.sub(lambda part: _field(maker, part, variables), template.replace("*", " "))


def _field(maker: Maker, part: re.Match[str], variables: Mapping[int, float | None]) -> str:
    number, whole, decimals = (int(group) for group in part.groups())
    if not 0 < whole + decimals <= _LONGEST_FIELD:
        raise ValueError(f"{part.group()}: more than {_LONGEST_FIELD} places, or none")
    value = variables[number]
    rounded = Decimal(str(value or 0.0)).quantize(Decimal(1).scaleb(-decimals), ROUND_HALF_UP)
    digits = f"{abs(rounded):.{decimals}f}"
    sign = "-" if rounded < 0 else ""
    blanks = " " * max(0, whole - len(digits.partition(".")[0]))
    point = "." if decimals == 0 and maker == "mitsubishi" else ""
    if maker == "fanuc-no-blanks":
        return f"{sign}{digits}"
    return f"{blanks}{sign}{digits}{point}" if maker == "haas" else f"{sign}{blanks}{digits}{point}"


def even(data: bytes) -> bytes:
    """Return characters of 7 bits with even parity in the eighth, as ISO code has it."""
    return bytes(byte | 0x80 if byte.bit_count() % 2 else byte for byte in data)


class _Client(Connection):
    def __init__(self, port: TcpPort, control: PrintingControl) -> None:
        super().__init__(port)
        self._control = control

    def opened(self) -> None:
        self._control._flush()

    def data_received(self, data: bytes) -> None:
        """Ignore what a client sends."""


class PrintingControl(Server):
    """A control, or a serial converter behind it.

    Parameters
    ----------
    maker : str
        Whose control it is.
    serial : bool
        On a pseudo-terminal instead of TCP.
    parity : bool
        Whether characters have 7 bits and even parity.
    keeps : bool
        Whether what is printed while no client is connected is kept, as serial converters do, or lost.
    port : int
        TCP port; 0 takes a free one.
    """

    def __init__(
        self, maker: Maker = "fanuc", *, serial: bool = False, parity: bool = False, keeps: bool = False, port: int = 0
    ) -> None:
        super().__init__()
        self.maker: Maker = maker
        self.keeps = keeps
        self._parity = parity
        self._random = random.Random(7)
        self._kept = b""
        self._tcp = None if serial else TcpPort(port, lambda tcp: _Client(tcp, self))
        self._pty = PtyPort(lambda _: None) if serial else None

    @property
    def address(self) -> str:
        """`HOST:PORT`, or the path of the serial port."""
        if self._tcp is not None:
            return f"{self._tcp.host}:{self._tcp.port}"
        assert self._pty is not None
        return self._pty.path

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return 0 if self._tcp is None else len(self._tcp.connections)

    async def start(self) -> None:
        """Open the port."""
        if self._tcp is not None:
            await self._tcp.listen()
        if self._pty is not None:
            self._pty.open()

    async def stop(self) -> None:
        """Close the port."""
        if self._tcp is not None:
            await self._tcp.close()
        if self._pty is not None:
            self._pty.close()

    async def apply_faults(self) -> None:
        """There are no faults of this kind; `unplug` and `send` make them."""

    def run_macro(self, text: str, variables: Mapping[int, float | None]) -> None:
        """Run the printing blocks of a macro; other blocks are left out.

        Parameters
        ----------
        text : str
            One block on each line.
        variables : mapping of int to float or None
            Values of the variables.
        """
        for block in text.splitlines():
            words = block.strip().rstrip(";").strip()
            if words == "POPEN":
                self.send(PUNCH_ON + (b"%" + self.line_end if self.maker == "mitsubishi" else b""))
            elif words == "PCLOS":
                self.send((b"%" if self.maker == "mitsubishi" else b"") + PUNCH_OFF)
            elif words.startswith("DPRNT["):
                self.dprnt(words.removeprefix("DPRNT[").rpartition("]")[0], variables)

    def dprnt(self, template: str, variables: Mapping[int, float | None]) -> None:
        """Print one line."""
        self.send(formatted(self.maker, template, variables).encode("ascii") + self.line_end)

    @property
    def line_end(self) -> bytes:
        """What ends a line."""
        return _LINE_ENDS[self.maker]

    def noise(self, length: int) -> bytes:
        """Return random bytes, those of a disturbed or wrongly set line."""
        return self._random.randbytes(length)

    def send(self, data: bytes, *, plain: bool = False) -> None:
        """Send bytes; `plain` leaves the parity as it is."""
        if self._parity and not plain:
            data = even(data)

        async def write() -> None:
            self._write(data)

        self.rack.run(write())

    def unplug(self) -> None:
        """Drop the connections and refuse new ones, or pull the cable."""

        async def drop() -> None:
            if self._tcp is not None:
                await self._tcp.refuse()
            if self._pty is not None:
                self._pty.unplug()

        self.rack.run(drop())

    def plug(self) -> None:
        """Accept connections again."""

        async def accept() -> None:
            if self._tcp is not None:
                await self._tcp.listen()
            if self._pty is not None:
                self._pty.plug()

        self.rack.run(accept())

    def _write(self, data: bytes) -> None:
        if self._pty is not None:
            self._pty.write(data)
        elif self._tcp is not None and self._tcp.connections:
            for connection in tuple(self._tcp.connections):
                connection.write(data)
        elif self.keeps:
            self._kept += data

    def _flush(self) -> None:
        kept, self._kept = self._kept, b""
        if kept:
            self._write(kept)
