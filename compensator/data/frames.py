"""Tables in memory: pandas DataFrames and dicts of arrays, in and out.

pandas is never imported here: a DataFrame comes only from a program that has imported it.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.data.table import Table, table_of, time_names
from compensator.errors import DataError


def is_frame(data: object) -> bool:
    """Whether this is a pandas DataFrame."""
    pandas = sys.modules.get("pandas")
    return pandas is not None and isinstance(data, pandas.DataFrame)


def has_local_time(frame: Any, roles: Mapping[str, str]) -> bool:
    """Whether the time of a DataFrame is a date and time without a zone; it is taken as UTC."""
    pandas = sys.modules["pandas"]
    name = roles.get("time_utc", "time_utc")
    time = frame[name] if name in frame.columns else frame.index
    return bool(pandas.api.types.is_datetime64_dtype(time.dtype))


def table_in_memory(name: str, data: Any, roles: Mapping[str, str], rows: Sequence[int] | None = None) -> Table:
    """Make a table of a DataFrame or a mapping of arrays.

    Parameters
    ----------
    name : str
        Name for messages.
    data : pandas.DataFrame or mapping of str to array_like
        With the column names of a table. A DatetimeIndex, or an index of the name `t_s` or `time_utc`, is the time of a
        DataFrame without a column of that name.
    roles : mapping of str to str
        Column name for each role; those of the time are used here.
    rows : sequence of int, optional
        Number of each row for messages; from 0 where it is not given.

    Raises
    ------
    DataError
        As :func:`table_of`.
    """
    cells = _frame_columns(name, data, roles) if is_frame(data) else {str(k): v for k, v in data.items()}
    return table_of(name, cells, roles=roles, rows=rows)


def _frame_columns(name: str, frame: Any, roles: Mapping[str, str]) -> dict[str, Any]:
    pandas = sys.modules["pandas"]
    names = [str(column) for column in frame.columns]
    for column in names:
        if names.count(column) > 1:
            raise DataError(f"{name}: column {column!r} is there twice, expected each name once")
    series = {column: frame.iloc[:, i] for i, column in enumerate(names)}
    times, index = time_names(roles), frame.index
    if not times & series.keys():
        dated = isinstance(index, pandas.DatetimeIndex) and index.name != roles.get("time_utc", "time_utc")
        time = "time_utc" if dated else index.name
        if time in times:
            series[time] = index.to_series()
    return {column: _cells(pandas, values) for column, values in series.items()}


def _cells(pandas: Any, series: Any) -> np.ndarray[Any, Any]:
    """Return a column's values; numpy has no time zones and no missing integers."""
    types = pandas.api.types
    if types.is_datetime64_any_dtype(series.dtype):
        utc = pandas.to_datetime(series, utc=True).dt.tz_localize(None)
        return np.asarray(utc.to_numpy(dtype="datetime64[us]"))
    if types.is_numeric_dtype(series.dtype) and not types.is_complex_dtype(series.dtype):
        return np.asarray(series.to_numpy(dtype=np.float64, na_value=np.nan))
    return np.asarray(series.astype(object).where(series.notna(), None).to_numpy(), dtype=object)


def hash_of(table: Table) -> str:
    """Return the SHA-256 of a table's values: the time and every column, in the order of their names."""
    digest = hashlib.sha256()
    for name, values in (("t_s", table.t_s), *sorted(table.columns.items())):
        digest.update(name.encode("utf-8") + b"\0" + np.ascontiguousarray(values, dtype="<f8").tobytes())
    return digest.hexdigest()


def hash_of_t_q(table: Table) -> str:
    """Return the SHA-256 of a table's readings of T_Q, by which a record with other columns is known again; or ""."""
    values = table.columns.get("t_q_degc")
    return "" if values is None else hashlib.sha256(np.ascontiguousarray(values, dtype="<f8").tobytes()).hexdigest()


def frame_of(columns: Mapping[str, Any], index: Any = None) -> Any:
    """Return columns as a DataFrame."""
    return sys.modules["pandas"].DataFrame(columns, index=index)


def time_index(t_s: Vector, start_utc_s: float | None, *, local: bool) -> Any:
    """Return the index of a DataFrame: times in UTC where that of `t_s` = 0 is known, None for rows by number.

    Where the times that came in had no zone (`local`), these have none either.
    """
    if start_utc_s is None:
        return None
    times = np.round((start_utc_s + t_s) * 1e6).astype(np.int64)
    return sys.modules["pandas"].to_datetime(times, unit="us", utc=not local)
