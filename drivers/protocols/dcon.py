r"""DCON / ADAM ASCII texts: commands, replies, checksums, values.

A frame is `lead AA command [checksum] CR` with the address AA in two hexadecimal digits. Replies lead with
`!` (valid, carries the address), `?` (not allowed, carries the address) or `>` (data, carries none).

Sources: ICP DAS I-7018/M-7018 user manual; Advantech ADAM-4000 series user's manual, chapter 5 and appendix
B.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.protocols.thermocouples import Span
from drivers.reading import Quality, Reading

CR = b"\r"
# Forms of a value: 7 characters with a point, 5 without one when out of range, 7 blanks when off.
_VALUE = re.compile(r"[+-]\d*\.?\d*| {7}")
_HEX = re.compile(r"[0-9A-F]{4}")


class BadTextError(ValueError):
    """A reply that does not follow the protocol; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """A reply without its checksum.

    Parameters
    ----------
    lead : str
        `!`, `?` or `>`.
    body : str
        The rest, with the address where the lead has one.
    """

    lead: str
    body: str

    def address(self) -> int | None:
        """Return the address the reply carries, or None."""
        if self.lead == ">" or not re.match(r"[0-9A-Fa-f]{2}", self.body):
            return None
        return int(self.body[:2], 16)


def checksum(text: str) -> str:
    """Sum the character codes, modulo 256, as two hexadecimal digits.

    Examples
    --------
    >>> checksum("$012"), checksum("!01200600")
    ('B7', 'AA')
    """
    return f"{sum(text.encode('ascii')) & 0xFF:02X}"


def command(text: str, *, with_checksum: bool) -> bytes:
    r"""Frame a command.

    Examples
    --------
    >>> command("$012", with_checksum=True)
    b'$012B7\r'
    """
    return (text + (checksum(text) if with_checksum else "")).encode("ascii") + CR


def reply(line: bytes, *, with_checksum: bool) -> Reply:
    """Split a reply.

    Parameters
    ----------
    line : bytes
        Without its CR.
    with_checksum : bool
        Whether the module sends one.

    Raises
    ------
    BadTextError
        Not ASCII, no lead, or the checksum is wrong.
    """
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        raise BadTextError(f"bytes that are not ASCII: {line[:40].hex(' ')}") from None
    if with_checksum:
        if len(text) < 3:
            raise BadTextError(f"{text!r} is too short for a checksum")
        text, sent = text[:-2], text[-2:]
        due = checksum(text)
        if sent.upper() != due:
            raise BadTextError(f"checksum {sent!r} of {text!r}, expected {due!r}")
    if not text or text[0] not in "!?>":
        raise BadTextError(f"{text!r} does not begin with ! ? or >")
    return Reply(lead=text[0], body=text[1:])


def split_values(body: str, count: int, form: str) -> list[str]:
    """Split the values of a `#AA` reply.

    Out-of-range texts are shorter than values, so values are separated by their signs, not by widths.

    Raises
    ------
    BadTextError
        Other characters than values, a value of a length no value has, or another number of values.
    """
    pattern = _HEX if form == "hex" else _VALUE
    values: list[str] = []
    place = 0
    while place < len(body):
        match = pattern.match(body, place)
        if match is None:
            raise BadTextError(f"{body!r} has no value at character {place + 1}")
        values.append(match[0])
        place = match.end()
    for value in values:
        if form != "hex" and (len(value), "." in value) not in {(7, True), (5, False)} and value.strip():
            raise BadTextError(
                f"value {value!r} in {body!r} has {len(value)} characters, expected 7, or 5 out of range"
            )
    if len(values) != count:
        raise BadTextError(f"{len(values)} values in {body!r}, expected {count}")
    return values


def thermocouple(text: str, form: str, span: Span, vendor: str | None) -> Reading:
    """Turn the text of one thermocouple value into a reading in °C.

    Parameters
    ----------
    text : str
        As `split_values` returns it.
    form : str
        `engineering` (°C), `percent` (of full scale) or `hex` (two's complement, 7FFF = full scale).
    span : Span
        Range of the thermocouple type in this maker's modules.
    vendor : str or None
        `icpdas` or `advantech`: hexadecimal marks of out-of-range differ.

    Raises
    ------
    BadTextError
        Five characters that are not a mark of out-of-range.
    """
    if not text.strip():
        return Reading.bad(Quality.INVALID, "input is switched off in the module")
    if form == "hex":
        return _hexadecimal(text, span, vendor)
    if text == "-0000":
        return Reading.bad(Quality.UNDER, "below the range (-0000)")
    if text == "+9999":
        return Reading.bad(Quality.OPEN, "open thermocouple or above the range (+9999)")
    if "." not in text:
        raise BadTextError(f"{text!r} is neither a value nor +9999 or -0000")
    value = float(text)
    if abs(value) >= 9999.0:
        quality = Quality.OPEN if value > 0 else Quality.UNDER
        return Reading.bad(quality, f"open thermocouple or out of range ({text})")
    return span.reading(value / 100.0 * span.full_degc if form == "percent" else value)


def _hexadecimal(text: str, span: Span, vendor: str | None) -> Reading:
    """Scale a two's complement value; both signs by the positive full scale."""
    raw = int(text, 16)
    if vendor == "advantech":
        if raw == 0xFFFF:
            return Reading.bad(Quality.OPEN, "open thermocouple or above the range (FFFF)")
        if raw == 0:
            return Reading.bad(Quality.UNDER, "below the range (0000)")
        return span.reading((raw - (raw >> 15 << 16)) / 32768.0 * span.full_degc)
    return span.icp_hex(raw)
