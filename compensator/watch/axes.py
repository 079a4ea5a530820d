"""The axes of a machine that has several, in the views."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import UNSET

from compensator.axes import FIRST, label_of
from compensator.codes import worst_state
from compensator.messages import Offset
from compensator.messages_axes import SHOWN_UNITS, UNITS, AxisOffset


def worst(offset: Offset, axes: Mapping[str, AxisOffset], before: int) -> tuple[str, list[str]]:
    """Return the worst state of all axes, and the reasons of all, each once.

    The offsets of a sample arrive one after the other: until that of the newest sample is here, an axis counts with
    that of the sample before.

    Parameters
    ----------
    offset : Offset
        Of Y.
    axes : mapping of str to AxisOffset
        Those of further axes that were received last; older ones than `before` do not count.
    before : int
        Number of the sample before that of `offset`.
    """
    valid = [one for one in axes.values() if one.seq >= before and one.machine == offset.machine]
    state = worst_state(one.state for one in (offset, *valid))
    return state, list(dict.fromkeys(reason for one in (offset, *valid) for reason in one.reasons))


def missing_axes(offset: Offset | None, axes: Mapping[str, AxisOffset], due: int | None) -> list[str]:
    """Return the labels of the axes of a machine that have no offset of its newest sample; none if it has Y alone.

    Parameters
    ----------
    offset : Offset or None
        Of Y.
    axes : mapping of str to AxisOffset
        Those of further axes that were received last.
    due : int or None
        Number of an earlier sample that is asked for instead of the newest.
    """
    if not isinstance(offset, AxisOffset):
        return []
    seqs = {axis: one.seq for axis, one in axes.items() if one.machine == offset.machine} | {FIRST: offset.seq}
    least = max(seqs.values()) if due is None else due
    return [label_of(axis).upper() for axis in offset.axes if axis in UNITS and seqs.get(axis, -1) < least]


def axis_snapshot(offset: AxisOffset, axes: Mapping[str, AxisOffset], *, silent: bool) -> list[dict[str, Any]]:
    """Return the present values of every axis; an axis whose message of this sample is missing has none.

    Parameters
    ----------
    offset : AxisOffset
        Of Y.
    axes : mapping of str to AxisOffset
        Those of further axes.
    silent : bool
        Whether the last offset is out of date; then there is no rate.
    """
    found = []
    for axis in offset.axes:
        if axis not in UNITS:
            continue
        message = offset if axis == FIRST else axes.get(axis)
        if message is not None and (message.seq, message.machine) != (offset.seq, offset.machine):
            message = None
        entry: dict[str, Any] = {
            "axis": axis,
            "label": label_of(axis).upper(),
            "unit": SHOWN_UNITS[UNITS[axis]],
            "offset": message.y_offset_um if message is not None else None,
            "rate_per_min": message.y_offset_rate_um_per_min if message is not None and not silent else None,
            "std": message.y_offset_std_um if message is not None else None,
            "state": message.state if message is not None else None,
            "reasons": list(message.reasons) if message is not None else [],
        }
        if message is not None and message.y_slope_um_per_m is not UNSET:
            entry["slope_um_per_m"] = message.y_slope_um_per_m
        found.append(entry)
    return found
