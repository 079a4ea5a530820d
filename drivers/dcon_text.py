"""Texts of the DCON (ADAM ASCII) protocol: checksum, splitting of replies, values in their three formats.

Sources: ICP DAS I-7018 and Advantech ADAM-4000 user's manuals; range tables from the ICP DAS
"ET-7000/PET-7000 Register Table" 1.0.3, appendix A, and the ADAM-4000 manual, appendix B.
"""

from __future__ import annotations

import re
from typing import Literal

from drivers.errors import DeviceGarbled
from drivers.reading import Quality, Reading

Format = Literal["engineering", "percent", "hex"]
Vendor = Literal["icpdas", "adam"]
Couple = Literal["J", "K", "T", "E", "R", "S", "B", "N", "C", "L", "M"]

FORMAT_BITS: dict[Format, int] = {"engineering": 0, "percent": 1, "hex": 2}
CHECKSUM_BIT = 0x40
TYPE_CODES: dict[Couple, int] = {
    "J": 0x0E, "K": 0x0F, "T": 0x10, "E": 0x11, "R": 0x12, "S": 0x13,
    "B": 0x14, "N": 0x15, "C": 0x16, "L": 0x17, "M": 0x18,
}  # fmt: skip
RANGES_DEGC: dict[Vendor, dict[Couple, tuple[float, float]]] = {
    "icpdas": {
        "J": (-210.0, 760.0), "K": (-270.0, 1372.0), "T": (-270.0, 400.0), "E": (-270.0, 1000.0),
        "R": (0.0, 1768.0), "S": (0.0, 1768.0), "B": (0.0, 1820.0), "N": (-270.0, 1300.0),
        "C": (0.0, 2320.0), "L": (-200.0, 800.0), "M": (-200.0, 100.0),
    },
    "adam": {
        "J": (0.0, 760.0), "K": (0.0, 1370.0), "T": (-100.0, 400.0), "E": (0.0, 1000.0),
        "R": (500.0, 1750.0), "S": (500.0, 1750.0), "B": (500.0, 1800.0),
    },
}  # fmt: skip
"""Limits of each thermocouple type, °C."""

DISABLED = " " * 7
OVER_CODES = frozenset({"+9999", "+9999.9"})
UNDER_CODES = frozenset({"-0000", "-9999", "-9999.9"})
MARGIN_DEGC = 1.0
_SIGNED = re.compile(r" {7}|[+-][0-9.]+")
_VALUE = re.compile(r"(?=.{7}\Z)[+-][0-9]+\.[0-9]*", re.ASCII)
_HEX = re.compile(r" {7}|[0-9A-F]{4}")


def checksum(text: str) -> str:
    """Return the two hex digits that go before the CR: the sum of all characters, modulo 256.

    Source: ICP DAS ZT-2005 manual, "DCON protocol".

    Examples
    --------
    >>> checksum("$012"), checksum("!01200600")
    ('B7', 'AA')
    """
    return f"{sum(text.encode('latin-1')) & 0xFF:02X}"


def encode(command: str, *, summed: bool) -> bytes:
    """Return the bytes of a command, with checksum if the module wants one, and CR."""
    return f"{command}{checksum(command) if summed else ''}\r".encode("latin-1")


def decode(device: str, line: bytes, *, summed: bool) -> str:
    """Return the text of a reply without checksum; `line` is without its CR.

    Raises
    ------
    DeviceGarbled
        If it has characters that no reply has, or the checksum is wrong.
    """
    text = line.decode("latin-1")
    if not text or not text.isascii() or not text.isprintable():
        raise DeviceGarbled(device, f"reply {shown(text)} is no DCON text")
    if not summed:
        return text
    if len(text) < 3 or checksum(text[:-2]) != text[-2:]:
        raise DeviceGarbled(device, f"reply {shown(text)} has a wrong checksum")
    return text[:-2]


def split_values(device: str, reply: str, *, count: int, data_format: Format) -> list[str | None]:
    """Split the reply to `#AA` into one text for each channel; None for a disabled one.

    The codes for out of range have five characters where a value has seven, so the cuts are at the signs.
    A text of any other length has lost a character and makes the whole reply worthless: which value the
    lost character belonged to is not known for sure.

    Parameters
    ----------
    device : str
        Name of the device, for the error.
    reply : str
        Reply without checksum, from its `>`.
    count : int
        Channels of the module.
    data_format : str
        Format of the values.

    Raises
    ------
    DeviceGarbled
        If it is no such reply, or not of `count` values.

    Examples
    --------
    >>> split_values("quill", ">+021.50+9999-0000       ", count=4, data_format="engineering")
    ['+021.50', '+9999', '-0000', None]
    """
    if not reply.startswith(">"):
        raise DeviceGarbled(device, f"reply {shown(reply)} does not start with '>'")
    body = reply[1:]
    parts = (_HEX if data_format == "hex" else _SIGNED).findall(body)
    if "".join(parts) != body:
        raise DeviceGarbled(device, f"reply {shown(reply)} is not made of values")
    if len(parts) != count:
        raise DeviceGarbled(device, f"reply {shown(reply)} has {len(parts)} values, expected {count}")
    if data_format != "hex":
        for part in parts:
            known = part == DISABLED or part in OVER_CODES or part in UNDER_CODES
            if not known and not _VALUE.fullmatch(part):
                raise DeviceGarbled(device, f"reply {shown(reply)}: {part!r} is not sign, 5 digits and point")
    return [None if part == DISABLED else part for part in parts]


def to_reading(text: str | None, *, couple: Couple, data_format: Format, vendor: Vendor) -> Reading:
    """Return the reading in °C that one text of `split_values` stands for.

    An open couple reads like one far too hot; whether it is open, the reply alone does not tell.

    Parameters
    ----------
    text : str or None
        One text of `split_values`; None for a disabled channel.
    couple, data_format, vendor : str
        Type, format and table of ranges.

    Examples
    --------
    >>> to_reading("+021.50", couple="K", data_format="engineering", vendor="icpdas").value
    21.5
    >>> round(to_reading("E6D0", couple="K", data_format="hex", vendor="icpdas").value, 2)
    -269.98
    >>> to_reading("+9999", couple="K", data_format="engineering", vendor="adam").quality.value
    'over_range'
    """
    if text is None:
        return Reading.bad(Quality.INVALID, "channel is disabled in the module")
    low, high = RANGES_DEGC[vendor][couple]
    full_scale = max(abs(low), abs(high))
    if data_format == "hex":
        return _from_word(int(text, 16), full_scale, vendor)
    if text in OVER_CODES:
        return Reading.bad(Quality.OVER, f"module reports {text}: over range or open couple")
    if text in UNDER_CODES:
        return Reading.bad(Quality.UNDER, f"module reports {text}: under range")
    value = float(text)
    if data_format == "percent":
        value *= full_scale / 100.0
    if not low - MARGIN_DEGC <= value <= high + MARGIN_DEGC:
        # The module cannot have meant it: its setting is not what the configuration says.
        return Reading.bad(
            Quality.INVALID, f"{value:g} degC is outside {low:g}..{high:g} degC of type {couple}"
        )
    return Reading.good(value)


def _from_word(word: int, full_scale: float, vendor: Vendor) -> Reading:
    """Both signs are scaled by the positive full scale; the ends are codes.

    At Advantech 0000 is both 0 °C and "under range", and FFFF both one count below 0 °C and "over range":
    these two are given up, since a reading that may be a code must not steer a machine.
    """
    over, under = ((0x7FFF,), 0x8000) if vendor == "icpdas" else ((0x7FFF, 0xFFFF), 0x0000)
    if word in over:
        return Reading.bad(Quality.OVER, f"module reports {word:04X}: over range or open couple")
    if word == under:
        return Reading.bad(Quality.UNDER, f"module reports {word:04X}: under range")
    signed = word - 0x10000 if word >= 0x8000 else word
    return Reading.good(signed / (32767.0 if signed >= 0 else 32768.0) * full_scale)


def shown(text: str) -> str:
    """Return a text fit for an error message: quoted, not too long."""
    return repr(text if len(text) <= 80 else text[:77] + "...")
