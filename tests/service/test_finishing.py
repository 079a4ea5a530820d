"""Finished recordings: compact, indexed, checked, kept as long as wanted; until then the live file stays."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader, make_reader

from compensator.audit.machine_audit import audit
from compensator.errors import DataError
from compensator.recording import compaction, finishing
from compensator.recording.container import Contents
from compensator.recording.finishing import Finisher, Retention, compact
from compensator.recording.reading import read_messages, recordings
from compensator.recording.recorder import McapRecorder
from tests.audit.made import CONFIG, MACHINE, MINUTE_NS, Service
from tests.audit.tampering import Line, end_of_chain, lines_of, rewrite
from tests.service.simulated import START_NS

DAY_NS = 1440 * MINUTE_NS


def live(folder: Path, samples: int = 20) -> Path:
    """A recording as a kill leaves it."""
    service = Service(folder).run(samples)
    service.kill()
    assert service.recorder.path is not None
    return service.recorder.path


def test_a_finished_file_has_chunks_an_index_and_crcs(tmp_path: Path) -> None:
    Service(tmp_path).run(50).stop()
    (path,) = recordings(tmp_path, MACHINE)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count == 1
        assert summary.chunk_indexes[0].compression == "zstd"
        assert {channel.topic for channel in summary.channels.values()} == {
            "/sample",
            "/estimate",
            "/offset",
            "/event",
            "/seal",
            "/chain",
        }
        assert len(summary.schemas) == 6 and len(summary.metadata_indexes) == 1
        assert [a.name for a in reader.iter_attachments()] == ["config.toml", "model.toml", "state.json"]
        sought = [(channel.topic, message.data) for _, channel, message in reader.iter_messages()]
        start = START_NS + 10 * MINUTE_NS
        some = list(reader.iter_messages("/offset", starting_at=start, ending_before=start + 5 * MINUTE_NS))
    assert len(some) == 5
    with path.open("rb") as file:
        walked = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        assert [(channel.topic, message.data) for _, channel, message in walked] == sought
    assert summary.statistics.message_count == len(sought)


def test_the_compact_file_says_what_the_live_one_said(tmp_path: Path) -> None:
    path = live(tmp_path)
    before, size, end = list(read_messages(path)), path.stat().st_size, end_of_chain(path)
    assert end is not None and not end.chunked and not end.whole
    said = compact(path)
    assert "it had no end; 0 complete record(s)" in said
    after, new = list(read_messages(path)), end_of_chain(path)
    assert after[: len(before)] == before and [m.topic for m in after[len(before) :]] == ["seal", "chain"]
    assert new is not None and new.value == end.value and new.chunked and new.whole and new.sealed == "recovered"
    assert path.stat().st_size < 0.6 * size
    assert not list(tmp_path.glob("*.part"))
    assert compact(path) == "" and list(read_messages(path)) == after


@pytest.mark.parametrize("zeros", [0, 4096], ids=["bytes missing", "zeros in their place"])
def test_every_whole_record_of_a_torn_end_is_kept(tmp_path: Path, zeros: int) -> None:
    """A power cut leaves the length of a file and zeros where its last pages were, also within a record."""
    path = live(tmp_path, 8)
    data = path.read_bytes()
    for cut in range(data.index(b'"seq":7,') - 60, len(data), 37):
        path.write_bytes(data[:cut] + bytes(zeros))
        before, end = [m for m in read_messages(path) if m.topic != "chain"], end_of_chain(path)
        compact(path)
        after = [m for m in read_messages(path) if m.topic != "chain"]
        assert after[:-1] == before and after[-1].topic == "seal"
        new = end_of_chain(path)
        assert end is not None and new is not None and new.value == end.value
        assert audit([path]).clean


@pytest.mark.parametrize("what", ["write", "read back", "kill"])
def test_whatever_happens_meanwhile_the_live_file_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    path = live(tmp_path)
    data = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    def killed(*_: object) -> None:
        raise SystemExit

    if what == "write":
        monkeypatch.setattr(compaction.os, "fsync", full)
    elif what == "read back":
        monkeypatch.setattr(compaction, "_digest", lambda *_: "another")
    else:
        monkeypatch.setattr(compaction, "_digest", killed)
    with pytest.raises((OSError, DataError, SystemExit)):
        compact(path)
    assert path.read_bytes() == data and list(tmp_path.iterdir()) == [path]


def test_what_a_kill_leaves_of_a_copy_is_written_anew(tmp_path: Path) -> None:
    path = live(tmp_path)
    part = path.with_suffix(".mcap.part")
    part.write_bytes(b"half a copy")
    assert recordings(tmp_path, MACHINE) == [path]
    compact(path)
    assert not part.exists() and audit([path]).clean


def test_a_failure_is_said_and_the_recording_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compaction, "_digest", lambda *_: "another")
    service = Service(tmp_path).run(5)
    service.recorder.start_new()
    service.run(5).stop()
    remarks = service.recorder.remarks()
    assert len(remarks) == 2 and "could not be compacted and remains unchanged" in remarks[0][0]
    found = audit(recordings(tmp_path, MACHINE))
    assert found.clean and found.samples == 10


def test_a_file_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    service = Service(tmp_path).run(5)
    path = service.recorder.path
    assert path is not None
    data = path.read_bytes()
    assert compact(path) == "" and path.read_bytes() == data
    service.run(5).stop()
    assert audit([path]).samples == 10


def test_a_pipe_with_the_name_of_a_recording_is_refused_and_the_service_ends(tmp_path: Path) -> None:
    service = Service(tmp_path).run(3)
    os.mkfifo(pipe := tmp_path / f"{MACHINE}_20250101T000000Z.mcap")
    finisher = Finisher(tmp_path, MACHINE, Retention(), None)
    finisher.enqueue(pipe, service.now_ns)
    waits = threading.Thread(target=finisher.wait, daemon=True)
    waits.start()
    waits.join(5.0)
    try:
        assert not waits.is_alive()
        assert any("not a regular file" in text for text, _ in finisher.remarks())
    finally:
        os.close(os.open(pipe, os.O_RDWR))  # where it waits for a writer, it has one now
        service.stop()


def _other_hash(contents: Contents) -> None:
    contents.run["previous_chain"] = "no hash"


def _no_seals(contents: Contents) -> None:
    number = next(number for number, channel in contents.channels.items() if channel.topic == "/seal")
    del contents.channels[number]


def _last_number(lines: list[Line]) -> list[Line]:
    return [*lines[:-1], replace(lines[-1], sequence=2**32 - 1)]


@pytest.mark.parametrize(
    ("edit", "contents"),
    [(list, _other_hash), (list, _no_seals), (_last_number, None)],
    ids=["a hash that is none", "a channel is missing", "the last number of a record"],
)
def test_what_no_recorder_writes_stays_and_later_files_are_finished(
    tmp_path: Path, edit: Callable[[list[Line]], list[Line]], contents: Callable[[Contents], None] | None
) -> None:
    path = live(tmp_path, 5)
    rewrite(path, edit, contents=contents, chunked=False)
    path.write_bytes(path.read_bytes()[:-30])  # without its end, as a kill leaves it
    data = path.read_bytes()
    service = Service(tmp_path, seq=10).run(5)
    service.recorder._finisher.wait()
    service.recorder.start_new()
    service.run(5).stop()
    assert path.read_bytes() == data
    assert any(f"{path.name}: could not be compacted" in text for text, _ in service.recorder.remarks())
    later = [end_of_chain(one) for one in recordings(tmp_path, MACHINE)[1:]]
    assert len(later) == 2 and all(end is not None and end.chunked for end in later)


def test_older_and_damaged_files_are_left_alone(tmp_path: Path) -> None:
    path = live(tmp_path)
    data = bytearray(path.read_bytes())
    data[data.index(b'{"schema":1,"machine":"vmc-07","seq":5,') - 27] = 0xFF  # a length beyond all bounds
    path.write_bytes(data)
    with pytest.raises(DataError, match="a record of"):
        compact(path)
    assert path.read_bytes() == data
    other = live(tmp_path / "older")
    rewrite(other, lambda lines: [line for line in lines if line.topic not in ("chain", "seal")], chunked=False)
    data = bytearray(other.read_bytes())
    assert compact(other) == "" and other.read_bytes() == data


def test_samples_do_not_wait_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow(*_: object, **__: object) -> str:
        begun.set()
        assert go_on.wait(10.0)
        return ""

    monkeypatch.setattr(finishing, "compact", slow)
    service = Service(tmp_path).run(5)
    service.recorder.start_new()
    assert begun.wait(10.0)
    service.run(5)  # on disk while the file before is still being worked on
    assert [len(lines_of_live(path)) for path in recordings(tmp_path, MACHINE)] == [5, 5]
    go_on.set()
    service.stop()
    assert not [thread for thread in threading.enumerate() if thread.name == "finish recordings"]


def lines_of_live(path: Path) -> list[bytes]:
    return [record.data for record in read_messages(path, ("sample",))]


# ------------------------------------------------------------------ retention


def days(folder: Path, count: int, **keep: float) -> Service:
    """A recording a day."""
    service = Service(folder, retention=Retention(**keep))
    for day in range(count):
        service.start_ns = START_NS + day * DAY_NS - service.seq * MINUTE_NS
        service.run(5)
        service.recorder._finisher.wait()
    return service


def test_without_a_limit_everything_is_kept(tmp_path: Path) -> None:
    days(tmp_path, 5).stop()
    assert len(recordings(tmp_path, MACHINE)) == 5


def test_old_files_are_removed_and_the_audit_says_where_it_begins(tmp_path: Path) -> None:
    service = days(tmp_path, 6, keep_days=2.5)
    remarks = service.recorder.remarks()
    assert [remark[1]["removed"][0][:15] for remark in remarks] == ["vmc-07_20260105", "vmc-07_20260106"]
    for text, data in remarks:
        service.note("recording", text, data)
    service.run(1).kill()
    names = [path.name[7:15] for path in recordings(tmp_path, MACHINE)]
    assert names == ["20260107", "20260108", "20260109", "20260110"]
    found = audit(recordings(tmp_path, MACHINE))
    assert found.clean
    assert "continues vmc-07_20260106T060000Z.mcap, which the retention limit removed" in " ".join(found.remarks)


@pytest.mark.parametrize("ahead_days", [30, 1100])
def test_a_clock_that_is_ahead_for_some_minutes_or_days_makes_no_recording_old(tmp_path: Path, ahead_days: int) -> None:
    service = days(tmp_path, 6, keep_days=10.0)
    for moved_days in (ahead_days, ahead_days + 1, ahead_days + 2, 6, 7):
        service.start_ns = START_NS + moved_days * DAY_NS - service.seq * MINUTE_NS
        service.run(5)
        service.recorder._finisher.wait()
    service.stop()
    assert len(recordings(tmp_path, MACHINE)) == 11 and service.recorder.remarks() == []


@pytest.mark.parametrize("is_full", [False, True])
def test_recordings_go_on_growing_old_after_a_start_with_the_clock_ahead(tmp_path: Path, is_full: bool) -> None:
    """Names are in order, so those of all later ones are ahead, too."""
    times: dict[Path, int] = {}
    for day in (0, 1, 2, 733, *range(3, 45)):
        at_ns = START_NS + day * DAY_NS
        recorder = McapRecorder(tmp_path, MACHINE, {"config.toml": CONFIG})
        recorder.write([("event", b"{}")], at_ns)
        recorder.close()
        assert recorder.path is not None
        times[recorder.path] = at_ns
    for path, at_ns in times.items():
        os.utime(path, ns=(at_ns, at_ns))
    assert sum("_20280108T" in path.name for path in times) == 43
    finisher = Finisher(tmp_path, MACHINE, Retention(keep_days=10.0), None)
    if is_full:
        finisher.make_room(START_NS)  # a clock at its beginning makes nothing old
        finisher.wait()
        assert len(recordings(tmp_path, MACHINE)) == len(times)
        finisher.make_room(START_NS + 45 * DAY_NS)
    else:
        finisher.enqueue(list(times)[-1], START_NS + 45 * DAY_NS)
    finisher.wait()
    assert recordings(tmp_path, MACHINE) == list(times)[-10:]


def test_after_a_holiday_recordings_are_old_once_a_week_has_confirmed_the_clock(tmp_path: Path) -> None:
    service, left = days(tmp_path, 3, keep_days=10.0), []
    for day in range(30, 40):
        service.start_ns = START_NS + day * DAY_NS - service.seq * MINUTE_NS
        service.run(5)
        service.recorder._finisher.wait()
        left.append(len(recordings(tmp_path, MACHINE)))
    service.stop()
    assert left == [4, 5, 6, 7, 8, 9, 10, 11, 9, 10]


def test_the_size_of_all_files_is_limited_and_the_newest_stay(tmp_path: Path) -> None:
    service = days(tmp_path, 6, keep_mb=0.05)
    service.stop()
    left = recordings(tmp_path, MACHINE)
    assert 2 <= len(left) < 6 and left[-1] == service.recorder.path
    tiny = days(tmp_path / "tiny", 5, keep_mb=0.000001)
    tiny.stop()
    assert len(recordings(tmp_path / "tiny", MACHINE)) == 2  # the newest and the one before it: a restart needs them


def test_a_disk_that_refuses_the_copy_is_made_room_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No file can be made compact; what is beyond the limit goes all the same, and the newest two stay."""

    def full(*_: object, **__: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(finishing, "compact", full)
    service = days(tmp_path, 6, keep_days=2.5)
    remarks = service.recorder.remarks()
    assert [data["removed"][0][7:15] for _, data in remarks if "removed" in data] == ["20260105", "20260106"]
    assert sum("could not be compacted and remains unchanged" in text for text, _ in remarks) >= 5
    live = service.recorder.path
    service.kill()
    left = recordings(tmp_path, MACHINE)
    assert [path.name[7:15] for path in left] == ["20260107", "20260108", "20260109", "20260110"] and left[-1] == live
    monkeypatch.undo()
    # Once the disk takes it the next finished file brings those along that it refused.
    finisher = service.recorder._finisher
    finisher.enqueue(left[-1], service.now_ns - DAY_NS)
    finisher.wait()
    assert all(lines_of(path)[1].chunked for path in left)
    assert audit(left).clean


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False, timeout=30).returncode:
        pytest.skip("a file system can be mounted by root only, and not in every container")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], capture_output=True, check=False, timeout=30)


def test_on_a_full_disk_the_limit_makes_the_room_that_the_recording_needs(small_disk: Path) -> None:
    # Finished files are small: several must go for a live one.
    service = days(small_disk, 9, keep_days=8.5)
    service.recorder._finisher.wait()
    before = recordings(small_disk, MACHINE)
    with (small_disk / "other").open("wb", buffering=0) as other, suppress(OSError):
        while other.write(bytes(4096)) == 4096:
            pass
    # Two weeks later: the day's end does not fit any more, nor does the new file.
    service.start_ns += 14 * DAY_NS
    with pytest.raises(OSError, match="No space"):
        service._write([], service.compensation.state())
    service.recorder._finisher.wait()
    left = recordings(small_disk, MACHINE)
    assert left == before[-2:]  # the limit has no use for the newest two, a restart has
    service.run(5)
    service.recorder._finisher.wait()
    remarks = service.recorder.remarks()
    assert [name for _, data in remarks for name in data.get("removed", [])] == [path.name for path in before[:-2]]
    for text, data in remarks:
        service.note("recording", text, data)
    service.run(1).stop()
    found = audit(recordings(small_disk, MACHINE))
    assert found.clean, found.findings
    assert f"continues {before[-3].name}, which the retention limit removed" in " ".join(found.remarks)


def test_over_weeks_the_folder_stays_below_the_limit(tmp_path: Path) -> None:
    keep_mb, sizes, removed = 0.22, [], 0
    service = Service(tmp_path, retention=Retention(keep_mb=keep_mb))
    for day in range(21):
        service.start_ns = START_NS + day * DAY_NS - service.seq * MINUTE_NS
        service.run(12)
        service.recorder._finisher.wait()
        live = service.recorder.path
        sizes.append(sum(path.stat().st_size for path in recordings(tmp_path, MACHINE) if path != live))
        for text, data in service.recorder.remarks():
            removed += len(data["removed"])
            service.note("recording", text, data)
    service.stop()
    # The file that ends now may be the one that passes the limit.
    at_end = [name for _, data in service.recorder.remarks() for name in data["removed"]]
    removed += len(at_end)
    assert max(sizes) <= keep_mb * 1e6 and max(sizes[:4]) < 0.7 * max(sizes[10:])
    left = recordings(tmp_path, MACHINE)
    assert removed == 21 - len(left) and len(left) > 5
    found = audit(left)
    assert found.clean, found.findings
    before = found.files[0].previous_file
    # What is removed at the end only the next start can say.
    words = f"continues {before}" + ("" if before in at_end else ", which the retention limit removed")
    assert before and any(words in remark for remark in found.remarks)


def test_files_of_others_are_not_touched(tmp_path: Path) -> None:
    tmp_path.mkdir(exist_ok=True)
    others = [tmp_path / "notes.txt", tmp_path / "vmc-08_20200101T000000Z.mcap"]
    for path in others:
        path.write_bytes(b"not ours")
    finisher = Finisher(tmp_path, MACHINE, Retention(keep_days=1.0), None)
    service = days(tmp_path, 4, keep_days=1.0)
    finisher.enqueue(others[1], service.now_ns)
    finisher.wait()
    service.stop()
    assert all(path.read_bytes() == b"not ours" for path in others)
    assert lines_of(recordings(tmp_path, MACHINE)[-1])[0]
