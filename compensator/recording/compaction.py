"""Compaction: replaces a live file by a copy with chunks, compression, CRCs and an index.

A live file is written so that a kill loses nothing; therefore it is larger and has no index. Once it is finished, it is
copied message by message; the copy is read back with the library's seeking reader and compared, and only then replaces
the live file. A kill at any time leaves one complete file under the name.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import struct
import time
from collections.abc import Callable
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from mcap.writer import CompressionType, Writer

from compensator.atomic_write import sync_folder
from compensator.errors import DataError
from compensator.input_file import open_file
from compensator.recording import chain
from compensator.recording.container import (
    PAYLOAD,
    Attachment,
    Container,
    Contents,
    McapChannel,
    Message,
    Torn,
)
from compensator.recording.live_file import Opening

#: Number of messages after which a yielding copy lets other threads run, and for how long, s.
TURN, MOMENT_S = 64, 0.0005
_PART = ".mcap.part"


class Copy:
    """The copy while it is written, with a hash over its content.

    Parameters
    ----------
    contents : Contents
        Content of the recording read so far.
    writer : Writer
        Writer of the copy.
    """

    def __init__(self, contents: Contents, writer: Writer) -> None:
        self.contents, self._writer = contents, writer
        self._opening = Opening(writer)
        #: Topics by number of the channel, as far as read.
        self.topics = self._opening.topics
        self._digest = hashlib.sha256()
        #: Messages in the copy, and whether the original ends within a record.
        self.messages, self.torn = 0, False

    def add(self, message: Message) -> None:
        """Copy one message."""
        if message.channel not in self.topics:
            self._opening.write(self.contents)
        publish_ns = int.from_bytes(message.body[12:PAYLOAD], "little")
        self._writer.add_message(
            message.channel, message.log_time_ns, message.body[PAYLOAD:], publish_ns, sequence=message.sequence
        )
        self._digest.update(message.channel.to_bytes(2, "little") + message.body)
        self.messages += 1

    def finish(self) -> None:
        """Write the end."""
        self._opening.write(self.contents)
        self._writer.finish()  # type: ignore[no-untyped-call]

    def digest(self) -> str:
        """Return the hash over everything in the copy."""
        return _with_parts(self._digest, self.contents)


def rewrite(
    path: Path,
    copy_of: Callable[[Contents, Writer], Copy] = Copy,
    *,
    yielding: bool = False,
    chained: bool = False,
) -> Copy | None:
    """Replace a finished or abandoned live recording by a compact copy.

    Every complete message of a torn file is kept.

    Parameters
    ----------
    path : pathlib.Path
        A recording.
    copy_of : callable
        Makes the copy.
    yielding : bool
        Whether to yield to other threads.
    chained : bool
        Whether to skip files without a hash chain.

    Returns
    -------
    Copy or None
        The copy; None if the file is already compact, is being written or was skipped.

    Raises
    ------
    OSError
        If the copy cannot be written; the file is not changed.
    DataError
        If the file is damaged, or the copy differs from it when read back; the file is not changed.
    """
    part = path.with_name(path.name.removesuffix(".mcap") + _PART)
    part.unlink(missing_ok=True)
    with open_file(path) as live:  # a pipe with such a name would never have an end
        try:
            fcntl.flock(live, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return None
        if not _is_live(path, chained):
            return None
        try:
            with part.open("xb") as file:
                copy = _copied(
                    path, Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True), copy_of, yielding
                )
                file.flush()
                os.fsync(file.fileno())
            if _digest(part, yielding) != copy.digest():
                raise DataError(f"{part}: the copy differs from the original when read back")
            part.replace(path)
        except (McapError, ValueError, struct.error) as error:  # a number, hash or text that no recorder writes
            raise DataError(f"{path}: not as a recorder writes it: {error}") from error
        finally:
            part.unlink(missing_ok=True)
    sync_folder(path.parent)
    return copy


def _is_live(path: Path, chained: bool) -> bool:
    """Return whether a file is not compact yet; with `chained`, only if it starts with a hash chain."""
    with Container(path) as container:
        try:
            for message in container.messages():
                topic = container.contents.channels[message.channel].topic
                return not container.contents.chunked and (not chained or topic == "/chain")
        except Torn:
            pass
        return not chained and not container.contents.chunked


def _copied(path: Path, writer: Writer, copy_of: Callable[[Contents, Writer], Copy], yielding: bool) -> Copy:
    with Container(path) as container:
        copy = copy_of(container.contents, writer)
        try:
            for number, message in enumerate(container.messages()):
                copy.add(message)
                if yielding and number % TURN == 0:
                    time.sleep(MOMENT_S)
        except Torn as torn:
            # Nothing can be read after a torn end; a damaged file is refused, so that an audit finds it unchanged.
            copy.torn = torn.offset < path.stat().st_size
        copy.finish()
    return copy


def _digest(path: Path, yielding: bool) -> str:
    """Read a compact file with the library's seeking reader; return the hash of everything in it."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for number, (_, _, message) in enumerate(reader.iter_messages(log_time_order=False)):
            head = chain.body_of(message.sequence, message.log_time, b"")[:12]
            body = head + message.publish_time.to_bytes(8, "little") + message.data
            digest.update(message.channel_id.to_bytes(2, "little") + body)
            if yielding and number % TURN == 0:
                time.sleep(MOMENT_S)
        return _with_parts(digest, _contents_of(path, reader))


def _contents_of(path: Path, reader: McapReader) -> Contents:
    """Return attachments, metadata and channels by means of the index."""
    summary = reader.get_summary()
    if (
        summary is None
        or summary.statistics is None
        or (summary.statistics.message_count and not summary.chunk_indexes)
    ):
        raise DataError(f"{path}: has no index")
    contents = Contents(metadata={one.name: one.metadata for one in reader.iter_metadata()})
    for one in reader.iter_attachments():
        part = Attachment(one.name, one.media_type, one.log_time, one.create_time, one.data)
        contents.attachments[one.name] = part
    for number, channel in summary.channels.items():
        schema = summary.schemas.get(channel.schema_id)
        described = (schema.name, schema.encoding, schema.data) if schema is not None else ("", "", b"")
        contents.channels[number] = McapChannel(channel.topic, channel.message_encoding, channel.metadata, *described)
    return contents


def _with_parts(digest: hashlib._Hash, contents: Contents) -> str:
    """Return a hash with that of attachments, metadata and channels added."""
    whole = digest.copy()
    for part in sorted(chain.parts_of(contents), key=lambda part: part.name):
        whole.update(f"{part.name} {part.sha256}\n".encode())
    return whole.hexdigest()
