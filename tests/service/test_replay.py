"""Replays do what the service did: the recorded model, run as another one, gives the recorded offsets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from compensator.audit.other_model import compare
from compensator.config import parse_config
from compensator.messages import number
from compensator.model.model_file import parse_model
from compensator.recording.reading import recordings
from compensator.service.compensation import Compensation, Outcome
from compensator.service.replay import ForeignRun, apply, steps_of
from tests.audit.made import CONFIG, QUILL
from tests.service.living import MACHINE, Machine

MODEL = parse_model(QUILL, source="test")


def machine_with(folder: Path, happenings: Mapping[int, Callable[[Machine], Any]]) -> Machine:
    """A machine to which something happens after a sample."""
    machine = Machine(folder, parse_config(CONFIG, source="test"), QUILL)
    machine.config_bytes = CONFIG
    for sample, happening in happenings.items():
        machine.at_sample[sample] = lambda happening=happening: happening(machine)
    return machine


def foreign_run_differs_um(machine: Machine) -> float:
    """Run the recorded model over all recordings as another model would be; largest difference of an offset, µm."""
    found = compare(recordings(machine.recordings, MACHINE), MODEL)
    assert found.samples == len(machine.outcomes) and not found.remarks
    return abs(found.own.offsets.peak)


@pytest.mark.parametrize("by_s", [3600.0, -3600.0, 86_400.0])
async def test_a_clock_that_was_set_is_no_pause(tmp_path: Path, by_s: float) -> None:
    """Also where it opens a file, since the day is another one then."""
    machine = machine_with(tmp_path, {60: lambda one: one.clock.set_wall_clock(by_s)})
    await machine.run(150)
    times = [outcome.sample.time_utc_ns for outcome in machine.outcomes]
    assert abs(times[61] - times[59]) > 3e12
    assert len(recordings(machine.recordings, MACHINE)) == (2 if by_s > 7200.0 else 1)
    assert foreign_run_differs_um(machine) == 0.0


@pytest.mark.parametrize("minutes", [7.0, 200.0])
async def test_between_two_starts_the_pause_is_the_recorded_one(tmp_path: Path, minutes: float) -> None:
    machine = machine_with(tmp_path, {40: lambda one: one.clock.set_wall_clock(1800.0)})
    await machine.run(80)
    await machine.sleep(minutes)
    await machine.run(60)
    assert foreign_run_differs_um(machine) == 0.0


async def test_a_pause_of_unknown_length_is_one_in_a_replay_too(tmp_path: Path) -> None:
    machine = machine_with(tmp_path, {})
    await machine.run(80)
    machine.clock.set_wall_clock(-7200.0)
    await machine.run(60)
    assert machine.events("restart")[-1].data["missing"] is None
    assert foreign_run_differs_um(machine) == 0.0


async def test_a_torn_last_sample_counts_and_its_offset_does_not(tmp_path: Path) -> None:
    machine = machine_with(tmp_path, {})
    await machine.run_and_kill(60, torn=700)
    await machine.sleep(3.0)
    await machine.run(30)
    first = [step for step in steps_of(recordings(machine.recordings, MACHINE)[0]) if step.sample is not None]
    assert len(first) == 60 and "offset" not in first[-1].records
    found = compare(recordings(machine.recordings, MACHINE), MODEL)
    assert found.samples == 89 and found.own.offsets.peak == 0.0


async def test_a_restart_goes_on_with_the_hold_of_an_internal_error(tmp_path: Path) -> None:
    """A poll that failed leaves an offset without a sample, which is a pause, and a hold until resume."""
    machine = machine_with(tmp_path, {})
    broken = [0]
    read = machine.device.read

    async def defective() -> Any:
        broken[0] -= 1
        if 0 <= broken[0] < 6:
            raise ZeroDivisionError("a defect")
        return await read()

    machine.device.read = defective  # type: ignore[method-assign]
    machine.at_sample[60] = lambda: broken.__setitem__(0, 6)
    await machine.run(100)
    assert broken[0] < 0
    path, after = recordings(machine.recordings, MACHINE)
    held = [step for step in steps_of(path) if step.sample is None and step.offset is not None]
    assert len(held) == 1 and next(steps_of(after)).sample is not None
    at_end = number(machine.outcomes[-1].offset.y_offset_um)
    await machine.run(30)
    after = [outcome.offset for outcome in machine.outcomes[-30:]]
    assert all("internal_error" in offset.reasons and number(offset.y_offset_um) == at_end for offset in after)
    assert not any("are not reproduced" in event.text for event in machine.events("restart"))
    assert compare(recordings(machine.recordings, MACHINE), MODEL).own.offsets.peak == 0.0


async def test_where_files_between_were_not_given_their_time_is_the_pause(tmp_path: Path) -> None:
    machine = machine_with(tmp_path, {})
    for _ in range(3):
        await machine.run(40)
        await machine.sleep(2.0)
    first, _, last = recordings(machine.recordings, MACHINE)
    foreign = ForeignRun(Compensation(machine.config, MODEL))
    by_hand = Compensation(machine.config, MODEL)
    for step in steps_of(first):
        foreign.run(step)
        apply(by_hand, step)
    before, samples = by_hand.status.time_utc_ns, [step for step in steps_of(last) if step.sample is not None]
    assert samples[0].sample is not None
    by_hand.pause(round((samples[0].sample.time_utc_ns - before) / 60e9) - 1)
    for step in samples:
        outcome = foreign.run(step)
        wanted = apply(by_hand, step)
        assert isinstance(outcome, Outcome) and isinstance(wanted, Outcome) and outcome.offset == wanted.offset


async def test_a_start_whose_first_sample_failed_keeps_its_pause(tmp_path: Path, monkeypatch: Any) -> None:
    """The pause is noted with the offset that was held, in a group without a sample."""
    machine = machine_with(tmp_path, {65: lambda one: one.command("resume")})
    await machine.run(60)
    await machine.sleep(40.0)
    last, process, defects = machine.outcomes[-1].sample.seq, Compensation.process, [ZeroDivisionError("a defect")]

    def fail_once(compensation: Compensation, raw: Any) -> Outcome:
        if raw.seq > last and defects:
            raise defects.pop()
        return process(compensation, raw)

    monkeypatch.setattr(Compensation, "process", fail_once)
    await machine.run(120)
    assert not defects
    found = compare(recordings(machine.recordings, MACHINE), MODEL)
    assert abs(found.own.offsets.peak) == 0.0 and machine.offsets()[-1] != machine.offsets()[64]
