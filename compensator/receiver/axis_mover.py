"""The applied offset of one axis of several: a number, or a straight line over the axis' position.

A line is kept as its values at both ends of the travel, each of which moves at no more than the rate. Between them the
offset then moves no faster either, at every position; and a change of the reference position changes nothing. The
axis' own motion moves the offset along the line at once, as the scale or screw asks for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from .errors import ReceiverError
from .limits import AxisLimits
from .modes import ARRIVED_UM, moved
from .reasons import Reason
from .values import finite, shown

#: A position may have been read this long before or after its time, s.
_JITTER_S = 0.05


def on_line(places_mm: Sequence[float], values_um: Sequence[float], position_mm: float) -> float:
    """Return the value of a line at a position; a single value is the same everywhere.

    Parameters
    ----------
    places_mm, values_um : sequence of float, shape (1,) or (2,)
        Positions, mm, and the values there, µm.
    position_mm : float
        Position, mm.
    """
    if len(values_um) == 1 or position_mm == places_mm[0]:
        return values_um[0]
    part = (position_mm - places_mm[0]) / (places_mm[1] - places_mm[0])
    return values_um[0] + part * (values_um[1] - values_um[0])


class AxisMover:
    """The applied offset of an axis.

    Parameters
    ----------
    limits : AxisLimits
        Limits of the axis.
    applied_um : float
        Offset applied by the control at the start, µm.
    step_max_s : float
        Longest time for which a change of the position counts as motion, s.

    Attributes
    ----------
    places_mm, ends_um : tuple of float, shape (1,) or (2,)
        Ends of the travel, mm, and the offset there, µm; without a slope a single one.
    owed_um : float
        What the changes of the tool's length have left to move, and in which direction, µm.

    Raises
    ------
    ReceiverError
        Where the offset at the start is not a number within the limits.
    """

    def __init__(self, limits: AxisLimits, applied_um: float, step_max_s: float) -> None:
        self.limits = limits
        ends_mm = (limits.position_min_mm, limits.position_max_mm)
        self.places_mm: tuple[float, ...] = ends_mm if limits.has_slope else ends_mm[:1]
        self.ends_um: tuple[float, ...] = ()
        self.owed_um = 0.0
        self._step_max_s = step_max_s
        self._position_mm = 0.5 * (self.places_mm[0] + self.places_mm[-1])
        self._located_s: float | None = None
        self.rebase(applied_um)

    @property
    def offset_um(self) -> float:
        """Return the offset at the present position, µm."""
        return on_line(self.places_mm, self.ends_um, self._position_mm)

    def rebase(self, applied_um: float, slope_um_per_m: float = 0.0, at_mm: float | None = None) -> None:
        """Continue from what the control applies.

        Parameters
        ----------
        applied_um : float
            Offset, µm.
        slope_um_per_m : float
            Slope that the control itself applies, µm/m.
        at_mm : float, optional
            Position at which the offset is this, mm; by default the present one.

        Raises
        ------
        ReceiverError
            Where it is not within the limits at each position.
        """
        given = map(finite, (applied_um, slope_um_per_m, self._position_mm if at_mm is None else at_mm))
        um, slope, from_mm = (math.nan if number is None else number for number in given)
        ends = tuple(um + slope * (place - from_mm) / 1000.0 for place in self.places_mm)
        most = self.limits.offset_max_um
        # A control that holds 32 bits, or adds up steps, has the limit itself a little beyond it.
        if not all(abs(end) <= most + ARRIVED_UM for end in ends):  # not for NaN either
            raise ReceiverError(
                f"applied offset = {shown(applied_um)} µm, slope {shown(slope_um_per_m)} µm/m: expected at most "
                f"offset_max_um = {most:g} at each position; correct the control first"
            )
        self.ends_um = tuple(max(-most, min(most, end)) for end in ends)
        self.owed_um = 0.0
        if len(ends) == 2:
            self._position_mm = max(self.places_mm[0], min(self.places_mm[1], from_mm))

    def locate(self, now_s: float, position_mm: float | None) -> Reason | None:
        """Go to the axis' position; a position that cannot be the axis' motion does not move the offset.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        position_mm : float or None
            Position in the control's machine coordinates, mm; None if it is not known.

        Returns
        -------
        Reason or None
            What is wrong with it.
        """
        if len(self.places_mm) == 1:
            return None
        number = finite(position_mm)
        if number is None:
            here = f"at {self._position_mm:.3f} mm"
            known = position_mm is None or isinstance(position_mm, float)
            return Reason("no_position", here if known else f"{here}; {shown(position_mm)}, expected a number")
        least, most = self.places_mm
        place = max(least, min(most, number))
        passed_s = 0.0 if self._located_s is None else min(max(now_s - self._located_s, 0.0), self._step_max_s)
        known, way_mm = self._located_s is not None, abs(place - self._position_mm)
        self._located_s = now_s
        if not known or way_mm > self.limits.position_speed_max_mm_per_s * (passed_s + _JITTER_S):
            before_um = self.offset_um
            self._position_mm = place
            self._shift_to(before_um)
            return Reason("position_jumped", f"by {way_mm:.1f} mm") if known else None
        self._position_mm = place
        beyond = f"{number:.3f} mm, travel {least:g} to {most:g}"
        return None if place == number else Reason("position_beyond", beyond)

    def _shift_to(self, offset_um: float) -> None:
        """Shift the line so that it has this value at the present position."""
        shift_um = offset_um - self.offset_um
        shifted = tuple(end + shift_um for end in self.ends_um)
        most = self.limits.offset_max_um
        self.ends_um = shifted if all(abs(end) <= most for end in shifted) else (offset_um,) * len(shifted)

    def owe(self, change_um: float) -> None:
        """Add what a new tool asks for, µm; a length that goes and comes back asks for nothing."""
        most = 2.0 * self.limits.offset_max_um
        self.owed_um = max(-most, min(most, self.owed_um + change_um))

    def pay(self, targets_um: Sequence[float], most_um: float) -> float:
        """Return how much further than its step the axis moves because of a new tool, µm; it is owed no more.

        Parameters
        ----------
        targets_um : sequence of float, shape (1,) or (2,)
            Where the ends go, µm: only what leads there is paid.
        most_um : float
            What the rate at a tool change permits, µm.
        """
        leads_there = any((t - e) * self.owed_um > 0.0 for e, t in zip(self.ends_um, targets_um, strict=True))
        paid_um = min(abs(self.owed_um), most_um) if leads_there else 0.0
        self.owed_um -= math.copysign(paid_um, self.owed_um)
        return paid_um

    def move(self, targets_um: Sequence[float], step_um: float) -> bool:
        """Move each end by one step; return whether all have arrived.

        Parameters
        ----------
        targets_um : sequence of float, shape (1,) or (2,)
            Where the ends go, µm.
        step_um : float
            Longest step, µm.
        """
        most = self.limits.offset_max_um
        pairs = list(zip(self.ends_um, targets_um, strict=True))
        self.ends_um = tuple(moved(end, target, step_um, most) for end, target in pairs)
        arrived = all(abs(t - e) <= ARRIVED_UM for e, t in zip(self.ends_um, targets_um, strict=True))
        if arrived:
            self.owed_um = 0.0
        return arrived
