"""Tables as they were read: a time, and columns of numbers by name."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from compensator.arrays import LARGEST, Vector
from compensator.axes import COLUMNS as AXIS_COLUMNS
from compensator.codes import DataRemark, Remark, SampleQuality
from compensator.config import ROLES
from compensator.errors import DataError, UsageError

#: Seconds in the unit of a column that holds the time from the start.
_SECONDS_IN = {"t_s": 1.0, "time_min": 60.0, "time_h": 3600.0}
#: Columns that hold the time: from the start, or date and time. With several, the first is used.
TIMES = ("t_s", "time_utc", "time_min", "time_h")
#: Rows at least so far apart, s, have whole seconds: a time in hours or minutes is rounded by its logger.
_WHOLE_S = 5.0
#: Roles of columns: those of the service, and the deformation of every axis.
DATA_ROLES = (*ROLES, *(column for column in AXIS_COLUMNS if column not in ROLES))
#: Largest number of columns.
COLUMNS = 1000
#: A column with more words than this share of its numbers is one of words, and left out.
_WORDS = 0.1
#: Columns of an exported recording that the service computed.
EXPORTED = (
    "seq",
    "heat_w",
    "y_dtf_um",
    "y_tdtf_um",
    "y_pred_um",
    "y_std_um",
    "y_ref_um",
    "residual_um",
    "y_offset_um",
    "y_offset_rate_um_per_min",
    "y_offset_std_um",
    "state",
    "reasons",
)
#: A measured heat in an exported recording, where `heat_w` is the estimate, and what follows a channel's name there.
MEASURED_HEAT, QUALITY = "heat_measured_w", "_quality"
#: The same of further axes, tilts and slopes.
_EXPORTED_AXES = re.compile(
    r"[xzab]_(state|reasons|(dtf|tdtf|pred|std|ref|residual|offset|offset_std)_(um|urad)"
    r"|offset_rate_(um|urad)_per_min)|[xyz]_slope_((dtf|tdtf|pred|std)_)?um_per_m|[xyz]_slope_rate_um_per_m_per_min"
)


def is_computed(name: str) -> bool:
    """Return whether a column of an exported recording was computed by the service.

    Examples
    --------
    >>> is_computed("z_pred_um"), is_computed("a_offset_rate_urad_per_min"), is_computed("z_um")
    (True, True, False)
    """
    return name in EXPORTED or _EXPORTED_AXES.fullmatch(name) is not None


def is_taken(name: str, channels: Collection[str]) -> bool:
    """Return whether the column of a channel would be lost in a table: the name has another meaning there.

    Parameters
    ----------
    name : str
        Name of the channel.
    channels : collection of str
        Names of all channels.

    Examples
    --------
    >>> [is_taken(name, ["oil_degc"]) for name in ("state", "t_s", "oil_degc_quality", "air_quality", "heat_w")]
    [True, True, True, False, False]
    """
    is_ours = name in (*TIMES, MEASURED_HEAT) or (is_computed(name) and name not in ROLES)
    return is_ours or (name.endswith(QUALITY) and name.removesuffix(QUALITY) in channels)


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table as it was read.

    Parameters
    ----------
    name : str
        Name for messages.
    t_s : numpy.ndarray, shape (n,)
        Time of each row from the first row, s.
    columns : dict of str to numpy.ndarray, shape (n,)
        Numeric columns by name; NaN where missing.
    rows : sequence of int
        Number of each row as its user counts it, for messages.
    start_utc_s : float, optional
        Time of the first row, s since 1970, where the table has `time_utc`.
    remarks : tuple of Remark
        What was left out when it was read.
    zeros_s : tuple of float
        Where Y was probed: times from which on it may count from another zero, in the clock of `t_s`.
    """

    name: str
    t_s: Vector
    columns: dict[str, Vector]
    rows: Sequence[int]
    start_utc_s: float | None = None
    remarks: tuple[Remark, ...] = ()
    zeros_s: tuple[float, ...] = ()

    def with_roles(self, roles: Mapping[str, str]) -> Table:
        """Return the table with columns renamed to their roles; `table_of` has renamed the time.

        Raises
        ------
        DataError
            If there is no such role or column.
        """
        given = {role: name for role, name in roles.items() if role not in TIMES}
        for role, name in given.items():
            if role not in DATA_ROLES:
                expected = ", ".join((*DATA_ROLES, *TIMES))
                raise DataError(f"{self.name}: --column {role}={name}: expected a role of {expected}")
            _check_named(self.name, role, name, self.columns)
        others = {name: values for name, values in self.columns.items() if name not in given.values()}
        return replace(self, columns=others | {role: self.columns[name] for role, name in given.items()})

    def measurements_only(self) -> tuple[Table, tuple[Remark, ...]]:
        """Leave out of an exported recording what the service computed.

        Its heat is the model's own estimate: a model fitted to it as to a measured heat would reproduce itself.
        """
        if not {"y_pred_um", "y_offset_um"} <= self.columns.keys():
            return self, self.remarks
        kept = {name: values for name, values in self.columns.items() if not is_computed(name)}
        if MEASURED_HEAT in kept:
            kept["heat_w"] = kept.pop(MEASURED_HEAT)
        words = f"{self.name}: an exported recording; the service's estimates and offsets are left out, with heat_w."
        return replace(self, columns=kept), (*self.remarks, Remark(DataRemark.ESTIMATES_LEFT_OUT, words))


def _check_named(table: str, role: str, name: str, columns: Mapping[str, Any]) -> None:
    if name not in columns:
        raise DataError(f"{table}: --column {role}={name}: no such column, expected one of: {', '.join(columns)}")


def table_of(
    name: str,
    cells: Mapping[str, Any],
    *,
    roles: Mapping[str, str] | None = None,
    rows: Sequence[int] | None = None,
    has: str = "it has",
) -> Table:
    """Make a table of columns of cells: text as in a CSV, numbers, or times.

    Parameters
    ----------
    name : str
        Name for messages.
    cells : mapping of str to array_like, shape (n,)
        Columns by name; the time among them. A column that is not numeric is left out unless it has a role.
    roles : mapping of str to str, optional
        Column name for each role; those of `TIMES` are used here, the others by `Table.with_roles`.
    rows : sequence of int, optional
        Number of each row for messages; from 0 where it is not given.
    has : str
        Words before the names of the columns in a message.

    Raises
    ------
    DataError
        One line that names row or column, value and what was expected.

    Examples
    --------
    >>> table = table_of("data", {"t_s": [60.0, 120.0], "y_um": ["1.5", ""]})
    >>> table.t_s, table.columns["y_um"]
    (array([ 0., 60.]), array([1.5, nan]))
    """
    check_columns(name, len(cells))
    cells = _with_time(name, cells, roles or {})
    time_column = next((column for column in TIMES if column in cells), None)
    if time_column is None:
        if not cells:
            raise DataError(f"{name}: no columns, expected t_s or time_utc and those of the roles")
        names = ", ".join(cells)[:100]
        raise DataError(
            f"{name}: no column t_s or time_utc; {has}: {names}. Name it with --column t_s=NAME, time_min=NAME or "
            "time_h=NAME"
        )
    arrays = {column: _flat(name, column, values) for column, values in cells.items()}
    size = arrays[time_column].size
    if size == 0:
        raise DataError(f"{name}: no rows in it, expected data")
    rows = range(size) if rows is None else rows
    numbers: dict[str, Vector] = {}
    remarks: list[Remark] = []
    for number, (column, values) in enumerate(arrays.items(), start=1):
        if values.size != size:
            raise DataError(f"{name}: {column} has {values.size} values, {time_column} {size}, expected equally many")
        if column in (time_column, *TIMES):
            continue
        is_needed = column in DATA_ROLES or column in (roles or {}).values()
        if not (is_needed or (column.strip() and column.isprintable())):
            remarks += _unnamed(name, number, values)
            continue
        converted, left_out = _numbers(name, column, values, rows, is_needed=is_needed)
        if converted is not None:
            numbers[column] = converted
        remarks += left_out
    remarks += _without_bad(name, numbers, arrays, rows)
    if time_column == "time_utc":
        time = _seconds(name, time_column, arrays[time_column], rows)
    else:
        time = _elapsed(name, time_column, arrays[time_column], rows)
    if np.isnan(time).any():
        raise DataError(f"{name}: row {rows[int(np.argmax(np.isnan(time)))]}: time is missing")
    if (far := np.abs(time) > LARGEST).any():
        i = int(np.argmax(far))
        raise DataError(f"{name}: row {rows[i]}: {time_column} = {time[i]:g} s, expected at most {LARGEST:g}")
    start = float(time[0]) if time_column == "time_utc" else None
    return Table(name=name, t_s=time - time[0], columns=numbers, rows=rows, start_utc_s=start, remarks=tuple(remarks))


def check_columns(name: str, count: int) -> None:
    """Refuse a table of too many columns.

    Raises
    ------
    DataError
        If there are more than `COLUMNS`.
    """
    if count > COLUMNS:
        raise DataError(f"{name}: {count} columns, expected at most {COLUMNS}")


def time_names(roles: Mapping[str, str]) -> set[str]:
    """Return the names that the column of the time may have."""
    return {roles.get(time, time) for time in TIMES}


def _with_time(name: str, cells: Mapping[str, Any], roles: Mapping[str, str]) -> Mapping[str, Any]:
    """Return columns with the time renamed; a time that a role names replaces any other."""
    times = {role: column for role, column in roles.items() if role in TIMES}
    if not times:
        return cells
    for role, column in times.items():
        _check_named(name, role, column, cells)
    others = {column: values for column, values in cells.items() if column not in (*times.values(), *TIMES)}
    return {role: cells[column] for role, column in times.items()} | others


def _flat(name: str, column: str, values: Any) -> np.ndarray[Any, Any]:
    """Return a column as an array of one axis; MATLAB's are of two."""
    array = np.asarray(np.ma.filled(values.astype(float), np.nan) if np.ma.isMaskedArray(values) else values)
    if array.ndim != 1 and array.size != max(array.shape, default=0):
        raise DataError(f"{name}: {column} has the shape {array.shape}, expected one value for each row")
    return array.ravel()


def _numbers(
    name: str, column: str, values: np.ndarray[Any, Any], rows: Sequence[int], *, is_needed: bool
) -> tuple[Vector | None, tuple[Remark, ...]]:
    """Return a column as numbers; None, and why, where much of it is something else and it is not needed."""
    if values.dtype.kind in "biuf":
        numbers = values.astype(np.float64)
    else:
        numbers, others = np.full(values.size, np.nan), []
        for i, cell in enumerate(values.tolist()):
            try:
                numbers[i] = _number(cell)
            except (ValueError, TypeError, OverflowError):
                others.append(i)
        if others:
            cell, more = str(values[others[0]]).strip()[:40], f" ({len(others)} like it)" if len(others) > 1 else ""
            where = f"{name}: row {rows[others[0]]}: {column} = {cell!r}{more}"
            # A column of words is left out; one word among numbers, such as Excel's #NV, would cost the whole channel.
            known = int(np.sum(np.isfinite(numbers)))
            if not is_needed and len(others) > _WORDS * known:
                words = f"{where}: no number; the column is left out."
                return None, (Remark(DataRemark.COLUMN_LEFT_OUT, words),) if known else ()
            raise DataError(f"{where}, expected a number, or an empty cell where it is missing")
    if np.isinf(numbers).any():
        i = int(np.argmax(np.isinf(numbers)))
        raise DataError(f"{name}: row {rows[i]}: {column} = {numbers[i]}, expected a finite number")
    return numbers, ()


def _unnamed(name: str, number: int, values: np.ndarray[Any, Any]) -> Iterator[Remark]:
    """Yield a remark on a column that is left out for its name, if it holds anything."""
    if any(str(value).strip() not in ("", "None", "nan") for value in values.tolist()):
        words = f"{name}: column {number} has no name, or one that cannot be shown; it is left out."
        yield Remark(DataRemark.COLUMN_UNNAMED, words)


def _without_bad(
    name: str, numbers: dict[str, Vector], arrays: Mapping[str, np.ndarray[Any, Any]], rows: Sequence[int]
) -> Iterator[Remark]:
    """Leave out values that are marked bad by a column `<channel>_quality`, as an exported recording has it.

    Yields a remark on each channel that lost values.
    """
    for column, marks in arrays.items():
        channel = column.removesuffix(QUALITY)
        if channel == "heat_w" and MEASURED_HEAT in numbers:
            channel = MEASURED_HEAT
        if column == channel or column in numbers or channel not in numbers:
            continue
        words = [str(mark).strip().lower() for mark in marks.tolist()]
        # Where no quality is stated, as between the values of touch probes, the value stands.
        bad = np.array([word not in ("", "none", "nan", SampleQuality.GOOD) for word in words]) & ~np.isnan(
            numbers[channel]
        )
        if bad.any():
            at = int(np.argmax(bad))
            numbers[channel] = np.where(bad, np.nan, numbers[channel])
            what = f"{name}: row {rows[at]}: {channel} is marked {words[at]!r}"
            yield Remark(DataRemark.MARKED_BAD, f"{what}; {int(bad.sum())} value(s) marked bad left out.")


def _number(cell: Any) -> float:
    if cell is None:
        return math.nan
    return float(cell) if not isinstance(cell, str) or cell.strip() else math.nan


def _elapsed(name: str, column: str, values: np.ndarray[Any, Any], rows: Sequence[int]) -> Vector:
    """Return a time from the start, in the unit that the column's name says, as seconds."""
    time, _ = _numbers(name, column, values, rows, is_needed=True)
    assert time is not None
    if column == "t_s":
        return time
    seconds = time * _SECONDS_IN[column]
    steps = np.abs(np.diff(seconds))
    return np.round(seconds) if steps.size and np.median(steps) >= _WHOLE_S else seconds


def _seconds(name: str, column: str, values: np.ndarray[Any, Any], rows: Sequence[int]) -> Vector:
    """Return times as seconds since 1970; a time without a zone is UTC."""
    if values.dtype.kind == "M":
        whole = values.astype("datetime64[us]")
        return np.where(np.isnat(whole), np.nan, whole.astype(np.int64) / 1e6)
    seconds = np.empty(values.size)
    for i, cell in enumerate(values.tolist()):
        try:
            seconds[i] = _timestamp(cell)
        except (ValueError, TypeError, OverflowError) as error:
            where = f"{name}: row {rows[i]}: {column} = {str(cell).strip()[:40]!r}"
            raise DataError(f"{where}, expected a time such as 2025-11-21T08:00:00Z") from error
    return seconds


def _timestamp(cell: Any) -> float:
    if cell is None or (isinstance(cell, str) and not cell.strip()):
        return math.nan
    if not isinstance(cell, str | datetime):
        raise TypeError(f"{type(cell).__name__} is no date and time")
    time = cell if isinstance(cell, datetime) else datetime.fromisoformat(cell.strip())
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def roles_of(pairs: Sequence[str]) -> dict[str, str]:
    """Split `--column ROLE=NAME`.

    Raises
    ------
    UsageError
        If one of them is no such pair, or has the role of another one.

    Examples
    --------
    >>> roles_of(["t_q_degc=t5_degc"])
    {'t_q_degc': 't5_degc'}
    """
    roles: dict[str, str] = {}
    for pair in pairs:
        role, equals, name = pair.partition("=")
        if not equals or not role or not name:
            raise UsageError(f"--column {pair}: expected ROLE=NAME, such as t_q_degc=t5_degc")
        if role in roles:
            raise UsageError(f"--column {pair}: {role} is {roles[role]} already, expected each role once")
        roles[role] = name
    return roles
