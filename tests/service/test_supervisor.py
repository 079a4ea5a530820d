"""Whatever goes wrong inside, the offset is held and it is said."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.audit.machine_audit import audit, summary
from compensator.config import parse_config
from compensator.messages import Offset, Sample
from compensator.recording.reading import decode, read_messages, recordings
from drivers.reading import Reading
from tests.audit.made import CONFIG, QUILL
from tests.service.simulated import Bench


@pytest.mark.parametrize("where", ["driver", "model"])
async def test_a_defect_holds_the_offset_until_resume(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    async def defective() -> Mapping[int, Reading]:
        raise ZeroDivisionError("a defect")

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    def break_it() -> None:
        if where == "driver":
            monkeypatch.setattr(bench.device, "read", defective)
        else:
            monkeypatch.setattr(bench.daemon._compensation, "process", broken)

    bench.at_sample[100] = break_it
    turns = 0

    async def repaired(seconds: float) -> None:
        nonlocal turns
        turns += 1
        if turns == 6 * 110:
            monkeypatch.undo()
        if turns == 6 * 115:
            bench.daemon.command("resume", b"")
        await type(bench.clock).sleep(bench.clock, seconds)

    bench.daemon._clock = _Sleeper(bench.clock, repaired)  # not by monkeypatch, which is undone half-way
    await bench.run(125)
    sent = [msgspec.json.decode(d, type=Offset) for n, d in bench.published if n == "offset"]
    assert [o.seq for o in sent] == list(range(125))
    held = sent[101:109]
    assert all(o.state == "hold" and "internal_error" in o.reasons for o in held)
    assert {o.y_offset_um for o in held} == {sent[99].y_offset_um}
    assert sent[112].state == "hold"  # nobody has looked at it yet
    assert sent[-1].state in ("ok", "degraded")
    told = [msgspec.json.decode(d)["text"] for n, d in bench.published if n == "event"]
    assert "internal error: ZeroDivisionError: a defect" in told


async def test_what_was_read_for_a_sample_that_failed_is_in_no_later_one(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A driver breaks off at the last poll of one sample; nobody may average its other readings into the next."""
    read, calls = bench.device.read, 0

    async def defective_once() -> Mapping[int, Reading]:
        nonlocal calls
        calls += 1
        if calls == 6 * 10:
            raise ZeroDivisionError("a defect")
        return await read()

    monkeypatch.setattr(bench.device, "read", defective_once)
    await bench.run(20)
    samples = [msgspec.json.decode(d, type=Sample) for n, d in bench.published if n == "sample"]
    assert len(samples) == 19
    assert {channel.polls for sample in samples for channel in sample.channels.values()} == {6}


@pytest.mark.parametrize("where", ["_guards.check", "_decision.decide", "plausibility.update", "_set_zero"])
async def test_a_sample_that_breaks_off_half_way_leaves_a_recording_that_audits_clean(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """What it had changed by then is in no record; the next file opens with the state that came of it."""
    bench = Bench(tmp_path, parse_config(CONFIG, source="test"))
    bench.recorder.attachments = {"config.toml": CONFIG, "model.toml": QUILL}
    monkeypatch.setattr(type(bench.daemon._compensation.plausibility), "is_on", True)

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    room, _, name = where.rpartition(".")
    compensation = bench.daemon._compensation
    broken_room = getattr(compensation, room) if room else compensation
    bench.at_sample[20] = lambda: setattr(broken_room, name, broken)
    bench.at_sample[19] = lambda: bench.daemon.command("zero", b'{"mode": "warm"}')

    def mend(error: str, text: str) -> None:
        delattr(broken_room, name)
        bench.daemon.command("resume", b"")

    note = bench.daemon._events.note
    errors: list[str] = []

    def noted(kind: str, text: str, data: dict[str, Any] | None = None) -> None:
        note(kind, text, data)
        if kind == "error":
            errors.append(text)
            if len(errors) == 3:
                mend(kind, text)

    bench.daemon._events.note = noted  # type: ignore[method-assign]
    await bench.run(40)
    assert errors == ["internal error: ZeroDivisionError: a defect"] * 3
    files = recordings(tmp_path / "rec", "vmc-07")
    found = audit(files)
    assert found.clean, summary(found)
    assert len(files) == 2 and [file.began for file in found.files] == ["start", "new"]
    assert found.samples == 37 and found.files[0].samples == 20
    said = [decode(record, files[0]).text for record in read_messages(files[0], ("event",))]  # type: ignore[union-attr]
    assert said.count(errors[0]) == 3  # why three samples are missing stands where they are missing
    offsets = [msgspec.json.decode(d, type=Offset) for n, d in bench.published if n == "offset"]
    assert [o.seq for o in offsets] == list(range(40))
    assert all(o.state == "hold" and "internal_error" in o.reasons for o in offsets[20:23])
    assert {o.y_offset_um for o in offsets[20:23]} == {offsets[19].y_offset_um}


async def test_a_stop_ends_the_wait_for_the_next_poll(bench: Bench, tmp_path: Path) -> None:
    """Polls may be an hour apart, and a service manager kills what has not ended after 90 s."""
    waits = asyncio.Event()

    async def endless(seconds: float) -> None:
        waits.set()
        await asyncio.get_running_loop().create_future()

    bench.daemon._clock = _Sleeper(bench.clock, endless)
    run = asyncio.create_task(bench.daemon.run())
    await waits.wait()
    bench.daemon.stop()
    await asyncio.wait_for(run, 10.0)
    (file,) = recordings(tmp_path / "rec", "vmc-07")
    assert file.read_bytes().endswith(b"\x89MCAP0\r\n")


async def test_a_stop_within_a_poll_lets_its_sample_end(bench: Bench) -> None:
    read, polls = bench.device.read, 0

    async def stopping() -> Mapping[int, Reading]:
        nonlocal polls
        polls += 1
        if polls == 12:
            bench.daemon.stop()
        return await read()

    bench.device.read = stopping  # type: ignore[method-assign]
    assert len(await bench.run(5)) == 2 and polls == 12


class _Sleeper:
    """A clock whose sleep is replaced."""

    def __init__(self, clock: object, sleep: object) -> None:
        self._inner = clock
        self.sleep = sleep

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)
