"""Limits of what is applied. None has a default, except where a larger value is no danger."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from .errors import ReceiverError

#: Largest value of each limit: more is a slip of the pen, and no limit at all.
LARGEST: Mapping[str, float] = {
    "offset_max_um": 5000.0,
    "offset_rate_max_um_per_min": 6000.0,
    "valid_max_s": 10_000.0,
    "step_max_s": 120.0,
    "clock_tolerance_s": 600.0,
    "offset_max_urad": 5000.0,
    "slope_max_um_per_m": 5000.0,
    "position_speed_max_mm_per_s": 10_000.0,
    "rate_at_tool_change_um_per_min": 6000.0,
}
#: Largest position and tool length, mm.
LONGEST_MM = 100_000.0


def check_limits(limits: object, names: Mapping[str, float] | tuple[str, ...]) -> None:
    """Check that limits are above 0 and at most those of `LARGEST`.

    Raises
    ------
    ReceiverError
        One line with the first limit that is not.
    """
    for name in names:
        value, largest = getattr(limits, name), LARGEST[name]
        if not 0.0 < value <= largest:
            raise ReceiverError(f"{name} = {value}: expected a number above 0, at most {largest:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Acceptance:
    """Which messages may be used.

    Parameters
    ----------
    valid_max_s : float
        Longest time that a message may be used, regardless of its own validity, s.
    step_max_s : float
        Longest time between two calls of `advance` that counts for the movement, s.
    clock_tolerance_s : float
        Largest time by which a message may be ahead of the wall clock, s.
    """

    valid_max_s: float = 600.0
    step_max_s: float = 1.0
    clock_tolerance_s: float = 5.0

    def __post_init__(self) -> None:
        check_limits(self, ("valid_max_s", "step_max_s", "clock_tolerance_s"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits(Acceptance):
    """Limits of the offset of one axis; each at most the value in `LARGEST`.

    Parameters
    ----------
    offset_max_um : float
        Largest offset, µm. A message beyond it is dropped.
    offset_rate_max_um_per_min : float
        Largest rate, µm/min.
    valid_max_s, step_max_s, clock_tolerance_s : float
        See `Acceptance`.
    """

    offset_max_um: float
    offset_rate_max_um_per_min: float

    def __post_init__(self) -> None:
        check_limits(self, ("offset_max_um", "offset_rate_max_um_per_min"))
        Acceptance.__post_init__(self)  # no super() in a dataclass with slots


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisLimits:
    """`[axis.x]`, `[axis.y]` or `[axis.z]`: limits of one axis of several.

    Parameters
    ----------
    offset_max_um : float
        Largest offset of the axis, tilt and slope included, µm.
    offset_rate_max_um_per_min : float
        Largest rate at each position of the axis, µm/min.
    sign : int
        −1 where the control's axis counts against the direction in which the service measures; the control then applies
        the opposite of what is published.
    slope_max_um_per_m : float
        Largest slope over the axis' position, µm/m; 0: no slope is applied.
    position_min_mm, position_max_mm : float
        Travel of the axis in the control's machine coordinates, mm.
    position_speed_max_mm_per_s : float
        Fastest motion of the axis, mm/s. A position that changes faster is a new zero or a fault, and does not move the
        offset.
    """

    offset_max_um: float
    offset_rate_max_um_per_min: float
    sign: int = 1
    slope_max_um_per_m: float = 0.0
    position_min_mm: float = 0.0
    position_max_mm: float = 0.0
    position_speed_max_mm_per_s: float = 0.0

    def __post_init__(self) -> None:
        check_limits(self, ("offset_max_um", "offset_rate_max_um_per_min"))
        if self.sign not in (1, -1):
            raise ReceiverError(f"sign = {self.sign}: expected 1 or -1")
        of_slope = ("slope_max_um_per_m", "position_speed_max_mm_per_s")
        travel = (self.position_min_mm, self.position_max_mm)
        if not any((*(getattr(self, name) for name in of_slope), *travel)):
            return
        check_limits(self, of_slope)
        if not -LONGEST_MM <= travel[0] < travel[1] <= LONGEST_MM:
            raise ReceiverError(
                f"position_min_mm = {travel[0]:g}, position_max_mm = {travel[1]:g}: expected the ends of the travel in "
                f"this order, at most {LONGEST_MM:g}"
            )

    @property
    def has_slope(self) -> bool:
        """Return whether a slope over the position is applied."""
        return self.slope_max_um_per_m > 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TiltLimits:
    """`[axis.a]` or `[axis.b]`: limit of an angle.

    Parameters
    ----------
    offset_max_urad : float
        Largest angle, µrad. A message beyond it is dropped. The rate is that of the axis on which the angle acts.
    """

    offset_max_urad: float

    def __post_init__(self) -> None:
        check_limits(self, ("offset_max_urad",))


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolLimits:
    """`[tool]`: the length of the tool, which an angle is multiplied by.

    Parameters
    ----------
    length_min_mm, length_max_mm : float
        Shortest and longest tool, mm. Any other length is not used.
    rate_at_tool_change_um_per_min : float
        How fast an axis may move by what a new length asks for, while the control says that the tool does not cut,
        µm/min; 0: no faster than else.
    length_from : str
        `control`: the program around the receiver reads it; `zenoh`: from the key `thermal/tool_length`.
    """

    length_min_mm: float
    length_max_mm: float
    rate_at_tool_change_um_per_min: float = 0.0
    length_from: str = "control"

    def __post_init__(self) -> None:
        if not 0.0 < self.length_min_mm < self.length_max_mm <= LONGEST_MM:
            raise ReceiverError(
                f"length_min_mm = {self.length_min_mm:g}, length_max_mm = {self.length_max_mm:g}: expected the "
                f"shortest and the longest tool, above 0, at most {LONGEST_MM:g}"
            )
        if self.rate_at_tool_change_um_per_min != 0.0:
            check_limits(self, ("rate_at_tool_change_um_per_min",))
        if self.length_from not in ("control", "zenoh"):
            raise ReceiverError(f"length_from = {self.length_from[:60]!r}: expected 'control' or 'zenoh'")
