"""DATA of the commands: CSV tables and our own recordings, brought to the model's sample period."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from compensator.arrays import Indices, Mask, Vector
from compensator.data.record import SHORT_GAP_SAMPLES, Data, Record
from compensator.errors import DataError, UsageError
from compensator.messages import Sample, number
from compensator.reasons import Remark
from compensator.recording.reading import decode, read_messages

ROLES = ("t_q_degc", "at_degc", "y_um", "heat_w")

#: What stands in an exported recording beside what was measured.
EXPORTED = (
    "seq",
    "heat_w",
    "y_dtf_um",
    "y_tdtf_um",
    "y_pred_um",
    "y_std_um",
    "residual_um",
    "y_offset_um",
    "y_offset_rate_um_per_min",
    "y_offset_std_um",
    "state",
    "reasons",
)

#: How files begin that somebody may take for a table, and what to do with them.
_OTHER_FILES = (
    (b"PK\x03\x04", "a workbook (XLSX, ODS) or ZIP archive, expected a table; save it as CSV in UTF-8"),
    (b"\xd0\xcf\x11\xe0", "an old workbook (XLS), expected a table; save it as CSV in UTF-8"),
    (b"\x1f\x8b", "compressed (gzip), expected a table; unpack it first"),
    (b"\x89MCAP0\r\n", "a recording by its content, expected a table; name it FILE.mcap"),
    (b"\xff\xfe", "text in UTF-16, expected UTF-8; save it as CSV in UTF-8"),
    (b"\xfe\xff", "text in UTF-16, expected UTF-8; save it as CSV in UTF-8"),
)

#: Larger numbers are no measurements, and their powers overflow.
LARGEST = 1e30
#: Longest table, in samples of the model: eleven years of minutes.
MOST_SAMPLES = 6_000_000


def load_data(path: Path, period_s: float, roles: Mapping[str, str] | None = None) -> Data:
    """Read a table or a recording.

    Parameters
    ----------
    path : pathlib.Path
        CSV, or MCAP of ours.
    period_s : float
        Sample period of the model, s.
    roles : mapping of str to str, optional
        Column name for each role that has another name in the table.

    Raises
    ------
    DataError
        One line that names file, row or column, value and what was expected.
    """
    if path.suffix == ".mcap":
        return load_recordings([path], period_s, roles)
    t_s, columns = _read_csv(path)
    measured, remarks = _measured_alone(path, columns)
    data = _gridded(path, t_s, _with_roles(path, measured, roles or {}), period_s)
    return replace(data, remarks=(*remarks, *data.remarks))


def load_recordings(paths: Sequence[Path], period_s: float, roles: Mapping[str, str] | None = None) -> Data:
    """Read recordings that follow each other as one: a machine's day goes on in the next file.

    Parameters
    ----------
    paths : sequence of pathlib.Path
        MCAP files of ours, in any order.
    period_s, roles
        As :func:`load_data`.

    Raises
    ------
    DataError
        As :func:`load_data`.
    """
    parts = []
    for path in paths:
        t_s, columns = _read_mcap(path)
        parts.append((t_s, _with_roles(path, columns, roles or {})))
    names = dict.fromkeys(name for _, columns in parts for name in columns)
    t_s = np.concatenate([t for t, _ in parts])
    whole = {
        name: np.concatenate([columns.get(name, np.full(t.size, np.nan)) for t, columns in parts]) for name in names
    }
    order = np.argsort(t_s, kind="stable")
    return _gridded(paths[0], t_s[order], {name: values[order] for name, values in whole.items()}, period_s)


def roles_of(pairs: Sequence[str]) -> dict[str, str]:
    """Take `--column ROLE=NAME` apart.

    Raises
    ------
    UsageError
        If one of them is no such pair.

    Examples
    --------
    >>> roles_of(["t_q_degc=t5_degc"])
    {'t_q_degc': 't5_degc'}
    """
    roles = {}
    for pair in pairs:
        role, equals, name = pair.partition("=")
        if not equals or not role or not name:
            raise UsageError(f"--column {pair}: expected ROLE=NAME, such as t_q_degc=t5_degc")
        roles[role] = name
    return roles


def _measured_alone(path: Path, columns: dict[str, Vector]) -> tuple[dict[str, Vector], tuple[Remark, ...]]:
    """Leave out of an exported recording what the service made of the measurements.

    Its heat is the model's own estimate: a model fitted to that as if somebody had measured it would find itself again.
    """
    if not {"y_pred_um", "y_offset_um"} <= columns.keys():
        return columns, ()
    kept = {name: values for name, values in columns.items() if name not in EXPORTED}
    if "heat_measured_w" in kept:
        kept["heat_w"] = kept.pop("heat_measured_w")
    said = f"{path}: an exported recording; what the service estimated and published is left out, heat_w with it."
    return kept, (Remark("estimates_left_out", said),)


def _with_roles(path: Path, columns: dict[str, Vector], roles: Mapping[str, str]) -> dict[str, Vector]:
    for role, name in roles.items():
        if role not in ROLES:
            raise DataError(f"{path}: --column {role}={name}: expected a role of {', '.join(ROLES)}")
        if name not in columns:
            raise DataError(f"{path}: --column {role}={name}: no such column, expected one of: {', '.join(columns)}")
    renamed = {roles_name: columns[name] for roles_name, name in roles.items()}
    return {**{n: v for n, v in columns.items() if n not in roles.values()}, **renamed}


def _read_csv(path: Path) -> tuple[Vector, dict[str, Vector]]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}; expected a table or a recording") from error
    if not data:
        raise DataError(f"{path}: the file is empty, expected a header and data")
    for begin, kind in _OTHER_FILES:
        if data.startswith(begin):
            raise DataError(f"{path}: {kind}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: not UTF-8 text ({error.reason} at byte {error.start}), expected a table: CSV in UTF-8"
        ) from error
    try:
        rows = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise DataError(f"{path}: not a CSV table: {error}") from error
    if len(rows) < 2:
        raise DataError(f"{path}: {len(rows)} row(s), expected a header and data")
    header = [name.strip() for name in rows[0]]
    for name in header:
        if header.count(name) > 1:
            raise DataError(f"{path}: the header names column {name!r} twice, expected each name once")
    if "t_s" not in header and "time_utc" not in header:
        for separator, word in ((";", "semicolons"), ("\t", "tabs")):
            if rows[0] and separator in rows[0][0]:
                raise DataError(f"{path}: {word} between its cells, expected commas, and a dot in numbers: 20.5")
        raise DataError(f"{path}: no column t_s or time_utc; the header has: {', '.join(header)[:100]}")
    cells: dict[str, list[float]] = {name: [] for name in header}
    text_columns: set[str] = set()
    for line, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        if len(row) != len(header):
            raise DataError(f"{path}: row {line}: {len(row)} cells, expected {len(header)}")
        for name, cell in zip(header, row, strict=True):
            cells[name].append(_cell(path, line, name, cell.strip(), text_columns))
    time = np.array(cells.pop("t_s" if "t_s" in cells else "time_utc"))
    cells.pop("time_utc", None)
    if np.isnan(time).any():
        raise DataError(f"{path}: row {int(np.argmax(np.isnan(time))) + 2}: time is missing")
    return time - time[0] if time.size else time, {
        name: np.array(values) for name, values in cells.items() if name not in text_columns
    }


def _cell(path: Path, line: int, name: str, cell: str, text_columns: set[str]) -> float:
    if cell == "":
        return math.nan
    try:
        if name == "time_utc":
            return datetime.fromisoformat(cell).timestamp()
        value = float(cell)
    except (ValueError, OverflowError) as error:
        if name in (*ROLES, "t_s", "time_utc"):
            raise DataError(f"{path}: row {line}: {name} = {cell[:40]!r}, expected a number") from error
        text_columns.add(name)
        return math.nan
    if math.isinf(value):
        raise DataError(f"{path}: row {line}: {name} = {cell}, expected a finite number")
    return value


def _read_mcap(path: Path) -> tuple[Vector, dict[str, Vector]]:
    times: list[int] = []
    rows: list[dict[str, float]] = []
    for record in read_messages(path, ("sample",)):
        sample = decode(record, path)
        assert isinstance(sample, Sample)
        times.append(sample.time_utc_ns)
        rows.append(
            {
                name: number(channel.mean) if channel.quality == "good" else math.nan
                for name, channel in sample.channels.items()
            }
        )
    if not rows:
        raise DataError(f"{path}: no samples in it")
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: np.array([row.get(name, math.nan) for row in rows]) for name in names}
    return np.array(times) / 1e9, columns


def _gridded(path: Path, t_s: Vector, columns: dict[str, Vector], period_s: float) -> Data:
    """Average to the period, report and sort what is out of order, split at long gaps."""
    _check_size(path, t_s, columns, period_s)
    remarks = []
    order = np.argsort(t_s, kind="stable")
    disordered = int(np.sum(np.diff(t_s) < 0))
    if disordered:
        row = int(np.argmax(np.diff(t_s) < 0)) + 3
        remarks.append(Remark("rows_sorted", f"{path}: row {row}: {disordered} row(s) out of order; sorted by time."))
    t_s = t_s[order] - t_s.min()
    slot = (
        np.round(t_s / period_s).astype(int)
        if _spacing(t_s) >= period_s
        else np.floor(t_s / period_s + 1e-9).astype(int)
    )
    n = int(slot[-1]) + 1
    gridded = {name: _mean_by_slot(slot, values[order], n) for name, values in columns.items()}
    present = np.zeros(n, dtype=bool)
    present[slot] = True
    records = []
    start = 0
    for first, last in _gaps(present):
        length = last - first
        gap = f"{path}: gap of {length} sample(s) from t_s = {first * period_s:g}"
        if length <= SHORT_GAP_SAMPLES:
            remarks.append(Remark("gap_bridged", f"{gap}; bridged."))
        else:
            remarks.append(Remark("gap_splits", f"{gap}; the record is split there."))
            records.append((start, first))
            start = last
    records.append((start, n))
    return Data(
        records=tuple(
            Record(
                t_s=np.arange(a, b, dtype=np.float64) * period_s, columns={name: v[a:b] for name, v in gridded.items()}
            )
            for a, b in records
        ),
        remarks=tuple(remarks),
    )


def _check_size(path: Path, t_s: Vector, columns: dict[str, Vector], period_s: float) -> None:
    """Refuse what is no measurement but a slip of the pen: its squares, or its rows, would not fit into the machine."""
    for name, values in (("time", t_s), *columns.items()):
        large = np.abs(values) > LARGEST
        if large.any():
            row = int(np.argmax(large))
            raise DataError(f"{path}: row {row + 2}: {name} = {values[row]:g}, expected a number below {LARGEST:g}")
    apart_s = float(np.median(np.abs(np.diff(t_s)))) if t_s.size > 1 else 0.0
    if apart_s > SHORT_GAP_SAMPLES * period_s:
        raise DataError(
            f"{path}: its rows are {apart_s:g} s apart, expected at most {period_s:g} s: is the time in seconds?"
        )
    samples = float(t_s.max() - t_s.min()) / period_s
    if samples > MOST_SAMPLES:
        row = int(np.argmax(np.abs(t_s - np.median(t_s)))) + 2
        raise DataError(
            f"{path}: row {row}: its time makes {samples:.3g} samples of {period_s:g} s, "
            f"expected at most {MOST_SAMPLES}"
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


def _gaps(present: Mask) -> list[tuple[int, int]]:
    edges = np.diff(np.concatenate(([1], present.astype(int), [1])))
    return list(zip(np.flatnonzero(edges == -1).tolist(), np.flatnonzero(edges == 1).tolist(), strict=True))
