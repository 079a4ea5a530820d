"""MCAP files that are being written: synced data survives a kill and a power cut."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from mcap.writer import CompressionType, Writer

from compensator import __version__
from compensator.errors import DataError
from compensator.messages import encode, shipped_schema
from compensator.messages_axes import ALL_MESSAGES, message_of
from compensator.recording import chain
from compensator.recording.container import LARGEST, Attachment, Contents, McapChannel
from compensator.recording.signature import Signer

#: Size of a file, bytes, from which a recorder goes on in a new one, so that every file is read whole, compact or not.
FULL = LARGEST // 4
#: Topics of a recording; `chain` and `seal` come from the recorder itself.
TOPICS = ("sample", "estimate", "offset", "event", "seal", "chain")


def topics_of(*, probes: bool, loop: bool, axes: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the topics of a machine's recording: with probes, with another model in shadow, of several axes."""
    wanted = {"probe": probes, "candidate": loop, "offsets": bool(axes)}
    return (*TOPICS, *(topic for topic, is_wanted in wanted.items() if is_wanted))


@dataclass(slots=True)
class _Sink:
    """Buffer of the MCAP writer since the last sync, written to the file at once."""

    data: bytearray = field(default_factory=bytearray)
    size: int = 0

    def write(self, data: bytes) -> None:
        self.data += data
        self.size += len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        return


class LiveFile:
    """An MCAP file that is being written.

    It has no chunks, so a message is in the file as soon as it is synced; a CRC over the data covers a finished one.

    Parameters
    ----------
    paths : iterable of pathlib.Path
        Names to try; the first free one is used.

    Raises
    ------
    OSError
        If the disk refuses it, or no name is free.
    """

    def __init__(self, paths: Iterable[Path]) -> None:
        self.path, self._descriptor = _create(paths)
        self._sink = _Sink()
        self.writer = Writer(self._sink, use_chunking=False, compression=CompressionType.NONE, enable_data_crcs=True)  # type: ignore[arg-type]
        #: Bytes that are on disk.
        self.synced = 0

    @property
    def is_full(self) -> bool:
        """Whether the next messages belong in a new file; never between two syncs, which write one file."""
        return self.synced == self._sink.size >= FULL

    def sync(self) -> None:
        """Write everything to disk."""
        self.writer.flush()  # type: ignore[no-untyped-call]
        view = memoryview(bytes(self._sink.data))
        while view:
            view = view[os.write(self._descriptor, view) :]
        self._sink.data.clear()
        os.fsync(self._descriptor)
        self.synced = self._sink.size

    def finish(self) -> None:
        """Write the end, close the file and release its lock."""
        self.writer.finish()  # type: ignore[no-untyped-call]
        self.sync()
        os.close(self._descriptor)

    def give_up(self) -> bool:
        """Truncate the file to its last sync and close it; return whether that succeeded."""
        cut = True
        try:
            os.ftruncate(self._descriptor, self.synced)
        except OSError:
            cut = False
        with suppress(OSError):
            os.close(self._descriptor)
        if not self.synced:
            with suppress(OSError):
                self.path.unlink()
                cut = True
        return cut


class Opening:
    """Writes the start of a file: channels with their numbers, metadata, attachments.

    Parameters
    ----------
    writer : Writer
        Writer of the file.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._begun = False
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        #: Topics that were written, without the slash, by number of the channel.
        self.topics: dict[int, str] = {}

    def write(self, contents: Contents) -> None:
        """Write the parts that were not yet written; after the first call only further channels.

        Raises
        ------
        DataError
            If a channel does not have the number that it gets here.
        """
        writer = self._writer
        if not self._begun:
            writer.start(profile="", library=contents.library or f"compensator {__version__}")
        for number, channel in contents.channels.items():
            if number in self.topics:
                continue
            schema = (channel.schema_name, channel.schema_encoding, channel.schema)
            if channel.schema_name and schema not in self._schemas:
                self._schemas[schema] = writer.register_schema(*schema)
            schema_number = self._schemas.get(schema, 0)
            if number != writer.register_channel(channel.topic, channel.encoding, schema_number, channel.metadata):
                raise DataError(f"channel {number} {channel.topic}: expected the channel numbers of the recorder")
            self.topics[number] = channel.topic.lstrip("/")
        if self._begun:
            return
        self._begun = True
        for name, table in contents.metadata.items():
            writer.add_metadata(name, table)
        for part in contents.attachments.values():
            writer.add_attachment(part.create_time_ns, part.log_time_ns, part.name, part.media_type, part.data)


class RecordingFile(LiveFile):
    """A live recording with its hash chain.

    Parameters
    ----------
    paths : iterable of pathlib.Path
        Names to try; the first free one is used.
    machine : str
        Name of the machine.
    before : bytes
        Last value of the chain in the previous recording.
    time_ns : int
        Now, ns since 1970 UTC.
    topics : sequence of str
        Its topics.
    axes : sequence of str
        Axes of the machine; empty where it has Y alone.
    """

    def __init__(
        self,
        paths: Iterable[Path],
        machine: str,
        before: bytes,
        time_ns: int,
        topics: Sequence[str] = TOPICS,
        axes: Sequence[str] = (),
    ) -> None:
        super().__init__(paths)
        self._topics, self._axes = topics, axes
        self.time_ns = self.sealed_ns = time_ns
        self._machine = machine
        self._channels: dict[str, int] = {}
        self._sequence = 0
        self._chain = chain.ChainWriter(machine, before)
        #: Value of the chain on disk, empty before the first sync, and the values that the next sync adds.
        self.synced_value, self.pending = b"", list[bytes]()

    @property
    def head(self) -> bytes:
        """Value of the chain at the last record."""
        return self._chain.head

    def begin(self, metadata: dict[str, str], attachments: list[Attachment]) -> None:
        """Write the start of the file."""
        contents = Contents(metadata={"run": metadata}, attachments={part.name: part for part in attachments})
        for number, topic in enumerate(self._topics, 1):
            name = message_of(topic, self._axes)
            about, kind, schema = {"machine": self._machine}, ALL_MESSAGES[name].__name__, shipped_schema(name)
            contents.channels[number] = McapChannel(f"/{topic}", "json", about, kind, "jsonschema", schema)
        opening = Opening(self.writer)
        opening.write(contents)
        self._channels = {topic: number for number, topic in opening.topics.items()}
        self._write("chain", self._chain.begin(chain.parts_of(contents), self.time_ns))
        self.pending.append(self._chain.head)

    def sync(self) -> None:
        """Write everything to disk."""
        super().sync()
        self.synced_value = self.pending[-1] if self.pending else self.synced_value
        self.pending.clear()

    def append(self, records: Iterable[tuple[str, bytes]], time_ns: int) -> None:
        """Write a group of records and the values of the chain."""
        self.time_ns = time_ns
        for topic, data in records:
            self._chain.add(topic, chain.body_of(self._sequence, time_ns, data))
            self.pending.append(self._chain.head)
            self._write(topic, data)
        self._write("chain", self._chain.message(time_ns))

    def seal(self, reason: str, time_ns: int, signer: Signer | None) -> None:
        """Write a seal, signed if there is a key."""
        message = chain.seal(self._machine, time_ns, reason, self._sequence - 1, self.head)
        if signer is not None:
            message = signer.sign(message)
        self.sealed_ns = time_ns
        self.append([("seal", encode(message))], time_ns)

    def _write(self, topic: str, data: bytes) -> None:
        self.writer.add_message(self._channels[topic], self.time_ns, data, self.time_ns, sequence=self._sequence)
        self._sequence += 1


def _create(paths: Iterable[Path]) -> tuple[Path, int]:
    path = None
    for path in paths:
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except FileExistsError:
            continue
        # Locked until the file is finished, so that it is not treated as abandoned.
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return path, descriptor
    raise OSError(f"{path}: this name and all names before it are in use")
