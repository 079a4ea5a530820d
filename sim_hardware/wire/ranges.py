"""Input ranges of ICP DAS and Advantech modules: type codes, limits and full scales.

Sources: ICP DAS "ET-7000/PET-7000 Register Table" 1.0.3, appendix A; Advantech ADAM-4000 manual,
appendix B, and the ranges of Advantech's published .NET library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim_hardware.wire.module import ILLEGAL_VALUE, MeasuringModule, RefusalError, Source

#: Ranges as a caller names them: one name or type code for all channels, a list, or those that differ; see `choose`.
Wanted = str | int | Sequence[str | int] | Mapping[int, str | int] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Range:
    """One input range.

    Parameters
    ----------
    code : int
        Type code.
    name : str
        Thermocouple letter, or the range in words: `10V`, `150mV`, `4-20mA`.
    low, high : float
        Limits in the unit that the module displays: °C, V, mV, mA.
    per_source_unit : float
        Displayed units in one unit of the source (1000 for a mV range, whose source gives V).
    engineering_per_unit : float
        Counts of the engineering word in one displayed unit.
    unsigned : bool
        Whether the hexadecimal word runs from 0 at `low` to FFFF at `high`.
    """

    code: int
    name: str
    low: float
    high: float
    per_source_unit: float = 1.0
    engineering_per_unit: float = 10.0
    unsigned: bool = False
    thermocouple: bool = False

    @property
    def full_scale(self) -> float:
        """Value of hexadecimal 7FFF, in the displayed unit; negative values use the same scale."""
        return max(abs(self.low), abs(self.high))

    @property
    def decimals(self) -> int:
        """Digits after the point of the seven-character text: five digits in all."""
        return 5 - len(str(int(self.full_scale)))


def _thermocouple(code: int, name: str, low: float, high: float, per_unit: float = 10.0) -> Range:
    return Range(code=code, name=name, low=low, high=high, engineering_per_unit=per_unit, thermocouple=True)


def _volts(code: int, name: str, limit: float, per_unit: float, *, milli: bool = False) -> Range:
    scale = 1000.0 if milli else 1.0
    return Range(code=code, name=name, low=-limit, high=limit, per_source_unit=scale, engineering_per_unit=per_unit)


def _current(code: int, name: str, low: float) -> Range:
    return Range(code=code, name=name, low=low, high=20.0, engineering_per_unit=1000.0, unsigned=low >= 0.0)


ICP_THERMOCOUPLES = (
    _thermocouple(0x0E, "J", -210.0, 760.0),
    _thermocouple(0x0F, "K", -270.0, 1372.0),
    _thermocouple(0x10, "T", -270.0, 400.0),
    _thermocouple(0x11, "E", -270.0, 1000.0),
    _thermocouple(0x12, "R", 0.0, 1768.0),
    _thermocouple(0x13, "S", 0.0, 1768.0),
    _thermocouple(0x14, "B", 0.0, 1820.0),
    _thermocouple(0x15, "N", -270.0, 1300.0),
    _thermocouple(0x16, "C", 0.0, 2320.0),
    _thermocouple(0x17, "L", -200.0, 800.0),
    _thermocouple(0x18, "M", -200.0, 100.0, 100.0),
    _thermocouple(0x19, "L-DIN", -200.0, 900.0),
)
# The low codes and the 08..0D block name two hardware families; "1V" of the one is not "1V" of the other.
ICP_LOW_VOLTS = (
    _volts(0x00, "15mV", 15.0, 1000.0, milli=True),
    _volts(0x01, "50mV", 50.0, 100.0, milli=True),
    _volts(0x02, "100mV", 100.0, 100.0, milli=True),
    _volts(0x03, "500mV", 500.0, 10.0, milli=True),
    _volts(0x04, "1V", 1.0, 10000.0),
    _volts(0x05, "2.5V", 2.5, 10000.0),
    _current(0x06, "+-20mA", -20.0),
)
ICP_HIGH_VOLTS = (
    _current(0x07, "4-20mA", 4.0),
    _volts(0x08, "10V", 10.0, 1000.0),
    _volts(0x09, "5V", 5.0, 1000.0),
    _volts(0x0A, "1V", 1.0, 10000.0),
    _volts(0x0B, "500mV", 500.0, 10.0, milli=True),
    _volts(0x0C, "150mV", 150.0, 100.0, milli=True),
    _current(0x0D, "+-20mA", -20.0),
    _current(0x1A, "0-20mA", 0.0),
)
ADAM_THERMOCOUPLES = (
    _thermocouple(0x0E, "J", 0.0, 760.0),
    _thermocouple(0x0F, "K", 0.0, 1370.0),
    _thermocouple(0x10, "T", -100.0, 400.0),
    _thermocouple(0x11, "E", 0.0, 1000.0),
    _thermocouple(0x12, "R", 500.0, 1750.0),
    _thermocouple(0x13, "S", 500.0, 1750.0),
    _thermocouple(0x14, "B", 500.0, 1800.0),
)
ADAM_4118_VOLTS = ICP_LOW_VOLTS
ADAM_VOLTS = (*(r for r in ICP_HIGH_VOLTS if r.code <= 0x0C), _current(0x0D, "0-20mA", 0.0))


def choose(
    wanted: Wanted,
    offered: Sequence[Range],
    channels: int,
    default: Range,
) -> list[Range]:
    """Return the range of each channel.

    Parameters
    ----------
    wanted : str, int, sequence or mapping
        Name or type code for all channels, a list of them, or the channels that differ from `default`.

    Raises
    ------
    ValueError
        If the module does not offer such a range, or a list is not as long as the module has channels.
    """
    if wanted is None:
        return [default] * channels
    if isinstance(wanted, (str, int)):
        return [find(wanted, offered)] * channels
    if isinstance(wanted, Mapping):
        alien = [c for c in wanted if not 0 <= c < channels]
        if alien:
            raise ValueError(f"channels {alien} do not exist: the module has 0..{channels - 1}")
        return [find(wanted[c], offered) if c in wanted else default for c in range(channels)]
    if len(wanted) != channels:
        raise ValueError(f"{len(wanted)} ranges for {channels} channels")
    return [find(each, offered) for each in wanted]


def find(wanted: str | int, offered: Sequence[Range]) -> Range:
    """Return the range with a name or type code.

    Raises
    ------
    ValueError
        If there is none.
    """
    for each in offered:
        if wanted in (each.code, each.name):
            return each
    raise ValueError(f"no range {wanted!r}: {', '.join(f'{r.name} ({r.code:#04x})' for r in offered)}")


def encode_hex(value: float, span: Range) -> int:
    """Return the hexadecimal word of a displayed value; both signs are scaled by the positive full scale.

    Examples
    --------
    >>> f"{encode_hex(-270.0, find('K', ICP_THERMOCOUPLES)):04X}"
    'E6D0'
    """
    if span.unsigned:
        return round(min(max((value - span.low) / (span.high - span.low), 0.0), 1.0) * 0xFFFF)
    raw = value / span.full_scale * (32767.0 if value >= 0.0 else 32768.0)
    # Towards zero: so the ends of types K and N come out as the maker's table has them.
    return int(min(max(raw, -32768.0), 32767.0)) & 0xFFFF


def decode_hex(word: int, span: Range) -> float:
    """Return the displayed value of a hexadecimal word."""
    if span.unsigned:
        return span.low + word / 0xFFFF * (span.high - span.low)
    signed = word - 0x10000 if word >= 0x8000 else word
    return signed / (32767.0 if signed >= 0 else 32768.0) * span.full_scale


class RangedModule(MeasuringModule):
    """A module whose inputs have ranges with type codes.

    Parameters
    ----------
    sources, channels, unwired
        As for `MeasuringModule`.
    offered : sequence of Range
        Ranges of the model.
    ranges : str, int, sequence, mapping or None
        See `choose`.
    default : str or int
        Name or type code of the factory setting.
    """

    def __init__(
        self,
        sources: Mapping[int, Source],
        channels: int,
        unwired: float,
        *,
        offered: Sequence[Range],
        ranges: Wanted,
        default: str | int,
    ) -> None:
        super().__init__(sources, channels, unwired)
        self.offered = offered
        self.ranges = choose(ranges, offered, channels, find(default, offered))

    def limits(self, channel: int) -> tuple[float, float]:
        """Return the range of an input, in °C, V or mA."""
        span = self.ranges[channel]
        return span.low / span.per_source_unit, span.high / span.per_source_unit

    def set_type(self, code: int, channel: int | None = None) -> None:
        """Set the range of one channel, or of all.

        Raises
        ------
        RefusalError
            Code 3 if the module does not have such a type code.
        """
        try:
            span = find(code, self.offered)
        except ValueError:
            raise RefusalError(ILLEGAL_VALUE) from None
        for i in range(self.channels) if channel is None else (channel,):
            self.ranges[i] = span
