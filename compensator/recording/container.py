"""Reads an MCAP file sequentially: live or finished, chunked or not, complete, torn or damaged.

The `mcap` library writes the recordings, and checks them when they are finished. An audit of a year reads millions of
records, must trust none of them and must distinguish a torn end from damage. This module therefore reads the framing
itself: one record after the other, without the index, with lengths checked before memory is allocated.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar

import zstandard

from compensator.errors import DataError
from compensator.input_file import open_file
from compensator.recording.framing import (
    ATTACHMENT,
    ATTACHMENT_INDEX,
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    SUMMARY_OFFSET,
    Damaged,
    Fields,
    Torn,
)
from compensator.recording.index import Index

__all__ = [
    "LONGEST",
    "MAGIC",
    "PAYLOAD",
    "Attachment",
    "Container",
    "Contents",
    "Damaged",
    "Flaw",
    "McapChannel",
    "Message",
    "Torn",
]

MAGIC = b"\x89MCAP0\r\n"
#: Longest record and chunk that is accepted, bytes; those of the recorder are below 2 MiB.
LONGEST = 64 * 2**20
#: Most bytes of a file that are read, those in chunks counted uncompressed, too: zeros take no space on a disk, but
#: time to read. A recorder goes on in a new file at a quarter of that (`live_file.py`).
LARGEST = 2**30
#: Zeros at the end of a file that a power cut may have left: more than a record ends with; at most more than is written
#: at once.
_LEAST_ZEROS, _MOST_ZEROS = 64, 2**24
_WINDOW = 2**20
_LONGEST_HEADER = 4096
#: Number of notes on bytes without content, and of flaws, that are kept.
_MOST_NOTES, _MOST_FLAWS = 20, 200

_T = TypeVar("_T")

_FRAME = struct.Struct("<BQ")
_HEAD = struct.Struct("<BQHIQQ")
_SHORTEST = {FOOTER: 20, MESSAGE: 22, CHUNK: 40, DATA_END: 4, STATISTICS: 46}


class Message(NamedTuple):
    """One message as in the file.

    Parameters
    ----------
    channel : int
        Number of its channel.
    sequence : int
        Number of the record.
    log_time_ns : int
        Time of writing.
    body : bytes
        Sequence, log time, publish time (4 + 8 + 8 bytes, little-endian) and payload.
    """

    channel: int
    sequence: int
    log_time_ns: int
    body: bytes


#: Where the payload begins in the body of a message.
PAYLOAD = 20


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file attached to the recording."""

    name: str
    media_type: str
    log_time_ns: int
    create_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class McapChannel:
    """A channel with its schema."""

    topic: str
    encoding: str
    metadata: dict[str, str]
    schema_name: str
    schema_encoding: str
    schema: bytes


class Flaw(StrEnum):
    """Fault of an attachment, a metadata table, a schema or a channel, as text."""

    WRONG_CRC = "its CRC is wrong"
    TWICE = "occurs twice"
    NOT_FIRST = "is not at the start of the file"
    LATE = "follows messages"


@dataclass(slots=True)
class Contents:
    """Content of the file other than messages, as far as read.

    Parameters
    ----------
    library : str
        Program that wrote the file.
    metadata : dict of str to dict
        By name.
    attachments : dict of str to Attachment
        By name.
    channels : dict of int to McapChannel
        By number.
    flaws : list of (str, Flaw)
        Attachments, metadata, schemas and channels with a flaw.
    chunked, ended : bool
        Whether the file has chunks, and whether it has its end.
    messages : int
        Number of messages.
    outside : list of str
        Bytes without content that differ from what the recorder writes, as text.
    """

    library: str = ""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, Attachment] = field(default_factory=dict)
    channels: dict[int, McapChannel] = field(default_factory=dict)
    flaws: list[tuple[str, Flaw]] = field(default_factory=list)
    chunked: bool = False
    ended: bool = False
    messages: int = 0
    outside: list[str] = field(default_factory=list)

    @property
    def run(self) -> dict[str, str]:
        """Metadata that the recorder of a machine writes; empty in other files."""
        return self.metadata.get("run", {})


class Container:
    """One MCAP file, read once.

    Parameters
    ----------
    path : pathlib.Path
        The file.

    Raises
    ------
    DataError
        If it cannot be opened or is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.contents = Contents()
        #: Compares the index with the records that were read.
        self.index = Index()
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        #: Schemas that a channel has.
        self._used: set[int] = set()
        try:
            self._file: BinaryIO = open_file(path)
            self._size = self._written(self._file.seek(0, 2))
            self._file.seek(0)
        except OSError as error:
            raise DataError(f"{path}: {error.strerror or error}; expected a recording") from error
        self._buffer = b""
        #: Place of the buffer in the file, and place in the buffer.
        self._base = self._at = 0
        self._crc = 0
        #: Number of bytes read, those uncompressed counted as well, and of those kept: everything but messages.
        self._read = self._kept = 0

    def __enter__(self) -> Container:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def position(self) -> int:
        """Number of bytes read."""
        return self._base + self._at

    def survey(self, *, whole: bool) -> Contents:
        """Read and return attachments, metadata and channels.

        Parameters
        ----------
        whole : bool
            Whether to read to the end; otherwise only to the first message.

        Raises
        ------
        DataError
            If it is not an MCAP file.
        """
        with suppress(Damaged):
            for _ in self.messages():
                if not whole:
                    break
        return self.contents

    def is_beheaded(self) -> bool:
        """Return whether the file is an MCAP file but for its first bytes: its end is one, or they nearly are."""
        self._file.seek(0)
        start = self._file.read(len(MAGIC))
        self._file.seek(max(0, self._size - len(MAGIC)))
        wrong = sum(one != other for one, other in zip(start, MAGIC, strict=False))
        return start != MAGIC and len(start) == len(MAGIC) and (wrong <= 2 or self._file.read(len(MAGIC)) == MAGIC)

    def outside(self) -> list[str]:
        """Return, as text, which bytes without content differ from what a machine's recorder writes."""
        contents, found = self.contents, list(self.contents.outside)
        version = contents.run.get("compensator")
        if version is not None and contents.library != f"compensator {version}":
            found.append(
                f"the header names {contents.library[:40]!r} as the program, the metadata compensator {version}"
            )
        unused = sorted(name for number, (name, _, _) in self._schemas.items() if number not in self._used)
        if unused and contents.channels:
            found.append(f"no channel has the schema(s) {', '.join(unused)[:80]}")
        return found

    def _note(self, what: str) -> None:
        if what not in self.contents.outside and len(self.contents.outside) < _MOST_NOTES:
            self.contents.outside.append(what)

    # ------------------------------------------------------------------ messages

    def messages(self) -> Iterator[Message]:
        """Yield every message in the order of the file; other records are added to `contents`.

        Raises
        ------
        DataError
            If it is not an MCAP file.
        Torn
            If the file ends inside a record; every complete message was yielded before.
        Damaged
            If a record is not valid.
        """
        self._need(len(MAGIC))
        start = self._buffer[: len(MAGIC)]
        if start != MAGIC:
            if MAGIC.startswith(start):
                raise Torn(self.path, 0)
            raise DataError(f"{self.path}: not an MCAP file, expected a recording")
        self._at = len(MAGIC)
        unpack = _HEAD.unpack_from
        contents, channels = self.contents, self.contents.channels
        loose: dict[int, int] = {}
        first_ns, last_ns = 2**64, 0
        while True:
            if self._at + 31 > len(self._buffer):
                self._need(31)
            buffer, at = self._buffer, self._at
            if len(buffer) - at >= 31 and buffer[at] == MESSAGE:
                _, length, channel, sequence, log_time, _ = unpack(buffer, at)
                end = at + 9 + length
                if end > len(buffer) or length < 22:
                    self._frame()
                    buffer, at = self._buffer, self._at
                    end = at + 9 + length
                if channel not in channels:
                    raise Damaged(self.path, self._base + at, f"a message of channel {channel}, which is not defined")
                contents.messages += 1
                loose[channel] = loose.get(channel, 0) + 1
                first_ns = min(first_ns, log_time)
                last_ns = max(last_ns, log_time)
                self._at = end
                yield Message(channel, sequence, log_time, buffer[at + 11 : end])
                continue
            code, length = self._frame()
            body = self._buffer[self._at + 9 : self._at + 9 + length]
            if code == CHUNK:
                yield from self._chunk(body)
            elif code == DATA_END:
                self.index.add_loose(loose, first_ns, last_ns)
                self._end(body)
                return
            else:
                self._other(code, body, self._base + self._at)
            self._at += 9 + length

    def _chunk(self, body: bytes) -> Iterator[Message]:
        """Yield the messages of a chunk."""
        offset = self._base + self._at
        self.contents.chunked = True
        data = self._uncompressed(body, offset)
        at, size = 0, len(data)
        places: dict[int, list[int]] = {}
        unpack, channels, contents = _HEAD.unpack_from, self.contents.channels, self.contents
        while at < size:
            if size - at < 9:
                raise Damaged(self.path, offset, "the chunk ends inside a record")
            code, length = _FRAME.unpack_from(data, at)
            end = at + 9 + length
            if end > size or length < _SHORTEST.get(code, 0):
                raise Damaged(self.path, offset, f"a record of {length} bytes in the chunk, {size - at - 9} are there")
            if code == MESSAGE:
                _, _, channel, sequence, log_time, _ = unpack(data, at)
                place = places.get(channel)
                if place is None:
                    if channel not in channels:
                        raise Damaged(self.path, offset, f"a message of channel {channel}, which is not defined")
                    place = places[channel] = []
                place += (log_time, at)
                contents.messages += 1
                yield Message(channel, sequence, log_time, data[at + 11 : end])
            elif code in (SCHEMA, CHANNEL):
                self._other(code, data[at + 9 : end], offset)
            else:
                raise Damaged(self.path, offset, f"a record of kind {code} in the chunk")
            at = end
        self.index.add_chunk(Fields(self.path, offset, body), offset, 9 + len(body), places)

    def _uncompressed(self, body: bytes, offset: int) -> bytes:
        size, crc = struct.unpack_from("<QI", body, 16)
        fields = Fields(self.path, offset, body, 28)
        compression = fields.text()
        data = fields.bytes8()
        fields.done()
        if size > LONGEST:
            raise Damaged(self.path, offset, f"a chunk of {size} bytes, expected at most {LONGEST}")
        self._count(size)
        try:
            if compression == "zstd":
                # The size in the frame is allocated before decompression, so it is checked first.
                stated = zstandard.frame_content_size(data)
                if stated not in (-1, size):
                    raise Damaged(self.path, offset, f"a chunk of {size} bytes whose data state {stated}")
                data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size or 1, allow_extra_data=False)
            elif compression:
                raise Damaged(self.path, offset, f"a chunk compressed by {compression!r}, expected zstd or none")
        except (zstandard.ZstdError, ValueError) as error:
            raise Damaged(self.path, offset, f"a chunk that cannot be uncompressed: {error}") from error
        if not crc and size:
            self._note("a chunk has no CRC")
        if len(data) != size or (crc and zlib.crc32(data) != crc):
            raise Damaged(self.path, offset, "a chunk whose CRC is wrong")
        return data

    # ------------------------------------------------------------------ other records

    def _other(self, code: int, body: bytes, offset: int) -> None:
        fields = Fields(self.path, offset, body)
        contents = self.contents
        if code != MESSAGE_INDEX:
            self._kept += len(body)
            if self._kept > LONGEST:
                raise Damaged(self.path, offset, f"more than {LONGEST} bytes besides messages")
        if code == HEADER:
            if fields.text():
                self._note("the header names a profile")
            library = fields.text()
            fields.done()
            if offset == len(MAGIC):
                contents.library = library
            else:
                self._add_flaw("a header", Flaw.NOT_FIRST)
        elif code == SCHEMA:
            number = fields.number("<H")
            described = (fields.text(), fields.text(), fields.bytes4())
            fields.done()
            self._check_place(f"schema {described[0]}", is_there=number in self._schemas)
            self._schemas[number] = described
            self.index.add_description(SCHEMA, number, body)
        elif code == CHANNEL:
            number, schema = fields.number("<H"), fields.number("<H")
            topic, encoding, metadata = fields.text(), fields.text(), fields.table()
            fields.done()
            self._used.add(schema)
            name, schema_encoding, data = self._schemas.get(schema, ("", "", b""))
            channel = McapChannel(topic, encoding, metadata, name, schema_encoding, data)
            known = number in contents.channels or topic in (one.topic for one in contents.channels.values())
            self._check_place(f"channel {topic}", is_there=known)
            if contents.channels.setdefault(number, channel) != channel:
                raise Damaged(self.path, offset, f"a second channel {number}, {topic}")
            self.index.add_description(CHANNEL, number, body)
        elif code == METADATA:
            name = fields.text()
            table = fields.table()
            fields.done()
            self.index.add_metadata(offset, 9 + len(body), name)
            self._keep(contents.metadata, name, table, "metadata")
        elif code == ATTACHMENT:
            log_time, create_time = fields.number("<Q"), fields.number("<Q")
            name, media_type, data = fields.text(), fields.text(), fields.bytes8()
            crc = fields.number("<I")
            fields.done()
            self.index.add_attachment(offset, 9 + len(body), log_time, create_time, len(data), name, media_type)
            if not crc:
                self._note(f"attachment {name} has no CRC")
            elif zlib.crc32(body[:-4]) != crc:
                self._add_flaw(f"attachment {name}", Flaw.WRONG_CRC)
            self._keep(
                contents.attachments, name, Attachment(name, media_type, log_time, create_time, data), "attachment"
            )
        elif code == MESSAGE_INDEX:
            channel_number, entries = fields.number("<H"), fields.bytes4()
            fields.done()
            self.index.add_message_index(offset, 9 + len(body), channel_number, entries)
        else:
            raise Damaged(self.path, offset, f"a record of kind {code}")

    def _keep(self, kept: dict[str, _T], name: str, value: _T, kind: str) -> None:
        if self._check_place(f"{kind} {name}", is_there=name in kept):
            kept[name] = value

    def _check_place(self, what: str, *, is_there: bool) -> bool:
        """Return whether a part is in its place: a recorder writes each once, before the first message.

        The chain names topics. A second channel of one, with a schema of its own, would show its messages differently.
        """
        if not (is_there or self.contents.messages):
            return True
        self._add_flaw(what, Flaw.TWICE if is_there else Flaw.LATE)
        return False

    def _add_flaw(self, what: str, flaw: Flaw) -> None:
        if len(self.contents.flaws) < _MOST_FLAWS:
            self.contents.flaws.append((what, flaw))

    def _end(self, body: bytes) -> None:
        """Read the summary up to the end of the file."""
        offset = self._base + self._at
        crc = zlib.crc32(self._buffer[: self._at], self._crc)
        stated = int.from_bytes(body[:4], "little")
        if not stated:
            self._note("the data have no CRC")
        elif stated != crc:
            raise Damaged(self.path, offset, "the CRC of the data is wrong")
        if len(body) > 4:
            self._note("the end of the data is longer than the recorder writes it")
        self._at += 9 + len(body)
        summary, summary_start = zlib.crc32(b""), self._base + self._at
        code = DATA_END
        while True:
            last, (code, length) = code, self._frame()
            start = self._at
            self._at += 9 + length
            record = self._buffer[start : self._at]
            if code == FOOTER:
                break
            if code not in (SCHEMA, CHANNEL, CHUNK_INDEX, ATTACHMENT_INDEX, STATISTICS, METADATA_INDEX, SUMMARY_OFFSET):
                raise Damaged(self.path, self._base + start, f"a record of kind {code} in the summary")
            self.index.summarise(
                code, self._base + start, Fields(self.path, self._base + start, record, 9), len(record)
            )
            summary = zlib.crc32(record, summary)
        stated = int.from_bytes(record[25:29], "little")
        if len(record) > 29:
            self._note("the footer is longer than the recorder writes it")
        if last not in (DATA_END, SUMMARY_OFFSET):
            self._note("the summary has no summary offsets")
        if not stated:
            self._note("the summary has no CRC")
        elif stated != zlib.crc32(record[:25], summary):
            raise Damaged(self.path, self._base + self._at, "the CRC of the summary is wrong")
        self.index.finish(summary_start, self._base + start, Fields(self.path, self._base + start, record, 9))
        self._need(len(MAGIC) + 1)
        rest = self._buffer[self._at : self._at + len(MAGIC) + 1]
        if rest != MAGIC:
            if MAGIC.startswith(rest):
                raise self._torn(self._base + self._at)
            more = self._size - self._base - self._at - len(MAGIC)
            raise Damaged(self.path, self._base + self._at, f"{more} bytes after the end of the file")
        self.contents.ended = True

    # ------------------------------------------------------------------ bytes

    def _need(self, count: int) -> None:
        """Read this number of bytes into the buffer, or as many as there are."""
        have = len(self._buffer) - self._at
        if have >= count:
            return
        self._crc = zlib.crc32(self._buffer[: self._at], self._crc)
        self._base += self._at
        self._buffer, self._at = self._buffer[self._at :], 0
        more = self._file.read(min(max(count - have, _WINDOW), self._size - self._base - have))
        self._count(len(more))
        self._buffer += more

    def _written(self, size: int) -> int:
        """Return where the file ends, without zeros in the place of what a power cut has lost.

        They begin anywhere, also within a record, which is then as torn as one whose bytes are missing. More of them
        than are written at once are judged where they are read. Behind the end of a file nothing was to be written.
        """
        self._file.seek(max(0, size - _LEAST_ZEROS))
        if size < _LEAST_ZEROS or self._file.read(_LEAST_ZEROS).strip(b"\0"):
            return size
        self._file.seek(max(0, size - _WINDOW))
        last = self._file.read(_WINDOW)
        kept = last.rstrip(b"\0")
        written = size - len(last) + len(kept)
        has_its_end = kept.endswith(MAGIC) and written > len(MAGIC)
        return written if kept and not has_its_end else size

    def _count(self, size: int) -> None:
        """Count bytes that are read; beyond the limit the file is damaged, whatever it holds."""
        self._read += size
        if self._read > LARGEST:
            raise Damaged(self.path, self.position, f"more than {LARGEST} bytes, those in chunks uncompressed")

    def _frame(self) -> tuple[int, int]:
        """Return kind and length of the current record, with the whole record in the buffer."""
        self._need(9)
        offset = self._base + self._at
        left = self._size - offset
        if left < 9 or len(self._buffer) - self._at < 9:
            code = self._buffer[self._at] if len(self._buffer) > self._at else MESSAGE
            if not (code == 0 or HEADER <= code <= DATA_END):
                raise Damaged(self.path, offset, f"a record of kind {code}")
            raise self._torn(offset)
        code, length = _FRAME.unpack_from(self._buffer, self._at)
        if code == 0 and self._only_zeros():
            raise self._torn(offset)
        if not HEADER <= code <= DATA_END:
            raise Damaged(self.path, offset, f"a record of kind {code}")
        longest = _LONGEST_HEADER if code == HEADER else LONGEST
        if not _SHORTEST.get(code, 0) <= length <= longest:
            raise Damaged(self.path, offset, f"a record of {length} bytes, expected at most {longest}")
        self._need(9 + length)
        if len(self._buffer) - self._at < 9 + length:
            raise self._torn(offset, self._buffer[self._at : self._at + _WINDOW])
        return code, length

    def _torn(self, offset: int, rest: bytes = b"") -> Damaged:
        """Return the error for a file that ends inside a record: a file with a footer is damaged, not torn."""
        self._file.seek(max(0, self._size - len(MAGIC)))
        if self._size > len(MAGIC) and self._file.read(len(MAGIC)) == MAGIC:
            return Damaged(self.path, offset, "a record that exceeds the end of the file")
        return Torn(self.path, offset, rest)

    def _only_zeros(self) -> bool:
        """Return whether only zeros follow, which a power cut may leave at the end of a file."""
        begin = self.position
        while True:
            if self._buffer[self._at :].strip(b"\0"):
                return False
            if self.position - begin > _MOST_ZEROS:
                raise Damaged(self.path, begin, f"more than {_MOST_ZEROS} zeros, expected a record")
            self._at = len(self._buffer)
            self._need(1)
            if len(self._buffer) == self._at:
                return True
