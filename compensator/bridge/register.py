"""Values in the PLC's memory that follow the offsets: decides what may be written to them, and when.

No protocol, no clock. Only values that were read back are trusted: after a start, a lost connection, a write with
unknown outcome, or a write by another program, the offsets continue from the PLC's values.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

from compensator.codes import BridgeTrouble, Remark
from compensator.receiver import AppliedAxes, AxesFollower, Follower, ReceiverError


def single_precision(value: float) -> float:
    """Return a value as 32 bits hold it."""
    return float(struct.unpack("f", struct.pack("f", value))[0])


class Registers(ABC):
    """Values that are read, compared and written together.

    Parameters
    ----------
    resume_after_s : float
        Time for which values written by another program must not change, s.

    Attributes
    ----------
    trouble : str
        Why nothing is written, as text; empty while the offsets are written.
    """

    def __init__(self, resume_after_s: float) -> None:
        self._resume_after_s = resume_after_s
        self.trouble = ""
        self._written: tuple[float, ...] | None = None
        self._found: tuple[tuple[float, ...], float] | None = None  # values, since
        self._known = False

    @abstractmethod
    def _differ(self, a: tuple[float, ...], b: tuple[float, ...]) -> list[int]:
        """Return which values differ by more than their tolerance; a NaN differs from everything."""

    @abstractmethod
    def _in_words(self, at: int, found: float, written: float) -> str:
        """Return what is found and what was written."""

    @abstractmethod
    def _rebase(self, values: tuple[float, ...]) -> str:
        """Continue from values; return what is wrong with them if that is not possible."""

    def lost(self, why: str) -> None:
        """Mark the PLC's values as unknown."""
        self.trouble = why
        self._known, self._written, self._found = False, None, None

    def check_all(self, now_s: float, values: tuple[float, ...]) -> bool:
        """Check values that were read; return whether the offsets may move.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        values : tuple of float
            In the PLC's units.
        """
        if not self._known:
            return self._continue_from(values)
        if self._written is None or not (differ := self._differ(values, self._written)):
            # Another program that has put the old value back is none any more, and its next value is a new one.
            self.trouble, self._found = "", None
            return True
        if self._found is None or self._differ(values, self._found[0]):
            self._found = (values, now_s)
        texts = [self._in_words(at, values[at], self._written[at]) for at in differ]
        self.trouble = Remark(BridgeTrouble.PLC_WRITTEN_OVER, f"{'; '.join(texts)}.").marked
        if now_s - self._found[1] < self._resume_after_s:
            return False
        return self._continue_from(values)

    def _continue_from(self, values: tuple[float, ...]) -> bool:
        if wrong := self._rebase(values):
            self.trouble = Remark(BridgeTrouble.PLC_BEYOND_LIMIT, f"{wrong}; nothing is written.").marked
            return False
        self._known, self._written, self._found = True, values, None
        self.trouble = ""
        return True


class Register(Registers):
    """One REAL or LREAL.

    Parameters
    ----------
    follower : Follower
        Provides the offset to apply; is rebased to the PLC's value.
    sign : int
        1 or −1.
    unit_um : float
        µm for each unit of the value.
    tolerance_um : float
        Largest difference between the value read back and the value written, µm.
    resume_after_s : float
        Time for which a value written by another program must not change, s.
    single : bool
        Whether it holds 32 bits.
    """

    def __init__(
        self,
        follower: Follower,
        *,
        sign: int,
        unit_um: float,
        tolerance_um: float,
        resume_after_s: float,
        single: bool = True,
    ) -> None:
        super().__init__(resume_after_s)
        self._follower = follower
        self._per_um = sign / unit_um
        self._tolerance_um = tolerance_um
        self.single = single

    def check(self, now_s: float, value: float) -> bool:
        """Check a value that was read; return whether the offset may move.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        value : float
            In the PLC's unit.
        """
        return self.check_all(now_s, (value,))

    def _differ(self, a: tuple[float, ...], b: tuple[float, ...]) -> list[int]:
        return [] if abs(a[0] - b[0]) <= self._tolerance_um * abs(self._per_um) else [0]

    def _in_words(self, at: int, found: float, written: float) -> str:
        found_um, left_um = found / self._per_um, written / self._per_um
        return f"the PLC holds {found_um:+.3f} µm instead of the written {left_um:+.3f} µm"

    def _rebase(self, values: tuple[float, ...]) -> str:
        offset_um = values[0] / self._per_um
        try:
            self._follower.rebase(offset_um)
        except ReceiverError:
            return f"the PLC holds {offset_um:g} µm, beyond {self._follower.limits.offset_max_um:g} µm"
        return ""

    def value(self, offset_um: float) -> float | None:
        """Return the value to write for an offset; None if the PLC already has it.

        Parameters
        ----------
        offset_um : float
            Offset to apply, µm.
        """
        value = offset_um * self._per_um
        if self.single:
            value = single_precision(value)
        return None if (value,) == self._written else value

    def wrote(self, value: float) -> None:
        """Store a confirmed write."""
        self._written = (value,)


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisPlace:
    """Where an axis has its offset in the PLC, and how it is counted there.

    Parameters
    ----------
    sign : int
        1 or −1.
    per_um, per_slope : float
        PLC's units for each µm, and for each µm/m; 0 where the PLC has no slope.
    reference_mm : float
        Position at which the offset holds, mm.
    tolerance_um : float
        Largest difference between read and written at each position, µm.
    travel_mm : float
        Length of the travel, mm; 0 without a slope.
    """

    sign: int
    per_um: float
    per_slope: float = 0.0
    reference_mm: float = 0.0
    tolerance_um: float
    travel_mm: float = 0.0

    @property
    def scales(self) -> tuple[float, ...]:
        """Return the PLC's units for each µm and, with a slope, for each µm/m, with their sign."""
        return (self.sign * self.per_um, *((self.sign * self.per_slope,) if self.per_slope else ()))

    @property
    def tolerances(self) -> tuple[float, ...]:
        """Return the largest differences in the PLC's units."""
        slope = self.tolerance_um / max(self.travel_mm, 1.0) * 1000.0
        return (self.tolerance_um * self.per_um, *((slope * self.per_slope,) if self.per_slope else ()))


class AxesRegisters(Registers):
    """The offsets, and slopes, of several axes: all may move, or none.

    Parameters
    ----------
    follower : AxesFollower
        Is rebased to the PLC's values.
    places : mapping of str to AxisPlace
        For each axis.
    resume_after_s : float
        Time for which values written by another program must not change, s.

    Attributes
    ----------
    single : list of bool
        Whether each value holds 32 bits: the offset of an axis, then its slope, then the next axis.
    """

    def __init__(self, follower: AxesFollower, places: Mapping[str, AxisPlace], resume_after_s: float) -> None:
        super().__init__(resume_after_s)
        self._follower, self._places = follower, places
        self._scales = [scale for place in places.values() for scale in place.scales]
        self._tolerances = [tolerance for place in places.values() for tolerance in place.tolerances]
        self._names = [(axis, unit) for axis, place in places.items() for unit in ("µm", "µm/m")[: len(place.scales)]]
        self.single = [True] * len(self._scales)

    def offsets_um(self, values: tuple[float, ...]) -> dict[str, float]:
        """Return the offset of each axis at its reference position, µm."""
        pairs = zip(self._names, values, self._scales, strict=True)
        return {axis: value / scale for (axis, unit), value, scale in pairs if unit == "µm"}

    def _differ(self, a: tuple[float, ...], b: tuple[float, ...]) -> list[int]:
        return [at for at, most in enumerate(self._tolerances) if not abs(a[at] - b[at]) <= most]

    def _in_words(self, at: int, found: float, written: float) -> str:
        (axis, unit), scale = self._names[at], self._scales[at]
        return f"{axis}: the PLC holds {found / scale:+.3f} {unit} instead of the written {written / scale:+.3f} {unit}"

    def _rebase(self, values: tuple[float, ...]) -> str:
        slopes = {
            axis: value / scale
            for (axis, unit), value, scale in zip(self._names, values, self._scales, strict=True)
            if unit == "µm/m"
        }
        for axis, offset_um in self.offsets_um(values).items():
            slope = slopes.get(axis, 0.0)
            try:
                # An axis before the one that is refused is where the PLC has it, and nothing is written.
                self._follower.rebase(axis, offset_um, slope, self._places[axis].reference_mm)
            except ReceiverError:
                return f"{axis}: the PLC holds {offset_um:g} µm and {slope:g} µm/m, beyond the limit of the axis"
        return ""

    def values(self, applied: AppliedAxes) -> tuple[float, ...] | None:
        """Return the values to write, those of all axes; None if the PLC already has them.

        Parameters
        ----------
        applied : AppliedAxes
            Offsets to apply.
        """
        wanted: list[float] = []
        for axis, place in self._places.items():
            one = applied.axes[axis]
            parts = (one.at(place.reference_mm), one.slope_um_per_m)
            wanted.extend(part * scale for part, scale in zip(parts, place.scales, strict=False))
        pairs = zip(wanted, self.single, strict=True)
        values = tuple(single_precision(value) if single else value for value, single in pairs)
        return None if values == self._written else values

    def wrote(self, values: tuple[float, ...]) -> None:
        """Store a confirmed write."""
        self._written = values
