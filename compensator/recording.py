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
    return sorted(folder.glob(f"{machine}_????????T??????Z*.mcap"))


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
