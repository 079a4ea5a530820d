"""Reading recordings: every whole message of an MCAP file, finished or torn, in the order of the file."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

from compensator.errors import DataError
from compensator.messages import MESSAGES, Offset, Sample

_EPOCH_2020_NS = 1_577_836_800 * 1_000_000_000

#: What the reader raises on a torn or damaged file.
TORN = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError, MemoryError)


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording.

    Parameters
    ----------
    topic : str
        `sample`, `estimate`, `offset` or `event`.
    data : bytes
        JSON as it was written.
    sequence : int
        Sequence number of the record in the file.
    log_time_ns : int
        When it was written.
    """

    topic: str
    data: bytes
    sequence: int
    log_time_ns: int


def read_messages(path: Path, topics: tuple[str, ...] | None = None) -> Iterator[Recorded]:
    """Yield the messages of a file in the order in which they were written.

    Parameters
    ----------
    path : pathlib.Path
        An MCAP file of ours, finished or not.
    topics : tuple of str, optional
        Only these.

    Raises
    ------
    DataError
        If it is not an MCAP file. A torn end ends the iteration without an error.
    """
    try:
        with path.open("rb") as file:
            if file.read(5) != b"\x89MCAP":
                raise DataError(f"{path}: not an MCAP file")
            file.seek(0)
            reader = NonSeekingReader(file)
            wanted = [f"/{topic}" for topic in topics] if topics else None
            try:
                for _, channel, message in reader.iter_messages(topics=wanted, log_time_order=False):
                    yield Recorded(channel.topic.lstrip("/"), message.data, message.sequence, message.log_time)
            except TORN:
                return
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}; expected a recording") from error


def decode(record: Recorded, path: Path) -> msgspec.Struct:
    """Decode a recorded message.

    Raises
    ------
    DataError
        If it does not follow its schema.
    """
    kind = MESSAGES.get(record.topic)
    if kind is None:
        raise DataError(f"{path}: unknown channel /{record.topic}, expected one of: {', '.join(MESSAGES)}")
    try:
        return msgspec.json.decode(record.data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: /{record.topic} record {record.sequence}: {error}") from error


def recordings(folder: Path, machine: str) -> list[Path]:
    """Return a machine's recordings in the order in which they were started."""
    # By stem: the second file of a second, "…Z-001.mcap", would sort before the first, "…Z.mcap".
    return sorted(folder.glob(f"{machine}_????????T??????Z*.mcap"), key=lambda path: path.stem)


def first_sequence(folder: Path, machine: str, utc_ns: int, period_s: float) -> int:
    """Return a sequence number that the machine has never published.

    Numbers go on after the last one on disk. A recording may have been removed, or a disk may not have taken the
    last ones, so the number is also at least that of the periods since 2020: a service cannot have published
    more samples than there were periods.

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
    """
    periods = int((utc_ns - _EPOCH_2020_NS) / 1e9 // period_s)
    return max(last_sequence(folder, machine) + 1, periods, 0)


def last_sequence(folder: Path, machine: str) -> int:
    """Return the highest sequence number that was ever published, −1 where there is none."""
    for path in reversed(recordings(folder, machine)):
        highest = -1
        for record in read_messages(path, ("sample", "offset")):
            message = decode(record, path)
            if isinstance(message, (Sample, Offset)):
                highest = max(highest, message.seq)
        if highest >= 0:
            return highest
    return -1
