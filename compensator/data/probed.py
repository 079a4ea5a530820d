"""Y as touch probes measured it: which probes of a record belong together.

Each feature has a level of its own, and a zero may move it: the control is often zeroed with the service. A step
between two levels is none that the machine made. So a table has the probes of one feature and the times of the zeros;
who cannot use a level of each zero takes the values about one of them (`about_one_zero`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from compensator.arrays import Indices, Mask, Vector
from compensator.clock import NS
from compensator.codes import DataRemark, ProbeCode, Remark
from compensator.data.table import Table
from compensator.events import EventKind
from compensator.messages import Event, Probe, number

#: Why a probe is refused, too, if the control applied nothing.
_APPLIED_NOTHING = (ProbeCode.MISMATCH, ProbeCode.DURING_HOLD)


def zeros_ns(events: Iterable[Event], ends_ns: Mapping[int, int]) -> list[int]:
    """Return the times of the samples with which a zero was set, ns since 1970 UTC.

    Parameters
    ----------
    events : iterable of Event
        Events of the record; one of kind `zero` says that a zero was set, and not that it was ordered.
    ends_ns : mapping of int to int
        Ends of the samples by their numbers. Of a sample that was lost the time of its event counts.
    """
    return [ends_ns.get(event.seq, event.time_utc_ns) for event in events if event.kind == EventKind.ZERO]


def measured_probes(name: str, recordings: Sequence[Sequence[Probe]]) -> tuple[list[Probe], tuple[Remark, ...]]:
    """Return the probes of recordings that are a measured Y, those of one feature.

    Parameters
    ----------
    name : str
        Name in remarks.
    recordings : sequence of sequence of Probe
        The probes of each recording.
    """
    shown, remarks = _showing_deformation(name, recordings)
    probes = of_one_feature(shown)
    if others := len(shown) - len(probes):
        feature = probes[0].feature
        words = f"{name}: y_um is that of feature {feature!r}, {len(probes)} probe(s); {others} of others left out."
        remarks = (*remarks, Remark(DataRemark.FEATURES_LEFT_OUT, words))
    return probes, remarks


def of_one_feature(probes: Iterable[Probe]) -> list[Probe]:
    """Return the probes of the feature that has most; of equally many that which came last."""
    groups: dict[str, list[Probe]] = {}
    for probe in probes:
        groups.setdefault(probe.feature, []).append(probe)
    return max(groups.values(), key=lambda group: (len(group), group[-1].time_utc_ns), default=[])


def about_one_zero(times: Vector | Indices, zeros: Sequence[float]) -> Mask:
    """Return which values are about the zero that has most of them; of equally many the last.

    Parameters
    ----------
    times : numpy.ndarray, shape (n,)
        Times of the values.
    zeros : sequence of float
        Times of the zeros, in the same clock.

    Examples
    --------
    >>> about_one_zero(np.array([1.0, 2.0, 3.0, 4.0]), [2.5, 3.5]).tolist()
    [True, True, False, False]
    """
    numbers = np.searchsorted(np.sort(np.asarray(zeros, dtype=times.dtype)), times, side="right")
    counts = np.bincount(numbers, minlength=1)
    return np.asarray(numbers == counts.size - 1 - int(np.argmax(counts[::-1])))


def with_probes(table: Table, probes: Sequence[Probe], zeros_ns: Iterable[int], behind_ns: int) -> Table:
    """Return a table with a row of its own for each probe, whose `y_um` is what it showed, in order of time.

    Parameters
    ----------
    table : Table
        Samples without measured Y; their times are their ends, s since 1970 UTC.
    probes : sequence of Probe
        The probes, of one feature.
    zeros_ns : iterable of int
        Times of the samples with which a zero was set, ns since 1970 UTC.
    behind_ns : int
        Time from the middle of the polls of a sample to its end: a probe's row is as much later than the probe, ns.
    """
    blank, shown = np.full(len(probes), np.nan), [number(probe.deformation_um) for probe in probes]
    columns = {name: np.concatenate([values, blank]) for name, values in table.columns.items()}
    columns["y_um"] = np.concatenate([np.full(table.t_s.size, np.nan), shown])
    t_s = np.concatenate([table.t_s, [(probe.time_utc_ns + behind_ns) / NS for probe in probes]])
    order = np.argsort(t_s, kind="stable")
    return replace(
        table,
        t_s=t_s[order],
        columns={name: values[order] for name, values in columns.items()},
        rows=range(2, t_s.size + 2),
        zeros_s=tuple((at_ns + behind_ns) / NS for at_ns in sorted(zeros_ns)),
    )


def of_one_zero(table: Table) -> tuple[Table, tuple[Remark, ...]]:
    """Return a table with its Y about one zero, that of which it has most values, and a remark on the others."""
    if not table.zeros_s:
        return table, ()
    y = table.columns["y_um"].copy()
    measured = np.flatnonzero(np.isfinite(y))
    others = measured[~about_one_zero(table.t_s[measured], table.zeros_s)]
    y[others] = np.nan
    one = replace(table, columns=table.columns | {"y_um": y}, zeros_s=())
    return one, others_left_out(table.name, measured.size - others.size, others.size)


def others_left_out(name: str, kept: int, others: int) -> tuple[Remark, ...]:
    """Return the remark that probes about other zeros are left out; nothing where there are none."""
    words = f"{name}: y_um is that about one zero, {kept} probe(s); {others} about others left out."
    return (Remark(DataRemark.ZEROS_LEFT_OUT, words),) if others else ()


def _showing_deformation(name: str, recordings: Sequence[Sequence[Probe]]) -> tuple[list[Probe], tuple[Remark, ...]]:
    """Return the probes of recordings that are a measured Y: taken, or refused only because nothing was applied.

    That nothing was applied is believed of a calibration: where others show that an offset was, what a refused probe
    shows is unknown.
    """
    shown: list[Probe] = []
    untold = 0
    for probes in recordings:
        is_calibration = not any(probe.offset_applied_um for probe in probes)
        for probe in probes:
            if probe.deformation_um is None:
                continue
            applied_nothing = probe.code in _APPLIED_NOTHING and probe.offset_applied_um == 0.0
            if probe.taken or (applied_nothing and is_calibration):
                shown.append(probe)
            else:
                untold += applied_nothing
    if not untold:
        return shown, ()
    words = f"{name}: {untold} refused probe(s) with offset_applied_um = 0 left out: others show that one was applied."
    return shown, (Remark(DataRemark.PROBES_LEFT_OUT, words),)
