"""From a table to records at the model's sample period: averaged, sorted, split at long gaps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from compensator.arrays import LARGEST, Indices, Mask, Vector, stretches_of
from compensator.codes import DataRemark, Remark
from compensator.data.record import SHORT_GAP_SAMPLES, TEMPERATURES, SampledData, SampledRecord
from compensator.data.runs import is_sparse
from compensator.data.table import DATA_ROLES, Table
from compensator.errors import DataError

#: Longest table, in samples of the model: eleven years of minutes.
MOST_SAMPLES = 6_000_000
#: A stretch of so many rows in order that overlaps another one was recorded by a clock that was set back.
STRETCH_ROWS = 10
#: Time between rows and length of a table below which its time is hardly one of seconds, s, from this number of rows.
_FASTEST_S, _SHORTEST_S, _UNIT_ROWS = 0.2, 600.0, 100
#: No heat makes T_Q change by so much from one minute to the next, K, in more than a fifth of so many minutes. A table
#: in minutes has rows at most 6 of them apart and is at most 44,640 long, a month.
_FASTEST_K, _UNIT_SHARE, _UNIT_MINUTES, _UNIT_STEP_S, _UNIT_SPAN_S = 2.0, 0.8, 5, 6.0, 44_640.0
#: Numbers that loggers and converters write in place of a missing value: in any column; in one with a role or of a
#: temperature, where a large number is no count or program; and those that converters of thermocouples and Pt100 give.
#: One is a fault's code where it is further from all other values than so many times their range, or the only negative.
_ANYWHERE = (-999.0, -999.9, -9999.0, -9999.9, -99999.0, -999999.0, -32768.0, -3276.8)
_MEASURED = (999.0, 999.9, 9999.0, 9999.9, 99999.0, 999999.0, 32767.0, 3276.7, 65535.0, 6553.5)
_TEMPERATURE, _APART = (850.0, 1370.0, 1372.0, 1768.0, -200.0, -242.0, -270.0), 3.0
#: Number of stretches that a remark lists.
_SHOWN = 3
#: Share of a sample's period from which rows apart are one for each sample, and not several.
_ROW_OF_SAMPLE = 0.75
#: Share of rows without a temperature, outside long gaps, from which it is remarked on.
_SPARSE = 0.1


def to_grid(table: Table, period_s: float, *, whole_y: bool) -> SampledData:
    """Average a table to a sample period; report gaps and rows out of order, split at long gaps.

    Rows without T_Q or AT are a gap like rows that are missing: the model knows nothing there. With `whole_y` they are
    none as long as Y is measured.

    Parameters
    ----------
    table : Table
        As it was read.
    period_s : float
        Sample period of the model, s.
    whole_y : bool
        Whether a record goes on where T_Q or AT is missing for long and Y is measured: about one zero.

    Raises
    ------
    DataError
        If a value or time cannot have been measured.
    """
    _check_size(table, period_s)
    _check_fault_codes(table)
    _check_unit_of_time(table)
    _check_clock(table, period_s)
    remarks = []
    t_s = table.t_s
    order = np.argsort(t_s, kind="stable")
    backwards = np.diff(t_s) < 0
    if backwards.any():
        row, count = table.rows[int(np.argmax(backwards)) + 1], int(np.sum(backwards))
        remarks.append(
            Remark(DataRemark.ROWS_SORTED, f"{table.name}: row {row}: {count} row(s) out of order; sorted by time.")
        )
    t_s = t_s[order] - t_s.min()
    again = np.diff(t_s) == 0
    if again.any():
        row, count = table.rows[int(order[int(np.argmax(again)) + 1])], int(np.sum(again))
        remarks.append(
            Remark(
                DataRemark.TIMES_EQUAL, f"{table.name}: row {row}: {count} row(s) with the time of another; averaged."
            )
        )
    # A row for each sample goes to the nearest one, whatever its clock's jitter; of several each sample has its own.
    nearest = _spacing(t_s) > _ROW_OF_SAMPLE * period_s
    slot = np.floor(t_s / period_s + (0.5 if nearest else 1e-9)).astype(int)
    n = int(slot[-1]) + 1
    columns = {name: _mean_by_slot(slot, values[order], n) for name, values in table.columns.items()}
    present = np.zeros(n, dtype=bool)
    present[slot] = True
    apart_s = _spacing(t_s) if t_s.size > 1 else 0.0
    usual = math.ceil(apart_s / period_s - 0.01) - 1
    gaps = [(first, last) for first, last in stretches_of(~present) if last - first > usual]
    if usual > 0:
        words = f"{table.name}: its rows are {apart_s:.0f} s apart, samples {period_s:g} s; bridged."
        remarks.append(Remark(DataRemark.ROWS_APART, words))
    empty = {name: present & np.isnan(columns[name]) for name in TEMPERATURES if name in columns}
    known = present & ~np.any([*empty.values()], axis=0) if empty else present
    if whole_y and known.any() and "y_um" in columns:
        y_um, at = columns["y_um"], np.flatnonzero(known)
        known[at[0] : at[-1]] |= (present if is_sparse(y_um) else np.isfinite(y_um))[at[0] : at[-1]]
    records = _between_long_gaps(known) if empty else []
    # Where no sample has both, what is missing is said by who needs it.
    records = records or _between_long_gaps(present)
    inside = np.zeros(n, dtype=bool)
    for a, b in records:
        inside[a:b] = True
    remarks += _bridged(table.name, [one for one in gaps if inside[one[0]]], period_s)
    for first, last in stretches_of(~inside):
        # What is only one temperature's is said of it.
        if not any(mask[first:last].all() for mask in empty.values()):
            gap = f"{table.name}: gap of {last - first} sample(s) from t_s = {first * period_s:g}"
            remarks.append(Remark(DataRemark.GAP_SPLITS, f"{gap}; the record is split there."))
    remarks += _missing_inputs(table.name, empty, inside, period_s)
    remarks += (sparse := list(_sparse_inputs(table, slot, order, columns)))
    if not sparse:
        remarks += _short_holes(table.name, {name: mask & inside for name, mask in empty.items()}, period_s)
    return SampledData(
        records=tuple(
            SampledRecord(
                t_s=np.arange(a, b, dtype=np.float64) * period_s,
                columns={name: v[a:b] for name, v in columns.items()},
                row_s=round(_spacing(t_s), 3),
            )
            for a, b in records
        ),
        remarks=tuple(remarks),
    )


def _bridged(name: str, gaps: Sequence[tuple[int, int]], period_s: float) -> Iterator[Remark]:
    """Yield a remark on each gap that is bridged, or one on many of them."""
    if len(gaps) > _SHOWN:
        longest, begin_s = max(last - first for first, last in gaps), gaps[0][0] * period_s
        words = f"{name}: {len(gaps)} gaps of up to {longest} sample(s) from t_s = {begin_s:g} on; bridged."
        yield Remark(DataRemark.GAP_BRIDGED, words)
        return
    for first, last in gaps:
        words = f"{name}: gap of {last - first} sample(s) from t_s = {first * period_s:g}; bridged."
        yield Remark(DataRemark.GAP_BRIDGED, words)


def _between_long_gaps(known: Mask) -> list[tuple[int, int]]:
    """Return the first and past last sample of each stretch between long gaps; short ones stay, at the ends, too."""
    if not known.any():
        return []
    long = [gap for gap in stretches_of(~known) if gap[1] - gap[0] > SHORT_GAP_SAMPLES]
    edges = [0, *(edge for gap in long for edge in gap), known.size]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a < b]


def _short_holes(name: str, empty: Mapping[str, Mask], period_s: float) -> Iterator[Remark]:
    """Yield one remark on all temperatures that are empty in samples of the records."""
    holes = {column: np.flatnonzero(mask & ~_long(mask)) for column, mask in empty.items()}
    said = [f"{c} in {at.size} sample(s), first at t_s = {at[0] * period_s:g}" for c, at in holes.items() if at.size]
    if said:
        yield Remark(DataRemark.GAP_BRIDGED, f"{name}: empty: {'; '.join(said)}; bridged between known ones.")


def _long(mask: Mask) -> Mask:
    """Return the samples of a mask that are in stretches longer than what is bridged."""
    long = np.zeros(mask.size, dtype=bool)
    for first, last in stretches_of(mask):
        long[first:last] = last - first > SHORT_GAP_SAMPLES
    return long


def _missing_inputs(name: str, empty: Mapping[str, Mask], inside: Mask, period_s: float) -> Iterator[Remark]:
    """Yield a remark on each temperature that is missing for longer than what is bridged."""
    for column, mask in empty.items():
        long = [(first, last) for first, last in stretches_of(mask) if last - first > SHORT_GAP_SAMPLES]
        if long:
            hours = sum(last - first for first, last in long) * period_s / 3600.0
            where = ", ".join(f"{first * period_s:g}" for first, _ in long[:_SHOWN])
            more = f" and {len(long) - _SHOWN} more" if len(long) > _SHOWN else ""
            splits = not all(inside[first] for first, _ in long)
            what = (
                "the record is split there"
                if splits
                else "Y is left out there, and the machine's state after it is unknown"
            )
            words = f"{name}: {column} is missing for {hours:.1f} h from t_s = {where}{more}; {what}."
            yield Remark(DataRemark.TEMPERATURE_MISSING, words)


def _check_clock(table: Table, period_s: float) -> None:
    """Refuse a table whose time was set back: sorted, rows of two hours would stand between each other.

    Raises
    ------
    DataError
        Naming the row from which on the time repeats.
    """
    t_s = table.t_s
    back = np.flatnonzero(np.diff(t_s) < 0) + 1
    stretches = np.split(np.arange(t_s.size), back)
    long = [rows for rows in stretches if rows.size >= STRETCH_ROWS]
    for before, after in itertools.pairwise(long):
        repeated_s = min(t_s[before[-1]], t_s[after[-1]]) - max(t_s[before[0]], t_s[after[0]])
        if repeated_s > STRETCH_ROWS * period_s:
            raise DataError(
                f"{table.name}: row {table.rows[after[0]]}: {repeated_s / 60.0:.0f} min occur twice, expected once: a "
                "clock that was set back, or two files in one? Give each part as a file of its own"
            )


def _sparse_inputs(table: Table, slot: Indices, order: Indices, columns: Mapping[str, Vector]) -> Iterator[Remark]:
    """Yield a remark on each temperature that is missing in many rows, long gaps apart."""
    for column in [c for c in TEMPERATURES if c in columns]:
        empty = np.isnan(table.columns[column][order])[~_long(np.isnan(columns[column]))[slot]]
        if empty.size and np.mean(empty) > _SPARSE:
            words = f"{table.name}: {column} is empty in {100.0 * np.mean(empty):.0f} % of the rows."
            yield Remark(DataRemark.TEMPERATURE_SPARSE, words)


def _check_size(table: Table, period_s: float) -> None:
    """Refuse values whose squares would overflow, and times whose rows would not fit into memory.

    Raises
    ------
    DataError
        Naming the row, or the time between rows.
    """
    name, t_s = table.name, table.t_s
    for column, values in (("time", t_s), *table.columns.items()):
        large = np.abs(values) > LARGEST
        if large.any():
            i = int(np.argmax(large))
            raise DataError(
                f"{name}: row {table.rows[i]}: {column} = {values[i]:g}, expected a number below {LARGEST:g}"
            )
    apart_s = float(np.median(np.diff(np.sort(t_s)))) if t_s.size > 1 else 0.0
    if apart_s > SHORT_GAP_SAMPLES * period_s:
        raise DataError(
            f"{name}: its rows are {apart_s:g} s apart, expected at most {period_s:g} s: is the time in seconds?"
        )
    samples = float(t_s.max() - t_s.min()) / period_s
    if samples > MOST_SAMPLES:
        row = table.rows[int(np.argmax(np.abs(t_s - np.median(t_s))))]
        raise DataError(
            f"{name}: row {row}: its time makes {samples:.3g} samples of {period_s:g} s, "
            f"expected at most {MOST_SAMPLES}"
        )


def _check_fault_codes(table: Table) -> None:
    """Refuse values that stand for a fault, before they are averaged with good ones.

    Raises
    ------
    DataError
        Naming row, column and value.
    """
    for column, values in table.columns.items():
        is_temperature = column.endswith("_degc")
        codes = (*_ANYWHERE, *(_MEASURED if is_temperature or column in DATA_ROLES else ()))
        is_code = np.isin(values, (*codes, *_TEMPERATURE) if is_temperature else codes)
        others = values[~is_code & ~np.isnan(values)]
        if not is_code.any() or others.size == 0:
            continue
        low, high = float(others.min()), float(others.max())
        away = np.maximum(values - high, low - values)
        is_apart = (away > _APART * (high - low)) | ((values < 0.0) & (low >= 0.0))
        if (is_fault := is_code & is_apart).any():
            i = int(np.argmax(is_fault))
            raise DataError(
                f"{table.name}: row {table.rows[i]}: {column} = {values[i]:g}, {int(is_fault.sum())} row(s) like it: a "
                "fault's code? expected an empty cell where a value is missing"
            )


def _check_unit_of_time(table: Table) -> None:
    """Refuse a `t_s` that is hardly one of seconds: in hours or minutes a day would last half a minute or so.

    Raises
    ------
    DataError
        Naming the unit that it may have.
    """
    t_s = np.sort(table.t_s)
    if table.start_utc_s is not None or t_s.size < _UNIT_ROWS:
        return
    step, span = float(np.median(np.diff(t_s))), float(np.ptp(t_s))
    if step < _FASTEST_S and span < _SHORTEST_S:
        raise DataError(
            f"{table.name}: t_s runs over {span:.3g} in {t_s.size} rows: hours? expected seconds; a time in hours is "
            "named time_h, or by --column time_h=NAME"
        )
    t_q = table.columns.get("t_q_degc")
    if t_q is None or span > _UNIT_SPAN_S or step > _UNIT_STEP_S:
        return
    minute = np.floor((table.t_s - t_s[0]) / 60.0).astype(int)
    means = _mean_by_slot(minute, t_q, int(minute.max()) + 1)
    changes = np.abs(np.diff(means))
    changes = changes[np.isfinite(changes)]
    if changes.size >= _UNIT_MINUTES and (fast := float(np.quantile(changes, _UNIT_SHARE))) > _FASTEST_K:
        raise DataError(
            f"{table.name}: t_q_degc changes by {fast:.1f} K from one minute to the next: t_s in minutes? expected "
            "seconds; a time in minutes is named time_min, or by --column time_min=NAME"
        )


def _spacing(t_s: Vector) -> float:
    steps = np.diff(t_s)
    steps = steps[steps > 0]
    return float(np.median(steps)) * (1 + 1e-9) if steps.size else math.inf


def _mean_by_slot(slot: Indices, values: Vector, n: int) -> Vector:
    good = ~np.isnan(values)
    total = np.bincount(slot[good], weights=values[good], minlength=n)
    count = np.bincount(slot[good], minlength=n)
    mean = np.full(n, np.nan)
    mean[count > 0] = total[count > 0] / count[count > 0]
    return mean
