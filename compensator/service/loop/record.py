"""What of a record may be diagnosed: the outcomes of the service as a table.

Y is left out where a sample shows a fault by itself (`trust`), and for an hour before T_Q and AT contradict each other,
in which the fault was there already. Temperatures and other channels stay as they were measured: they drive the model
throughout. Only where T_Q, AT or Y stood still for an hour, as no live sensor does, are they left out, or each
diagnosis of that record would be refused.

Where Y is probed, the values of one feature are used, as of any recording (`data.probed`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from compensator.arrays import Vector
from compensator.clock import NS
from compensator.codes import Reason
from compensator.data.probed import of_one_feature, with_probes
from compensator.data.screening import dead_part
from compensator.data.table import Table
from compensator.errors import DataError
from compensator.messages import Offset, Probe, Sample, number
from compensator.service.loop.trust import is_contradicted, is_disturbed
from compensator.service.outcome import Outcome, sets_zero

#: Sensors that never stand still.
_ALIVE = ("t_q_degc", "at_degc", "y_um")
#: Y is left out for so long before T_Q and AT contradict each other, h.
BEFORE_H = 1.0


def usable_table(record: Sequence[Outcome]) -> Table:
    """Return outcomes as the table of a diagnosis; the time counts from 1970.

    Where no displacement sensor measured Y, `y_um` is what the probes showed, each in a row of its own: as much later
    than the probe as the time of a sample, its end, is than the middle of its polls.
    """
    return table_of_rows(
        [(outcome.sample, outcome.offset) for outcome in record],
        [probe for outcome in record for probe in outcome.probes],
        "record",
        zeros_ns=[outcome.sample.time_utc_ns for outcome in record if sets_zero(outcome)],
    )


def is_probed(table: Table) -> bool:
    """Return whether Y of a table was probed: its values stand in rows of their own, without a temperature."""
    measured = np.isfinite(table.columns["y_um"])
    return bool(measured.any()) and not bool(np.isfinite(table.columns["t_q_degc"][measured]).any())


def table_of_rows(
    rows: Sequence[tuple[Sample, Offset | None]], probes: Sequence[Probe], name: str, *, zeros_ns: Sequence[int] = ()
) -> Table:
    """Return samples with their offsets, and decided probes, as the table of a diagnosis; see `usable_table`.

    Parameters
    ----------
    rows : sequence of (Sample, Offset or None)
        In order.
    probes : sequence of Probe
        In order.
    name : str
        Name in messages.
    zeros_ns : sequence of int
        Times of the samples with which a zero was set, ns since 1970 UTC, in order.

    Raises
    ------
    DataError
        If there is no sample.
    """
    if not rows:
        raise DataError(f"{name}: no samples in the time that is diagnosed")
    names = dict.fromkeys(channel for sample, _ in rows for channel in sample.channels)
    t_s = np.array([sample.time_utc_ns / NS for sample, _ in rows])
    columns = {channel: np.array([_mean(sample, channel) for sample, _ in rows], dtype=np.float64) for channel in names}
    left_out = _left_out_s(rows)
    y = columns.get("y_um", np.full(t_s.size, np.nan))
    if left_out.size:
        y = np.where(np.isin(t_s, left_out), np.nan, y)
    columns["y_um"] = y
    for channel in _ALIVE:
        columns[channel] = _alive(columns[channel])
    table = Table(name=name, t_s=t_s, columns=columns, rows=range(2, t_s.size + 2))
    if np.isfinite(columns["y_um"]).any():
        return table
    # A sample in which the service began has fewer polls.
    behind_ns = max((sample.behind_ns for sample, _ in rows), default=0)
    return with_probes(table, _usable(probes, left_out, rows), zeros_ns, behind_ns)


def _alive(values: Vector) -> Vector:
    """Return values without those of a sensor that stood still."""
    while (dead := dead_part(values)) is not None:
        values = values.copy()
        values[dead] = np.nan
    return values


def _mean(sample: Sample, channel: str) -> float:
    found = sample.channels.get(channel)
    return number(found.mean) if found is not None and found.is_good else math.nan


def _left_out_s(rows: Sequence[tuple[Sample, Offset | None]]) -> Vector:
    """Return the times of samples whose Y must not be used, s."""
    times, left_out = np.array([sample.time_utc_ns / NS for sample, _ in rows]), np.zeros(len(rows), dtype=bool)
    for i, (_, offset) in enumerate(rows):
        reasons = offset.reasons if offset is not None else [Reason.INTERNAL_ERROR]
        if is_contradicted(reasons):
            left_out |= (times > times[i] - 3600.0 * BEFORE_H) & (times <= times[i])
        left_out[i] |= is_disturbed(reasons)
    return times[left_out]


def _usable(probes: Sequence[Probe], left_out: Vector, rows: Sequence[tuple[Sample, Offset | None]]) -> list[Probe]:
    """Return the taken probes of one feature outside of what is left out."""
    period_s = rows[0][0].period_s if rows else 0.0

    def is_left_out(at_s: float) -> bool:
        return bool(np.any((left_out - period_s <= at_s) & (at_s <= left_out)))

    usable = [probe for probe in probes if probe.taken and not is_left_out(probe.time_utc_ns / NS)]
    return of_one_feature(usable)
