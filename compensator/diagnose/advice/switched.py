"""Events of a machine: when a channel is switched, how often it acts in a record, and what goes with it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom

from compensator.arrays import Vector
from compensator.diagnose.residual.evidence import Evidence

Time = tuple[int, float]

#: A channel is switched where it changes by this share of its span within a few samples.
SWITCH_SHARE, SWITCH_SAMPLES = 0.2, 3
#: A swing is a change by this share of the span, however slow.
SWING_SHARE = 0.4
#: Something goes with a channel where at least this share of its times meets the channel's, and chance would do that
#: more rarely than this.
MEETS, CHANCE = 0.6, 1e-3
#: Share of a course that a day's sine explains where it goes with the day, and the least length of the record, min.
DAILY, LEAST_DAY_MIN = 0.6, 2160.0
#: Name of the heat among the channels, and of the day as an event.
HEAT, DAY = "heat", "day"


@dataclass(frozen=True, slots=True, kw_only=True)
class GoesWith:
    """An event that something goes with.

    Parameters
    ----------
    event : str
        A channel that is switched then, `heat`, or `day`.
    times, of : int
        How many of how many times meet the event; 0 for a day.
    """

    event: str
    times: int = 0
    of: int = 0


def switched(values: Vector, period_min: float) -> Vector:
    """Return when a channel is switched, min.

    Parameters
    ----------
    values : numpy.ndarray, shape (n,)
        A record.
    period_min : float
        Sample period, min.

    Examples
    --------
    >>> switched(np.repeat([0.0, 5.0, 0.0], 20), 1.0)
    array([20., 40.])
    """
    low, high = np.quantile(values, [0.005, 0.995]).tolist()
    if values.size < 4 * SWITCH_SAMPLES or high - low <= 0.0:
        return np.zeros(0)
    sums = np.concatenate(([0.0], np.cumsum(values)))
    means = (sums[SWITCH_SAMPLES:] - sums[:-SWITCH_SAMPLES]) / SWITCH_SAMPLES
    change = np.abs(means[SWITCH_SAMPLES:] - means[:-SWITCH_SAMPLES])
    times, at = [], 0
    above = np.flatnonzero(change > SWITCH_SHARE * (high - low))
    while at < above.size:
        # One switching is seen by several neighbours: it is where the change is largest.
        end = at + int(np.searchsorted(above[at:], above[at] + 2 * SWITCH_SAMPLES))
        times.append(float(above[at:end][np.argmax(change[above[at:end]])] + SWITCH_SAMPLES) * period_min)
        at = end
    return np.array(times)


def swings(values: Vector) -> int:
    """Return how often a signal goes up or down by much of its span.

    Examples
    --------
    >>> swings(np.array([0.0, 0.1, 1.0, 0.9, 0.0])), swings(np.array([0.0, 1.0, 1.0]))
    (2, 1)
    """
    least = SWING_SHARE * float(np.ptp(values))
    if least <= 0.0:
        return 0
    count, direction, low, high = 0, 0, float(values[0]), float(values[0])
    for value in values.tolist():
        low, high = min(low, value), max(high, value)
        if direction <= 0 and value - low >= least:
            count, direction, high = count + 1, 1, value
        elif direction >= 0 and high - value >= least:
            count, direction, low = count + 1, -1, value
    return count


def switchings_of(evidence: Evidence) -> Mapping[str, list[Time]]:
    """Return when each channel, and the heat, is switched: record and time, min."""
    period_min = evidence.context.period_min
    found: dict[str, list[Time]] = {}
    for record in evidence.signals:
        signals = {name: record.channels[name] for name in evidence.context.channels}
        if evidence.context.has_ttf:
            signals[HEAT] = record.drive
        for name, values in signals.items():
            found.setdefault(name, []).extend((record.number, at) for at in switched(values, period_min).tolist())
    return found


def goes_with(evidence: Evidence, times: Sequence[Time], tolerance_min: float) -> GoesWith | None:
    """Return the channel that is switched when something else is, if chance hardly makes it so.

    Parameters
    ----------
    evidence : Evidence
        Channels.
    times : sequence of (int, float)
        Record and time, min, of each switching of the other.
    tolerance_min : float
        Largest distance of two times that meet, min.
    """
    minutes = sum(record.size for record in evidence.signals) * evidence.context.period_min
    best: tuple[float, GoesWith] | None = None
    for name, events in switchings_of(evidence).items():
        met = sum(any(r == q and abs(a - b) <= tolerance_min for q, b in events) for r, a in times)
        share = min(1.0, len(events) * 2.0 * tolerance_min / minutes)
        chance = float(binom.sf(met - 1, len(times), share)) if met else 1.0
        # Of channels that meet equally, that which is switched least often beside it.
        if met >= MEETS * len(times) and chance < CHANCE and (best is None or chance < best[0]):
            best = chance, GoesWith(event=name, times=met, of=len(times))
    return best[1] if best else None


def follows_day(evidence: Evidence, course: Vector) -> bool:
    """Return whether a course over all samples is mostly a sine of a day."""
    if evidence.context.minutes < LEAST_DAY_MIN or not np.any(course):
        return False
    parts = []
    for record in evidence.signals:
        angle = 2.0 * math.pi * record.minutes / 1440.0
        parts.append(np.column_stack([np.sin(angle), np.cos(angle), np.ones(record.size)]))
    table, used = np.concatenate(parts), evidence.used
    centred = course[used] - course[used].mean()
    left = centred - table[used] @ np.linalg.lstsq(table[used], centred, rcond=None)[0]
    return bool(np.var(left) < (1.0 - DAILY) * np.var(centred))


def steepest(evidence: Evidence, course: Vector, count: int) -> list[Time]:
    """Return when a course that is no switching moves fastest: record and time, min, apart from each other.

    Parameters
    ----------
    evidence : Evidence
        Records.
    course : numpy.ndarray, shape (n,)
        On every sample; NaN where it is not known.
    count : int
        Most times.
    """
    found: list[tuple[float, Time]] = []
    period_min = evidence.context.period_min
    for record, run in zip(evidence.signals, evidence.samples_of_runs(), strict=True):
        part = course[run]
        wide = max(2, record.size // 200)
        # To the next known value that is at least so far away: a hole is crossed, and its edges are no movement.
        known = np.flatnonzero(np.isfinite(part))
        behind = np.searchsorted(known, known + wide)
        first, last = known[behind < known.size], known[behind[behind < known.size]]
        slope = np.abs(part[last] - part[first]) * (wide / (last - first))
        least = 0.5 * float(slope.max(initial=0.0))
        for at in np.argsort(slope)[::-1][: 20 * count].tolist():
            time = record.number, float(first[at] + last[at]) / 2.0 * period_min
            apart = 4.0 * wide * period_min
            if slope[at] > least and all(r != time[0] or abs(t - time[1]) > apart for _, (r, t) in found):
                found.append((float(slope[at]), time))
    return [time for _, time in sorted(found, reverse=True)[:count]]
