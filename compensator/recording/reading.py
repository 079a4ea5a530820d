"""Reading recordings: every whole message of an MCAP file, finished or torn, in the order of the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from compensator.errors import DataError
from compensator.messages import MESSAGES, Chain, Offset, Sample, Seal
from compensator.recording import chain
from compensator.recording.container import PAYLOAD, Container, Damaged

_EPOCH_2020_NS = 1_577_836_800 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording.

    Parameters
    ----------
    topic : str
        `sample`, `estimate`, `offset`, `event`, `seal` or `chain`.
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


def read_messages(path: Path, topics: tuple[str, ...] | None = None, *, prefix: str = "") -> Iterator[Recorded]:
    """Yield the messages of a file in the order in which they were written.

    Parameters
    ----------
    path : pathlib.Path
        An MCAP file of ours, finished or not.
    topics : tuple of str, optional
        Only these.
    prefix : str
        Of a shop's recording: the machine's, such as `shop/vmc-07`; its messages come by the topics of its own.

    Raises
    ------
    DataError
        If it is not an MCAP file. A torn end ends the iteration without an error.
    """
    with Container(path) as container:
        channels = container.contents.channels
        try:
            for number, sequence, log_time_ns, body in container.messages():
                topic = channels[number].topic.lstrip("/")
                if prefix:
                    machine, _, rest = topic.rpartition("/thermal/")
                    topic = rest.removeprefix("y/") if machine == prefix else ""
                if topics is None or topic in topics:
                    yield Recorded(topic, body[PAYLOAD:], sequence, log_time_ns)
        except Damaged:
            return


def machines_in(path: Path) -> list[str]:
    """Return the prefixes of the machines in a shop's recording; none in a recording of one machine.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    with Container(path) as container:
        topics = [channel.topic.strip("/") for channel in container.survey(whole=True).channels.values()]
    known = {topic.rpartition("/thermal/")[0] for topic in topics if not topic.startswith("other/")}
    return sorted(known - {""})


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


@dataclass(frozen=True, slots=True)
class ChainEnd:
    """Where the hash chain of a file ends.

    Parameters
    ----------
    value : bytes
        Value at its last whole record; the chain of the next file begins with it. A seal that was set afterwards,
        when a torn end was finished, does not count: the next file was begun without it.
    unlisted : int
        Number of whole records behind the last `/chain` message.
    sealed : str
        Reason of the seal that it ends with, empty where it ends without one.
    whole : bool
        Whether the file has its end.
    chunked : bool
        Whether it is compact.
    """

    value: bytes
    unlisted: int
    sealed: str
    whole: bool
    chunked: bool


def end_of_chain(path: Path) -> ChainEnd | None:
    """Follow the hash chain of a file to its end; None where it has none.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    value, before_seal, unlisted, sealed = b"", b"", 0, ""
    with Container(path) as container:
        channels = container.contents.channels
        try:
            for number, _, _, body in container.messages():
                topic = channels[number].topic.lstrip("/")
                if topic == "chain":
                    if not value:
                        first = msgspec.json.decode(body[PAYLOAD:], type=Chain)
                        value = chain.opening(bytes.fromhex(first.before), chain.parts_of(container.contents))
                    unlisted = 0
                    continue
                if not value:
                    return None
                before_seal, value = value, chain.link(value, topic, body)
                unlisted += 1
                sealed = msgspec.json.decode(body[PAYLOAD:], type=Seal).reason if topic == "seal" else ""
        except (Damaged, msgspec.MsgspecError, ValueError):
            pass
    if not value:
        return None
    contents = container.contents
    return ChainEnd(before_seal if sealed == "recovered" else value, unlisted, sealed, contents.ended, contents.chunked)


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
