"""Tables in files: CSV, MATLAB's MAT, and recordings."""

from __future__ import annotations

import csv
import math
import pickle
import re
import signal
import subprocess
import sys
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from compensator.codes import DataRemark, Remark
from compensator.data import mat_reader
from compensator.data.cells import text_of, with_points
from compensator.data.frames import table_in_memory
from compensator.data.mat_reader import DAMAGED
from compensator.data.probed import measured_probes, with_probes, zeros_ns
from compensator.data.table import DATA_ROLES, TIMES, Table, check_columns, table_of, time_names
from compensator.errors import DataError
from compensator.messages import Event, Probe, number
from compensator.recording.reading import messages

#: First bytes of files that are mistaken for tables, and what to do with such a file.
_OTHER_FILES = (
    (b"PK\x03\x04", "a workbook or ZIP archive by its content, expected a table; name it FILE.xlsx, or save it as CSV"),
    (b"\xd0\xcf\x11\xe0", "an old workbook (XLS), expected a table; save it as CSV"),
    (b"\x1f\x8b", "compressed (gzip), expected a table; unpack it first"),
    (b"\x89MCAP0\r\n", "a recording by its content, expected a table; name it FILE.mcap"),
    (b"MATLAB 5.0 MAT", "a MAT file by its content, expected a table; name it FILE.mat"),
    (b"\xff\xfe", "text in UTF-16, expected UTF-8; save it as CSV in UTF-8"),
    (b"\xfe\xff", "text in UTF-16, expected UTF-8; save it as CSV in UTF-8"),
)
#: Largest table: bytes of its file, rows, and cells; each cell takes some hundred bytes while it is read.
TABLE_BYTES, ROWS, CELLS = 1_000_000_000, 6_000_000, 20_000_000
#: Longest that the largest MAT file takes to read on a loaded computer, s.
_MAT_S = 300.0
#: First line by which Excel names the separator.
_SEPARATOR = re.compile(r"sep=([,;\t])", re.IGNORECASE)
#: How to save what only MATLAB can read.
_AS_CSV = "in MATLAB, writetable(T, 'run.csv') saves a table T as CSV"


def read_csv(path: Path, data: bytes, roles: Mapping[str, str]) -> Table:
    """Read a table from the bytes of a CSV file; `roles` may give the time another name.

    Raises
    ------
    DataError
        One line that names file, row or column, value and what was expected.
    """
    if not data:
        raise DataError(f"{path}: the file is empty, expected a header and data")
    for begin, kind in _OTHER_FILES:
        if data.startswith(begin):
            raise DataError(f"{path}: {kind}")
    rows = data.count(b"\n")
    cells = rows + sum(map(data.count, (b",", b";", b"\t")))
    if cells > CELLS or rows > ROWS:
        raise DataError(f"{path}: {rows} rows of {cells} cells, expected at most {ROWS} and {CELLS}; split the table")
    lines, first, separator = _lines(path, text_of(path, data), roles)
    if len(lines) < 2:
        found = "a header without data" if lines else "empty"
        raise DataError(f"{path}: {found}, expected a header and data")
    header = _header(path, lines[0], roles)
    numbered = [(row, cells) for row, cells in enumerate(lines[1:], start=first) if cells]
    for row, line in numbered:
        if len(line) != len(header):
            taken = f", as in its first line, {header[0][:40]!r}: is that the header?" if len(header) == 1 else ""
            raise DataError(f"{path}: row {row}: {len(line)} cells, expected {len(header)}{taken}")
    columns = zip(*(line for _, line in numbered), strict=True) if numbered else ([] for _ in header)
    # Keep cells as text: numpy would truncate or convert them.
    arrays = {name: np.array(cells, dtype=object) for name, cells in zip(header, columns, strict=True)}
    numbers = [row for row, _ in numbered]
    if separator != ",":
        arrays = with_points(str(path), arrays, numbers)
    return table_of(str(path), arrays, roles=roles, rows=numbers, has="the header has")


def _lines(path: Path, text: str, roles: Mapping[str, str]) -> tuple[list[list[str]], int, str]:
    """Return the cells of all lines, the number of the line after the header, and what stands between cells."""
    lines = text.splitlines()
    first = 2
    if lines and (excel := _SEPARATOR.fullmatch(lines[0].strip())):
        # Excel's own first line names the separator.
        lines, first, separators = lines[1:], 3, excel[1]
    else:
        separators = ",;\t"
    # Without a time in the header, which is refused by name later, the separator is that of most names.
    most = max(separators, key=lambda one: len(_names(lines[:1], one)))
    separator = next((one for one in separators if time_names(roles) & _names(lines[:1], one)), most)
    try:
        return list(csv.reader(lines, delimiter=separator)), first, separator
    except csv.Error as error:
        raise DataError(f"{path}: not a CSV table: {error}") from error


def _names(header: Sequence[str], separator: str) -> set[str]:
    """Return the names of a header; none if it cannot be split so."""
    try:
        return {name.strip() for name in next(csv.reader(header, delimiter=separator), [])}
    except csv.Error:
        return set()


def _header(path: Path, cells: Sequence[str], roles: Mapping[str, str]) -> list[str]:
    check_columns(str(path), len(cells))
    # What has no name is left out later: the index that pandas writes, or columns behind the last separator.
    header = [name.strip() or " " * i for i, name in enumerate(cells)]
    for name, count in Counter(header).items():
        if count > 1:
            raise DataError(f"{path}: the header names column {name[:64]!r} twice, expected each name once")
    return header


def read_mat(path: Path, roles: Mapping[str, str]) -> tuple[Table, tuple[Remark, ...]]:
    """Read a table from a MAT file: vectors of equal length, or one struct of such vectors.

    Matrices and vectors of another length are left out with a remark; one that has a role is refused.
    `roles` may give the time another name.

    Raises
    ------
    DataError
        If the file is of version 7.3, holds an object such as a `table`, or no columns.
    """
    content = _variables(path)
    if isinstance(content, NotImplementedError):
        raise DataError(
            f"{path}: a MAT file of version 7.3 (HDF5), expected version 7: save(FILE, ..., '-v7'), or a CSV; {_AS_CSV}"
        ) from content
    if isinstance(content, Exception):
        raise DataError(f"{path}: not a MAT file that can be read ({str(content)[:80]}); {_AS_CSV}") from content
    columns: Mapping[str, Any] = {name: value for name, value in content.items() if not name.startswith("__")}
    while len(columns) == 1 and (fields := _fields(next(iter(columns.values())))):
        columns = fields
    arrays = {name: value for name, value in columns.items() if getattr(value, "ndim", 0) and value.size > 1}
    time = next((arrays[name] for name in time_names(roles) if name in arrays), None)
    if time is None:
        raise DataError(
            f"{path}: no vector t_s or time_utc; it has: {', '.join(columns)[:100] or 'no variables'}. Save each "
            "column as a vector, a table by S = table2struct(T, 'ToScalar', true); save(FILE, '-struct', 'S'); or as "
            f"CSV: {_AS_CSV}"
        )
    needed = (*DATA_ROLES, *TIMES, *roles.values())
    others = [name for name, value in arrays.items() if value.shape != time.shape and name not in needed]
    table = table_of(str(path), {name: arrays[name] for name in arrays if name not in others}, roles=roles)
    if not others:
        return table, ()
    shown = ", ".join(f"{name} ({' × '.join(map(str, arrays[name].shape))})" for name in others)
    words = f"{path}: left out, not one value for each of {time.size} rows: {shown}."
    return table, (Remark(DataRemark.VARIABLES_LEFT_OUT, words),)


def _variables(path: Path) -> dict[str, Any] | Exception:
    """Return the variables of a MAT file, or why there are none."""
    # Unsafe paths are left out (-P): a module in the folder of the data is no part of this program.
    command = (sys.executable, "-P", str(Path(mat_reader.__file__)), str(path.absolute()))
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=_MAT_S)
    except subprocess.TimeoutExpired:
        return DataError(f"its reader had not ended after {_MAT_S:.0f} s")
    if done.returncode < 0:
        return DataError(f"its reader was ended by {signal.Signals(-done.returncode).name}")
    if done.returncode:
        return DataError(done.stderr.decode(errors="replace").strip().rpartition("\n")[2])
    found: dict[str, Any] | Exception = pickle.loads(done.stdout)
    return found


def _fields(value: Any) -> Mapping[str, Any]:
    """Return the fields of a MATLAB struct, none of anything else."""
    names = getattr(getattr(value, "dtype", None), "names", None)
    return {name: value[name].item() for name in names} if names and value.size == 1 else {}


def read_workbook(path: Path, roles: Mapping[str, str]) -> Table:
    """Read the first sheet of an Excel workbook, where pandas and openpyxl are installed.

    Raises
    ------
    DataError
        If they are not, or it cannot be read; the message says how to save a CSV.
    """
    as_csv = "save the sheet as CSV (File, Save As, CSV UTF-8)"
    try:
        import pandas

        frame = pandas.read_excel(path, sheet_name=0, engine="openpyxl", nrows=ROWS)
    except ImportError as error:
        needs = "an Excel workbook, which needs pandas and openpyxl"
        raise DataError(f"{path}: {needs}; install them, or {as_csv}") from error
    except (zipfile.BadZipFile, *DAMAGED) as error:
        why = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
        raise DataError(f"{path}: not a workbook that can be read ({why}); {as_csv}") from error
    return table_in_memory(str(path), frame, roles, rows=range(2, len(frame) + 2))


def read_recordings(paths: Sequence[Path], roles: Mapping[str, str]) -> tuple[Table, tuple[Remark, ...]]:
    """Read recordings that follow each other as one table; each has the columns that the roles name.

    Where no displacement sensor measured Y, the values of touch probes of one feature are `y_um`, each in a row of its
    own: as much later than the probe as the time of a sample, its end, is than the middle of its polls.

    Raises
    ------
    DataError
        If one is no recording, has no samples, or lacks a column, or if a role names another time.
    """
    for role in TIMES:
        if role in roles:
            raise DataError(f"{paths[0]}: --column {role}={roles[role]}: a recording has a time of its own")
    parts = [_read_recording(path) for path in paths]
    tables = [part.table.with_roles(roles) for part in parts]
    names = dict.fromkeys(name for table in tables for name in table.columns)
    t_s = np.concatenate([table.t_s for table in tables])
    columns = {
        name: np.concatenate([table.columns.get(name, np.full(table.t_s.size, np.nan)) for table in tables])
        for name in names
    }
    order = np.argsort(t_s, kind="stable")
    columns, t_s = {name: values[order] for name, values in columns.items()}, t_s[order]
    table = Table(name=str(paths[0]), t_s=t_s, columns=columns, rows=range(2, t_s.size + 2))
    if np.isfinite(columns.get("y_um", np.array([]))).any():
        return table, ()
    probes, remarks = measured_probes(table.name, [part.probes for part in parts])
    if not probes:
        return table, remarks
    zeros = [time_ns for part in parts for time_ns in part.zeros_ns]
    return with_probes(table, probes, zeros, max(part.behind_ns for part in parts)), remarks


class _Recording(NamedTuple):
    """What a recording has for a table.

    Parameters
    ----------
    table : Table
        Its samples; the time counts from 1970.
    probes : list of Probe
        All of its probes.
    zeros_ns : list of int
        Times of the samples with which a zero was set, ns since 1970 UTC.
    behind_ns : int
        Time from the middle of the polls of a sample to its end.
    """

    table: Table
    probes: list[Probe]
    zeros_ns: list[int]
    behind_ns: int


def _read_recording(path: Path) -> _Recording:
    times: list[int] = []
    behind_ns = 0
    samples: list[dict[str, float]] = []
    probes: list[Probe] = []
    events: list[Event] = []
    ends_ns: dict[int, int] = {}
    for message in messages(path, ("sample", "probe", "event")):
        if isinstance(message, Probe):
            probes.append(message)
            continue
        if isinstance(message, Event):
            events.append(message)
            continue
        # A sample in which the service began has fewer polls.
        behind_ns = max(behind_ns, message.behind_ns)
        times.append(message.time_utc_ns)
        ends_ns[message.seq] = message.time_utc_ns
        samples.append(
            {name: number(channel.mean) if channel.is_good else math.nan for name, channel in message.channels.items()}
        )
    if not samples:
        raise DataError(f"{path}: no samples in it")
    names = dict.fromkeys(name for row in samples for name in row)
    columns = {name: np.array([row.get(name, math.nan) for row in samples]) for name in names}
    table = Table(name=str(path), t_s=np.array(times) / 1e9, columns=columns, rows=range(2, len(times) + 2))
    return _Recording(table, probes, zeros_ns(events, ends_ns), behind_ns)
