"""The receiver's behaviour for several axes, without thread, clock or socket.

All axes of a sample are taken together or not at all. Each then has its own limits and moves on its own; only
`AxesFollower.advance` moves them, as in `follower.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from .axes_applied import NOTHING_READ, AppliedAxes, AppliedAxis, ControlState, together
from .axis_message import LINEAR, TILTS, AxisMessage, parse_axis, with_axis
from .axis_mover import AxisMover
from .errors import ReceiverError
from .gate import Gate, Held
from .limits import Acceptance, AxisLimits, TiltLimits, ToolLimits
from .message import Rejected
from .modes import FollowerState, Modes, followed_s
from .reasons import Reason
from .sample import Assembler, Sample
from .tool import Levers


@dataclass(slots=True)
class _Axis:
    """What happens to an axis in one call."""

    state: FollowerState
    reasons: list[Reason]
    targets_um: tuple[float, ...] | None = None
    arrived: bool = False


class AxesFollower(Modes[Sample]):
    """Follows the offsets of one machine.

    Parameters
    ----------
    machine : str
        Machine whose offsets are followed; messages of other machines are dropped.
    axes : mapping of str to (AxisLimits or TiltLimits)
        Limits of `x`, `y`, `z`, and of the angles `a`, `b`.
    tool : ToolLimits or None
        Limits of the tool's length; needed with an angle.
    acceptance : Acceptance
        Limits of age and clock.
    applied_um : mapping of str to float
        Offsets applied by the control at the start, µm; an axis that is not named starts at 0.
    last_sequence : int
        Highest number used before a restart; −1 if unknown.

    Attributes
    ----------
    signs : dict of str to int
        −1 where this side turns the axis; a bridge that does it itself enters it here.

    Raises
    ------
    ReceiverError
        Where the axes do not belong together, or an offset at the start is not within its limits.
    """

    def __init__(
        self,
        machine: str,
        axes: Mapping[str, AxisLimits | TiltLimits],
        tool: ToolLimits | None,
        acceptance: Acceptance,
        applied_um: Mapping[str, float] | None = None,
        last_sequence: int = -1,
    ) -> None:
        super().__init__(Gate(machine, acceptance, self._check_size, last_sequence))
        self._tilts = {axis: limits for axis, limits in axes.items() if isinstance(limits, TiltLimits)}
        linear = {axis: limits for axis, limits in axes.items() if isinstance(limits, AxisLimits)}
        check_axes(axes, tool)
        self._levers = Levers(tool if self._tilts else None)
        self._assembler = Assembler(axes)
        start_um = applied_um or {}
        self._movers = {
            axis: AxisMover(linear[axis], start_um.get(axis, 0.0), self.step_max_s) for axis in LINEAR if axis in linear
        }
        self.signs = {axis: mover.limits.sign for axis, mover in self._movers.items()}

    @property
    def axes(self) -> tuple[str, ...]:
        """Return the axes whose messages are needed, angles included."""
        return self._assembler.axes

    @property
    def applied_um(self) -> dict[str, float]:
        """Return the applied offsets, µm."""
        return {axis: mover.offset_um for axis, mover in self._movers.items()}

    def rebase(self, axis: str, applied_um: float, slope_um_per_m: float = 0.0, at_mm: float | None = None) -> None:
        """Continue from the offset that the control applies, if it differs from the last one.

        Parameters
        ----------
        axis : str
            The axis.
        applied_um, slope_um_per_m, at_mm : float
            Offset at a position, µm, the slope that the control itself applies, µm/m, and that position, mm; by default
            the present one.

        Raises
        ------
        ReceiverError
            Where it is not a number within the limits.
        """
        self._movers[axis].rebase(applied_um, slope_um_per_m, at_mm)

    # ------------------------------------------------------------------ messages

    def receive(
        self,
        now_s: float,
        axis: str,
        payload: bytes,
        *,
        utc_ns: Callable[[], int] | None = None,
        asked: bool = False,
    ) -> bool:
        """Accept a message, or drop it with a reason; no payload raises an error.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        axis : str
            Axis of the key under which it was published.
        payload : bytes
            Payload as received.
        utc_ns : callable, optional
            The wall clock, ns since 1970 UTC, if the message's age is to be checked; otherwise it counts as measured
            now.
        asked : bool
            Whether it is the answer to a query.

        Returns
        -------
        bool
            Whether it has completed the sample that is now the newest.
        """
        try:
            message = parse_axis(payload, axis)
            age_s = None if utc_ns is None else (utc_ns() - message.time_utc_ns) / 1e9
            completed = self._assembler.add(now_s, message, age_s, asked=asked)
            if completed is None:
                return False
            accepted = self._gate.accept(now_s, completed.sample, completed.age_s, asked=completed.asked)
        except Rejected as rejected:
            own = rejected.reason.code in ("malformed", "other_schema")
            self._gate.reject(with_axis(rejected.reason, axis) if own else rejected.reason)
            return False
        if accepted:
            self._assembler.forget(now_s, completed.sample.seq)
        return accepted

    def _check_size(self, sample: Sample) -> None:
        """Drop a sample of which any offset, slope or angle is beyond its limit."""
        for message in sample.axes:
            tilt = self._tilts.get(message.axis)
            if tilt is not None:
                _check_value(message.axis, "µrad", message.offset, tilt.offset_max_urad)
                continue
            mover = self._movers[message.axis]
            _check_value(message.axis, "µm", message.offset, mover.limits.offset_max_um)
            if mover.limits.has_slope:
                _check_value(message.axis, "µm/m", message.slope_um_per_m, mover.limits.slope_max_um_per_m)
                for place_mm in mover.places_mm:
                    end_um = (message.offset or 0.0) + _slope_um(message.slope_um_per_m, message, place_mm)
                    _check_value(message.axis, f"µm at {place_mm:g} mm", end_um, mover.limits.offset_max_um)

    # ------------------------------------------------------------------ the applied offsets

    def advance(self, now_s: float, control: ControlState = NOTHING_READ) -> AppliedAxes:
        """Advance in time and return the offsets to apply; only this method moves them.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s. A clock that moves backwards counts as stopped.
        control : ControlState
            What the control shows now.
        """
        step_s = self._step_s(now_s)
        state, held, reasons = self._state(now_s)
        missing = self._assembler.missing(now_s, self.last_sequence)
        reasons = [
            *reasons,
            *filter(None, (missing, self._further(), self._turned())),
            *self._levers.measure(control.tool_length_mm),
        ]
        done = {}
        for axis, mover in self._movers.items():
            located = mover.locate(now_s, control.positions_mm.get(axis))
            one = self._wanted(axis, now_s, state, held)
            if located is not None:
                one.reasons.append(located)
            self._move(mover, one, step_s, cutting=control.cutting)
            one.arrived = one.arrived and located is None
            done[axis] = one
        return self._applied(now_s, reasons, done)

    def _move(self, mover: AxisMover, one: _Axis, step_s: float, *, cutting: bool) -> None:
        if one.targets_um is None:
            return
        rate = mover.limits.offset_rate_max_um_per_min
        if one.state == "fading":
            rate = min(rate, self._fade_rate_um_per_min)
        step_um = rate * step_s / 60.0
        if one.state == "following" and not cutting:
            step_um += mover.pay(one.targets_um, self._levers.faster_um(rate, step_s))
        one.arrived = mover.move(one.targets_um, step_um)
        if one.state == "fading":
            one.reasons.append(Reason("fading" if any(mover.ends_um) else "faded"))
        elif not one.arrived:
            ends = " … ".join(f"{target:+.2f}" for target in one.targets_um)
            one.reasons.append(Reason("catching_up", f"to {ends} µm"))

    def _wanted(self, axis: str, now_s: float, state: FollowerState, held: Held[Sample] | None) -> _Axis:
        """Return what an axis does: the offsets that its ends go to, or none where it holds."""
        mover, newest = self._movers[axis], self._gate.held
        tilts = [] if newest is None else newest.message.tilts_of(axis)
        if state == "fading":
            self._levers.forget()
            mover.owed_um = 0.0
            return _Axis(state, [], (0.0,) * len(mover.ends_um))
        if held is None:
            return _Axis(state, self._levers.held(tilts, mover.limits.sign))
        message = held.message.of(axis)
        reasons = []
        for one in (message, *tilts):
            codes = ", ".join(one.reasons)
            if not one.usable or one.offset is None:
                because = Reason(f"service_{one.state}", codes)
                because = because if one is message else with_axis(because, one.axis)
                return _Axis("holding", [because, *self._levers.held(tilts, mover.limits.sign)])
            if one.state == "degraded":
                reasons.append(Reason("service_degraded", codes))
        targets = self._targets(mover, message, tilts, followed_s(now_s, held) / 60.0, reasons)
        return _Axis("following", list(dict.fromkeys(reasons)), targets)

    def _targets(
        self, mover: AxisMover, message: AxisMessage, tilts: list[AxisMessage], minutes: float, reasons: list[Reason]
    ) -> tuple[float, ...]:
        """Return the offsets of both ends, from the published values and rates; add what is limited."""
        limits = mover.limits
        base_um = (message.offset or 0.0) + message.rate_per_min * minutes
        for tilt in tilts:
            angle = (tilt.offset or 0.0) + tilt.rate_per_min * minutes
            angle = _limited(angle, self._tilts[tilt.axis].offset_max_urad, "µrad", reasons)
            added_um, change_um = self._levers.follow(tilt, angle)
            mover.owe(limits.sign * change_um)
            base_um += added_um
        slope = message.slope_um_per_m + message.slope_rate_um_per_m_per_min * minutes
        if limits.has_slope:
            slope = _limited(slope, limits.slope_max_um_per_m, "µm/m", reasons)
        elif slope != 0.0:
            reasons.append(Reason("slope_not_applied", f"the offset holds at {message.reference_mm:g} mm"))
            slope = 0.0
        ends = (limits.sign * (base_um + _slope_um(slope, message, place_mm)) for place_mm in mover.places_mm)
        return tuple(_limited(end, limits.offset_max_um, "µm", reasons) for end in ends)

    # ------------------------------------------------------------------ what is shown

    def _further(self) -> Reason | None:
        held = self._gate.held
        further = [] if held is None else [axis for axis in held.message.axes[0].axes if axis not in self.axes]
        return Reason("further_axes", ", ".join(further)) if further else None

    def _turned(self) -> Reason | None:
        """Return which axes both the service and this side turn, so that neither does."""
        held = self._gate.held
        turned = [] if held is None else [a for a, sign in self.signs.items() if held.message.of(a).sign == sign == -1]
        return Reason("signs_cancel", ", ".join(turned)) if turned else None

    def _applied(self, now_s: float, reasons: list[Reason], done: Mapping[str, _Axis]) -> AppliedAxes:
        held = self._gate.held
        age_s = None if held is None else max(now_s - held.measured_s, 0.0)
        seq = None if held is None else held.message.seq
        axes = {
            axis: AppliedAxis(
                offset_um=self._movers[axis].offset_um,
                state=one.state,
                reasons=(*reasons, *one.reasons),
                arrived=one.arrived,
                age_s=age_s,
                seq=seq,
                service_state=None if held is None else held.message.of(axis).state,
                places_mm=self._movers[axis].places_mm,
                ends_um=self._movers[axis].ends_um,
            )
            for axis, one in done.items()
        }
        return AppliedAxes(
            axes=axes,
            state=next((one.state for one in done.values() if one.state != "following"), "following"),
            reasons=(*reasons, *together({axis: one.reasons for axis, one in done.items()})),
            arrived=all(one.arrived for one in done.values()),
            age_s=age_s,
            seq=seq,
        )


def check_axes(axes: Mapping[str, AxisLimits | TiltLimits], tool: ToolLimits | None) -> None:
    """Check that axes, angles and tool belong together.

    Raises
    ------
    ReceiverError
        One line that names the table.
    """
    for axis, limits in axes.items():
        if axis not in (LINEAR if isinstance(limits, AxisLimits) else TILTS):
            raise ReceiverError(f"axis.{axis}: expected x, y or z with an offset, a or b with an angle")
    if not any(axis in LINEAR for axis in axes):
        raise ReceiverError("axis: expected at least one of x, y, z")
    tilts = [axis for axis in axes if axis in TILTS]
    if tilts and tool is None:
        raise ReceiverError(f"axis.{tilts[0]}: an angle needs a table [tool]")


def _check_value(axis: str, unit: str, value: float | None, most: float) -> None:
    if value is not None and abs(value) > most:
        raise Rejected(Reason("beyond_limit", f"{axis}: {value:.2f} {unit}, expected at most {most:g}"))


def _limited(value: float, most: float, unit: str, reasons: list[Reason]) -> float:
    if abs(value) <= most:
        return value
    reasons.append(Reason("limit_reached", f"{most:g} {unit}"))
    return math.copysign(most, value)


def _slope_um(slope_um_per_m: float, message: AxisMessage, place_mm: float) -> float:
    return slope_um_per_m * (place_mm - message.reference_mm) / 1000.0
