"""What a receiver of several axes gives to a control, and what it takes from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from .axis_message import with_axis
from .axis_mover import on_line
from .follower import Applied
from .modes import FollowerState
from .reasons import Reason, steady


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlState:
    """What the control shows at one time.

    Parameters
    ----------
    tool_length_mm : float or None
        Length of the tool in the spindle, mm; None if it is not known.
    positions_mm : mapping of str to (float or None)
        Machine coordinates of the axes that have a slope, mm; where the control itself applies offset and slope, its
        reference position.
    cutting : bool
        Whether the tool may cut; while false an axis may move faster by what a new tool length asks for.
    """

    tool_length_mm: float | None = None
    positions_mm: Mapping[str, float | None] = field(default_factory=dict)
    cutting: bool = True


#: A control of which nothing is read.
NOTHING_READ = ControlState()


@dataclass(frozen=True, slots=True, kw_only=True)
class AppliedAxis(Applied):
    """The offset of one axis to apply now, and why; see `Applied`.

    Parameters
    ----------
    places_mm, ends_um : tuple of float, shape (1,) or (2,)
        Ends of the travel, mm, and the offset there, µm; without a slope a single one.
    """

    places_mm: tuple[float, ...]
    ends_um: tuple[float, ...]

    def at(self, position_mm: float) -> float:
        """Return the offset at a position, µm."""
        return on_line(self.places_mm, self.ends_um, position_mm)

    @property
    def slope_um_per_m(self) -> float:
        """Return the change of the offset over the position, µm/m."""
        if len(self.ends_um) == 1:
            return 0.0
        return (self.ends_um[1] - self.ends_um[0]) / (self.places_mm[1] - self.places_mm[0]) * 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AppliedAxes:
    """The offsets of all axes to apply now, and why.

    Parameters
    ----------
    axes : mapping of str to AppliedAxis
        One for each of x, y, z that is applied.
    state : str
        `following` if every axis follows; else the state of the first that does not.
    reasons : tuple of Reason
        Those of all axes; the detail of one that is not of all names its axes.
    arrived : bool
        Whether every axis has reached its target.
    age_s, seq
        As in `Applied`.
    """

    axes: Mapping[str, AppliedAxis]
    state: FollowerState
    reasons: tuple[Reason, ...]
    arrived: bool
    age_s: float | None
    seq: int | None

    @property
    def text(self) -> str:
        """Return offsets, state and reasons as one line of text."""
        values = ", ".join(f"{axis} {applied.offset_um:+.2f}" for axis, applied in self.axes.items())
        why = " ".join(reason.marked for reason in self.reasons)
        return f"{values} µm, {self.state}" + (f": {why}" if why else "")

    @property
    def steady_reasons(self) -> str:
        """Return the reasons without the figures that change at every call, for logs that report changes only."""
        return steady(self.reasons)


def together(reasons: Mapping[str, Iterable[Reason]]) -> list[Reason]:
    """Return the reasons of several axes, each once: with the names of its axes, unless it is that of all.

    Examples
    --------
    >>> [one.detail for one in together({"y": [Reason("expired", "9 s")], "z": [Reason("expired", "9 s")]})]
    ['9 s']
    >>> [one.detail for one in together({"y": [], "z": [Reason("limit_reached", "5 µm")]})]
    ['z: 5 µm']
    """
    axes: dict[Reason, list[str]] = {}
    for axis, its in reasons.items():
        for reason in its:
            axes.setdefault(reason, []).append(axis)
    return [
        reason if len(names) == len(reasons) and len(names) > 1 else with_axis(reason, ", ".join(names))
        for reason, names in axes.items()
    ]
