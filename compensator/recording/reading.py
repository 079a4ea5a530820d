"""Reading recordings: every complete message of an MCAP file, finished or torn, in the order of the file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from compensator.errors import DataError, UsageError
from compensator.messages import MESSAGES, UNREADABLE, Chain, read_message
from compensator.messages_axes import ALL_MESSAGES, OFFSETS, AxesEstimate, names_axes, topic_of
from compensator.recording import chain
from compensator.recording.container import PAYLOAD, Container, Damaged
from compensator.recording.naming import is_name, order_of

#: Most bytes and records of a group: what one sample writes is a thousandth of that, a model that is adopted a tenth.
GROUP_BYTES, GROUP_RECORDS = 16_000_000, 10_000

_T = TypeVar("_T")
_DECODERS = {topic: msgspec.json.Decoder(kind) for topic, kind in ALL_MESSAGES.items()}
#: Of a machine of several axes, whose messages name them.
_DECODERS_OF_AXES: dict[str, msgspec.json.Decoder[Any]] = {
    "offset": msgspec.json.Decoder(OFFSETS["y"]),
    "estimate": msgspec.json.Decoder(AxesEstimate),
}


class RawRecord(NamedTuple):
    """One message of a recording.

    Parameters
    ----------
    topic : str
        In a machine's recording `sample`, `estimate`, `offset`, `event`, `seal` or `chain`.
    sequence : int
        Number of the record in the file.
    log_time_ns : int
        Time of writing.
    body : bytes
        Bytes covered by the hash chain; see `Message`.
    """

    topic: str
    sequence: int
    log_time_ns: int
    body: bytes

    @property
    def data(self) -> bytes:
        """JSON as it was written."""
        return self.body[PAYLOAD:]


class Group(NamedTuple):
    """Records that were written to disk together.

    Parameters
    ----------
    records : list of RawRecord
        Events, sample, estimate and offset of one sample, or a seal.
    chain : RawRecord or None
        The `/chain` message that lists them; None in a file without a hash chain.
    whole : bool
        Whether the group is complete; only the last group of a file may be incomplete.
    """

    records: list[RawRecord]
    chain: RawRecord | None
    whole: bool


def records_of(container: Container) -> Iterator[RawRecord]:
    """Yield the messages of a file with their topics.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    Damaged
        If it cannot be read any further.
    """
    topics: dict[int, str] = {}
    channels = container.contents.channels
    for channel, sequence, time_ns, body in container.messages():
        topic = topics.get(channel)
        if topic is None:
            topic = topics[channel] = channels[channel].topic.lstrip("/")
        yield RawRecord(topic, sequence, time_ns, body)


def groups_of(container: Container) -> Iterator[Group]:
    """Yield the records of a machine's recording group by group.

    A `/chain` message ends a group; in a file without such messages an offset does. Records of a group without its
    end come last.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    Damaged
        If it cannot be read any further; everything before that was yielded.
    """
    records: list[RawRecord] = []
    end, size = "", 0
    try:
        for record in records_of(container):
            topic = record.topic
            size = size + len(record.body) if records else len(record.body)
            if size > GROUP_BYTES or len(records) >= GROUP_RECORDS:
                raise Damaged(container.path, container.position, "a group of records that is too long")
            if not end:
                topics = {channel.topic for channel in container.contents.channels.values()}
                end = "chain" if "/chain" in topics else "offset"
            if topic == end == "chain":
                yield Group(records, record, True)
                records = []
                continue
            records.append(record)
            if topic == end:
                yield Group(records, None, True)
                records = []
    except Damaged:
        yield Group(records, None, False)
        raise
    yield Group(records, None, False)


def read_messages(path: Path, topics: tuple[str, ...] | None = None, *, prefix: str = "") -> Iterator[RawRecord]:
    """Yield the messages of a file in the order in which they were written.

    Parameters
    ----------
    path : pathlib.Path
        A recording, finished or not.
    topics : tuple of str, optional
        Only these.
    prefix : str
        Prefix of a machine in a shop's recording, such as `shop/vmc-07`; its messages get the topics of a machine's own
        recording.

    Raises
    ------
    DataError
        If it is not an MCAP file. A torn end ends the iteration without an error.
    """
    with Container(path) as container, suppress(Damaged):
        for record in records_of(container):
            topic = record.topic
            if prefix:
                machine, _, rest = topic.rpartition("/thermal/")
                axis, _, name = rest.rpartition("/")
                topic = (topic_of(axis) if axis and name == "offset" else rest) if machine == prefix else ""
            if topics is None or topic in topics:
                yield record._replace(topic=topic) if prefix else record


def messages(path: Path, topics: tuple[str, ...], *, prefix: str = "", since_ns: int = 0) -> Iterator[Any]:
    """Yield the decoded messages of a file in the order in which they were written.

    Parameters
    ----------
    path : pathlib.Path
        A recording, finished or not.
    topics : tuple of str
        Only these.
    prefix : str
        See `read_messages`.
    since_ns : int
        Only messages written at this time or later, ns since 1970 UTC.

    Raises
    ------
    DataError
        If it is not an MCAP file, or a message does not follow its schema.
    """
    # A file is modified after its last message.
    if since_ns and path.stat().st_mtime_ns < since_ns:
        return
    for record in read_messages(path, topics, prefix=prefix):
        if record.log_time_ns >= since_ns:
            yield decode(record, path)


def files_since(paths: Sequence[Path], from_ns: int) -> list[Path]:
    """Return the recordings that may contain something of the time since then, ns since 1970 UTC.

    What has the name of a recording and is none says nothing of when it begins.

    Parameters
    ----------
    paths : sequence of pathlib.Path
        In order.
    from_ns : int
        The time.
    """
    for i in range(len(paths) - 1, 0, -1):
        first = None
        with suppress(DataError):
            first = next(messages(paths[i], ("sample",)), None)
        if first is not None and first.time_utc_ns <= from_ns:
            return list(paths[i:])
    return list(paths)


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


def decode(record: RawRecord, file: Path | str) -> Any:
    """Decode a recorded message of any topic; `file` is for the error.

    Raises
    ------
    DataError
        If it does not follow its schema.
    """
    decoder = _DECODERS.get(record.topic)
    if record.topic in _DECODERS_OF_AXES and names_axes(record.data):
        decoder = _DECODERS_OF_AXES[record.topic]
    if decoder is None:
        raise DataError(f"{file}: unknown channel /{record.topic}, expected one of: {', '.join(MESSAGES)}")
    return decode_with(decoder, record, str(file))


def decode_with(decoder: msgspec.json.Decoder[_T], record: RawRecord, file: str) -> _T:
    """Decode a recorded message, or a part of one.

    Parameters
    ----------
    decoder : msgspec.json.Decoder
        Decoder of the expected type.
    record : RawRecord
        The message.
    file : str
        File name, for the error.

    Raises
    ------
    DataError
        If the message has another type or a number that no message holds; the error names file, topic and record.
    """
    try:
        return read_message(decoder, record.data)
    except UNREADABLE as error:
        raise DataError(f"{file}: /{record.topic} record {record.sequence}: {error}") from error


def recordings(folder: Path, machine: str) -> list[Path]:
    """Return a machine's recordings in the order in which they were started, by the names that a recorder gives."""
    found = _found(folder, f"{machine}_????????T??????Z*.mcap")
    return [path for path in found if is_name(path, machine)]


def recordings_in(given: Iterable[Path]) -> list[Path]:
    """Return the given recordings; a folder is replaced by the recordings in it.

    A folder without any that is named as a recording stands for itself among others, as `rec/*.mcap` may give it.

    Raises
    ------
    UsageError
        If there are none in a folder.
    """
    paths: list[Path] = []
    given = list(given)
    for path in given:
        inside = _found(path, "*.mcap") if path.is_dir() else [path]
        if not inside and path.suffix == ".mcap" and len(given) > 1:
            inside = [path]
        if not inside:
            raise UsageError(f"{path}: no recordings in it, expected FILE.mcap")
        paths += inside
    return paths


def _found(folder: Path, pattern: str) -> list[Path]:
    # A hidden file is what a copy over a network has left beside another one.
    found = [path for path in folder.glob(pattern) if not path.name.startswith(".")]
    return sorted(found, key=lambda path: order_of(path.stem))


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return recordings of one machine in the order of their start, each once.

    Raises
    ------
    DataError
        If a file is not an MCAP file, the files belong to several machines, or one is a copy of another.
    """
    began: dict[Path, str] = {}
    machines: set[str] = set()
    created: dict[tuple[str | None, str], Path] = {}
    for path in dict.fromkeys(paths):
        run = run_of(path)
        machines |= {run["machine"]} if "machine" in run else set()
        began[path] = run.get("file", path.name).removesuffix(".mcap")
        # A torn beginning says nothing of itself.
        other = created.setdefault((run.get("machine"), run["file"]), path) if "file" in run else path
        if other != path:
            raise DataError(f"{path}: a copy of {other}, expected each recording once")
    if len(machines) > 1:
        raise DataError(f"recordings of {', '.join(sorted(machines))}; expected those of one machine")
    return sorted(began, key=lambda path: order_of(began[path]))


def last_value(path: Path) -> bytes:
    """Return the value with which the chain of the next file starts; empty if a file has no chain.

    It is the value of the last complete record, not of a seal that was added later to finish a torn end, because the
    next file was started without it.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    before_seal = value = b""
    recovered = False
    for record, following in linked(path):
        before_seal, value = value, following
        recovered = record.topic == "seal" and b'"reason":"recovered"' in record.body
    return before_seal if recovered else value


def has_begun(path: Path) -> bool:
    """Return whether a file holds the beginning of a chain.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    return next(linked(path), None) is not None


def values_of(path: Path) -> set[bytes]:
    """Return all values of the chain of a file, as computed from its records; empty if it has no chain.

    A file that is not an MCAP file has none.
    """
    try:
        return {value for _, value in linked(path)}
    except DataError:
        return set()


def run_of(path: Path) -> dict[str, str]:
    """Return what a recording says of itself in its metadata.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    with Container(path) as container:
        return container.survey(whole=False).run


def linked(path: Path) -> Iterator[tuple[RawRecord, bytes]]:
    """Yield the first message of the chain and every record, each with the value of the chain that it makes.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    value = b""
    with Container(path) as container, suppress(Damaged, *UNREADABLE, ValueError):
        for record in records_of(container):
            if record.topic == "chain" and not value:
                first = msgspec.json.decode(record.data, type=Chain)
                value = chain.opening(bytes.fromhex(first.before), chain.parts_of(container.contents))
            elif record.topic == "chain":
                continue
            elif not value:
                break
            else:
                value = chain.link(value, record.topic, record.body)
            yield record, value
