"""Killed while the disk takes nothing: the service goes on from what it published last, not from what is on disk."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.audit.machine_audit import audit
from compensator.messages import Offset
from compensator.recording import recorder as recorder_module
from compensator.recording.reading import recordings
from compensator.service.offset_checkpoint import CheckpointedOffset, OffsetCheckpoint
from tests.service.living import MACHINE, Machine, largest_step, settings
from tests.service.simulated import TABLE

RATE_UM_PER_MIN = 0.2


def slow_machine(folder: Path) -> Machine:
    """A machine whose offset may move so slowly that it is under way all the time."""
    return Machine(folder, settings(limits={**TABLE["limits"], "offset_rate_max_um_per_min": RATE_UM_PER_MIN}))


async def test_killed_on_a_full_disk_the_offset_does_not_leap_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = slow_machine(tmp_path)
    sync = recorder_module.RecordingFile.sync

    def full(live: Any) -> None:
        raise OSError(28, "No space left on device")

    machine.at_sample[60] = lambda: monkeypatch.setattr(recorder_module.RecordingFile, "sync", full)
    await machine.run_and_kill(100)
    monkeypatch.setattr(recorder_module.RecordingFile, "sync", sync)
    before = machine.offsets()
    assert abs(before[99] - before[59]) > 20 * RATE_UM_PER_MIN  # so far it would leap
    (note,) = tmp_path.glob("compensator-*.json")
    await machine.run(20)
    assert "published while the disk failed" in " ".join(event.text for event in machine.events("restart"))
    assert largest_step(machine.outcomes) <= RATE_UM_PER_MIN + 1e-9
    assert [o.offset.seq for o in machine.outcomes] == sorted({o.offset.seq for o in machine.outcomes})
    assert not note.exists()  # the disk has everything again
    # The machine of these tests has no configuration to be worked out again with; all else must hold.
    assert {finding.kind for finding in audit(recordings(machine.recordings, MACHINE)).findings} == {"unreadable"}


@pytest.mark.parametrize("command", ["hold", "resume"])
async def test_a_command_on_a_full_disk_acts_after_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """An operator who has frozen the offset need not watch whether the disk took the command, or the service lived."""
    machine, write = slow_machine(tmp_path), recorder_module.McapRecorder.write

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    if command == "resume":
        machine.at_sample[50] = lambda: machine.command("hold")
    machine.at_sample[60] = lambda: monkeypatch.setattr(recorder_module.McapRecorder, "write", full)
    machine.at_sample[70] = lambda: machine.command(command)
    await machine.run_and_kill(100)
    monkeypatch.setattr(recorder_module.McapRecorder, "write", write)
    machine.at_sample[110] = lambda: machine.command("resume")
    await machine.run(20)
    held = ["operator_hold" in outcome.offset.reasons for outcome in machine.outcomes]
    if command == "hold":
        assert held == [False] * 70 + [True] * 40 + [False] * 10
        assert len({outcome.offset.y_offset_um for outcome in machine.outcomes[70:110]}) == 1
    else:
        assert held == [False] * 50 + [True] * 20 + [False] * 50


async def test_while_the_disk_takes_everything_nothing_is_noted(tmp_path: Path) -> None:
    machine = slow_machine(tmp_path)
    await machine.run(10)
    assert not list(tmp_path.glob("compensator-*"))


def offset(value: float, seq: int = 7) -> Offset:
    return Offset(
        schema=1,
        machine=MACHINE,
        seq=seq,
        time_utc_ns=5,
        valid_for_s=150.0,
        y_offset_um=value,
        y_offset_rate_um_per_min=0.0,
        y_offset_std_um=0.1,
        state="degraded",
        reasons=["recording_failed"],
        model_sha256="",
    )


def test_the_note_is_of_one_machine_and_its_newest(tmp_path: Path) -> None:
    note, other = (OffsetCheckpoint(tmp_path / folder, MACHINE, tmp_path) for folder in ("a", "b"))
    assert note.read(100.0) is None
    note.write(offset(1.5))
    note.write(offset(float("nan"), 8))  # nothing was published that a control could apply
    note.write(offset(-2.5, 9))
    assert note.read(100.0) == CheckpointedOffset(seq=9, time_utc_ns=5, y_offset_um=-2.5)
    assert b"hold" not in note.path.read_bytes()  # a service before these keys reads it, too
    assert other.read(100.0) is None and note.path.stat().st_mode & 0o777 == 0o600
    note.write(msgspec.structs.replace(offset(-2.5, 9), reasons=["operator_hold", "internal_error"]))
    held = CheckpointedOffset(seq=9, time_utc_ns=5, y_offset_um=-2.5, operator_hold=True, internal_error=True)
    assert note.read(100.0) == held
    assert note.read(2.0) is None  # beyond the limit: no service published that
    note.remove()
    note.remove()
    assert note.read(100.0) is None


@pytest.mark.parametrize("what", ["not JSON", "torn", "not a number", "a link", "a pipe", "others may write it"])
def test_what_no_service_wrote_does_not_count(tmp_path: Path, what: str) -> None:
    note = OffsetCheckpoint(tmp_path / "rec", MACHINE, tmp_path)
    note.write(offset(3.0))
    whole = note.path.read_bytes()
    if what == "not JSON":
        note.path.write_bytes(b"\xff\0")
    elif what == "torn":
        note.path.write_bytes(whole[:-4])
    elif what == "not a number":
        note.path.write_bytes(whole.replace(b"3.0", b"null"))
    elif what == "a link":
        note.path.rename(tmp_path / "elsewhere")
        note.path.symlink_to(tmp_path / "elsewhere")
    elif what == "a pipe":
        note.path.unlink()
        os.mkfifo(note.path, 0o600)
    else:
        note.path.chmod(0o666)
    assert note.read(100.0) is None


def test_a_computer_that_does_not_take_the_note_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    note = OffsetCheckpoint(tmp_path / "rec", MACHINE, tmp_path / "missing")
    note.write(offset(3.0))
    note.write(offset(4.0))
    assert caplog.text.count("a kill now would lose the offset") == 1 and note.read(100.0) is None
