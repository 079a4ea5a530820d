"""What data showed of an effect: the ranges in which its explanation speaks.

A coefficient says how large an effect is only to those who know how far its cause moved. So an explanation begins with
µm at the range that was seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from compensator.arrays import Vector

#: Samples of the median by which a single spike is no range.
_MEDIAN = 5
#: An end of a range that is nearer to zero than this share of the range is zero.
_NO_SIZE = 0.1
#: Ends of names of channels whose zero is not rest.
_NO_ZERO = ("_degc",)
#: Units of channels by the end of their name, as people write them.
_UNITS = {
    "degc": "°C",
    "k": "K",
    "rpm": "rpm",
    "lpm": "l/min",
    "pct": "%",
    "bar": "bar",
    "w": "W",
    "kw": "kW",
    "a": "A",
    "v": "V",
    "nm": "Nm",
    "hz": "Hz",
    "mm": "mm",
    "um": "µm",
}


@dataclass(frozen=True, slots=True)
class Range:
    """Lowest and highest value."""

    low: float
    high: float

    @classmethod
    def of(cls, records: Sequence[Vector]) -> Self:
        """Return the range of a signal in several records, each of shape (n,), without single spikes."""
        smooth = np.concatenate(
            [np.median(sliding_window_view(np.pad(v, _MEDIAN // 2, mode="edge"), _MEDIAN), axis=1) for v in records]
        )
        return cls(float(np.min(smooth)), float(np.max(smooth)))

    def ends(self, channel: str) -> tuple[float, float]:
        """Return from where to where a channel went: from rest, where it was near that, or from its lower end.

        Examples
        --------
        >>> Range(2.0, 5000.0).ends("spindle_rpm"), Range(-3000.0, 3000.0).ends("c_rpm"), Range(0.0, 9.0).ends("a_degc")
        ((0.0, 5000.0), (0.0, -3000.0), (0.0, 9.0))
        >>> Range(1250.0, 5000.0).ends("spindle_rpm"), Range(-2.0, 30.0).ends("outside_degc")
        ((1250.0, 5000.0), (-2.0, 30.0))
        """
        near = max(self.low, -self.high) < _NO_SIZE * (self.high - self.low)
        if near and not channel.endswith(_NO_ZERO):
            return 0.0, max(self.low, self.high, key=abs)
        return self.low, self.high


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """Ranges of an effect in the data of its diagnosis.

    Parameters
    ----------
    rms_um : float
        Standard deviation of what it adds to y, µm.
    added_um : Range
        What it adds to y, µm.
    channel : Range, optional
        The channel that it acts by, in its unit.
    path_um : Range, optional
        The path that it acts on, µm.
    """

    rms_um: float
    added_um: Range
    channel: Range | None = None
    path_um: Range | None = None

    @property
    def words(self) -> str:
        """What it adds to y in words.

        Examples
        --------
        >>> Seen(rms_um=2.0, added_um=Range(-84.2, 3.0)).words
        'Up to −84 µm (2.0 µm rms)'
        >>> Seen(rms_um=2.0, added_um=Range(-3.12, 8.3)).words
        '−3.1 to +8.3 µm (2.0 µm rms)'
        """
        return f"{self.size[0].upper()}{self.size[1:]}"

    @property
    def size(self) -> str:
        """The same within a sentence."""
        low, high = self.added_um.low, self.added_um.high
        most = max(low, high, key=abs)
        one_sided = low * high >= 0.0 or min(abs(low), abs(high)) < _NO_SIZE * abs(most)
        size = f"up to {signed(most)}" if one_sided else f"{signed(low)} to {signed(high)}"
        return f"{size} µm ({rounded(self.rms_um)} µm rms)"

    @property
    def path_words(self) -> str:
        """What the path adds to y, as a clause; empty where there is no path."""
        if self.path_um is None:
            return ""
        return f", which moves Y by {signed(self.path_um.low)} to {signed(self.path_um.high)} µm,"


def rounded(value: float) -> str:
    """Return a size in µm to two digits, to whole ones from 10 on, with a minus that is one.

    Examples
    --------
    >>> rounded(84.26), rounded(8.261), rounded(-0.08261), rounded(0.0), rounded(9.97)
    ('84', '8.3', '−0.083', '0', '10')
    """
    if abs(value) >= 9.95 or value == 0.0:
        return f"{value:.0f}".replace("-", "−")
    decimals = max(1 - int(f"{value:.1e}".partition("e")[2]), 0)
    return f"{value:.{min(decimals, 3)}f}".replace("-", "−")


def signed(value: float) -> str:
    """Return a size in µm as `rounded`, with its sign.

    Examples
    --------
    >>> signed(-84.26), signed(8.3)
    ('−84', '+8.3')
    """
    return f"{'+' if value > 0.0 else ''}{rounded(value)}"


def digits(value: float) -> str:
    """Return a number to three digits as an engineer writes it.

    Examples
    --------
    >>> digits(5000.0), digits(0.01684), digits(-1234.0), digits(2.5e-7)
    ('5000', '0.0168', '−1230', '2.5e−07')
    """
    text = f"{float(f'{value:.3g}'):.7g}" if abs(value) < 1e6 else f"{value:.3g}"
    return text.replace("-", "−")


def roughly(value: float) -> str:
    """Return a number to two digits, for advice: what is expected is known no better.

    Examples
    --------
    >>> roughly(3.97), roughly(171.2), roughly(-0.833), roughly(6000.0)
    ('4', '170', '−0.83', '6000')
    """
    return digits(float(f"{value:.2g}"))


def quantity(value: float, channel: str) -> str:
    """Return a value of a channel with the unit that its name carries.

    Examples
    --------
    >>> quantity(5000.0, "spindle_rpm"), quantity(21.46, "coolant_degc"), quantity(3.0, "door")
    ('5000 rpm', '21.5 °C', '3')
    """
    unit = unit_of_channel(channel)
    return f"{digits(value)} {unit}" if unit else digits(value)


def unit_of_channel(channel: str) -> str:
    """Return the unit that a channel's name carries, as people write it; empty where it carries none."""
    over, per, under = unit_in(channel).partition("_per_")
    return f"{_UNITS.get(over, over)}/{_UNITS.get(under, under)}" if per else _UNITS.get(over, "")


#: Units of what can be nothing but a flow, and of what moves the medium of a film: a speed, or a flow. A power or a
#: load may stand for the heat itself.
FLOWS = ("lpm", "l_per_min", "l_per_h", "m3_per_h", "kg_per_min", "gpm")
POWERS = ("w", "kw")
MOVES = ("rpm", "1_per_min", *FLOWS)


def unit_in(channel: str) -> str:
    """Return the end of a channel's name that is its unit, as in names of parameters; empty if it has one word.

    Examples
    --------
    >>> unit_in("spindle_rpm"), unit_in("coolant_l_per_min"), unit_in("door"), unit_of_channel("coolant_l_per_min")
    ('rpm', 'l_per_min', '', 'l/min')
    """
    words, per, under = channel.partition("_per_")
    before, _, unit = words.rpartition("_")
    return f"{unit}{per}{under}" if before else ""


def with_unit(name: str, channel: str) -> str:
    """Return the name of a parameter with the unit of a channel, where that has one.

    Examples
    --------
    >>> with_unit("half_flow", "coolant_l_per_min"), with_unit("half_flow", "coolant_flow")
    ('half_flow_l_per_min', 'half_flow')
    """
    return f"{name}_{unit_in(channel)}" if unit_of_channel(channel) else name
