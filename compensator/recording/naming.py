"""Names of recordings: machine (or `shop`) and UTC time of creation, such as `vmc-07_20260105T060000Z.mcap`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from compensator.clock import NS

_STAMP = "%Y%m%dT%H%M%SZ"
#: Number of a file within its second. A name may also come from a recording's metadata, with thousands of digits.
_NUMBER = re.compile(r"[0-9]{1,9}")
_NAME = re.compile(r"(?P<of>.+)_[0-9]{8}T[0-9]{6}Z(-[0-9]{3,4})?\.mcap")


def day_of(time_utc_ns: int) -> str:
    """Return the UTC day of a time; a file contains one day, or a part of it.

    Examples
    --------
    >>> day_of(1_767_600_000 * NS)
    '20260105'
    """
    return _utc(time_utc_ns).strftime("%Y%m%d")


def names(folder: Path, of: str, time_utc_ns: int, newest: Path | None = None) -> Iterator[Path]:
    """Yield names for a new file.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the recordings.
    of : str
        Name of the machine; `shop` for a shop's recording.
    time_utc_ns : int
        Now, ns since 1970 UTC.
    newest : pathlib.Path, optional
        Recording that the names must follow in order, even if the clock was set back since it was opened.
    """
    stamp, number = _utc(time_utc_ns).strftime(_STAMP), 0
    if newest is not None:
        last, _, suffix = newest.stem.removeprefix(f"{of}_").partition("-")
        if last >= stamp:
            stamp, number = last, int(suffix or 0) + 1
    for count in range(number, number + 1000):
        ending = f"-{count:03d}" if count else ""
        yield folder / f"{of}_{stamp}{ending}.mcap"


def order_of(stem: str) -> tuple[str, int]:
    """Return what names are sorted by: the time, and then the number of files of one second.

    Examples
    --------
    >>> sorted(("m-7_20260105T060000Z-1000", "m-7_20260105T060000Z-999", "m-7_20260105T060000Z"), key=order_of)
    ['m-7_20260105T060000Z', 'm-7_20260105T060000Z-999', 'm-7_20260105T060000Z-1000']
    """
    stamp, dash, number = stem.rpartition("-")
    return (stamp, int(number)) if dash and _NUMBER.fullmatch(number) else (stem, 0)


def is_name(path: Path, of: str) -> bool:
    """Return whether a file has a name that this module gives.

    Examples
    --------
    >>> [is_name(Path(f"m_{rest}.mcap"), "m") for rest in ("20260105T060000Z", "20260105T060000Z-002")]
    [True, True]
    >>> [is_name(Path(f"m_{rest}.mcap"), "m") for rest in ("20260105T060000Z-copy", "00000000T000000Z")]
    [False, False]
    """
    if named_of(path.name) != of:
        return False
    try:
        began_ns(path, of)
    except ValueError:
        return False
    return True


def named_of(name: str) -> str:
    """Return the machine, or `shop`, in the name of a recording; empty for another name.

    Examples
    --------
    >>> named_of("vmc_07_20260105T060000Z-002.mcap"), named_of("copy.mcap")
    ('vmc_07', '')
    """
    found = _NAME.fullmatch(name)
    return found["of"] if found is not None else ""


def began_ns(path: Path, of: str) -> int:
    """Return the time in a recording's name, ns since 1970 UTC."""
    stamp = path.name[len(of) + 1 :][:16]
    return int(datetime.strptime(stamp, _STAMP).replace(tzinfo=UTC).timestamp()) * NS


def _utc(time_ns: int) -> datetime:
    return datetime.fromtimestamp(time_ns / NS, UTC)
