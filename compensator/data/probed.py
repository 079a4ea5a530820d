"""Y as touch probes measured it: which probes of a record belong together."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from compensator.arrays import Vector
from compensator.clock import NS
from compensator.codes import DataRemark, ProbeCode, Remark
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


def measured_probes(
    name: str, recordings: Sequence[Sequence[Probe]], zeros_ns: Iterable[int]
) -> tuple[list[Probe], tuple[Remark, ...]]:
    """Return the probes of recordings that are a measured Y, those of one level; see `of_one_level`.

    Parameters
    ----------
    name : str
        Name in remarks.
    recordings : sequence of sequence of Probe
        The probes of each recording.
    zeros_ns : iterable of int
        Times of the samples with which a zero was set, ns since 1970 UTC.
    """
    shown, untold = _showing_deformation(name, recordings)
    probes = of_one_level(shown, zeros_ns)
    if len(probes) == len(shown):
        return probes, untold
    feature, remarks = probes[0].feature, list(untold)
    others = sum(probe.feature != feature for probe in shown)
    if others:
        words = f"{name}: y_um is that of feature {feature!r}, {len(probes)} probe(s); {others} of others left out."
        remarks.append(Remark(DataRemark.FEATURES_LEFT_OUT, words))
    if before_or_after := len(shown) - len(probes) - others:
        words = f"{name}: y_um is that about one zero, {len(probes)} probe(s); {before_or_after} about others left out."
        remarks.append(Remark(DataRemark.ZEROS_LEFT_OUT, words))
    return probes, tuple(remarks)


def of_one_level(probes: Iterable[Probe], zeros_ns: Iterable[int]) -> list[Probe]:
    """Return the probes of the feature and about the zero that have most; of equally many the last ones.

    Each feature has a level of its own, and counts anew at a zero: against the values before it that is a step which
    the machine did not make.

    Parameters
    ----------
    probes : iterable of Probe
        In order.
    zeros_ns : iterable of int
        Times of the samples with which a zero was set, ns since 1970 UTC.
    """
    zeros = sorted(zeros_ns)
    groups: dict[tuple[str, int], list[Probe]] = {}
    for probe in probes:
        groups.setdefault((probe.feature, bisect_right(zeros, probe.time_utc_ns)), []).append(probe)
    return max(reversed(groups.values()), key=len, default=[])


def with_probes(
    t_s: Vector, columns: Mapping[str, Vector], probes: Sequence[Probe], behind_ns: int
) -> tuple[Vector, dict[str, Vector]]:
    """Return a table with a row of its own for each probe, whose `y_um` is what it showed, in order of time.

    Parameters
    ----------
    t_s : array, shape (n,)
        Times of the samples, their ends, s since 1970 UTC.
    columns : mapping of str to array, shape (n,)
        Columns without measured Y.
    probes : sequence of Probe
        The probes.
    behind_ns : int
        Time from the middle of the polls of a sample to its end: a probe's row is as much later than the probe, ns.
    """
    blank, shown = np.full(len(probes), np.nan), [number(probe.deformation_um) for probe in probes]
    longer = {name: np.concatenate([values, blank]) for name, values in columns.items()}
    longer["y_um"] = np.concatenate([np.full(t_s.size, np.nan), shown])
    t_s = np.concatenate([t_s, [(probe.time_utc_ns + behind_ns) / NS for probe in probes]])
    order = np.argsort(t_s, kind="stable")
    return t_s[order], {name: values[order] for name, values in longer.items()}


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
