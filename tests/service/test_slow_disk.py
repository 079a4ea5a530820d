"""A disk that takes its time: polling goes on, nothing is lost, and whoever uses the offset is told."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.audit.machine_audit import Audit, audit, summary
from compensator.messages import Event, Offset
from compensator.recording.reading import read_messages, recordings
from compensator.service import disk_writer
from tests.audit.made import CONFIG, MACHINE, QUILL
from tests.service.simulated import Bench


class Disk:
    """Stands still between `stop` and `go_on`: what is being written then does not end, and nobody waits for it."""

    def __init__(self, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
        self._moves = threading.Event()
        self._moves.set()
        self._reached = threading.Event()
        self.error: OSError | None = None
        self._patient = False
        write, settle = bench.recorder.write, bench.clock.settle

        def slow(*arguments: Any, **rest: Any) -> None:
            self._reached.set()
            assert self._moves.wait(60.0)
            if self.error is not None:
                raise self.error
            write(*arguments, **rest)

        async def impatient(tasks: Collection[asyncio.Future[Any]], timeout_s: float) -> None:
            disk = any(not isinstance(task, asyncio.Task) for task in tasks)
            if disk and self._patient and timeout_s > 10.0:
                await settle(tasks, timeout_s)
                return
            if not disk or self._moves.is_set():
                await settle(tasks, timeout_s)
            while disk and not self._reached.is_set():
                await asyncio.sleep(0.001)

        monkeypatch.setattr(bench.recorder, "write", slow)
        monkeypatch.setattr(bench.clock, "settle", impatient)

    def stop(self) -> None:
        self._moves.clear()
        self._reached.clear()

    def stop_patiently(self) -> None:
        """Stop, and let whoever does not stand still for the disk wait as long as it takes."""
        self._patient = True
        self.stop()

    @property
    def moves(self) -> bool:
        return self._moves.is_set()

    def go_on(self, error: OSError | None = None) -> None:
        self.error = error
        self._moves.set()


def replayable(folder: Path) -> Bench:
    bench = Bench(folder)
    bench.recorder.attachments = {"config.toml": CONFIG, "model.toml": QUILL}
    return bench


def sent(bench: Bench) -> list[Offset]:
    return [msgspec.json.decode(data, type=Offset) for name, data in bench.published if name == "offset"]


def logged(folder: Path) -> list[Offset]:
    return [
        msgspec.json.decode(record.data, type=Offset)
        for path in recordings(folder, MACHINE)
        for record in read_messages(path, ("offset",))
    ]


def events(bench: Bench, kind: str = "recording") -> list[Event]:
    told = [msgspec.json.decode(data, type=Event) for name, data in bench.published if name == "event"]
    return [event for event in told if event.kind == kind]


def look(folder: Path) -> Audit:
    return audit(recordings(folder, MACHINE))


def at(bench: Bench, actions: dict[int, Callable[[], Any]]) -> None:
    bench.at_sample.update(actions)


async def test_polling_goes_on_nothing_is_lost_and_the_receiver_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = replayable(tmp_path)
    disk = Disk(bench, monkeypatch)
    at(
        bench,
        {
            10: disk.stop,
            20: lambda: bench.daemon.command("hold", b""),
            30: disk.go_on,
            35: lambda: bench.daemon.command("resume", b""),
        },
    )
    await bench.run(50)
    offsets = sent(bench)
    assert [o.seq for o in offsets] == list(range(50))
    late = [o.seq for o in offsets if "recording_late" in o.reasons]
    assert late == list(range(10, 30))
    assert all(o.state in ("degraded", "hold") and o.y_offset_um is not None for o in offsets[10:30])
    assert all(o.sample.channels["t_q_degc"].polls == 6 for o in bench.outcomes[1:])  # no poll was left out
    # Everything is on disk once and in order, as it was published; of the one that was being written an event tells.
    recorded = logged(tmp_path / "rec")
    assert [o.seq for o in recorded] == list(range(50))
    assert [a.seq for a, b in zip(recorded, offsets, strict=True) if a != b] == [10]
    assert [e.data.get("published_early") for e in events(bench)] == [10, None]
    assert events(bench)[1].text == "the disk accepts the recording again; nothing was lost"
    found = look(tmp_path / "rec")
    assert found.clean and found.samples == 50 and sum(file.early for file in found.files) == 20, summary(found)
    assert "20 offset(s) were published before they were on disk" in summary(found)


async def test_an_offset_waits_for_the_disk_while_polling_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that needs three poll intervals: on record first, then published; no poll is left out, nothing is late."""
    bench = replayable(tmp_path)
    disk = Disk(bench, monkeypatch)
    polls_while_waiting: list[int] = []
    read = bench.device.read

    async def counted() -> Any:
        if not disk.moves:
            polls_while_waiting.append(len(sent(bench)))
            if len(polls_while_waiting) == 3:
                disk.go_on()
        return await read()

    monkeypatch.setattr(bench.device, "read", counted)
    at(bench, {10: disk.stop_patiently})
    await bench.run(20)
    assert polls_while_waiting == [10, 10, 10]  # the eleventh is decided, waits, and is not out
    assert [o.seq for o in sent(bench)] == list(range(20))
    assert not any("recording_late" in o.reasons for o in sent(bench))
    assert not events(bench)
    assert logged(tmp_path / "rec") == sent(bench)
    assert look(tmp_path / "rec").clean


async def test_a_disk_that_hangs_and_then_fails_gets_everything_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = replayable(tmp_path)
    disk = Disk(bench, monkeypatch)
    at(bench, {10: disk.stop, 15: lambda: disk.go_on(OSError(5, "Input/output error")), 20: disk.go_on})
    await bench.run(30)
    offsets = sent(bench)
    reasons = ["".join(o.reasons) for o in offsets]
    assert reasons[10:20] == ["recording_late"] * 5 + ["recording_failed"] * 5 and not any(reasons[20:])
    assert logged(tmp_path / "rec") == offsets
    found = look(tmp_path / "rec")
    assert found.clean and found.samples == 30, summary(found)


async def test_what_waits_is_bounded_and_what_is_given_up_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk_writer, "WAITING_SAMPLES", 8)
    bench = replayable(tmp_path)
    disk = Disk(bench, monkeypatch)

    def catch_up() -> None:
        disk.go_on()
        while bench.daemon._writer.waiting:
            time.sleep(0.001)

    at(bench, {10: disk.stop, 12: lambda: bench.daemon.command("zero", b'{"mode": "warm"}'), 30: catch_up})
    await bench.run(40)
    # The one that is being written and eight that wait; the zero that was set with one of the lost ones stands.
    assert [o.seq for o in logged(tmp_path / "rec")] == [*range(11), *range(22, 40)]
    assert events(bench)[-1].text == "the disk accepts the recording again; 11 sample(s) were not recorded"
    assert events(bench)[-1].data == {"code": "disk_back", "lost": 11}
    found = look(tmp_path / "rec")
    assert found.clean and found.samples == 29, summary(found)
    kept = [
        msgspec.json.decode(record.data, type=Event)
        for path in recordings(tmp_path / "rec", MACHINE)
        for record in read_messages(path, ("event",))
    ]
    assert [(e.seq, e.text) for e in kept if e.kind == "command"] == [(12, "zero")]


async def test_what_is_lost_at_the_end_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk_writer, "WAITING_SAMPLES", 8)
    bench = replayable(tmp_path)
    disk = Disk(bench, monkeypatch)
    at(bench, {10: lambda: disk.go_on(OSError(28, "No space left on device"))})
    await bench.run(30)
    assert [o.seq for o in logged(tmp_path / "rec")] == [*range(10)]
    # Those that wait, and those that were given up before: none of the twenty is on disk.
    lost = "20 sample(s) could not be written to disk"
    assert bench.daemon.unfinished == f"{lost}; the recording could not be finished: [Errno 28] No space left on device"


async def test_an_error_of_its_own_while_writing_is_said_and_heals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = replayable(tmp_path)
    disk = Disk(bench, monkeypatch)
    at(bench, {10: lambda: disk.go_on(ValueError("a defect")), 12: disk.go_on})  # type: ignore[arg-type]
    await bench.run(20)
    assert [o.seq for o in sent(bench) if "recording_failed" in o.reasons] == [10, 11]
    assert "internal error: ValueError: a defect" in events(bench)[0].text
    assert logged(tmp_path / "rec") == sent(bench)
    assert look(tmp_path / "rec").clean
