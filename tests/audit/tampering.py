"""What somebody with an MCAP library does to a recording."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
from mcap.writer import CompressionType, Writer

from compensator.messages import Chain
from compensator.recording import chain
from compensator.recording.container import PAYLOAD, Attachment, Container, Contents, Torn
from compensator.recording.reading import last_value


@dataclass(frozen=True)
class Line:
    """One message of a file."""

    topic: str
    sequence: int
    time_ns: int
    data: bytes

    def edited(self, old: bytes, new: bytes) -> Line:
        assert old in self.data, self.data
        return replace(self, data=self.data.replace(old, new, 1))


def lines_of(path: Path) -> tuple[list[Line], Contents]:
    with Container(path) as container:
        channels = container.contents.channels
        lines = []
        with suppress(Torn):
            for number, sequence, time_ns, body in container.messages():
                lines.append(Line(channels[number].topic[1:], sequence, time_ns, body[PAYLOAD:]))
        return lines, container.contents


@dataclass(frozen=True)
class End:
    """How a file ends: the value it hands on, messages the chain does not list, its seal, whether whole and compact."""

    value: bytes
    unlisted: int
    sealed: str
    whole: bool
    chunked: bool


def end_of_chain(path: Path) -> End | None:
    lines, contents = lines_of(path)
    listed = [i for i, line in enumerate(lines) if line.topic == "chain"]
    if not listed:
        return None
    last = [line for line in lines if line.topic != "chain"][-1]
    sealed = msgspec.json.decode(last.data)["reason"] if last.topic == "seal" else ""
    return End(last_value(path), len(lines) - 1 - listed[-1], sealed, contents.ended, contents.chunked)


def rewrite(
    path: Path,
    edit: Callable[[list[Line]], list[Line]] = list,
    *,
    contents: Callable[[Contents], None] | None = None,
    chunked: bool = True,
    chunk_size: int = 2**20,
    late: Attachment | None = None,
) -> None:
    """Write a file again with other messages, attachments or metadata; everything else fits, CRCs included."""
    lines, there = lines_of(path)
    if contents is not None:
        contents(there)
    with path.open("wb") as file:
        compression = CompressionType.ZSTD if chunked else CompressionType.NONE
        writer = Writer(file, chunk_size, use_chunking=chunked, compression=compression, enable_data_crcs=True)
        writer.start(library=there.library)
        numbers = {}
        for channel in there.channels.values():
            schema = writer.register_schema(channel.schema_name, channel.schema_encoding, channel.schema)
            numbers[channel.topic[1:]] = writer.register_channel(
                channel.topic, channel.encoding, schema, channel.metadata
            )
        for name, table in there.metadata.items():
            writer.add_metadata(name, table)
        for part in there.attachments.values():
            writer.add_attachment(part.create_time_ns, part.log_time_ns, part.name, part.media_type, part.data)
        for line in edit(lines):
            writer.add_message(numbers[line.topic], line.time_ns, line.data, line.time_ns, sequence=line.sequence)
        if late is not None:
            writer.add_attachment(late.create_time_ns, late.log_time_ns, late.name, late.media_type, late.data)
        writer.finish()


def find(lines: list[Line], topic: str, which: int) -> int:
    """Index of one message of a topic, counted among that topic."""
    return [i for i, line in enumerate(lines) if line.topic == topic][which]


def group(lines: list[Line], which: int) -> tuple[int, int]:
    """Begin and end of the group that the chain message closes, that message included."""
    end = find(lines, "chain", which)
    begin = find(lines, "chain", which - 1) + 1 if which else 0
    return begin, end + 1


def with_new_values(lines: list[Line], contents: Contents) -> list[Line]:
    """Compute the whole chain of a file anew, as somebody does who knows how."""
    made: list[Line] = []
    writer: chain.ChainWriter | None = None
    for line in lines:
        if line.topic != "chain":
            assert writer is not None
            writer.add(line.topic, chain.body_of(line.sequence, line.time_ns, line.data))
            made.append(line)
            continue
        if writer is None:
            first = msgspec.json.decode(line.data, type=Chain)
            writer = chain.ChainWriter(first.machine, bytes.fromhex(first.before))
            data = writer.begin(chain.parts_of(contents), line.time_ns)
        else:
            data = writer.message(line.time_ns)
        made.append(replace(line, data=data))
    return made
