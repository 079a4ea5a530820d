"""Lines of a CSV file with probes: header row, comma, dot, UTF-8; each line has its own time."""

from __future__ import annotations

import csv
import datetime
import math
from collections.abc import Mapping
from typing import NamedTuple

from compensator.probes.probe import LARGEST_UM

#: Columns, and whether a line needs a value. The time is either of the first two.
COLUMNS = {
    "time_utc": False,
    "time_utc_ns": False,
    "axis": False,
    "measured_um": True,
    "offset_applied_um": False,
    "std_um": False,
    "feature": True,
    "tool": False,
    "stopped_s": False,
}
#: Times are below this, ns since 1970 UTC, whatever their form; in the year 2262.
_END_NS = 2**63
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)


class BadLine(ValueError):
    """A header or line that cannot be used; says why."""


class NoFeature(BadLine):
    """A line without a feature."""


class Row(NamedTuple):
    """A line.

    Parameters
    ----------
    time_utc_ns : int
        When it was measured, ns since 1970 UTC.
    measured_um : float
        Where the feature was found minus where it belongs, in the direction of the file, µm.
    offset_applied_um, std_um, stopped_s : float or None
        None where empty.
    feature, tool : str
        Names.
    """

    time_utc_ns: int
    measured_um: float
    offset_applied_um: float | None
    std_um: float | None
    feature: str
    tool: str
    stopped_s: float | None

    @property
    def identity(self) -> str:
        """What makes it one probe: its time and its feature."""
        return f"{self.time_utc_ns} {self.feature}"

    @property
    def values(self) -> str:
        """The rest of it, to recognise a change."""
        return repr(self[1:4] + self[5:])


def columns(line: str) -> list[str]:
    """Read the header row.

    Raises
    ------
    BadLine
        If a column is unknown, occurs twice or is missing.
    """
    names = [name.strip() for name in _fields(line.removeprefix("\ufeff"))]
    if not set(names) & set(COLUMNS):
        raise BadLine(f"no header row, expected some of {', '.join(COLUMNS)}")
    for name in names:
        if name not in COLUMNS:
            raise BadLine(f"column {name!r}, expected some of {', '.join(COLUMNS)}")
    if len(set(names)) < len(names):
        raise BadLine("a column occurs twice")
    for name, needed in COLUMNS.items():
        if needed and name not in names:
            raise BadLine(f"no column {name}")
    if ("time_utc" in names) == ("time_utc_ns" in names):
        raise BadLine("expected either a column time_utc or time_utc_ns")
    return names


def row(names: list[str], line: str) -> Row:
    """Read a line.

    Raises
    ------
    BadLine
        If a value is missing or cannot be used.

    Examples
    --------
    >>> names = columns("time_utc,measured_um,offset_applied_um,feature")
    >>> row(names, "2026-03-02T10:00:00.5Z,3.2,,sphere-1").time_utc_ns
    1772445600500000000
    """
    fields = _fields(line)
    if len(fields) != len(names):
        raise BadLine(f"{len(fields)} values, expected {len(names)}")
    values = dict(zip(names, (field.strip() for field in fields), strict=True))
    if (values.get("axis") or "y") != "y":
        raise BadLine(f"axis = {values['axis']!r}, expected y")
    measured_um = _number(values, "measured_um", -LARGEST_UM, LARGEST_UM)
    if measured_um is None:
        raise BadLine("measured_um is empty")
    if not values["feature"]:
        raise NoFeature("feature is empty, expected a name")
    for name in ("feature", "tool"):
        if len(values.get(name, "")) > 64 or not values.get(name, "").isprintable():
            raise BadLine(f"{name}: expected at most 64 printable characters")
    return Row(
        time_utc_ns=_time(values),
        measured_um=measured_um,
        offset_applied_um=_number(values, "offset_applied_um", -LARGEST_UM, LARGEST_UM),
        std_um=_number(values, "std_um", 1e-3, LARGEST_UM),
        feature=values["feature"],
        tool=values.get("tool", ""),
        stopped_s=_number(values, "stopped_s", 0.0, 1e9),
    )


def _fields(line: str) -> list[str]:
    try:
        return next(csv.reader([line], strict=True), [])
    except csv.Error as error:
        raise BadLine(str(error)) from None


def _number(values: Mapping[str, str], name: str, least: float, most: float) -> float | None:
    text = values.get(name, "")
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    # An underscore is a number to Python and to nobody else.
    if "_" in text or not least <= value <= most:
        raise BadLine(f"{name} = {text[:40]!r}, expected a number from {least:g} to {most:g}")
    return value


def _time(values: Mapping[str, str]) -> int:
    if "time_utc_ns" in values:
        text = values["time_utc_ns"]
        # The length is checked first: Python refuses to convert thousands of digits.
        if not (text.isascii() and text.isdigit() and len(text) <= 19 and 0 < int(text) < _END_NS):
            raise BadLine(f"time_utc_ns = {text[:40]!r}, expected ns since 1970 UTC")
        return int(text)
    try:
        time = datetime.datetime.fromisoformat(values["time_utc"])
    except ValueError:
        raise BadLine(f"time_utc = {values['time_utc'][:40]!r}, expected such as 2026-03-02T10:00:00Z") from None
    if time.tzinfo is None:
        raise BadLine(f"time_utc = {values['time_utc'][:40]!r} has no zone, expected Z at its end")
    time_utc_ns = (time - _EPOCH) // datetime.timedelta(microseconds=1) * 1000
    if not 0 < time_utc_ns < _END_NS:
        raise BadLine(f"time_utc = {values['time_utc'][:40]!r}, expected a time after 1970, at most 2262-04-11")
    return time_utc_ns
