"""Texts of the DCON (ADAM ASCII) protocol: values in their three formats, and the checksum.

Sources: ICP DAS I-7018 and Advantech ADAM-4000 user's manuals; checksum example from the ZT-2005 manual.
"""

from __future__ import annotations

from typing import Literal, Protocol

from sim_hardware.wire.module import Sample, State
from sim_hardware.wire.ranges import Range

DataFormat = Literal["engineering", "percent", "hex"]
FORMAT_BITS: dict[DataFormat, int] = {"engineering": 0, "percent": 1, "hex": 2}
OVER_TEXT = "+9999"
UNDER_TEXT = "-0000"
DISABLED_TEXT = " " * 7


class DconModule(Protocol):
    """What an analogue input module offers to the DCON protocol."""

    model: str
    name: str
    firmware: str
    channels: int
    ranges: list[Range]
    enabled: int
    cjc_degc: float

    @property
    def type_per_channel(self) -> bool:
        """Whether each channel has its own type code."""

    def begin(self) -> None:
        """Start a conversion."""

    def quantised(self, channel: int) -> Sample:
        """Return the displayed value as the converter resolves it."""

    def hex_word(self, channel: int) -> int:
        """Return the two's complement word."""

    def bad(self, channel: int) -> bool:
        """Return whether an input is out of range or open."""

    def set_type(self, code: int, channel: int | None = None) -> None:
        """Set the range of a channel, or of all."""


def checksum(text: str) -> str:
    """Return the two hex digits that follow a text when checksums are on.

    Examples
    --------
    >>> checksum("$012"), checksum("!01200600")
    ('B7', 'AA')
    """
    return f"{sum(text.encode('latin-1')) & 0xFF:02X}"


def value_text(module: DconModule, channel: int, data_format: DataFormat) -> str:
    """Return one value: sign, five digits and a point; or four hex digits; or an out-of-range code."""
    if data_format == "hex":
        return f"{module.hex_word(channel):04X}"
    sample = module.quantised(channel)
    if sample.state is not State.GOOD:
        # Five characters where a value has seven: splitting the reply by position fails here.
        return UNDER_TEXT if sample.state is State.UNDER else OVER_TEXT
    span = module.ranges[channel]
    if data_format == "percent":
        return seven(sample.value / span.full_scale * 100.0, 2)
    return seven(sample.value, span.decimals)


def seven(value: float, decimals: int) -> str:
    """Return a number as sign, five digits and a point.

    Examples
    --------
    >>> seven(21.5, 2), seven(-0.001, 2)
    ('+021.50', '+000.00')
    """
    text = f"{value:+07.{decimals}f}"
    return text.replace("-", "+") if float(text) == 0.0 else text
