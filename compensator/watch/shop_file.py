"""Compacts a shop's finished recording, complete or torn, and verifies the copy before it replaces the original."""

from __future__ import annotations

import fcntl
import hashlib
import os
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from compensator import __version__
from compensator.errors import DataError
from compensator.recording.container import PAYLOAD, Container, Contents, Damaged, Torn
from compensator.recording.live_file import sync_folder


def compact(path: Path) -> str:
    """Rewrite a finished recording with chunks, compression, CRCs and index.

    Every complete message of a torn file is kept. A kill at any time leaves a complete file under the name.

    Parameters
    ----------
    path : pathlib.Path
        A shop's recording; one that is compact or still being written is left unchanged.

    Returns
    -------
    str
        The outcome in words; empty if nothing was done.

    Raises
    ------
    OSError
        If the copy cannot be written; the file stays as it is.
    DataError
        If the file is damaged, or the copy differs from it; it stays as it is.
    """
    part = path.with_name(path.name.removesuffix(".mcap") + ".mcap.part")
    with path.open("rb") as live:
        try:
            fcntl.flock(live, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return ""
        try:
            with part.open("wb") as file:
                copied = _copy(path, file)
                file.flush()
                os.fsync(file.fileno())
            if copied is None:
                return ""
            count, digest, ended = copied
            if _read_back(part) != (count, digest):
                raise DataError(f"{part}: differs from the original when read back")
            part.replace(path)
        except McapError as error:
            raise DataError(f"{path}: {error}") from error
        finally:
            part.unlink(missing_ok=True)
    sync_folder(path.parent)
    return f"{count} messages, compact" + ("" if ended else "; it had no end, every complete message was kept")


def _copy(path: Path, file: BinaryIO) -> tuple[int, str, bool] | None:
    """Copy a recording; return number and hash of its messages and whether it had an end, None if it is compact."""
    writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile="", library=f"compensator {__version__}")
    numbers: dict[int, int] = {}
    schemas: dict[tuple[str, str, bytes], int] = {}
    digest, count = hashlib.sha256(), 0
    with Container(path) as container:
        contents = container.contents
        try:
            for message in container.messages():
                if contents.chunked:
                    return None
                if message.channel not in numbers:
                    numbers[message.channel] = _register(writer, contents, message.channel, schemas)
                publish_ns = int.from_bytes(message.body[12:PAYLOAD], "little")
                payload = message.body[PAYLOAD:]
                channel = numbers[message.channel]
                writer.add_message(channel, message.log_time_ns, payload, publish_ns, sequence=message.sequence)
                digest.update(contents.channels[message.channel].topic.encode() + message.body)
                count += 1
        except Torn:
            pass
        except Damaged as error:
            raise DataError(str(error)) from error
        for name, table in contents.metadata.items():
            writer.add_metadata(name, table)
    writer.finish()  # type: ignore[no-untyped-call]
    return count, digest.hexdigest(), contents.ended


def _register(writer: Writer, contents: Contents, number: int, schemas: dict[tuple[str, str, bytes], int]) -> int:
    channel = contents.channels[number]
    schema = 0
    if channel.schema_name:
        wanted = (channel.schema_name, channel.schema_encoding, channel.schema)
        if wanted not in schemas:
            schemas[wanted] = writer.register_schema(*wanted)
        schema = schemas[wanted]
    return writer.register_channel(channel.topic, channel.encoding, schema, channel.metadata)


def _read_back(path: Path) -> tuple[int, str]:
    """Return number and hash of the messages, read by the library's own reader."""
    digest, count = hashlib.sha256(), 0
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            times = message.log_time.to_bytes(8, "little") + message.publish_time.to_bytes(8, "little")
            digest.update(channel.topic.encode() + message.sequence.to_bytes(4, "little") + times + message.data)
            count += 1
    return count, digest.hexdigest()
