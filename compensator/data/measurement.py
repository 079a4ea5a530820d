"""DATA: anything that holds measurements, read once for every verb."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from compensator import display
from compensator.codes import DataRemark, Remark
from compensator.data.cleaning import cleaned, refuse_at_limit
from compensator.data.files import TABLE_BYTES, read_csv, read_mat, read_recordings, read_workbook
from compensator.data.frames import has_local_time, hash_of, hash_of_t_q, is_frame, table_in_memory
from compensator.data.gridding import to_grid
from compensator.data.probed import of_one_zero
from compensator.data.record import SampledData, SampledRecord, require
from compensator.data.runs import SHORTEST_RUN, Run, runs_of
from compensator.data.screening import check_deformation_scale, check_y_std, screen_temperatures
from compensator.data.table import Table
from compensator.errors import DataError, UsageError
from compensator.input_file import read_file, sha256_of_file
from compensator.options import check_types
from compensator.recording.reading import recordings_in

if TYPE_CHECKING:
    from pandas import DataFrame

#: Sample period of identified models, s, as in the service.
PERIOD_S = 60.0
#: A time before 2001 counts from the start of a record, s since 1970 UTC.
EARLIEST_UTC_S = 978_307_200.0
_NEEDED = ("t_q_degc", "at_degc", "y_um")


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Where a table comes from.

    Parameters
    ----------
    name : str
        The file's name, or the role of a table in memory, such as `data 2`.
    sha256 : str
        Of the file's bytes, or of the values of a table in memory.
    path : pathlib.Path, optional
        The file.
    size : tuple of (int, tuple of str)
        Number of rows, and columns, of a table in memory.
    t_q_sha256 : str
        Of the readings of T_Q in a table: the same record with other columns has the same; empty for a recording.
    """

    name: str
    sha256: str
    path: Path | None = None
    size: tuple[int, tuple[str, ...]] = (0, ())
    t_q_sha256: str = ""

    def provenance(self) -> dict[str, Any]:
        """Return what a model file says of it."""
        hashes = {"sha256": self.sha256} | ({"t_q_sha256": self.t_q_sha256} if self.t_q_sha256 else {})
        if self.path is not None:
            return {"file": self.name} | hashes
        return {"table": self.name, "rows": self.size[0], "columns": list(self.size[1])} | hashes

    def is_in(self, known: Collection[object]) -> bool:
        """Return whether the same data, or the same record with other columns, are among some hashes."""
        return self.sha256 in known or (self.t_q_sha256 != "" and self.t_q_sha256 in known)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Measurement(display.Shown):
    """Measured data as it was read: one table, or recordings that follow each other.

    Parameters
    ----------
    table : Table
        What was measured, in columns named by role.
    label : str
        Name of its runs: the file's, without its folder.
    origins : tuple of Origin
        Files, or the table in memory.
    roles : dict of str to str
        Columns that had other names.
    remarks : tuple of Remark
        What reading left out.
    in_frame : bool
        Whether it was a pandas DataFrame; tables of results then are, too.
    local_time : bool
        Whether its times had no zone.
    """

    table: Table
    label: str
    origins: tuple[Origin, ...]
    roles: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[Remark, ...] = ()
    in_frame: bool = False
    local_time: bool = False

    @property
    def name(self) -> str:
        """Name in messages."""
        return self.table.name

    @property
    def since_utc_s(self) -> float | None:
        """Time of the first row, s since 1970 UTC; None where it is not known."""
        first_s = float(self.table.t_s.min()) + (self.table.start_utc_s or 0.0)
        return None if self.local_time or first_s < EARLIEST_UTC_S else first_s

    @property
    def hours(self) -> float:
        """Time from the first row to the last, h."""
        return float(np.ptp(self.table.t_s)) / 3600.0

    def at_period(self, period_s: float, *, whole_y: bool = False) -> SampledData:
        """Return the records at a sample period, s, with what had to be corrected.

        Parameters
        ----------
        period_s : float
            Sample period, s.
        whole_y : bool
            Whether all of Y is kept: what was probed about every zero, and not only about that which has most probes,
            and what was measured before and after T_Q or AT was missing for long, in one record.

        Raises
        ------
        DataError
            If a value or time cannot have been measured.
        """
        table, others = (self.table, ()) if whole_y else of_one_zero(self.table)
        data = to_grid(table, period_s, whole_y=whole_y)
        records, left_out = cleaned(self.name, data.records)
        return SampledData(records=records, remarks=(*self.remarks, *others, *data.remarks, *left_out))

    def before(self, hour: float) -> Measurement:
        """Return the rows before an hour from the start.

        Raises
        ------
        DataError
            If there are none.
        """
        t_s = self.table.t_s - np.min(self.table.t_s)
        keep = t_s < hour * 3600.0
        if not keep.any():
            raise DataError(f"{self.name}: no rows before {hour:g} h, expected data to search in")
        columns = {name: values[keep] for name, values in self.table.columns.items()}
        rows = np.asarray(self.table.rows)[keep].tolist()
        table = dataclasses.replace(self.table, t_s=self.table.t_s[keep], columns=columns, rows=rows)
        return dataclasses.replace(self, table=table)

    def contents(self) -> list[display.Table]:
        """Return what it shows: span, samples, columns, remarks."""
        return [display.Table(title=self.name, head=["", ""], rows=self._rows())]

    def _rows(self) -> list[list[str]]:
        t_s, columns = self.table.t_s, self.table.columns
        apart = f" of {np.median(np.abs(np.diff(t_s))):g} s" if t_s.size > 1 else ""
        missing = {name: 100.0 * float(np.mean(np.isnan(values))) for name, values in columns.items()}
        names = [f"{name} ({share:.0f} % missing)" if share >= 0.5 else name for name, share in missing.items()]
        rows = [["span", f"{self.hours:.2f} h"], ["samples", f"{t_s.size}{apart}"], ["columns", ", ".join(names)]]
        try:
            remarks = [remark.marked for remark in self.at_period(PERIOD_S).remarks]
        except DataError as error:
            remarks = [str(error)]
        return rows + [["remark", remark] for remark in remarks]


Source: TypeAlias = "str | os.PathLike[str] | DataFrame | Mapping[str, npt.ArrayLike] | Measurement"
DataLike: TypeAlias = "Source | Sequence[Source]"
"""What every verb accepts as data: a path, a DataFrame, a mapping of arrays, a Measurement, or several of those.

A path names a table (CSV or MAT) or a recording. Columns of what is in memory have the names of a table's: `t_s` or
`time_utc` is the time, the others are roles (`t_q_degc`, `at_degc`, `y_um`, `heat_w`) or further channels; NaN is
missing. A sequence is several runs; recordings in it follow each other and are one.
"""


def read(data: DataLike, *, columns: Mapping[str, str] | None = None, name: str = "data") -> Measurement:
    """Read measured data.

    Parameters
    ----------
    data : DataLike
        One table, or recordings that follow each other.
    columns : mapping of str to str, optional
        Column name for each role, or for the time, that has another name: `{"t_q_degc": "t5", "t_s": "seconds"}`.
    name : str
        Name in messages of data that is not a file.

    Raises
    ------
    DataError
        One line that names file, row or column, value and what was expected.

    Examples
    --------
    >>> read({"t_s": [0, 60], "t5": [20.0, 20.5], "at_degc": [20.0, 20.1]}, columns={"t_q_degc": "t5"})
    data
    span     0.02 h
    samples  2 of 60 s
    columns  at_degc, t_q_degc
    """
    check_types(name=name)
    found = measurements(data, name, columns, needed=True)
    if len(found) != 1:
        raise DataError(f"{name}: {len(found)} tables, expected one; hand several runs over as a list")
    return found[0]


def measurements(
    data: DataLike | None, role: str, columns: Mapping[str, str] | None = None, *, needed: bool = False
) -> list[Measurement]:
    """Read a DATA argument: one source or a list of them.

    Recordings follow each other and are one; they come after the tables.

    Parameters
    ----------
    data, columns
        As :func:`read`; several tables, too.
    role : str
        Name in messages of data that is not a file; numbered where there are several.
    needed : bool
        Whether an empty list is refused.

    Raises
    ------
    DataError
        As :func:`read`.
    """
    sources: list[Any] = [] if data is None else [data]
    if isinstance(data, Sequence) and not isinstance(data, (str, bytes)):
        sources = list(data)
    if columns is not None and not isinstance(columns, Mapping):
        raise UsageError(f'columns: {type(columns).__name__}, expected names by role: {{"t_q_degc": "t5"}}')
    if needed and not sources:
        raise DataError(f"{role}: empty, expected a path, a DataFrame, a dict of arrays, or a list of those")
    roles = dict(columns or {})
    found, recordings = [], []
    for number, source in enumerate(sources, start=1):
        name = f"{role} {number}" if len(sources) > 1 else role
        if isinstance(source, Measurement):
            found.append(source)
        elif isinstance(source, (str, os.PathLike)):
            path = Path(source)
            if path.is_dir():
                recordings += recordings_in([path])
            elif path.suffix.lower() == ".mcap":
                recordings.append(path)
            else:
                found.append(_of_file(path, roles))
        elif isinstance(source, Mapping) or is_frame(source):
            found.append(_in_memory(name, source, roles))
        else:
            raise DataError(
                f"{name}: {type(source).__name__}, expected a path, a DataFrame, a dict of arrays, or a list of those"
            )
    if recordings:
        table, left_out = read_recordings(recordings, roles)
        origins = tuple(_origin(path, sha256_of_file(path)) for path in recordings)
        label = recordings[0].name
        found.append(Measurement(table=table, label=label, origins=origins, roles=roles, remarks=left_out))
    return found


def check_each_once(measured: Sequence[Measurement]) -> None:
    """Refuse the same values twice, whatever the files are named: they would count as twice the evidence.

    Raises
    ------
    DataError
        Naming the second.
    """
    if len(measured) < 2:
        return
    seen: dict[str, str] = {}
    for one in measured:
        values = hash_of(one.table)
        if values in seen:
            raise DataError(f"{one.label}: has the values of {seen[values]}, expected each run once")
        seen[values] = one.label


def check_validation(fitted: Sequence[Measurement], validation: Sequence[Measurement]) -> None:
    """Refuse to validate a model on data that were used to make it, or a copy of them.

    Raises
    ------
    UsageError
        Naming the data.
    """
    used = {value for measured in fitted for origin in measured.origins for value in (origin.sha256, origin.t_q_sha256)}
    for measured in validation:
        for origin in measured.origins:
            if origin.is_in(used):
                named = origin.path or origin.name
                raise UsageError(f"--validate {named}: is used for the fit, expected another run")


def _of_file(path: Path, roles: Mapping[str, str]) -> Measurement:
    try:
        data = read_file(path, TABLE_BYTES)
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}; expected a table or a recording") from error
    left_out: tuple[Remark, ...] = ()
    if path.suffix.lower() == ".mat":
        table, left_out = read_mat(path, roles)
    elif path.suffix.lower() in (".xlsx", ".xlsm"):
        table = read_workbook(path, roles)
    else:
        table = read_csv(path, data, roles)
    table, remarks = table.measurements_only()
    table = table.with_roles(roles)
    origin = _origin(path, hashlib.sha256(data).hexdigest(), hash_of_t_q(table))
    return Measurement(table=table, label=path.name, origins=(origin,), roles=roles, remarks=(*left_out, *remarks))


def _in_memory(name: str, source: Any, roles: Mapping[str, str]) -> Measurement:
    table, remarks = table_in_memory(name, source, roles).measurements_only()
    sha256, size, table = hash_of(table), (table.t_s.size, tuple(table.columns)), table.with_roles(roles)
    origin = Origin(name=name, sha256=sha256, size=size, t_q_sha256=hash_of_t_q(table))
    return Measurement(
        table=table,
        label=name,
        origins=(origin,),
        roles=roles,
        remarks=remarks,
        in_frame=is_frame(source),
        local_time=is_frame(source) and has_local_time(source, roles),
    )


def _origin(path: Path, sha256: str, t_q_sha256: str = "") -> Origin:
    return Origin(name=path.name, sha256=sha256, path=path, t_q_sha256=t_q_sha256)


def runs_in(
    data: Sequence[Measurement],
    period_s: float = PERIOD_S,
    *,
    y_std_um: float | None = None,
    check: Callable[[SampledRecord, str], None] = lambda record, name: None,
    whole_y: bool = False,
) -> tuple[list[Run], list[Remark]]:
    """Return the runs of measurements, and what had to be corrected.

    Parameters
    ----------
    data : sequence of Measurement
        With T_Q, AT and Y.
    period_s : float
        Sample period of the model, s.
    y_std_um : float, optional
        Standard deviation of one measured value of Y, µm; by default what neighbouring values show.
    check : callable
        Called with each record and the name of its data; refuses what cannot be used.
    whole_y : bool
        Whether all of Y is kept: what was probed about every zero (`Run.zeros_s`), and not only about one, and what was
        measured before and after T_Q or AT was missing for long (`Run.holes`), in one run.

    Raises
    ------
    DataError
        If a column is missing, or there is no stretch long enough for a run.
    UsageError
        If the standard deviation is none.
    """
    check_y_std(y_std_um)
    gridded = [(measured, measured.at_period(period_s, whole_y=whole_y)) for measured in data]
    runs: list[Run] = []
    remarks: list[Remark] = []
    for number, (measured, part) in enumerate(gridded):
        remarks += part.remarks
        for record in part.records:
            check(record, measured.name)
            require(measured.name, record, _NEEDED)
            refuse_at_limit(measured.name, record)
            zeros_s = tuple(at_s - float(measured.table.t_s.min()) for at_s in measured.table.zeros_s)
            for run in runs_of(measured.label, record, whole_y=whole_y):
                one = dataclasses.replace(run, recording=number, y_std_um=y_std_um)
                own = one.with_zeros(zeros_s) if whole_y else one
                if left_out := int(np.sum(np.isfinite(one.y_um)) - np.sum(np.isfinite(own.y_um))):
                    words = f"{run.name}: {left_out} probe(s) left out: alone about their zero, or beside its change."
                    remarks.append(Remark(DataRemark.ZEROS_LEFT_OUT, words))
                runs.append(own)
    if not runs and gridded:
        raise DataError(_without_runs(gridded[0][0].name, gridded[0][1], period_s))
    return runs, remarks


def screened_runs_in(
    data: Sequence[Measurement],
    period_s: float = PERIOD_S,
    *,
    y_std_um: float | None = None,
    check: Callable[[SampledRecord, str], None] = lambda record, name: None,
    whole_y: bool = False,
) -> tuple[list[Run], list[Remark]]:
    """Return the runs of measurements that a model is judged by, as `runs_in`, with temperatures and Y screened.

    Raises
    ------
    DataError
        If a temperature cannot be true, or Y moves by no or another unit's amount.
    """
    runs, remarks = runs_in(data, period_s, y_std_um=y_std_um, check=check, whole_y=whole_y)
    name = name_of(runs)
    screen_temperatures(name, runs, quiet_air=True)
    check_deformation_scale(name, np.concatenate([run.y_um for run in runs]))
    return runs, remarks


def name_of(runs: Sequence[Run]) -> str:
    """Return the names of runs, each once, for messages."""
    return ", ".join(dict.fromkeys(run.name for run in runs))


def _without_runs(name: str, data: SampledData, period_s: float) -> str:
    """Return the reason why data yields no run."""
    size = sum(record.t_s.size for record in data.records)
    is_apart = any(record.row_s >= 1.5 * period_s for record in data.records)  # between its rows everything is missing
    for column in ("t_q_degc", "at_degc", "heat_w"):
        missing = sum(int(np.isnan(r.columns[column]).sum()) for r in data.records if column in r.columns)
        if missing > size // 2 and not is_apart:
            return f"{name}: {column} is missing in {missing} of {size} samples, expected it in most of them"
    return (
        f"{name}: {size * period_s / 60.0:.0f} min of data in {len(data.records)} part(s), expected at least one of "
        f"{SHORTEST_RUN * period_s / 60.0:.0f} min without a long gap, and 120 min in all for a model"
    )
