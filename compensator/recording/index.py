"""Checks that the index of an MCAP file leads to every record of it, and to nothing else.

The hash chain covers the content of the records. Readers that seek (Foxglove, the JavaScript library) find only records
in the index: a missing or wrong entry hides records. The index is therefore compared with the data section while that
is read: the message indexes after each chunk, and in the summary the chunks, attachments and metadata, the statistics,
the repeated schemas and channels, and the offsets.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import StrEnum
from typing import Any

from compensator.recording.framing import (
    ATTACHMENT_INDEX,
    CHANNEL,
    CHUNK_INDEX,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    SUMMARY_OFFSET,
    Fields,
)

#: Number of faults that are kept; further faults are counted.
KEPT = 50
_NAMES = {
    SCHEMA: "schema",
    CHANNEL: "channel",
    STATISTICS: "statistics",
    CHUNK_INDEX: "chunk index",
    ATTACHMENT_INDEX: "attachment index",
    METADATA_INDEX: "metadata index",
}
_THINGS = {CHUNK_INDEX: "chunk", ATTACHMENT_INDEX: "attachment", METADATA_INDEX: "metadata table"}


class _Part(StrEnum):
    """Parts of an entry of the index, as findings name them."""

    FIRST_NS = "first message (ns)"
    LAST_NS = "last message (ns)"
    OFFSET = "offset"
    LENGTH = "length"
    INDEXES = "message indexes"
    INDEXES_LENGTH = "length of the message indexes"
    COMPRESSION = "compression"
    COMPRESSED_SIZE = "compressed size"
    SIZE = "size"
    LOG_NS = "log time (ns)"
    CREATION_NS = "creation time (ns)"
    NAME = "name"
    MEDIA_TYPE = "media type"
    MESSAGES = "messages"
    SCHEMAS = "schemas"
    CHANNELS = "channels"
    ATTACHMENTS = "attachments"
    METADATA = "metadata tables"
    CHUNKS = "chunks"
    BY_CHANNEL = "messages by channel"


def _u64(fields: Fields) -> int:
    return fields.number("<Q")


def _u32(fields: Fields) -> int:
    return fields.number("<I")


#: The parts of each kind of record of the index, in their order on disk.
_LAYOUT = {
    CHUNK_INDEX: (
        *(_Part.FIRST_NS, _Part.LAST_NS, _Part.OFFSET, _Part.LENGTH, _Part.INDEXES, _Part.INDEXES_LENGTH),
        *(_Part.COMPRESSION, _Part.COMPRESSED_SIZE, _Part.SIZE),
    ),
    ATTACHMENT_INDEX: (
        *(_Part.OFFSET, _Part.LENGTH, _Part.LOG_NS, _Part.CREATION_NS, _Part.SIZE, _Part.NAME, _Part.MEDIA_TYPE),
    ),
    METADATA_INDEX: (_Part.OFFSET, _Part.LENGTH, _Part.NAME),
    STATISTICS: (
        *(_Part.MESSAGES, _Part.SCHEMAS, _Part.CHANNELS, _Part.ATTACHMENTS, _Part.METADATA, _Part.CHUNKS),
        *(_Part.FIRST_NS, _Part.LAST_NS, _Part.BY_CHANNEL),
    ),
}
#: How a part is read where it is not an unsigned number of 8 bytes.
_READERS: dict[_Part, Callable[[Fields], Any]] = {
    **dict.fromkeys((_Part.COMPRESSION, _Part.NAME, _Part.MEDIA_TYPE), Fields.text),
    **dict.fromkeys((_Part.INDEXES, _Part.BY_CHANNEL), Fields.counts),
    **dict.fromkeys((_Part.CHANNELS, _Part.ATTACHMENTS, _Part.METADATA, _Part.CHUNKS), _u32),
    _Part.SCHEMAS: lambda fields: fields.number("<H"),
}

#: How an entry describes what it points to.
_Entry = dict[_Part, Any]


class Index:
    """Compares what is in a file with its index."""

    def __init__(self) -> None:
        #: Part of the index that is wrong, and what is wrong with it: the first `KEPT`, and the number of all.
        self.faults: list[tuple[str, str]] = []
        self.count = 0
        #: For each kind the expected entry, by the offset of what it points to, and the offsets that were found.
        self._due: dict[int, dict[int, _Entry]] = {kind: {} for kind in _THINGS}
        self._found: dict[int, set[int]] = {kind: set() for kind in _THINGS}
        #: Schemas and channels by number, and those that the summary repeats.
        self._described: dict[int, dict[int, bytes]] = {SCHEMA: {}, CHANNEL: {}}
        self._repeated: dict[int, set[int]] = {SCHEMA: set(), CHANNEL: set()}
        #: Messages of the chunk that was read last for which no message index came yet; where the next one must be.
        self._places: dict[int, list[int]] = {}
        self._chunk: _Entry = {}
        self._next = 0
        self._chunk_at = 0
        self._messages: dict[int, int] = {}
        self._loose = 0
        self._first_ns, self._last_ns = 2**64, 0
        #: Groups of the summary as they are there, and as the summary offsets state.
        self._groups: list[list[int]] = []
        self._stated: list[tuple[int, int, int]] = []
        self._offsets_at = 0
        self._statistics: _Entry | None = None

    def _fault(self, where: str, what: str) -> None:
        self.count += 1
        if len(self.faults) < KEPT:
            self.faults.append((where, what))

    # ------------------------------------------------------------------ the data section

    def add_chunk(self, head: Fields, offset: int, length: int, places: dict[int, list[int]]) -> None:
        """Note a chunk.

        Parameters
        ----------
        head : Fields
            Its own fields.
        offset, length : int
            Where it is, bytes.
        places : dict of int to list of int
            By channel: log time (ns) and place in the chunk (bytes) of one message after the other.
        """
        self._close_chunk()
        start_ns, end_ns, size = head.number("<Q"), head.number("<Q"), head.number("<Q")
        head.number("<I")
        compression, stored = head.text(), head.bytes8()
        first_ns = min((min(place[::2]) for place in places.values()), default=0)
        last_ns = max((max(place[::2]) for place in places.values()), default=0)
        if (start_ns, end_ns) != (first_ns, last_ns):
            self._fault(
                f"chunk at byte {offset}",
                f"says that its messages are from {start_ns} to {end_ns} ns, they are from {first_ns} to {last_ns} ns",
            )
        self._places, self._chunk_at, self._next = places, offset, offset + length
        self._chunk = {
            _Part.FIRST_NS: first_ns,
            _Part.LAST_NS: last_ns,
            _Part.LENGTH: length,
            _Part.INDEXES: {},
            _Part.INDEXES_LENGTH: 0,
            _Part.COMPRESSION: compression,
            _Part.COMPRESSED_SIZE: len(stored),
            _Part.SIZE: size,
        }
        self._due[CHUNK_INDEX][offset] = self._chunk
        for channel, place in places.items():
            self._messages[channel] = self._messages.get(channel, 0) + len(place) // 2
        if places:
            self._first_ns, self._last_ns = min(self._first_ns, first_ns), max(self._last_ns, last_ns)

    def add_message_index(self, offset: int, length: int, channel: int, entries: bytes) -> None:
        """Compare a message index with the messages of the chunk before it.

        Parameters
        ----------
        offset, length : int
            Where it is, bytes.
        channel : int
            Number of the channel.
        entries : bytes
            Log times (ns) and places in the chunk (bytes).
        """
        where = f"message index of channel {channel} at byte {offset}"
        if offset != self._next:
            self._fault(where, "does not follow a chunk")
            return
        self._next += length
        self._chunk[_Part.INDEXES_LENGTH] += length
        place = self._places.pop(channel, None)
        if place is None:
            if entries or channel in self._chunk[_Part.INDEXES]:
                self._fault(where, f"leads into the chunk at byte {self._chunk_at}, which has no (more) messages of it")
            return
        self._chunk[_Part.INDEXES][channel] = offset
        if entries == struct.pack(f"<{len(place)}Q", *place):
            return
        due = set(zip(place[::2], place[1::2], strict=True))
        whole = len(entries) % 16 == 0
        stated = list(struct.iter_unpack("<QQ", entries)) if whole else []
        missing, wrong = len(due - set(stated)), len(stated) - len(due & set(stated))
        if missing or wrong or not whole:
            self._fault(
                where,
                f"leads to {len(due) - missing} of the {len(due)} messages of the chunk at byte "
                f"{self._chunk_at}, and {wrong} time(s) to something else",
            )

    def _close_chunk(self) -> None:
        """Check that every message of the chunk had its index."""
        for channel, place in self._places.items():
            what = f"no message index leads to its {len(place) // 2} message(s) of channel {channel}"
            self._fault(f"chunk at byte {self._chunk_at}", what)
        self._places = {}

    def add_loose(self, messages: dict[int, int], first_ns: int, last_ns: int) -> None:
        """Note the messages that are in no chunk.

        Parameters
        ----------
        messages : dict of int to int
            How many, by channel.
        first_ns, last_ns : int
            First and last log time, ns.
        """
        for channel, count in messages.items():
            self._messages[channel] = self._messages.get(channel, 0) + count
            self._loose += count
        self._first_ns, self._last_ns = min(self._first_ns, first_ns), max(self._last_ns, last_ns)

    def add_description(self, kind: int, number: int, body: bytes) -> None:
        """Note a schema or channel."""
        if self._described[kind].setdefault(number, body) != body:
            self._fault(f"{_NAMES[kind]} {number}", "occurs twice, with different content")

    def add_attachment(
        self, offset: int, length: int, log_ns: int, create_ns: int, size: int, name: str, media_type: str
    ) -> None:
        """Note an attachment."""
        self._due[ATTACHMENT_INDEX][offset] = {
            _Part.LENGTH: length,
            _Part.LOG_NS: log_ns,
            _Part.CREATION_NS: create_ns,
            _Part.SIZE: size,
            _Part.NAME: name,
            _Part.MEDIA_TYPE: media_type,
        }

    def add_metadata(self, offset: int, length: int, name: str) -> None:
        """Note a metadata table."""
        self._due[METADATA_INDEX][offset] = {_Part.LENGTH: length, _Part.NAME: name}

    # ------------------------------------------------------------------ the summary

    def summarise(self, kind: int, offset: int, fields: Fields, length: int) -> None:
        """Check a record of the summary.

        Parameters
        ----------
        kind : int
            Its kind.
        offset, length : int
            Where it is, bytes.
        fields : Fields
            Its fields.
        """
        if kind == SUMMARY_OFFSET:
            self._offsets_at = self._offsets_at or offset
            self._stated.append((fields.number("<B"), fields.number("<Q"), fields.number("<Q")))
            fields.done()
            return
        if self._offsets_at:
            self._fault(_NAMES[kind], f"is at byte {offset}, after the summary offsets")
        if self._groups and self._groups[-1][0] == kind:
            self._groups[-1][2] += length
        else:
            self._groups.append([kind, offset, length])
        if kind in _THINGS:
            self._entry(kind, _read(kind, fields))
        elif kind == STATISTICS:
            if self._statistics is not None:
                self._fault("statistics", "occur twice")
            self._statistics = _read(kind, fields)
        else:
            self._repeat(kind, fields)

    def _entry(self, kind: int, entry: _Entry) -> None:
        offset = entry[_Part.OFFSET]
        where = f"{_NAMES[kind]} of the {_THINGS[kind]} at byte {offset}"
        due = self._due[kind].get(offset)
        if due is None:
            self._fault(where, f"no {_THINGS[kind]} is there")
        elif offset in self._found[kind]:
            self._fault(where, "occurs twice")
        else:
            self._found[kind].add(offset)
            self._compare(where, entry, due)

    def _compare(self, where: str, entry: _Entry, due: _Entry) -> None:
        for name, value in due.items():
            if entry[name] != value:
                self._fault(where, f"{name}: {entry[name]!r} is there, {value!r} is right")

    def _repeat(self, kind: int, fields: Fields) -> None:
        body = fields.rest()
        number = int.from_bytes(body[:2], "little")
        if self._described[kind].get(number) != body or number in self._repeated[kind]:
            self._fault(f"{_NAMES[kind]} {number}", "differs between the summary and the file")
        self._repeated[kind].add(number)

    def finish(self, summary_start: int, footer_at: int, footer: Fields) -> None:
        """Find what is known only at the end.

        Parameters
        ----------
        summary_start, footer_at : int
            Where the summary and the footer are, bytes.
        footer : Fields
            Its fields.
        """
        self._close_chunk()
        chunks = len(self._due[CHUNK_INDEX])
        if chunks and self._loose:
            self._fault("chunk index", f"{self._loose} message(s) are in no chunk, so it leads to none of them")
        if footer_at == summary_start:
            self._fault("summary", "is missing, so readers that seek find nothing")
            return
        for kind, entries in self._due.items():
            for offset in entries.keys() - self._found[kind]:
                self._fault(
                    _NAMES[kind],
                    f"no entry leads to the {_THINGS[kind]} at byte {offset}"
                    + (f", {entries[offset][_Part.NAME]}" if _Part.NAME in entries[offset] else ""),
                )
        for kind, described in self._described.items():
            for number in described.keys() - self._repeated[kind]:
                self._fault(f"{_NAMES[kind]} {number}", "is not repeated in the summary")
        if self._statistics is None:
            self._fault("statistics", "are missing")
        else:
            self._compare("statistics", self._statistics, self._totals())
        self._places_of_groups(summary_start, footer_at, footer.number("<Q"), footer.number("<Q"))

    def _totals(self) -> _Entry:
        any_there = bool(self._messages)
        return {
            _Part.MESSAGES: sum(self._messages.values()),
            _Part.SCHEMAS: len(self._described[SCHEMA]),
            _Part.CHANNELS: len(self._described[CHANNEL]),
            _Part.ATTACHMENTS: len(self._due[ATTACHMENT_INDEX]),
            _Part.METADATA: len(self._due[METADATA_INDEX]),
            _Part.CHUNKS: len(self._due[CHUNK_INDEX]),
            _Part.FIRST_NS: self._first_ns if any_there else 0,
            _Part.LAST_NS: self._last_ns if any_there else 0,
            _Part.BY_CHANNEL: self._messages,
        }

    def _places_of_groups(self, start: int, footer_at: int, stated_start: int, stated_offsets: int) -> None:
        """Compare footer and summary offsets with the places of the groups in the summary."""
        if stated_start != start:
            self._fault("footer", f"says that the summary begins at byte {stated_start}, it begins at byte {start}")
        if stated_offsets != self._offsets_at and (self._offsets_at or stated_offsets != footer_at):
            self._fault(
                "footer",
                f"says that the summary offsets begin at byte {stated_offsets}, they begin at byte {self._offsets_at}",
            )
        if not self._stated:  # readers walk through the summary
            return
        groups = [tuple(group) for group in self._groups]
        for kind, begin, length in groups:
            if self._stated.count((kind, begin, length)) != 1:
                self._fault(f"summary offset of kind {_NAMES[kind]}", f"none leads to those at byte {begin}")
        for group in self._stated:
            if group[2] and group not in groups:
                name = _NAMES.get(group[0], group[0])
                self._fault(f"summary offset of kind {name}", f"none of them is at byte {group[1]}")


def _read(kind: int, fields: Fields) -> _Entry:
    """Read an entry of the index, or the statistics."""
    entry = {part: _READERS.get(part, _u64)(fields) for part in _LAYOUT[kind]}
    fields.done()
    return entry
