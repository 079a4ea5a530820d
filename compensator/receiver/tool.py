"""The length of the tool, which an angle is multiplied by: its bounds, and what a tool change does to an axis."""

from __future__ import annotations

from collections.abc import Sequence

from .axis_message import AxisMessage
from .limits import ToolLimits
from .modes import ARRIVED_UM
from .reasons import Reason
from .values import finite, shown


class Levers:
    """The lengths for which the offsets are followed.

    Parameters
    ----------
    limits : ToolLimits or None
        Bounds of the length; None without angles.
    """

    def __init__(self, limits: ToolLimits | None) -> None:
        self._limits = limits
        self._length_mm: float | None = None
        self._followed_mm: dict[str, float] = {}

    def measure(self, length_mm: float | None) -> list[Reason]:
        """Take the length of the tool, mm; return what is wrong with it: then that of the reference counts."""
        self._length_mm = None
        if self._limits is None:
            return []
        if length_mm is None:
            return [Reason("no_tool_length")]
        number = finite(length_mm)
        if number is None and not isinstance(length_mm, float):
            return [Reason("no_tool_length", f"{shown(length_mm)}, expected a number")]
        least, most = self._limits.length_min_mm, self._limits.length_max_mm
        if number is None or not least <= number <= most:
            return [Reason("tool_length_beyond", f"{length_mm:g} mm, expected {least:g} to {most:g}")]
        self._length_mm = number
        return []

    def follow(self, tilt: AxisMessage, angle_urad: float) -> tuple[float, float]:
        """Return what an angle adds to its axis, and by how much a new tool has changed that, µm."""
        length_mm = self._length_of(tilt)
        change_mm = length_mm - self._followed_mm.get(tilt.axis, length_mm)
        self._followed_mm[tilt.axis] = length_mm
        return angle_urad * (length_mm - tilt.reference_mm) / 1000.0, angle_urad * change_mm / 1000.0

    def forget(self) -> None:
        """Forget the lengths that were followed: what moves afterwards is not what a new tool asks for."""
        self._followed_mm.clear()

    def held(self, tilts: Sequence[AxisMessage], sign: int) -> list[Reason]:
        """Return by how much a held offset is wrong for another tool than the one that it was followed for."""
        wrong_um = 0.0
        for tilt in tilts:
            length_mm = self._length_of(tilt)
            change_mm = length_mm - self._followed_mm.get(tilt.axis, length_mm)
            wrong_um += sign * (tilt.offset or 0.0) * change_mm / 1000.0
        return [Reason("tool_changed", f"{wrong_um:+.2f} µm")] if abs(wrong_um) > ARRIVED_UM else []

    def faster_um(self, rate_um_per_min: float, step_s: float) -> float:
        """Return how much further than its rate an axis may move for a new tool while nothing cuts, µm.

        Parameters
        ----------
        rate_um_per_min : float
            Rate of the axis, µm/min.
        step_s : float
            Time, s.
        """
        if self._limits is None:
            return 0.0
        return max(self._limits.rate_at_tool_change_um_per_min - rate_um_per_min, 0.0) * step_s / 60.0

    def _length_of(self, tilt: AxisMessage) -> float:
        return tilt.reference_mm if self._length_mm is None else self._length_mm
