"""A file that is larger than any recording, however little space it takes: it blocks no start and passes no audit."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import pytest
import zstandard

from compensator.audit.machine_audit import audit, summary
from compensator.messages import encode
from compensator.recording import container, live_file
from compensator.recording.container import LARGEST, LONGEST, MAGIC
from compensator.recording.framing import ATTACHMENT, CHANNEL, CHUNK, HEADER, MESSAGE
from compensator.recording.live_file import FULL
from compensator.recording.numbering import first_sequence
from compensator.recording.reading import last_value, recordings
from compensator.recording.signature import Signer
from tests.audit.made import MACHINE, MINUTE_NS, Service
from tests.audit.tampering import lines_of
from tests.audit.test_signatures import write_key
from tests.service.simulated import START_NS

GB = 10**9
NEWER = f"{MACHINE}_20270101T000000Z.mcap"


def text(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def record(code: int, body: bytes, more: int = 0) -> bytes:
    """A record, or only its beginning if more bytes belong to it."""
    return struct.pack("<BQ", code, len(body) + more) + body


START = MAGIC + record(HEADER, text(b"") + text(b"compensator 0.1.0"))
TOPIC = record(CHANNEL, struct.pack("<HH", 1, 0) + text(b"/chain") + text(b"json") + text(b""))


def zeros(path: Path, size: int) -> None:
    path.write_bytes(MAGIC)
    os.truncate(path, size)


def zeros_behind_records(path: Path, size: int) -> None:
    """The newest recording itself."""
    os.truncate(recordings(path.parent, MACHINE)[-1], size)


def _many(path: Path, size: int, begin: Callable[[int], bytes], length: int) -> None:
    """Records that are long, of which only the beginnings are written."""
    with path.open("wb") as file:
        file.write(START + TOPIC)
        for number in range(size // length):
            file.write(begin(number))
            file.seek(length, os.SEEK_CUR)
        file.write(b"\0")


def attachments(path: Path, size: int, length: int = 60 * 2**20) -> None:
    def begin(number: int) -> bytes:
        times, name = struct.pack("<QQ", 1, 1), text(str(number).encode()) + text(b"")
        return record(ATTACHMENT, times + name + struct.pack("<Q", length - 4), length)

    _many(path, size, begin, length)


def messages(path: Path, size: int, length: int = 15 * 10**6) -> None:
    _many(path, size, lambda number: record(MESSAGE, struct.pack("<HIQQ", 1, number, 1, 1), length), length)


def chunks(path: Path, size: int, length: int = 15 * 10**6) -> None:
    """A few kilobytes for each of them."""
    data = record(MESSAGE, struct.pack("<HIQQ", 1, 1, 1, 1), length) + bytes(length)
    small = zstandard.ZstdCompressor().compress(data)
    body = struct.pack("<QQQI", 1, 1, len(data), zlib.crc32(data)) + text(b"zstd") + struct.pack("<Q", len(small))
    path.write_bytes(START + TOPIC + record(CHUNK, body + small) * (size // length))


class Counting(BytesIO):
    """A file, of which the bytes are counted that are read."""

    total = 0

    def __init__(self, file: BinaryIO) -> None:
        super().__init__()
        self._file = file

    def read(self, size: int | None = -1, /) -> bytes:
        data = self._file.read(-1 if size is None else size)
        Counting.total += len(data)
        return data

    def seek(self, offset: int, whence: int = 0, /) -> int:
        return self._file.seek(offset, whence)

    def close(self) -> None:
        super().close()
        if hasattr(self, "_file"):
            self._file.close()


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> type[Counting]:
    opened = container.open_file
    monkeypatch.setattr(container, "open_file", lambda path: Counting(opened(path)))
    monkeypatch.setattr(Counting, "total", 0)
    return Counting


@pytest.mark.parametrize(
    ("make", "size"),
    [(zeros, GB // 2), (zeros, 100 * GB), (zeros_behind_records, 100 * GB), (attachments, GB)],
)
def test_a_start_reads_little_of_it_and_continues_what_was_recorded(
    tmp_path: Path, counted: type[Counting], make: Callable[[Path, int], None], size: int
) -> None:
    private, public = write_key(tmp_path, "machine", 7)

    def start(seq: int) -> Service:
        return Service(tmp_path / "rec", seq=seq, signer=Signer(private), head=tmp_path / "head.json")

    start(0).run(6).kill()
    (real,) = recordings(tmp_path / "rec", MACHINE)
    large = tmp_path / "rec" / NEWER
    make(large, size)
    large = large if large.exists() else real
    original = real.read_bytes()[: 10**6] if large != real else b""
    counted.total = 0
    assert first_sequence(tmp_path / "rec", MACHINE, START_NS + 6 * MINUTE_NS, 60.0) >= 6
    service = start(6).run(1)
    # Twice in front of the first sample, and beside it by what compacts files.
    service.recorder._finisher.wait()
    assert counted.total < (8 * LONGEST if make is attachments else LONGEST * 3 // 2)
    said = [words for words, _ in service.recorder.remarks() if large.name in words]
    assert len(said) == 1 and "remains unchanged" in said[0] and "\n" not in said[0]
    service.run(5).stop()
    counted.total = 0
    found = audit(recordings(tmp_path / "rec", MACHINE), public_key=public)
    assert counted.total < 2 * LONGEST
    assert found.samples == 12 and {finding.file for finding in found.findings} == {large.name}, summary(found)
    assert "damaged" in {finding.kind for finding in found.findings}
    if original:
        large.unlink()
        assert audit(recordings(tmp_path / "rec", MACHINE), public_key=public).clean


@pytest.mark.parametrize("make", [messages, chunks])
def test_no_more_than_the_limit_is_read_of_any_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, counted: type[Counting], make: Callable[[Path, int, int], None]
) -> None:
    monkeypatch.setattr(container, "LARGEST", 2**22)
    path = tmp_path / NEWER
    make(path, 2**23, 10**5)
    found = audit([path])
    assert "damaged" in {finding.kind for finding in found.findings} and "more than 4194304 bytes" in summary(found)
    assert counted.total <= 2**23 and last_value(path) == b""
    monkeypatch.setattr(container, "LARGEST", LARGEST)
    assert "more than" not in summary(audit([path]))


def test_a_recorder_goes_on_in_a_new_file_before_one_is_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert FULL <= LARGEST // 4  # a batch is written at once, and a compact file holds its chunks twice
    monkeypatch.setattr(live_file, "FULL", 50_000)
    service = Service(tmp_path).run(30)
    # What is synced together stays in one file: should the disk refuse it, all of it is written again.
    for number in range(30):
        service.note("long", "x" * 5000)
        events = [("event", encode(event)) for event in service.events]
        service.events = []
        service.recorder.write(events, service.now_ns, state=service.compensation.state(), sync=number == 29)
    service.run(30).stop()
    files = recordings(tmp_path, MACHINE)
    sizes = [len(lines_of(path)[0]) for path in files]
    assert len(files) > 4 and max(sizes) > 60, sizes
    found = audit(files)
    assert found.clean and found.samples == 60 and not found.remarks, summary(found)
    assert [file.began for file in found.files] == ["start", *["day"] * (len(files) - 1)]
