"""The offset of one axis of several, every key checked: a message with any error is dropped with a reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .limits import LONGEST_MM
from .message import USABLE, decode, header_of, malformed, number, number_of, value_of
from .reasons import Reason

#: Axes that have an offset, and angles that act on one of them.
LINEAR, TILTS = ("x", "y", "z"), ("a", "b")
#: The axis of a service that has one alone; its messages do not name it.
ALONE = "y"
#: Largest value and rate: beyond it arithmetic with them says nothing.
_LARGEST = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisMessage:
    """A checked offset of one axis.

    Parameters
    ----------
    axis : str
        `x`, `y` or `z`; `a` or `b` for an angle.
    axes : tuple of str
        All axes that are published with this number.
    machine, seq, time_utc_ns, valid_for_s, state, reasons
        As in `OffsetMessage`.
    offset : float or None
        To be added to the commanded position, µm; of an angle µrad. A number whenever the state is `ok` or `degraded`.
    rate_per_min : float
        Rate until the next offset, in that unit per minute; 0 where none is known.
    slope_um_per_m, slope_rate_um_per_m_per_min : float
        Change of the offset over the axis' position, µm/m, and its rate; 0 without a slope.
    reference_mm : float
        Position for which the offset holds; of an angle the length of the tool, mm. 0 without angle and slope.
    acts_on : str
        Axis on which an angle acts; empty for the others.
    sign : int
        −1 where the service has turned the direction of the axis.
    """

    axis: str
    axes: tuple[str, ...]
    machine: str
    seq: int
    time_utc_ns: int
    valid_for_s: float
    state: str
    reasons: tuple[str, ...]
    offset: float | None
    rate_per_min: float
    slope_um_per_m: float = 0.0
    slope_rate_um_per_m_per_min: float = 0.0
    reference_mm: float = 0.0
    acts_on: str = ""
    sign: int = 1

    @property
    def usable(self) -> bool:
        """Whether a receiver may follow it."""
        return self.state in USABLE


def parse_axis(payload: bytes, axis: str) -> AxisMessage:
    """Decode and check a payload; unknown keys are ignored.

    Parameters
    ----------
    payload : bytes
        Payload as received.
    axis : str
        Axis of the key that it was published under.

    Raises
    ------
    Rejected
        `malformed` or `other_schema`; the detail names the axis.
    """
    table = decode(payload)
    head = header_of(table)
    offset, rate = _bounded(table, f"{axis}_offset", "urad" if axis in TILTS else "um")
    return AxisMessage(
        axis=axis,
        axes=_axes(table, axis),
        sign=_sign(table),
        offset=offset,
        rate_per_min=rate,
        **head,
        **number_of(table),
        **(_tilt(table) if axis in TILTS else _slope(table, axis)),
    )


def _axes(table: dict[str, Any], axis: str) -> tuple[str, ...]:
    """Return the axes of the sample; a service with Y alone names none."""
    named, axes = table.get("axis", ALONE), table.get("axes", [ALONE])
    if named != axis:
        raise malformed("axis", named, axis)
    if not isinstance(axes, list) or axis not in axes or not all(one in LINEAR + TILTS for one in axes):
        raise malformed("axes", axes, f"a list of axes, {axis} among them")
    if len(set(axes)) != len(axes):
        raise malformed("axes", axes, "each axis once")
    return tuple(axes)


def _sign(table: dict[str, Any]) -> int:
    """Return by what the service has turned the axis; it says so only where it has."""
    sign = table.get("sign", 1)
    if isinstance(sign, bool) or sign not in (1, -1):
        raise malformed("sign", sign, "1 or -1")
    return int(sign)


def _bounded(table: dict[str, Any], name: str, unit: str) -> tuple[float | None, float]:
    value, rate = value_of(table, name, unit)
    for key, one in ((f"{name}_{unit}", value), (f"{name}_rate_{unit}_per_min", rate)):
        if one is not None and abs(one) > _LARGEST:
            raise malformed(key, one, f"at most {_LARGEST:g}")
    return value, rate


def _reference_mm(table: dict[str, Any]) -> float:
    reference_mm = number(table, "reference_mm")
    if reference_mm is None or abs(reference_mm) > LONGEST_MM:
        raise malformed("reference_mm", reference_mm, f"a number, at most {LONGEST_MM:g}")
    return reference_mm


def _tilt(table: dict[str, Any]) -> dict[str, Any]:
    acts_on = table.get("acts_on")
    if acts_on not in LINEAR:
        raise malformed("acts_on", acts_on, f"one of {', '.join(LINEAR)}")
    return {"acts_on": acts_on, "reference_mm": _reference_mm(table)}


def _slope(table: dict[str, Any], axis: str) -> dict[str, Any]:
    name = f"{axis}_slope"
    if not any(key in table for key in (f"{name}_um_per_m", f"{name}_rate_um_per_m_per_min", f"{name}_std_um_per_m")):
        return {}
    slope, rate = _bounded(table, name, "um_per_m")
    return {
        "slope_um_per_m": slope or 0.0,  # None in a state that is not followed
        "slope_rate_um_per_m_per_min": rate,
        "reference_mm": _reference_mm(table),
    }


def with_axis(reason: Reason, axis: str) -> Reason:
    """Return a reason whose detail begins with the axis."""
    return Reason(reason.code, f"{axis}: {reason.detail}" if reason.detail else axis)
