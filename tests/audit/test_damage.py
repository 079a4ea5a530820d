"""Damage anywhere in a file is a finding with its place, and the other files are audited; bytes outside records."""

from __future__ import annotations

import os
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap.writer import Writer

from compensator.audit.machine_audit import Audit, audit, summary
from compensator.cli import main
from compensator.recording.container import MAGIC
from compensator.recording.framing import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    MESSAGE,
    SCHEMA,
    SUMMARY_OFFSET,
)
from compensator.recording.reading import recordings, recordings_in
from tests.audit.made import MACHINE, Service

SEEDS = range(40)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, bytes]]:
    folder = tmp_path_factory.mktemp("damage")
    for seq in (0, 6, 12):
        Service(folder, seq=seq).run(6).stop()
    return [(path.name, path.read_bytes()) for path in recordings(folder, MACHINE)]


def placed(folder: Path, made: list[tuple[str, bytes]], which: int, data: bytes) -> list[Path]:
    for i, (name, original) in enumerate(made):
        (folder / name).write_bytes(data if i == which else original)
    return [folder / name for name, _ in made]


def records(data: bytes) -> list[tuple[int, int, int]]:
    """Kind, place and length with head of each record of a file."""
    at, found = len(MAGIC), []
    while at < len(data) - len(MAGIC):
        code, length = struct.unpack_from("<BQ", data, at)
        found.append((code, at, 9 + length))
        at += 9 + length
    return found


def first_chunk(data: bytes) -> tuple[int, int]:
    return next((at, length) for code, at, length in records(data) if code == CHUNK)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_flipped_bit_in_the_first_chunk_names_its_place_and_stops_nothing(
    tmp_path: Path, made: list[tuple[str, bytes]], which: int
) -> None:
    rng = random.Random(which)
    name, data = made[which]
    at, length = first_chunk(data)
    for _ in range(15):
        changed = bytearray(data)
        changed[rng.randrange(at, at + length)] ^= 1 << rng.randrange(8)
        found = audit(placed(tmp_path, made, which, bytes(changed)))
        assert not found.clean and found.samples >= 12, summary(found)
        assert {finding.file for finding in found.findings} == {name}
        assert any(finding.kind in ("damaged", "index") and "byte" in finding.line() for finding in found.findings)


def test_the_first_bytes_of_a_file(tmp_path: Path, made: list[tuple[str, bytes]]) -> None:
    for at in range(len(MAGIC)):
        changed = bytearray(made[1][1])
        changed[at] ^= 4
        found = audit(placed(tmp_path, made, 1, bytes(changed)))
        assert [finding.kind for finding in found.findings] == ["damaged"] and "byte 0" in found.findings[0].line()
        assert found.samples == 12


def test_the_command_gives_3_and_audits_the_others(
    tmp_path: Path, made: list[tuple[str, bytes]], capsys: pytest.CaptureFixture[str]
) -> None:
    name, data = made[0]
    at, _ = first_chunk(data)
    changed = bytearray(data)
    changed[at + 60] ^= 1
    paths = placed(tmp_path, made, 0, bytes(changed))
    assert main(["replay", *map(str, paths)]) == 3
    shown = capsys.readouterr().out
    assert f"{name}: damaged: byte {at}" in shown and "12 samples" in shown
    # What has neither the name nor the bytes of a recording is a mistake.
    table = tmp_path / "table.csv"
    table.write_bytes(b"t_s,y_um\n0,1\n")
    assert main(["replay", *map(str, paths), str(table)]) == 2


@pytest.mark.parametrize("count", [1, 63, 64, 5000, 200_000])
def test_zeros_behind_the_end_of_a_file_are_found(
    tmp_path: Path, made: list[tuple[str, bytes]], unfinished: bytes, count: int
) -> None:
    """A power cut leaves them where something was to be written: in a file without its end."""
    found = audit(placed(tmp_path, made, 1, made[1][1] + bytes(count)))
    assert [(finding.kind, finding.file) for finding in found.findings] == [("damaged", made[1][0])], summary(found)
    assert f"{count} bytes after the end of the file" in found.findings[0].line() and found.samples == 18
    live = tmp_path / f"{MACHINE}_20260105T061800Z.mcap"
    live.write_bytes(unfinished + bytes(count))
    assert audit([live]).clean


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The newest file of a service that runs on."""
    live = Service(tmp_path_factory.mktemp("live"), seq=18).run(6)
    path = live.recorder.path
    assert path is not None
    live.kill()
    return path.read_bytes()


@pytest.mark.parametrize("length", [1, 4, 8, 100, 4096, 10**6])
@pytest.mark.parametrize("other", [b"\0", b"t_s,y_um\n0,1\n"])
@pytest.mark.parametrize("alone", [False, True])
def test_the_beginning_of_the_newest_file(
    tmp_path: Path,
    made: list[tuple[str, bytes]],
    unfinished: bytes,
    length: int,
    other: bytes,
    alone: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Nothing at its end shows that it was a recording, but its name does."""
    if not alone:
        placed(tmp_path, made, -1, b"")
    path = tmp_path / f"{MACHINE}_20260105T061800Z.mcap"
    length = min(length, len(unfinished))
    path.write_bytes((other * length)[:length] + unfinished[length:])
    assert main(["replay", str(tmp_path)]) == 3
    shown = capsys.readouterr().out
    assert f"{path.name}: damaged: byte 0: " in shown and f"{0 if alone else 18} samples" in shown


@pytest.mark.parametrize("data", [b"\0" * 7, b"\0" * 10**5, b"7 bytes", MAGIC + b"\x01" + bytes(7), b"a shop's"])
def test_a_file_with_the_name_of_a_recording_does_not_prevent_the_audit_of_the_others(
    tmp_path: Path, made: list[tuple[str, bytes]], data: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    placed(tmp_path, made, -1, b"")
    path = tmp_path / f"{MACHINE}_20270101T000000Z.mcap"
    path.write_bytes(data)
    if data == b"a shop's":
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            writer.add_message(writer.register_channel("/shop/vmc-07/thermal/sample", "json", 0), 0, b"{}", 0)
            writer.finish()
        assert main(["replay", str(path)]) == 2  # by itself it is a mistake
    assert main(["replay", str(tmp_path)]) == (0 if data.startswith(MAGIC) else 3)
    shown = capsys.readouterr().out
    assert path.name in shown and "18 samples" in shown


@pytest.mark.parametrize("what", ["folder", "loop", "nothing", "pipe", "device"])
@pytest.mark.parametrize("place", ["x.mcap", "first", "last"])
def test_what_is_no_file_among_recordings_is_a_finding(
    tmp_path: Path, made: list[tuple[str, bytes]], what: str, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = placed(tmp_path, made, -1, b"")
    path = {"first": paths[0], "last": paths[-1]}.get(place, tmp_path / place)
    path.unlink(missing_ok=True)
    if what == "folder":
        path.mkdir()
    elif what == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to({"loop": path.name, "nothing": "none", "device": "/dev/zero"}[what])
    for given in ([tmp_path], sorted(tmp_path.iterdir())):
        assert main(["replay", *map(str, given)]) == 3
        shown = capsys.readouterr().out
        assert f"{path.name}: damaged: not read: " in shown
        assert f"{18 if place == 'x.mcap' else 12} samples" in shown and "differ in the replay" not in shown
    # By itself it is a mistake.
    assert main(["replay", str(path)]) == 2
    assert main(["replay", str(tmp_path), str(tmp_path / "missing.mcap")]) == 2


# ------------------------------------------------------------------ bytes outside records


def _resealed(data: bytearray) -> bytes:
    """Both CRCs at the end made to fit."""
    there = records(bytes(data))
    end = next(at for code, at, _ in there if code == DATA_END)
    struct.pack_into("<I", data, end + 9, zlib.crc32(data[:end]))
    footer = next(at for code, at, _ in there if code == FOOTER)
    summary_at = end + next(length for code, at, length in there if code == DATA_END)
    struct.pack_into("<I", data, footer + 25, zlib.crc32(data[summary_at : footer + 25]))
    return bytes(data)


def header(data: bytes) -> bytes:
    return _resealed(bytearray(data.replace(b"compensator 0", b"compensatos 0", 1)))


def data_crc(data: bytes) -> bytes:
    changed = bytearray(data)
    struct.pack_into("<I", changed, next(at for code, at, _ in records(data) if code == DATA_END) + 9, 0)
    return bytes(changed)


def summary_crc(data: bytes) -> bytes:
    changed = bytearray(data)
    struct.pack_into("<I", changed, next(at for code, at, _ in records(data) if code == FOOTER) + 25, 0)
    return bytes(changed)


def chunk_crc(data: bytes) -> bytes:
    changed = bytearray(data)
    struct.pack_into("<I", changed, first_chunk(data)[0] + 9 + 24, 0)
    return _resealed(changed)


def attachment_crc(data: bytes) -> bytes:
    changed = bytearray(data)
    at, length = next((at, length) for code, at, length in records(data) if code == ATTACHMENT)
    struct.pack_into("<I", changed, at + length - 4, 0)
    return _resealed(changed)


def summary_offsets(data: bytes) -> bytes:
    there = records(data)
    first = next(at for code, at, _ in there if code == SUMMARY_OFFSET)
    footer, length = next((at, length) for code, at, length in there if code == FOOTER)
    end = bytearray(data[footer : footer + length])
    struct.pack_into("<Q", end, 9 + 8, 0)
    return _resealed(bytearray(data[:first] + bytes(end) + data[footer + length :]))


@pytest.mark.parametrize("change", [header, data_crc, summary_crc, chunk_crc, attachment_crc, summary_offsets])
def test_bytes_that_carry_no_record_are_remarked_on(
    tmp_path: Path, made: list[tuple[str, bytes]], change: Callable[[bytes], bytes]
) -> None:
    assert "outside_chain" not in _codes(audit(placed(tmp_path, made, 1, made[1][1])))
    changed = change(made[1][1])
    assert changed != made[1][1]
    found = audit(placed(tmp_path, made, 1, changed))
    assert found.clean and _codes(found) == ["outside_chain"], summary(found)
    assert made[1][0] in found.remarks[-1]


def test_a_schema_that_no_channel_has(tmp_path: Path) -> None:
    live = Service(tmp_path).run(6)
    path = live.recorder.path
    assert path is not None
    live.kill()
    data = path.read_bytes()
    code, at, length = records(data)[0]
    assert code == HEADER
    body = struct.pack("<H", 99) + b"".join(struct.pack("<I", len(part)) + part for part in (b"ghost", b"", b"hidden"))
    extra = struct.pack("<BQ", SCHEMA, len(body)) + body
    path.write_bytes(data[: at + length] + extra + data[at + length :])
    found = audit([path])
    assert found.clean and "outside_chain" in _codes(found) and "ghost" in " ".join(found.remarks)


@pytest.mark.parametrize("place", ["first", "second", "middle", "last"])
@pytest.mark.parametrize("count", [1, 50])
def test_a_header_that_is_not_the_first_record_is_found(
    tmp_path: Path, unfinished: bytes, place: str, count: int
) -> None:
    path = tmp_path / f"{MACHINE}_20260105T061800Z.mcap"
    there = records(unfinished)
    code, at, length = there[0]
    assert code == HEADER
    before = {"first": 0, "second": 1, "middle": len(there) // 2, "last": len(there) - 1}[place]
    where = there[before][1]
    path.write_bytes(unfinished[:where] + unfinished[at : at + length] * count + unfinished[where:])
    found = audit([path])
    assert found.findings_count == count and found.samples == 6, summary(found)
    assert f"{path.name}: inserted: a header: is not at the start of the file" in found.findings[0].line()


def test_bytes_behind_the_content_of_a_chunk(tmp_path: Path, made: list[tuple[str, bytes]]) -> None:
    """A reader would not see them, and no CRC of the content covers them."""
    for extra in (b"approved", zstandard.ZstdCompressor().compress(b"approved")):
        data = made[1][1]
        at, length = first_chunk(data)
        body = bytearray(data[at + 9 : at + length])
        place = 8 + 8 + 8 + 4 + 4 + len("zstd")
        (size,) = struct.unpack_from("<Q", body, place)
        struct.pack_into("<Q", body, place, size + len(extra))
        chunk = struct.pack("<BQ", CHUNK, len(body) + len(extra)) + body + extra
        found = audit(placed(tmp_path, made, 1, data[:at] + chunk + data[at + length :]))
        assert f"damaged: byte {at}: a chunk that cannot be uncompressed" in summary(found)


@pytest.mark.parametrize("topic", ["/offset", "/sneaky", ""])
def test_a_schema_or_a_channel_after_the_first_message_is_found(tmp_path: Path, topic: str) -> None:
    """Another channel of a topic would show its messages under another schema, which the chain does not name."""
    live = Service(tmp_path).run(6)
    path = live.recorder.path
    assert path is not None
    live.kill()
    data, texts = path.read_bytes(), (b"forged", b"jsonschema", b'{"title": "y_offset in nm"}')
    there = records(data)
    body = struct.pack("<H", 999) + b"".join(struct.pack("<I", len(text)) + text for text in texts)
    extra = struct.pack("<BQ", SCHEMA, len(body)) + body
    if topic:
        texts = (topic.encode(), b"json", b"")
        channel = struct.pack("<HH", 77, 999) + b"".join(struct.pack("<I", len(text)) + text for text in texts)
        extra += struct.pack("<BQ", CHANNEL, len(channel)) + channel
    messages = [at for code, at, _ in there if code == MESSAGE]
    middle = messages[len(messages) // 2]
    own = [at for code, at, length in there if code == CHANNEL and b"/offset" in data[at : at + length]]
    changed = bytearray(data)
    for at in messages[len(messages) // 2 :]:
        if topic == "/offset" and changed[at + 9 : at + 11] == data[own[0] + 9 : own[0] + 11]:
            struct.pack_into("<H", changed, at + 9, 77)
    path.write_bytes(bytes(changed[:middle]) + extra + bytes(changed[middle:]))
    found = audit([path])
    assert not found.clean and {finding.kind for finding in found.findings} == {"inserted"}, summary(found)
    assert any("forged" in finding.line() for finding in found.findings)


def _codes(found: Audit) -> list[str]:
    return [str(remark.code) for remark in found.remarks]


def test_what_a_copy_over_a_network_leaves_beside_a_recording_is_no_recording(tmp_path: Path) -> None:
    Service(tmp_path).run(3).stop()
    (path,) = recordings_in([tmp_path])
    (tmp_path / f"._{path.name}").write_bytes(b"\x00\x05\x16\x07 resource fork")
    assert recordings_in([tmp_path]) == [path]
    assert audit(recordings_in([tmp_path])).clean
