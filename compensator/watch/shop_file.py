"""A shop's recording after it was written: made compact, whole or torn, and checked before it takes its place."""

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
    """Rewrite a recording that nobody writes to with chunks, compression, CRCs and index.

    Every whole message of a torn file is kept. A kill at any time leaves one whole file under the name.

    Parameters
    ----------
    path : pathlib.Path
        A shop's recording; one that is compact or is being written is left alone.

    Returns
    -------
    str
        What became of it, in words; empty where there was nothing to do.

    Raises
    ------
    OSError
        If the disk does not take the copy; the file stays as it is.
    DataError
        If the file is damaged, or the copy does not read back as what was copied; it stays as it is.
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
                raise DataError(f"{part}: does not read back as what was written")
            part.replace(path)
        except McapError as error:
            raise DataError(f"{path}: {error}") from error
        finally:
            part.unlink(missing_ok=True)
    sync_folder(path.parent)
    return f"{count} messages, compact" + ("" if ended else "; it had no end, every whole message was kept")


def _copy(path: Path, file: BinaryIO) -> tuple[int, str, bool] | None:
    """Copy a recording; return number and hash of its messages and whether it had its end, None where it is compact."""
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
    """Return number and hash of the messages as the library's seeking reader finds them."""
    digest, count = hashlib.sha256(), 0
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            times = message.log_time.to_bytes(8, "little") + message.publish_time.to_bytes(8, "little")
            digest.update(channel.topic.encode() + message.sequence.to_bytes(4, "little") + times + message.data)
            count += 1
    return count, digest.hexdigest()
