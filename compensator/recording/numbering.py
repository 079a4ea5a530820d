"""The number of the next sample: after the last one on disk, as far as this service has written what is there.

Whoever can write the folder must not decide about it. A number that receivers accept no longer, or from which too few
are left, would silence the machine for good: receivers drop every lower one as repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from compensator.errors import DataError
from compensator.messages import SEQ_MAX
from compensator.recording.head import HeadKeeper
from compensator.recording.reading import decode, linked, messages, recordings, run_of

_EPOCH_2020_NS = 1_577_836_800 * 1_000_000_000
_NUMBERED = ("sample", "offset")
#: Most samples a second that a model permits, twice: the clock may have been ahead.
_PER_S = 20
#: For a clock that was never set: time since 2020 after which a number counts as possible, s.
_LEAST_S = 10 * 365 * 86_400


def first_sequence(
    folder: Path,
    machine: str,
    utc_ns: int,
    period_s: float,
    *,
    keeper: HeadKeeper | None = None,
    remark: Callable[[str, str], None] = lambda file, text: None,
) -> int:
    """Return a sequence number that the machine has never published.

    Numbers continue after the last one on disk. Because a recording may have been removed, or the disk may not have
    accepted the last samples, the number is also at least the number of periods since 2020: a service cannot have
    published more samples than that.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the recordings.
    machine : str
        Name of the machine.
    utc_ns : int
        Now, ns since 1970 UTC.
    period_s : float
        Length of a sample, s.
    keeper : HeadKeeper, optional
        The head: what is in its chain counts, and of the rest what can have been published since it was written, by
        the time that has passed or by the number of samples.
    remark : callable
        Called with file and text where a number cannot be one that was published.
    """
    since_s = (utc_ns - _EPOCH_2020_NS) / 1e9
    most = min(int(_PER_S * max(since_s, _LEAST_S)), SEQ_MAX // 2)
    last = last_sequence(folder, machine, most=most, keeper=keeper, remark=remark)
    if keeper is not None and keeper.ends:
        # A service whose head could not be written goes on. It cannot have published more samples than periods have
        # passed or, where the clock was set back, than are on disk. Whoever writes the folder gains nothing: a number
        # more costs a sample, and `most` stays.
        passed = max(utc_ns - keeper.time_utc_ns, 0) / 1e9 // period_s
        behind = _behind(folder, machine, last)
        most = min(most, last + max(int(passed), len(behind)) + 2)
        last = max((number for number in behind if number <= most), default=last)
    return max(last + 1, int(since_s // period_s), 0)


def last_sequence(
    folder: Path,
    machine: str,
    *,
    most: int = SEQ_MAX,
    keeper: HeadKeeper | None = None,
    remark: Callable[[str, str], None] = lambda file, text: None,
) -> int:
    """Return the highest number of a sample on disk that was written so; −1 if there is none.

    A file that cannot be read does not keep a service from starting: `first_sequence` does not depend on it.

    Parameters
    ----------
    folder, machine, keeper, remark
        As for `first_sequence`.
    most : int
        Numbers above it are not used.
    """
    for numbers in _by_head(folder, keeper) if keeper is not None and keeper.ends else _by_name(folder, machine):
        possible = [number for number in numbers.found if number <= most]
        if len(possible) < len(numbers.found):
            text = f"sample number {max(numbers.found)} is not used, a machine has at most {most} by now"
            remark(numbers.file, text)
        if possible:
            return max(possible)
    return -1


class _Numbers(NamedTuple):
    """Numbers of the samples in a file."""

    file: str
    found: set[int]


def _by_name(folder: Path, machine: str) -> Iterator[_Numbers]:
    """Yield what the recordings hold, the newest first."""
    for path in reversed(recordings(folder, machine)):
        found: set[int] = set()
        with suppress(DataError):
            for message in messages(path, _NUMBERED):
                found.add(message.seq)
        yield _Numbers(path.name, found)


def _behind(folder: Path, machine: str, last: int) -> set[int]:
    """Return the numbers above the last one in the newest recordings."""
    behind: set[int] = set()
    for numbers in _by_name(folder, machine):
        behind |= {number for number in numbers.found if number > last}
        if min(numbers.found, default=last + 1) <= last:
            break
    return behind


def _by_head(folder: Path, keeper: HeadKeeper) -> Iterator[_Numbers]:
    """Yield what is in the chain of the head, the newest recording first."""
    for end in reversed(keeper.ends):
        file, values = end.file, frozenset(map(bytes.fromhex, end.accepted))
        while file and (found := _as_written(folder / file, values)) is not None:
            yield _Numbers(file, found)
            run = run_of(folder / file)
            file, values = run.get("previous_file", ""), frozenset({bytes.fromhex(run.get("previous_chain", ""))})


def _as_written(path: Path, values: frozenset[bytes]) -> set[int] | None:
    """Return the numbers up to the last of these values of the chain; None if it has none of them."""
    known: set[int] | None = None
    found: set[int] = set()
    with suppress(DataError):
        for record, value in linked(path):
            if record.topic in _NUMBERED:
                found.add(decode(record, path).seq)
            if value in values:
                known = set() if known is None else known
                known |= found
                found.clear()
    return known
