"""Leaves out readings that a sensor cannot have meant: one or two wrong ones, and those at the end of its range."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from compensator.arrays import Indices, Mask, Vector, stretches_of
from compensator.codes import DataRemark, Remark
from compensator.data.record import SHORT_GAP_SAMPLES, TEMPERATURES, SampledRecord
from compensator.data.runs import is_sparse, noise_std
from compensator.data.screening import DEAD_SAMPLES, LIVELY_STILL, LIVELY_TURNS
from compensator.errors import DataError

#: A reading this many noise deviations away from what is beside it is an outlier.
OUTLIER_DEVIATIONS = 12.0
#: So many outliers may follow each other where a signal is slow: what disturbs one reading may reach into the next.
IN_A_ROW = 2
#: What is beside an outlier is together within this share of its distance.
TOGETHER = 0.3
#: At an end of a record so many samples beside a reading have to be together.
BESIDE_SAMPLES = 5
#: Endings of what is measured and follows slowly: temperatures, displacements, tilts. All else may be commanded.
TEMPERATURE, SLOW = "_degc", ("_degc", "_um", "_urad")
#: Something is commanded where it changes by this share of its span in a sample.
COMMANDED = 0.2
#: Shortest stand at the end of a range, all of them together, and how far beside it its slope is looked at, samples.
STAND_SAMPLES, STANDS_SAMPLES, SLOPE_SAMPLES = 10, 30, 5
#: Two readings are the same value within this, relative: means of equal readings.
SAME = 1e-9
#: A jump from one unit to another is this many times what is left of it after a conversion.
OTHER_UNIT = 10.0
_UNITS = {"K": (1.0, 273.15), "°F": (1.8, 32.0)}


@dataclass(frozen=True, slots=True)
class Stand:
    """Where a channel stands at an end of its range, or at both.

    Parameters
    ----------
    limits : tuple of float
        The value, or both.
    mask : numpy.ndarray of bool, shape (n,)
        The samples.
    """

    limits: tuple[float, ...]
    mask: Mask

    def in_words(self, column: str, t_s: Vector) -> str:
        """Return channel, value, times and share."""
        first = int(np.argmax(self.mask))
        last = first + int(np.argmin(np.append(self.mask[first:], False))) - 1
        count, share = int(self.mask.sum()), 100.0 * float(np.mean(self.mask))
        values, end = " or ".join(f"{limit:g}" for limit in self.limits), "end" if len(self.limits) == 1 else "ends"
        return (
            f"{column} stands at exactly {values}, the {end} of what it shows, in {count} of {self.mask.size} "
            f"samples ({share:.0f} %), first from t_s = {t_s[first]:g} to {t_s[last]:g}"
        )


def cleaned(name: str, records: Sequence[SampledRecord]) -> tuple[tuple[SampledRecord, ...], tuple[Remark, ...]]:
    """Leave out what a sensor cannot have meant, with remarks.

    Parameters
    ----------
    name : str
        Name of the data, for messages.
    records : sequence of SampledRecord
        As they were averaged.
    """
    found, remarks = [], list[Remark]()
    for record in records:
        columns, is_switched = dict(record.columns), _is_switched_at_start(record.columns)
        for column, values in record.columns.items():
            if column == "heat_w":
                continue
            slow = column.endswith(SLOW) and not is_sparse(values)
            row = IN_A_ROW if slow else 1
            switches = not column.endswith(SLOW)
            kept, count = without_outliers(
                values, first=slow and not is_switched, last=slow, in_a_row=row, switches=switches
            )
            if count:
                remarks.append(Remark(DataRemark.WILD_READINGS, f"{name}: {column}: {count} outlier(s) left out."))
            if column.endswith(SLOW) and (stand := stand_at_limit(kept)):
                needed = column in TEMPERATURES
                then = "what it was there is not known" if needed else "not used there"
                words = f"{name}: {stand.in_words(column, record.t_s)}; {then}."
                remarks.append(Remark(DataRemark.AT_LIMIT, words))
                kept = kept if needed else np.where(stand.mask, np.nan, kept)
            remarks += _changed_unit(name, column, kept, record.t_s)
            columns[column] = kept
        found.append(dataclasses.replace(record, columns=columns))
    return tuple(found), tuple(remarks)


def refuse_at_limit(name: str, record: SampledRecord) -> None:
    """Refuse a record whose T_Q or AT stands at the end of its range: nobody can interpolate what was cut off.

    Raises
    ------
    DataError
        Naming channel, value, times and what to do.
    """
    for column in TEMPERATURES:
        if stand := stand_at_limit(record.columns[column]):
            raise DataError(
                f"{name}: {stand.in_words(column, record.t_s)}: the range of its sensor or transmitter? What the "
                "temperature was there is not known. Widen the range and record again, or give the rows before and "
                "after as files of their own"
            )


# ---------------------------------------------------------------------- wrong readings


def without_outliers(
    values: Vector, *, first: bool = False, last: bool = False, in_a_row: int = 1, switches: bool = False
) -> tuple[Vector, int]:
    """Replace outliers, readings far from all that is beside them, by NaN.

    A step stays: its samples are near one of their neighbours. On a slope, what is beside a reading is not at one place
    but on one line. The first and last reading of a stretch have neighbours on one side only; they are outliers where
    these are together, and the signal has no such step elsewhere.

    Parameters
    ----------
    values : numpy.ndarray, shape (n,)
        A record; NaN where missing.
    first, last : bool
        Whether the first and last reading of each stretch without a long gap may be outliers, too.
    in_a_row : int
        Most outliers that follow each other, all on one side.
    switches : bool
        Whether the signal may be switched, within a sample, for one sample. Then a reading that is no farther out than
        where the signal goes by itself elsewhere is no outlier.

    Examples
    --------
    >>> values = np.tile([1.0, 1.1], 60)
    >>> values[[0, 7]] = 9.0
    >>> without_outliers(values)[1], without_outliers(values, first=True)[1]
    (1, 2)
    >>> flow = np.repeat([0.0, 12.0, 0.0, 12.0], 60)
    >>> flow[[90, 100, 110]] = [0.0, 6.0, 99.0]
    >>> without_outliers(flow)[1], without_outliers(flow, switches=True)[1]
    (3, 1)
    """
    known = np.flatnonzero(~np.isnan(values))
    v = values[known]
    if v.size < BESIDE_SAMPLES + 2:
        return values, 0
    noise = noise_std(v)
    # A fast signal reverses within a sample, too: what it does in one of twenty steps is no outlier.
    limit = OUTLIER_DEVIATIONS * noise + 3.0 * float(np.quantile(np.abs(np.diff(v)), 0.95)) + 1e-9
    counts = range(1, in_a_row + 1)
    found = [_apart(v, known, count, limit) for count in counts]
    # What is commanded may come and go within a sample, and what was computed has no wrong readings.
    if (first or last) and noise > 0.0:
        found += [_off_line(v, known, count, OUTLIER_DEVIATIONS * noise) for count in counts]
    outliers = np.unique(np.concatenate(found))
    if noise > 0.0:  # what was computed has no wrong readings, but may begin with a step
        known = np.setdiff1d(known, outliers)
        ends = [end for end, asked in ((_first_alone, first), (_last_alone, last)) if asked]
        outliers = np.union1d(outliers, [at for end in ends for at in end(values, known, limit)]).astype(int)
    if switches and outliers.size:
        outliers = outliers[~_is_switched_to(values, outliers, limit)]
    if outliers.size == 0 or outliers.size > 0.02 * v.size:
        return values, 0
    kept = values.copy()
    kept[outliers] = np.nan
    return kept, int(outliers.size)


def _apart(v: Vector, known: Indices, count: int, limit: float) -> Indices:
    """Return where so many readings in a row are far from both that are beside them, and on one side of these.

    Several in a row may also be what a signal does, as where a quick couple is heated for a minute or two: then it is
    seen in what is beside them, too, and of a disturbance nothing is.
    """
    rows = sliding_window_view(v, count)[1:-1]
    before, after = v[: -count - 1], v[count + 1 :]
    above = np.min(rows, axis=1) - np.maximum(before, after)
    below = np.minimum(before, after) - np.max(rows, axis=1)
    distance = np.maximum(above, below)
    apart = (distance > limit) & (np.abs(after - before) < TOGETHER * distance)
    if count > 1:
        # Behind a gap a signal may be anywhere.
        apart &= known[count + 1 :] - known[: -count - 1] <= count + SHORT_GAP_SAMPLES
        pairs = sliding_window_view(v, 2)
        beside = np.concatenate([pairs[: -count - 2], pairs[count + 2 :]], axis=1)
        apart[0] = apart[-1] = False
        apart[1:-1] &= np.ptp(beside, axis=1) < limit
    return np.asarray(known[(np.flatnonzero(apart)[:, None] + 1 + np.arange(count)).ravel()])


def _off_line(v: Vector, known: Indices, count: int, noise: float) -> Indices:
    """Return where so many readings in a row are far from the line through the two on each side of them.

    These have to be on it, and the readings beyond both beside them: a corner of the signal is neither.

    Parameters
    ----------
    v, known : numpy.ndarray, shape (n,)
        The readings and their samples.
    count : int
        Readings in a row.
    noise : float
        Largest distance from the line that noise makes.
    """
    if v.size < count + 4:
        return np.empty(0, dtype=np.intp)
    windows = sliding_window_view(v, count + 4)
    rows, beside = windows[:, 2:-2], np.delete(windows, np.s_[2:-2], axis=1)
    at = np.delete(np.arange(count + 4.0), np.s_[2:-2])
    design = np.column_stack([np.ones(4), at])
    lines = beside @ np.linalg.pinv(design).T
    uneven = np.max(np.abs(beside - lines @ design.T), axis=1)
    off = rows - (lines[:, :1] + lines[:, 1:] * np.arange(2.0, count + 2.0))
    distance = np.maximum(np.min(off, axis=1), np.min(-off, axis=1))
    beyond = np.maximum(
        np.min(rows, axis=1) - np.max(beside[:, 1:3], axis=1), np.min(beside[:, 1:3], axis=1) - np.max(rows, axis=1)
    )
    # What the signal does at one of twenty samples is no outlier.
    limit = noise + 3.0 * float(np.quantile(np.abs(np.median(off, axis=1)), 0.95)) + 1e-9
    apart = (np.minimum(distance, beyond) > limit) & (uneven < TOGETHER * limit)
    apart &= known[count + 3 :] - known[: -count - 3] == count + 3
    return np.asarray(known[(np.flatnonzero(apart)[:, None] + 2 + np.arange(count)).ravel()])


def _is_switched_to(values: Vector, outliers: Indices, limit: float) -> Mask:
    """Return which readings far from their neighbours are no farther out than the signal goes elsewhere.

    That is the levels it jumps between and stays at, and all between them, where the mean of a sample lies in which it
    was switched. A level that is only seen for single samples, as of a pump that lubricates for a minute, counts if the
    very same value comes again, but not farther outside the other readings than these reach: a fault's code comes
    again, too.
    """
    others = values.copy()
    others[outliers] = np.nan
    levels = [np.empty(0)]
    for lag in (1, 2):  # two where a sample is the mean of both levels
        before, after = others[:-lag], others[lag:]
        jumps = np.abs(after - before) > limit
        levels += [before[jumps], after[jumps]]
    readings, low, high = np.sort(values[outliers]), float(np.nanmin(others)), float(np.nanmax(others))
    again = readings[1:][np.diff(readings) <= SAME * np.maximum(1.0, np.abs(readings[1:]))]
    # Of a signal that stands still but for these readings there is no measure of how far is too far.
    reach = high - low if high > low else np.inf
    levels.append(again[(again <= high + reach) & (again >= low - reach)])
    known = np.concatenate(levels)
    least, most = np.min(known, initial=np.inf) - limit, np.max(known, initial=-np.inf) + limit
    kept = np.flatnonzero(~np.isnan(others))
    beside = others[kept[np.minimum(np.searchsorted(kept, outliers), kept.size - 1)]]
    out = values[outliers]
    return np.asarray(np.where(out > beside, out <= most, out >= least))


def _first_alone(values: Vector, known: Indices, limit: float) -> Iterator[int]:
    """Yield the first reading of each stretch that stands alone against what follows."""
    for part in np.split(known, np.flatnonzero(np.diff(known) > SHORT_GAP_SAMPLES) + 1):
        v = values[part]
        if v.size < BESIDE_SAMPLES + 2:
            continue
        jump = abs(float(v[1] - v[0]))
        if jump <= limit or not _together(v, 0, jump):
            continue
        steps = np.abs(np.diff(v))
        others = np.flatnonzero(steps > max(limit, 0.5 * jump)).tolist()
        if not any(_together(v, i, float(steps[i])) for i in others if 0 < i < v.size - 1 - BESIDE_SAMPLES):
            yield int(part[0])


def _last_alone(values: Vector, known: Indices, limit: float) -> Iterator[int]:
    n = values.size
    for at in _first_alone(values[::-1], n - 1 - known[::-1], limit):
        yield n - 1 - at


def _together(v: Vector, i: int, jump: float) -> bool:
    """Whether the samples behind a jump are together: a signal that was moved goes on to move."""
    return bool(np.ptp(v[i + 1 : i + 1 + BESIDE_SAMPLES]) < TOGETHER * jump)


def _is_switched_at_start(columns: Mapping[str, Vector]) -> bool:
    """Whether the machine is switched in the second sample: then a jump of a measured signal may be real."""
    for column, values in columns.items():
        if not column.endswith(SLOW) and values.size > 1:
            span = float(np.nanmax(values) - np.nanmin(values)) if np.isfinite(values).any() else 0.0
            if span > 0.0 and abs(values[1] - values[0]) > COMMANDED * span:
                return True
    return False


# ---------------------------------------------------------------------- ends of ranges and units


def stand_at_limit(values: Vector) -> Stand | None:
    """Return where a channel stands at an end of its range, or at both, if it does.

    There it is exactly one value, its largest or smallest, for many samples, and comes and leaves with a slope, while
    it is noisy elsewhere. A converter of coarse steps has such stands at every level, a machine at rest comes to its
    smallest value slowly: neither is taken for one.

    Parameters
    ----------
    values : numpy.ndarray, shape (n,)
        A record; NaN where missing.
    """
    known = np.flatnonzero(~np.isnan(values))
    v = values[known]
    if v.size < STANDS_SAMPLES + DEAD_SAMPLES or np.ptp(v) == 0.0:
        return None
    ends = [(limit, *_stands(v, limit)) for limit in sorted({float(v.min()), float(v.max())})]
    ends = [(limit, at, long) for limit, at, long in ends if sum(b - a for a, b in long) >= STANDS_SAMPLES]
    # A signal that is cut off on both sides is lively between them.
    within = np.logical_or.reduce([at for _, at, _ in ends]) if ends else np.zeros(v.size, dtype=bool)
    if not ends or not _is_lively(v, within):
        return None
    if not any(_is_cut_off(v, within, long) for _, _, long in ends):
        return None
    # It may come to the other end more slowly than usual, as a machine does that comes to rest below it.
    found = [(limit, at) for limit, at, long in ends if _is_cut_off(v, within, long, also=True)]
    mask = np.zeros(values.size, dtype=bool)
    mask[known[np.logical_or.reduce([at for _, at in found])]] = True
    return Stand(tuple(limit for limit, _ in found), mask)


def _stands(v: Vector, limit: float) -> tuple[Mask, list[tuple[int, int]]]:
    """Return where a signal is at a limit, and first and past last sample of each time that it stands there."""
    at = np.abs(v - limit) <= SAME * max(1.0, abs(limit))
    return at, [(a, b) for a, b in stretches_of(at) if b - a >= STAND_SAMPLES]


def _is_lively(v: Vector, at: Mask) -> bool:
    """Whether a signal is noisy, in steps finer than its noise, where it is not at a limit."""
    steps = np.diff(v)[~at[1:] & ~at[:-1]]
    if steps.size < DEAD_SAMPLES:
        return False
    turns, still = float(np.mean(steps[1:] * steps[:-1] < 0.0)), float(np.mean(steps == 0.0))
    return turns > LIVELY_TURNS and still < LIVELY_STILL


def _is_cut_off(v: Vector, at: Mask, stands: Sequence[tuple[int, int]], *, also: bool = False) -> bool:
    """Whether a signal comes to its limit, and leaves it, as steeply as it usually moves.

    Where it is cut off at another one, `also`, it only has to come or leave faster than its noise.
    """
    k, noise = SLOPE_SAMPLES, 2.0 * noise_std(v)
    usual = np.abs(v[k:] - v[:-k])[~at[k:] & ~at[:-k]]
    least = noise if also else max(float(np.median(usual)) if usual.size else np.inf, noise)
    comes = [abs(v[a] - v[a - k]) for a, _ in stands if a >= k]
    leaves = [abs(v[b - 1 + k] - v[b - 1]) for _, b in stands if b - 1 + k < v.size]
    medians = [float(np.median(slopes)) for slopes in (comes, leaves) if slopes]
    return len(medians) > (0 if also else 1) and min(medians) > least


def _changed_unit(name: str, column: str, values: Vector, t_s: Vector) -> Iterator[Remark]:
    """Yield a remark on a temperature that goes on in another unit from some sample on."""
    known = np.flatnonzero(~np.isnan(values))
    v = values[known]
    if not column.endswith(TEMPERATURE) or v.size < 2 * STANDS_SAMPLES:
        return
    steps = np.abs(np.diff(v))
    at = int(np.argmax(steps)) + 1
    limit = OUTLIER_DEVIATIONS * noise_std(v) + 3.0 * float(np.quantile(steps, 0.95))
    before, after = float(v[at - 1]), float(v[at])
    for unit, (factor, shift) in _UNITS.items():
        off = min(abs(factor * before + shift - after), abs(factor * after + shift - before)) / factor
        if off < limit and steps[at - 1] > OTHER_UNIT * limit and min(at, v.size - at) >= STANDS_SAMPLES:
            words = (
                f"{name}: {column} jumps from {before:.4g} to {after:.4g} at t_s = {t_s[known[at]]:g}, as from °C to "
                f"{unit} or back: one unit before and another one after?"
            )
            yield Remark(DataRemark.UNIT_CHANGES, words)
            return
