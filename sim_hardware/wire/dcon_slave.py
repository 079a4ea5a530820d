"""Answers of one module to DCON (ADAM ASCII) commands.

Sources: ICP DAS I-7018 and Advantech ADAM-4000 user's manuals.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from sim_hardware.wire.dcon_text import DISABLED_TEXT, FORMAT_BITS, DataFormat, DconModule, seven, value_text
from sim_hardware.wire.module import RefusalError

BAUD_CODES = {1200: 3, 2400: 4, 4800: 5, 9600: 6, 19200: 7, 38400: 8, 57600: 9, 115200: 10}
CHECKSUM_BIT = 0x40
FILTER_50HZ_BIT = 0x80
_CONFIGURE = re.compile(r"([0-9A-F]{2})([0-9A-F]{2})([0-9A-F]{2})([0-9A-F]{2})")
_SET_CHANNEL_TYPE = re.compile(r"7C([0-9A-F])R([0-9A-F]{2})")
_READ_CHANNEL_TYPE = re.compile(r"8C([0-9A-F])")


class _NotAllowedError(Exception):
    """The command is understood but not allowed: `?AA`."""


@dataclass(slots=True, kw_only=True)
class DconSettings:
    """Settings of one module in DCON mode.

    Parameters
    ----------
    data_format : {"engineering", "percent", "hex"}
        Format of the values.
    checksum : bool
        Whether commands must and replies do carry a checksum.
    baud : int
        Baud rate reported by `$AA2`, 1/s.
    filter_50hz : bool
        Bit 7 of the format byte.
    init_grounded : bool
        Whether the INIT* pin is grounded, without which neither checksum nor baud rate can be changed.
    """

    data_format: DataFormat = "engineering"
    checksum: bool = False
    baud: int = 9600
    filter_50hz: bool = False
    init_grounded: bool = False

    @property
    def format_byte(self) -> int:
        """The FF of `$AA2` and `%AANNTTCCFF`."""
        flags = (CHECKSUM_BIT if self.checksum else 0) | (FILTER_50HZ_BIT if self.filter_50hz else 0)
        return FORMAT_BITS[self.data_format] | flags


class DconSlave:
    """Answer commands for one module; its address is that of the call.

    Parameters
    ----------
    module : DconModule
        What measures.
    settings : DconSettings
        Format, checksum and so on.
    """

    def __init__(self, module: DconModule, settings: DconSettings) -> None:
        self.module = module
        self.settings = settings
        self.new_address: int | None = None

    def reply(self, lead: str, address: str, rest: str) -> str | None:
        """Return the reply without checksum and CR; None where the module keeps silent."""
        self.module.begin()
        try:
            if lead == "#":
                return self._read(rest)
            if lead == "%":
                return self._configure(rest)
            return self._status(address, rest) if lead == "$" else None
        except _NotAllowedError:
            return f"?{address}"

    def _read(self, rest: str) -> str | None:
        if not rest:
            values = (self._value(i) for i in range(self.module.channels))
            return ">" + "".join(values)
        if len(rest) != 1 or not rest.isalnum():
            return None
        return ">" + self._value(self._channel(rest))

    def _value(self, channel: int) -> str:
        if not self.module.enabled >> channel & 1:
            return DISABLED_TEXT
        return value_text(self.module, channel, self.settings.data_format)

    def _channel(self, text: str) -> int:
        if text not in "0123456789"[: self.module.channels]:
            raise _NotAllowedError
        return int(text)

    def _status(self, address: str, rest: str) -> str | None:
        module, settings = self.module, self.settings
        if rest == "2":
            code = module.ranges[0].code
            return f"!{address}{code:02X}{BAUD_CODES[settings.baud]:02X}{settings.format_byte:02X}"
        if rest == "3":
            return ">" + seven(module.cjc_degc, 1)
        if rest == "6":
            return f"!{address}{module.enabled:02X}"
        if rest == "B":
            return f"!{address}{sum(module.bad(i) << i for i in range(module.channels)):02X}"
        if rest in {"M", "F"}:
            return f"!{address}{module.name if rest == 'M' else module.firmware}"
        if re.fullmatch(r"5[0-9A-F]{2}", rest):
            module.enabled = int(rest[1:], 16)
            return f"!{address}"
        return self._channel_type(address, rest) if module.type_per_channel else None

    def _channel_type(self, address: str, rest: str) -> str | None:
        read, write = _READ_CHANNEL_TYPE.fullmatch(rest), _SET_CHANNEL_TYPE.fullmatch(rest)
        if read:
            channel = self._channel(read[1])
            return f"!{address}C{channel}R{self.module.ranges[channel].code:02X}"
        if write:
            self._set_type(int(write[2], 16), self._channel(write[1]))
            return f"!{address}"
        return None

    def _configure(self, rest: str) -> str | None:
        match = _CONFIGURE.fullmatch(rest)
        if match is None:
            return None
        new, code, baud, flags = (int(group, 16) for group in match.groups())
        settings = self.settings
        formats = [name for name, bits in FORMAT_BITS.items() if bits == flags & 0x03]
        bauds = [rate for rate, number in BAUD_CODES.items() if number == baud]
        if not formats or not bauds:
            raise _NotAllowedError
        wants_checksum = bool(flags & CHECKSUM_BIT)
        if not settings.init_grounded and (wants_checksum != settings.checksum or bauds[0] != settings.baud):
            raise _NotAllowedError
        self._set_type(code, None)
        settings.data_format, settings.baud, settings.checksum = formats[0], bauds[0], wants_checksum
        settings.filter_50hz = bool(flags & FILTER_50HZ_BIT)
        self.new_address = new
        return f"!{new:02X}"

    def _set_type(self, code: int, channel: int | None) -> None:
        try:
            self.module.set_type(code, channel)
        except RefusalError:
            raise _NotAllowedError from None
