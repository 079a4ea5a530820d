"""Recordings as a table: one row for each sample, with everything that was measured, estimated and published."""

from __future__ import annotations

import bisect
import csv
import logging
import math
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET

from compensator.atomic_write import atomic_write
from compensator.axes import FIRST
from compensator.data.probed import about_one_zero, measured_probes, others_left_out, zeros_ns
from compensator.data.table import MEASURED_HEAT, QUALITY
from compensator.errors import DataError, of_files
from compensator.messages import EstimateMessage, Event, Offset, Probe, Sample, number
from compensator.messages_axes import UNITS, AxesEstimate, AxisOffset, RecordedOffsets, named_for, topic_of
from compensator.recording.reading import machines_in, messages, recordings_in

log = logging.getLogger("compensator")

PathLike = str | os.PathLike[str]

_ESTIMATE = ("heat_w", "y_dtf_um", "y_tdtf_um", "y_pred_um", "y_std_um", "y_ref_um", "residual_um")
_OFFSET = ("y_offset_um", "y_offset_rate_um_per_min", "y_offset_std_um", "state")
_SLOPE = ("y_slope_um_per_m", "y_slope_rate_um_per_m_per_min", "y_slope_std_um_per_m")
_TOPICS = ("sample", "estimate", "offsets", *(topic_of(axis) for axis in UNITS), "probe", "event")
#: Values of further axes that the table has; a measured value is in the column of its channel.
_OF_AXES = ("_dtf_", "_tdtf_", "_pred_", "_std_", "_ref_", "_residual_")


@of_files()
def export(recordings: PathLike | Sequence[PathLike], out: PathLike, machine: str = "") -> int:
    """Write the recordings of one machine as one CSV, in the order of their samples.

    Columns: `time_utc`, `t_s`, `seq`, the mean of every channel by its name and its quality, the estimate, the
    offset, its state and reasons; of a machine of several axes the same of each, such as `z_pred_um`, `z_offset_um`,
    `z_state`. `heat_w` is the estimate; a measured heat is in `heat_measured_w`. `y_um` is as
    measured, and `y_ref_um` its value at the zero: `y_um` − `y_ref_um` counts from the zero of `y_pred_um`. Where no
    displacement sensor measured Y, `y_um` is the deformation that a touch probe showed, at the sample whose polls are
    around its time.

    Parameters
    ----------
    recordings : path or sequence of paths
        The MCAP files, in any order; a folder stands for those in it.
    out : path
        The CSV.
    machine : str
        Prefix of the machine, such as `shop/vmc-07`, in a shop's recording.

    Returns
    -------
    int
        Number of samples.

    Raises
    ------
    CompensatorError
        If one is no recording or has no samples, they are of several machines, or the table cannot be written.
    """
    given = [recordings] if isinstance(recordings, (str, os.PathLike)) else recordings
    paths = recordings_in(map(Path, given))
    if not paths:
        raise DataError("recordings: empty, expected a recording, a folder of them, or a list of those")
    rows: dict[int, dict[str, Any]] = {}
    probes: list[list[Probe]] = []
    events: list[Event] = []
    middles: dict[int, tuple[int, int]] = {}
    machines: dict[str, Path] = {}
    for recording in paths:
        before = len(rows)
        probes.append([])
        for message in _messages(recording, machine):
            machines.setdefault(message.machine, recording)
            if isinstance(message, Probe):
                probes[-1].append(message)
                continue
            if isinstance(message, Event):
                events.append(message)
                continue
            if isinstance(message, Sample):
                middles[message.seq] = message.time_utc_ns - message.behind_ns, round(0.5e9 * message.period_s)
            rows.setdefault(message.seq, {}).update(_cells(message))
        if len(machines) > 1:  # before their numbers are compared: those of two machines may be the same
            (one, first), (other, second) = list(machines.items())[:2]
            raise DataError(f"{first} is of {one}, {second} of {other}; expected recordings of one machine")
        if len(rows) == before:
            raise _without_samples(recording, machine, alone=len(paths) == 1)
    rows = dict(sorted(rows.items()))
    zeros = zeros_ns(events, {seq: row["_ns"] for seq, row in rows.items()})
    _add_probes(str(paths[0]), rows, probes, zeros, middles)
    start = min(row["_ns"] for row in rows.values())
    for row in rows.values():
        row["t_s"] = (row.pop("_ns") - start) / 1e9
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    names.sort(key=lambda name: ("time_utc", "t_s", "seq").index(name) if name in ("time_utc", "t_s", "seq") else 3)
    with atomic_write(Path(out), may_stream=True) as file:
        writer = csv.DictWriter(file, names, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows.values())
    return len(rows)


def _messages(recording: Path, machine: str) -> Iterator[Any]:
    """Yield the messages of a recording, those of further axes one by one."""
    for message in messages(recording, _TOPICS, prefix=machine):
        yield from message.messages() if isinstance(message, RecordedOffsets) else (message,)


def _add_probes(
    name: str,
    rows: dict[int, dict[str, Any]],
    recorded: Sequence[Sequence[Probe]],
    zeros: Sequence[int],
    middles: Mapping[int, tuple[int, int]],
) -> None:
    """Add `y_um` to the rows around the middle of whose polls a probe was measured; one outside of all is left out.

    Parameters
    ----------
    middles : mapping of int to (int, int)
        By `seq`, middle of the polls of a sample and half its period, ns.
    """
    if not any(recorded) or any(row.get("y_um") is not None for row in rows.values()):
        return
    of_feature, remarks = measured_probes(name, recorded)
    kept = about_one_zero(np.array([probe.time_utc_ns for probe in of_feature], dtype=np.int64), zeros)
    probes = [probe for probe, is_kept in zip(of_feature, kept, strict=True) if is_kept]
    for remark in (*remarks, *others_left_out(name, len(probes), len(of_feature) - len(probes))):
        log.warning("%s", remark.marked)
    begins = sorted((middle - half, seq) for seq, (middle, half) in middles.items())
    values: defaultdict[int, list[float]] = defaultdict(list)
    for probe in probes:
        i = bisect.bisect_left(begins, (probe.time_utc_ns, 0)) - 1
        if i >= 0 and probe.time_utc_ns - begins[i][0] <= 2 * middles[begins[i][1]][1]:
            values[begins[i][1]].append(number(probe.deformation_um))
    for row in rows.values():
        row.setdefault("y_um", None)
    for seq, measured in values.items():
        rows[seq]["y_um"] = math.fsum(measured) / len(measured)


def _without_samples(recording: Path, machine: str, *, alone: bool) -> DataError:
    """Return the error of a file without a new row; a file given twice has none the second time."""
    machines = machines_in(recording)
    if machines:
        words = f"of {machine or 'one machine'} in it; a shop's recording, expected --machine"
        return DataError(f"{recording}: no samples {words}, one of: {', '.join(machines)}")
    return DataError(f"{recording}: no samples in it" + ("" if alone else " that the files before it have not"))


def _cells(message: Sample | EstimateMessage | Offset) -> dict[str, Any]:
    cells: dict[str, Any] = {
        "_ns": message.time_utc_ns,
        "time_utc": datetime.fromtimestamp(message.time_utc_ns / 1e9, UTC).isoformat(),
        "seq": message.seq,
    }
    if isinstance(message, Sample):
        for name, channel in message.channels.items():
            # A mean that the guards refused is missing from the table; the quality says why.
            cells[MEASURED_HEAT if name == "heat_w" else name] = channel.mean if channel.is_good else None
            cells[f"{name}{QUALITY}"] = channel.quality
        return cells
    if isinstance(message, AxisOffset) and message.axis != FIRST:
        return cells | _axis_cells(message)
    fields = msgspec.structs.asdict(message)
    cells |= {name: fields[name] for name in (_ESTIMATE if isinstance(message, EstimateMessage) else _OFFSET)}
    if isinstance(message, Offset):
        cells["reasons"] = " ".join(message.reasons)
    if isinstance(message, AxisOffset):
        cells |= _axis_cells(message)
    if isinstance(message, AxesEstimate):
        own = {name: value for name, value in message.axes.items() if not isinstance(value, list)}
        cells |= {name: value for name, value in own.items() if any(part in name for part in _OF_AXES)}
    return cells


def _axis_cells(message: AxisOffset) -> dict[str, Any]:
    """Return the columns of an axis of several; state and reasons of Y have no name of an axis."""
    names = _OFFSET[:3] if message.axis != FIRST else ()
    cells = {named_for(message.axis, name): getattr(message, name) for name in names}
    if message.axis != FIRST:
        cells |= {f"{message.axis}_state": message.state, f"{message.axis}_reasons": " ".join(message.reasons)}
    if message.y_slope_um_per_m is not UNSET:
        cells |= {named_for(message.axis, name): getattr(message, name) for name in _SLOPE}
    return cells
