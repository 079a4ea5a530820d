"""An index that does not lead to all that is in the file is found, though records, chain and every CRC are right.

Readers that seek show what the index leads them to: an entry taken out hides records that are still there.
"""

from __future__ import annotations

import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from compensator.audit.machine_audit import audit
from compensator.cli import main
from compensator.recording.container import Container
from compensator.recording.framing import (
    ATTACHMENT_INDEX,
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    MESSAGE_INDEX,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    SUMMARY_OFFSET,
)
from compensator.recording.index import KEPT
from compensator.recording.reading import recordings
from tests.audit.made import MACHINE, Service
from tests.audit.tampering import rewrite

_MAGIC, SAMPLES = 8, 90
#: Places of fields in the bodies of a chunk, a chunk index, an attachment index and statistics.
START, END, OFFSET, LENGTH = 0, 8, 16, 24


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few samples in several small chunks."""
    folder = tmp_path_factory.mktemp("made")
    Service(folder).run(SAMPLES).stop()
    rewrite(recordings(folder, MACHINE)[0], chunk_size=60_000)
    return folder


@pytest.fixture
def path(made: Path, tmp_path: Path) -> Path:
    return recordings(Path(shutil.copytree(made, tmp_path / "rec")), MACHINE)[0]


Record = tuple[int, bytes]


def records_of(path: Path) -> list[Record]:
    data, at, found = path.read_bytes(), _MAGIC, []
    while at < len(data) - _MAGIC:
        code, length = struct.unpack_from("<BQ", data, at)
        found.append((code, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def write(path: Path, records: list[Record]) -> None:
    """Write the records again with right CRCs, and a footer and summary offsets that lead to where the groups are now.

    Nothing that the data section holds may move.
    """
    data = bytearray(path.read_bytes()[:_MAGIC])
    summary = offsets = 0
    groups: dict[int, tuple[int, int]] = {}
    for code, body in records:
        if code == FOOTER:
            head = struct.pack("<BQQQ", FOOTER, 20, summary, offsets)
            data += head + struct.pack("<I", zlib.crc32(bytes(data[summary:]) + head))
            break
        if code == DATA_END:
            body = struct.pack("<I", zlib.crc32(bytes(data)))
        elif code == SUMMARY_OFFSET:
            offsets = offsets or len(data)
            if body[0] in groups:
                body = struct.pack("<BQQ", body[0], *groups[body[0]])
        elif summary:
            begin, length = groups.get(code, (len(data), 0))
            groups[code] = begin, length + 9 + len(body)
        data += struct.pack("<BQ", code, len(body)) + body
        if code == DATA_END:
            summary = len(data)
    path.write_bytes(data + path.read_bytes()[:_MAGIC])


def changed(body: bytes, at: int, value: int, form: str = "<Q") -> bytes:
    there = bytearray(body)
    struct.pack_into(form, there, at, value)
    return bytes(there)


def edit(code: int, how: Callable[[bytes], bytes | None], which: int = 0) -> Callable[[list[Record]], list[Record]]:
    """Change one record of a kind, or take it out."""

    def edited(records: list[Record]) -> list[Record]:
        at = [i for i, record in enumerate(records) if record[0] == code][which]
        body = how(records[at][1])
        return [*records[:at], *([] if body is None else [(code, body)]), *records[at + 1 :]]

    return edited


def add(at: int, amount: int, form: str = "<Q") -> Callable[[bytes], bytes]:
    return lambda body: changed(body, at, struct.unpack_from(form, body, at)[0] + amount, form)


def gone(body: bytes) -> None:
    return None


def twice(code: int) -> Callable[[list[Record]], list[Record]]:
    def edited(records: list[Record]) -> list[Record]:
        at = next(i for i, record in enumerate(records) if record[0] == code)
        return [*records[: at + 1], *records[at:]]

    return edited


def last_entry_as_the_first(body: bytes) -> bytes:
    """A message index that leads to one message twice and to another never."""
    return body[:-16] + body[6:22]


def renamed(body: bytes) -> bytes:
    return body.replace(b"/offset", b"/OFFSET").replace(b"model.toml", b"other.toml").replace(b"run", b"fun")


#: What is done to a file, which part of the index is named, and in which words.
CASES: dict[str, tuple[Callable[[list[Record]], list[Record]], str, str]] = {
    "chunk index gone": (edit(CHUNK_INDEX, gone, 1), "chunk index", "no entry leads to the chunk at byte"),
    "chunk index twice": (twice(CHUNK_INDEX), "chunk index", "occurs twice"),
    "chunk index elsewhere": (edit(CHUNK_INDEX, add(OFFSET, 9)), "chunk index", "no chunk is there"),
    "chunk index, length": (edit(CHUNK_INDEX, add(LENGTH, -1)), "chunk index", "length:"),
    "chunk index, from": (edit(CHUNK_INDEX, add(START, 60 * 10**9)), "chunk index", "first message (ns):"),
    "chunk index, to": (edit(CHUNK_INDEX, add(END, -(10**9)), 1), "chunk index", "last message (ns):"),
    "chunk index, message index": (edit(CHUNK_INDEX, add(38, 1)), "chunk index", "message indexes:"),
    "chunk index, channel": (edit(CHUNK_INDEX, add(36, 70, "<H")), "chunk index", "message indexes:"),
    "chunk, from": (edit(CHUNK, add(START, 60 * 10**9)), "chunk at byte", "says that its messages are from"),
    "message index, place": (edit(MESSAGE_INDEX, add(14, 7)), "message index", "and 1 time(s) to something else"),
    "message index, time": (edit(MESSAGE_INDEX, add(6, 10**9), 2), "message index", "and 1 time(s) to something else"),
    "message index skips one": (edit(MESSAGE_INDEX, last_entry_as_the_first), "message index", "of the"),
    "attachment index gone": (edit(ATTACHMENT_INDEX, gone, 1), "attachment index", ", model.toml"),
    "attachment index elsewhere": (edit(ATTACHMENT_INDEX, add(0, 1)), "attachment index", "no attachment is there"),
    "attachment index, size": (edit(ATTACHMENT_INDEX, add(32, -5)), "attachment index", "size:"),
    "attachment index, name": (edit(ATTACHMENT_INDEX, renamed, 1), "attachment index", "'model.toml' is right"),
    "metadata index gone": (edit(METADATA_INDEX, gone), "metadata index", "no entry leads to the metadata table"),
    "metadata index, name": (edit(METADATA_INDEX, renamed), "metadata index", "'run' is right"),
    "statistics, messages": (edit(STATISTICS, add(0, -1)), "statistics", "messages:"),
    "statistics, chunks": (edit(STATISTICS, add(22, -1, "<I")), "statistics", "chunks:"),
    "statistics, attachments": (edit(STATISTICS, add(14, -1, "<I")), "statistics", "attachments:"),
    "statistics, end": (edit(STATISTICS, add(34, -(10**9))), "statistics", "last message (ns):"),
    "statistics, one channel": (edit(STATISTICS, add(48, 1)), "statistics", "messages by channel:"),
    "statistics gone": (edit(STATISTICS, gone), "statistics", "are missing"),
    "channel under another name": (edit(CHANNEL, renamed, -4), "channel 3", "differs between the summary and the file"),
    "channel gone": (edit(CHANNEL, gone, -1), "channel 6", "is not repeated"),
    "schema gone": (edit(SCHEMA, gone, -1), "schema 6", "is not repeated"),
    "summary offset gone": (edit(SUMMARY_OFFSET, gone, 3), "summary offset", "none leads to those at byte"),
    "no summary": (
        lambda records: [*records[: [code for code, _ in records].index(DATA_END) + 1], records[-1]],
        "summary",
        "is missing",
    ),
}


def test_the_untouched_file_written_again_is_the_same(path: Path) -> None:
    before = path.read_bytes()
    records = records_of(path)
    assert [code for code, _ in records].count(CHUNK_INDEX) >= 3
    write(path, records)
    assert path.read_bytes() == before


@pytest.mark.parametrize("case", CASES)
def test_an_index_that_does_not_fit_is_named(path: Path, case: str) -> None:
    how, where, what = CASES[case]
    write(path, how(records_of(path)))
    with Container(path) as container:  # every record is there, every CRC is right
        assert sum(1 for _ in container.messages()) > 4 * SAMPLES and container.contents.ended
    found = audit([path])
    assert found.samples == SAMPLES and found.findings
    assert {finding.kind for finding in found.findings} == {"index"}
    assert any(f.topic.startswith(where) and what in f.text for f in found.findings), [f.line() for f in found.findings]
    assert found.findings_count <= 3


def test_what_a_reader_that_seeks_would_have_missed(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One entry of the index less, and a part of the day is not shown; the audit says so and ends with 3."""

    def seen() -> int:
        with path.open("rb") as file:
            return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages("/offset"))

    assert seen() == SAMPLES
    write(path, edit(CHUNK_INDEX, gone, 1)(records_of(path)))
    assert seen() < SAMPLES
    assert main(["replay", str(path)]) == 3
    said = capsys.readouterr().out
    assert f"{path.name}: index: chunk index: no entry leads to the chunk at byte" in said


def test_messages_behind_the_chunks_are_seen_by_no_index(path: Path) -> None:
    """A group moved out of its chunk stands where the chain wants it, and no reader that seeks shows it."""
    inside = path.with_name("loose.mcap")
    shutil.copy(path, inside)
    rewrite(inside, chunked=False)
    chunked, loose = records_of(path), records_of(inside)
    last = next(i for i in reversed(range(len(chunked))) if chunked[i][0] == CHUNK)
    end = next(i for i, record in enumerate(chunked) if record[0] == DATA_END)
    with Container(path) as container:
        total = sum(1 for _ in container.messages())
    kept = total - sum((len(body) - 6) // 16 for code, body in chunked[last + 1 : end])
    messages = [record for record in loose if record[0] == 5][kept:]
    index = [i for i, record in enumerate(chunked) if record[0] == CHUNK_INDEX][-1]
    statistics = edit(STATISTICS, add(22, -1, "<I"))
    write(path, statistics([*chunked[:last], *messages, *chunked[end:index], *chunked[index + 1 :]]))
    (finding,) = audit([path]).findings
    assert finding.kind == "index" and f"{len(messages)} message(s) are in no chunk" in finding.text


def test_a_great_many_faults_are_counted_and_some_are_kept(path: Path) -> None:
    at = next(i for i, record in enumerate(records_of(path)) if record[0] == CHUNK_INDEX)
    records = records_of(path)
    write(path, [*records[: at + 1], *[records[at]] * 200, *records[at + 1 :]])
    found = audit([path])
    assert found.findings_count == 200 and len(found.findings) == KEPT
