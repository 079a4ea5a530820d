"""Messages of a machine of several axes: those of Y, with the axis in them, and the same for every other axis.

An offset of any axis is one class whose attributes are written for Y (`y_offset_um`); in JSON they have the names and
units of the axis, such as `z_offset_um` or `a_offset_urad`. A machine with Y alone has none of these.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, UnsetType

from compensator.axes import FIRST
from compensator.codes import State
from compensator.messages import MESSAGES, EstimateMessage, Number, Offset, OffsetValue, Status, number

#: Axes of a control and its tilts, each with the unit of its offset.
UNITS: Mapping[str, str] = {"x": "um", "y": "um", "z": "um", "a": "urad", "b": "urad"}
#: Units in names, and as people see them; the last is that of a slope.
SHOWN_UNITS: Mapping[str, str] = {"um": "µm", "urad": "µrad", "um_per_m": "µm/m"}


class AxisOffset(Offset, frozen=True, kw_only=True):
    """The correction of one axis of several, `thermal/<axis>/offset`; `/offset` of Y, else `/<axis>_offset`.

    Parameters
    ----------
    y_offset_um, y_offset_rate_um_per_min, y_offset_std_um : float or None
        As in `Offset`, in the unit of the axis.
    axis : str
        The axis.
    axes : list of str
        All axes of the sample; their messages have the same `seq` and belong together.
    acts_on : str, optional
        Of a tilt: the axis whose offset changes by the angle, times the length of the tool less `reference_mm`.
    reference_mm : float, optional
        Of a tilt: the length of the tool for which the offset of that axis holds, mm. Of a slope: the position of the
        axis at which its offset holds, mm.
    y_slope_um_per_m, y_slope_rate_um_per_m_per_min, y_slope_std_um_per_m : float or None, optional
        How the offset changes with the position of the axis, µm/m.
    sign : int, optional
        −1 where the service has turned what was calibrated into the sense of the control's axis: whoever applies it
        does not turn it again. Absent where nothing was turned.
    """

    axis: str
    axes: list[str]
    acts_on: str | UnsetType = UNSET
    reference_mm: Number | UnsetType = UNSET
    y_slope_um_per_m: OffsetValue | UnsetType | None = UNSET
    y_slope_rate_um_per_m_per_min: Number | UnsetType | None = UNSET
    y_slope_std_um_per_m: Number | UnsetType | None = UNSET
    sign: Annotated[int, Meta(ge=-1, le=1)] | UnsetType = UNSET


class AxesEstimate(EstimateMessage, frozen=True, kw_only=True):
    """What the model makes of one sample on a machine of several axes.

    Parameters
    ----------
    axes : dict
        Values of the further axes, tilts and slopes by their names, such as `z_dtf_um`, `z_tdtf_um`, `z_effects_um`,
        `z_base_um`, `z_pred_um`, `z_std_um`; `z_um`, `z_ref_um` and `z_residual_um` where the axis is measured. Units
        are in the names; rates are in the offsets.
    """

    axes: dict[str, Number | list[Number] | None]


class AxisState(msgspec.Struct, frozen=True, kw_only=True):
    """State of an axis and the reasons for it."""

    state: State
    reasons: list[str]


class AxesStatus(Status, frozen=True, kw_only=True):
    """How the service of several axes is; `state` and `reasons` are those of Y.

    Parameters
    ----------
    axes : dict of str to AxisState
        State of each axis.
    """

    axes: dict[str, AxisState]


def named_for(axis: str, name: str) -> str:
    """Return a name that is written for Y, in µm, for an axis and in its unit.

    Examples
    --------
    >>> named_for("z", "y_offset_rate_um_per_min"), named_for("a", "y_offset_um"), named_for("z", "y_slope_um_per_m")
    ('z_offset_rate_um_per_min', 'a_offset_urad', 'z_slope_um_per_m')
    """
    rest = name.removeprefix(f"{FIRST}_")
    if not rest.startswith("slope"):
        rest = rest.replace("um", UNITS[axis], 1)
    return f"{axis}_{rest}"


def _offset_of(axis: str) -> type[AxisOffset]:
    fields = [
        (field.name, field.type, msgspec.field(name=named_for(axis, field.name), default=field.default))
        if field.default is not msgspec.NODEFAULT
        else (field.name, field.type, msgspec.field(name=named_for(axis, field.name)))
        for field in msgspec.structs.fields(AxisOffset)
        if field.name.startswith(f"{FIRST}_")
    ]
    made = msgspec.defstruct(
        f"{axis.upper()}Offset", fields, bases=(AxisOffset,), frozen=True, kw_only=True, module=__name__
    )
    made.__doc__ = AxisOffset.__doc__
    return made  # type: ignore[return-value]


#: Message of each axis, tilts included.
OFFSETS: Mapping[str, type[AxisOffset]] = {axis: _offset_of(axis) for axis in UNITS}


class RecordedOffsets(msgspec.Struct, frozen=True, kw_only=True):
    """The offsets of one sample of all axes but Y, each exactly as it was published, `/offsets`; in recordings only.

    Parameters
    ----------
    x, z, a, b : AxisOffset, optional
        Message of each axis that the machine has.
    """

    def messages(self) -> list[AxisOffset]:
        """Return the messages of all axes."""
        return [one for one in msgspec.structs.asdict(self).values() if one is not UNSET]


_Offsets = msgspec.defstruct(
    "Offsets",
    [(axis, kind | UnsetType, UNSET) for axis, kind in OFFSETS.items() if axis != FIRST],
    bases=(RecordedOffsets,),
    frozen=True,
    kw_only=True,
    module=__name__,
)
_Offsets.__doc__ = RecordedOffsets.__doc__


def recorded_offsets(offsets: Iterable[AxisOffset]) -> RecordedOffsets:
    """Return the record of the offsets of a sample; that of Y is not in it."""
    return _Offsets(**{one.axis: one for one in offsets if one.axis != FIRST})  # type: ignore[return-value]


def further_values(offsets: Iterable[AxisOffset]) -> dict[str, float]:
    """Return the values of further axes and of all slopes by name, such as `z` and `y_slope`; NaN where missing.

    Parameters
    ----------
    offsets : iterable of AxisOffset
        Messages of one sample.
    """
    found = {}
    for one in offsets:
        if one.axis != FIRST:
            found[one.axis] = number(one.y_offset_um)
        if one.y_slope_um_per_m is not UNSET:
            found[f"{one.axis}_slope"] = number(one.y_slope_um_per_m)
    return found


def further_bases(estimate: AxesEstimate) -> dict[str, float]:
    """Return what each further output was predicted to be at its zero by name, such as `z` and `y_slope`.

    Parameters
    ----------
    estimate : AxesEstimate
        Has it under names such as `z_base_um`.
    """
    named = ((name.partition("_base_"), value) for name, value in estimate.axes.items())
    return {name: value for (name, base, _), value in named if base and isinstance(value, (int, float))}


def names_axes(data: bytes) -> bool:
    """Return whether an offset or an estimate is of a machine of several axes; only those messages name them."""
    return b'"axes":' in data


def topic_of(axis: str) -> str:
    """Return the name of an axis' offset where it is published, and its topic in the recording of a shop."""
    return "offset" if axis == FIRST else f"{axis}_offset"


def axis_of(topic: str) -> str | None:
    """Return the axis whose offset a topic holds; None for any other topic."""
    axis = FIRST if topic == "offset" else topic.removesuffix("_offset")
    return axis if axis in UNITS and topic == topic_of(axis) else None


#: Message of each topic that only a machine of several axes has, and what `offset`, `estimate` and `status` are there.
AXES_MESSAGES: Mapping[str, type[msgspec.Struct]] = {
    **{f"{axis}_offset": kind for axis, kind in OFFSETS.items()},
    "offsets": _Offsets,
    "axes_estimate": AxesEstimate,
    "axes_status": AxesStatus,
}
ALL_MESSAGES: Mapping[str, type[msgspec.Struct]] = {**MESSAGES, **AXES_MESSAGES}


def message_of(topic: str, axes: Sequence[str]) -> str:
    """Return the name of the message in a topic of a recording, see `ALL_MESSAGES`.

    Parameters
    ----------
    topic : str
        The topic.
    axes : sequence of str
        Axes of the machine; empty where it has Y alone.
    """
    several = {"offset": "y_offset", "estimate": "axes_estimate", "status": "axes_status"}
    return several.get(topic, topic) if axes else topic
