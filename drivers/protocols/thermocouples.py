"""Thermocouple ranges and type codes by manufacturer.

Sources: ICP DAS ET-7000/PET-7000 register table, appendix A; Advantech ADAM-4000 manual, appendix B, with the
scaling of Advantech's own class library; for modules that report °C the limits of IEC 60584-1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.reading import Quality, Reading

OPEN_WORD = 0x7FFF
UNDER_WORD = 0x8000
# Values may overshoot a printed limit by rounding of the last digit.
_TOLERANCE_DEGC = 0.06


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Range of one thermocouple type in one maker's modules.

    Parameters
    ----------
    low_degc, high_degc : float
        Ends of the range, °C.
    code : int
        Type code in the module's settings; -1 where it has none.
    """

    low_degc: float
    high_degc: float
    code: int = -1

    @property
    def full_degc(self) -> float:
        """Full scale of the percent and two's complement formats: the larger end of the range, °C."""
        return max(abs(self.low_degc), self.high_degc)

    def reading(self, value_degc: float) -> Reading:
        """Make a reading of a temperature, with the quality that follows from the range."""
        if not math.isfinite(value_degc):
            return Reading.bad(Quality.INVALID, f"not a number ({value_degc})")
        if value_degc > self.high_degc + _TOLERANCE_DEGC:
            return Reading.bad(Quality.OVER, f"{value_degc:.1f} °C, the range ends at {self.high_degc:g} °C")
        if value_degc < self.low_degc - _TOLERANCE_DEGC:
            return Reading.bad(Quality.UNDER, f"{value_degc:.1f} °C, the range begins at {self.low_degc:g} °C")
        return Reading.good(value_degc)

    def icp_hex(self, raw: int) -> Reading:
        """Scale a word of an ICP DAS module in hexadecimal format.

        `value = word / 32767 × full scale` for words from 0 up, `word / 32768 × full scale` below: both
        signs by the positive full scale, so the lower end of the range is not at 8000.

        Examples
        --------
        >>> round(ICPDAS["K"].icp_hex(0xE6D0).value, 2)
        -269.98
        """
        if (mark := icp_mark(raw)) is not None:
            return mark
        if raw & 0x8000:
            return self.reading((raw - 0x10000) / 32768.0 * self.full_degc)
        # Type M alone has its full scale at -200 °C, and +100 °C at 4000.
        return self.reading(raw / (32768.0 if -self.low_degc > self.high_degc else 32767.0) * self.full_degc)

    def icp_engineering(self, raw: int, step_degc: float) -> Reading:
        """Scale a word of an ICP DAS module in engineering format: a signed count of steps."""
        if (mark := icp_mark(raw)) is not None:
            return mark
        return self.reading((raw - (raw >> 15 << 16)) * step_degc)

    def advantech(self, raw: int) -> Reading:
        """Scale a word of an Advantech module: `low + word / 65535 × (high − low)`.

        Such a module cannot report a value outside its range: it is clamped to the end.

        Examples
        --------
        >>> round(ADVANTECH["T"].advantech(16225).value, 2), round(ADVANTECH["K"].advantech(996).value, 2)
        (23.79, 20.82)
        """
        if raw == 0:
            return Reading.bad(Quality.UNDER, f"at or below {self.low_degc:g} °C, the module reports nothing lower")
        if raw == 0xFFFF:
            return Reading.bad(Quality.OVER, f"at or above {self.high_degc:g} °C, the module reports nothing higher")
        return Reading.good(self.low_degc + raw / 65535.0 * (self.high_degc - self.low_degc))


def icp_mark(raw: int) -> Reading | None:
    """Recognise the words by which an ICP DAS module reports a broken wire."""
    if raw == OPEN_WORD:
        return Reading.bad(Quality.OPEN, "open thermocouple, or above the range (7FFF)")
    if raw == UNDER_WORD:
        return Reading.bad(Quality.UNDER, "below the range, or a broken wire (8000)")
    return None


ICPDAS = {
    "J": Span(low_degc=-210.0, high_degc=760.0, code=0x0E),
    "K": Span(low_degc=-270.0, high_degc=1372.0, code=0x0F),
    "T": Span(low_degc=-270.0, high_degc=400.0, code=0x10),
    "E": Span(low_degc=-270.0, high_degc=1000.0, code=0x11),
    "R": Span(low_degc=0.0, high_degc=1768.0, code=0x12),
    "S": Span(low_degc=0.0, high_degc=1768.0, code=0x13),
    "B": Span(low_degc=0.0, high_degc=1820.0, code=0x14),
    "N": Span(low_degc=-270.0, high_degc=1300.0, code=0x15),
    "C": Span(low_degc=0.0, high_degc=2320.0, code=0x16),
    "L": Span(low_degc=-200.0, high_degc=800.0, code=0x17),
    "M": Span(low_degc=-200.0, high_degc=100.0, code=0x18),
    "L-DIN": Span(low_degc=-200.0, high_degc=900.0, code=0x19),
}

ADVANTECH = {
    "J": Span(low_degc=0.0, high_degc=760.0, code=0x0E),
    "K": Span(low_degc=0.0, high_degc=1370.0, code=0x0F),
    "T": Span(low_degc=-100.0, high_degc=400.0, code=0x10),
    "E": Span(low_degc=0.0, high_degc=1000.0, code=0x11),
    "R": Span(low_degc=500.0, high_degc=1750.0, code=0x12),
    "S": Span(low_degc=500.0, high_degc=1750.0, code=0x13),
    "B": Span(low_degc=500.0, high_degc=1800.0, code=0x14),
}

STANDARD = {
    "J": Span(low_degc=-210.0, high_degc=1200.0),
    "K": Span(low_degc=-270.0, high_degc=1372.0),
    "T": Span(low_degc=-270.0, high_degc=400.0),
    "E": Span(low_degc=-270.0, high_degc=1000.0),
    "R": Span(low_degc=-50.0, high_degc=1768.0),
    "S": Span(low_degc=-50.0, high_degc=1768.0),
    "B": Span(low_degc=0.0, high_degc=1820.0),
    "N": Span(low_degc=-270.0, high_degc=1300.0),
}


def type_of_code(table: Mapping[str, Span], code: int) -> str:
    """Name the thermocouple of a type code, for messages.

    Examples
    --------
    >>> type_of_code(ICPDAS, 0x0E)
    'type J'
    """
    return next((f"type {name}" for name, span in table.items() if span.code == code), "no thermocouple type")
