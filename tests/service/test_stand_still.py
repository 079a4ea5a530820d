"""The computer sleeps, or is too busy: what nobody measured is a pause, as after a restart."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

from compensator.audit.machine_audit import audit, summary
from compensator.clock import NS, SystemClock, VirtualClock
from compensator.config import parse_config
from compensator.events import PauseData, data_of
from compensator.messages import number
from compensator.recording.reading import recordings
from compensator.service.loop.state import LoopState
from compensator.service.sampling import Grid
from drivers.reading import Quality, Reading
from tests.audit.made import CONFIG, QUILL
from tests.service.living import MACHINE, Machine, check_files, largest_step, settings
from tests.service.looping import extended, shown
from tests.service.simulated import START_NS, Bench
from tests.service.test_loop_service import EVENING, Looping, checked

PERIOD_S = 60.0


@pytest.fixture(scope="module")
def awake(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    """The machine with a service that never stands still."""
    machine = Machine(tmp_path_factory.mktemp("awake"))
    asyncio.run(machine.run(480))
    return machine


def stands_still(machine: Machine, minutes: float, *, within_a_sample: bool) -> None:
    """Let the service of a machine stand still once, from the next poll on that is the first of its sample, or not."""
    polls = [0]

    def at_poll() -> None:
        polls[0] += 1
        if polls[0] > 1 and (machine.clock.utc_ns() % (60 * NS) != 0) is within_a_sample:
            machine.at_poll = lambda: None
            machine.clock.stand_still(60.0 * minutes)

    machine.at_poll = at_poll


@pytest.mark.parametrize("within_a_sample", [False, True])
@pytest.mark.parametrize(("minutes", "tolerance_um"), [(3.0, 0.2), (25.0, 0.6), (120.0, 3.0)])
async def test_time_passes_for_the_model_while_nothing_runs(
    tmp_path: Path, awake: Machine, minutes: float, tolerance_um: float, within_a_sample: bool
) -> None:
    machine = Machine(tmp_path)
    machine.at_sample[300] = lambda: stands_still(machine, minutes, within_a_sample=within_a_sample)
    await machine.run(350)
    before, after = machine.outcomes[299], machine.outcomes[302:]
    whole = awake.by_time()
    for one in machine.outcomes[:300]:
        assert one.offset == whole[one.offset.time_utc_ns].offset
    assert len(machine.outcomes) == 350
    errors = [
        abs(number(one.estimate.y_pred_um) - number(whole[one.offset.time_utc_ns].estimate.y_pred_um)) for one in after
    ]
    assert max(errors) <= tolerance_um
    # No value of after the pause has a time of before it.
    for one in after[:3]:
        same = whole[one.offset.time_utc_ns].sample.channels["t_q_degc"].mean
        assert one.sample.channels["t_q_degc"].mean == pytest.approx(same, abs=1e-9)
    assert {one.offset.state for one in after} <= {"ok", "degraded"}
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9

    (told,) = [event for event in machine.events("restart") if data_of(event, PauseData) is not None]
    missing = told.data["missing"]
    assert minutes - 1 <= missing <= minutes + 1 and told.data["bridged"] and not machine.events("clock")
    # Numbers and times go on together.
    last = after[-1].offset
    assert (last.time_utc_ns - before.offset.time_utc_ns) / (60 * NS) == last.seq - before.offset.seq
    assert check_files(machine) == 350


async def test_it_is_what_a_restart_is(tmp_path: Path) -> None:
    """The heat is switched meanwhile: both draw the same straight line."""
    machine, other = Machine(tmp_path / "stands still"), Machine(tmp_path / "restarts")
    machine.at_sample[300] = lambda: machine.clock.stand_still(90 * 60.0)
    await machine.run(320)
    await other.run_and_kill(300)
    await other.sleep(90.0)
    await other.run(20)
    assert [one.estimate for one in machine.outcomes] == [one.estimate for one in other.outcomes]


async def test_what_is_recorded_about_it_audits_clean(tmp_path: Path) -> None:
    bench = Bench(tmp_path, parse_config(CONFIG, source="test"))
    bench.recorder.attachments = {"config.toml": CONFIG, "model.toml": QUILL}
    bench.at_sample[60] = lambda: bench.clock.stand_still(1800.0)
    await bench.run(80)
    files = recordings(tmp_path / "rec", MACHINE)
    found = audit(files)
    assert found.clean, summary(found)
    assert found.samples == 80 and len(files) == 2


async def test_a_clock_that_is_set_while_nothing_runs_hides_no_sample(tmp_path: Path) -> None:
    machine = Machine(tmp_path)

    def sleeps() -> None:
        machine.clock.stand_still(3600.0)
        machine.clock.set_wall_clock(-7200.0)

    machine.at_sample[100] = sleeps
    await machine.run(120)
    (told,) = [event for event in machine.events("restart") if data_of(event, PauseData) is not None]
    assert 59 <= told.data["missing"] <= 60
    assert [round(event.data["seconds"]) for event in machine.events("clock")] == [-7200]
    assert check_files(machine) == 120


async def test_time_passes_while_samples_cannot_be_processed(tmp_path: Path, awake: Machine) -> None:
    """A defect holds the offset until a person has seen to it; the machine warms up meanwhile."""
    machine = Machine(tmp_path, settings())
    original: list[Any] = []

    def breaks() -> None:
        decision = machine.daemon._compensation._decision  # type: ignore[union-attr]
        original.append(decision.decide)

        def broken(*_: Any) -> Any:
            raise ZeroDivisionError("a defect")

        decision.decide = broken  # type: ignore[method-assign]

    def ends() -> None:
        machine.daemon._compensation._decision.decide = original[0]  # type: ignore[union-attr, method-assign]
        machine.command("resume")

    fails = [0]

    def at_poll() -> None:
        fails[0] += len(machine.outcomes) == 300
        if fails[0] == 50:  # two polls a sample
            ends()

    machine.at_sample[300] = breaks
    machine.at_poll = at_poll
    await machine.run(360)
    after, whole = machine.outcomes[300:], awake.by_time()
    missing = after[0].offset.seq - machine.outcomes[299].offset.seq - 1
    assert 20 <= missing <= 30
    pauses = [event for event in machine.events("restart") if data_of(event, PauseData) is not None]
    assert [event.data["missing"] for event in pauses] == [1] * missing
    errors = [
        abs(number(one.estimate.y_pred_um) - number(whole[one.offset.time_utc_ns].estimate.y_pred_um)) for one in after
    ]
    assert max(errors) <= 0.7
    assert check_files(machine) == len(machine.outcomes)
    assert len(recordings(machine.recordings, MACHINE)) == 2


def test_the_grid_counts_what_is_missing() -> None:
    clock = VirtualClock(START_NS)
    grid = Grid(clock, PERIOD_S, 6)
    label_ns = grid.label_ns
    for _ in range(6):
        clock.stand_still(grid.seconds_to_next_poll())
        assert grid.begin_again() is None
        grid.count_poll()
    grid.next_sample()
    clock.stand_still(59.0)  # less than a sample: its polls are late, and none is missing
    assert grid.begin_again() is None
    clock.stand_still(20.0 + 10 * PERIOD_S)
    assert grid.begin_again() == (0.0, 11)
    assert grid.label_ns == label_ns + 12 * 60 * NS
    assert 0.0 <= grid.seconds_to_next_poll() <= 10.0
    clock.set_wall_clock(-600.0)
    assert grid.count_poll() is False and grid.begin_again() is None  # the sample goes on


def test_the_computers_clock_goes_on_while_it_sleeps() -> None:
    clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
    before = time.clock_gettime_ns(clock)
    assert before <= SystemClock().monotonic_ns() <= time.clock_gettime_ns(clock)


async def test_times_of_the_loop_are_those_of_before(tmp_path: Path) -> None:
    """No clock was set: what is compared goes on after the pause, and the models in shadow have passed it, too."""
    machine = Looping(tmp_path, shown(extended()))
    machine.at_sample[EVENING + 60] = lambda: machine.clock.stand_still(7200.0)
    began: list[int] = []

    def loop() -> LoopState:
        return machine.daemon._loop._core.state  # type: ignore[union-attr]

    machine.at_sample[EVENING + 59] = lambda: began.extend(place.since_utc_ns for place in loop().taken)
    await machine.run(EVENING + 70)
    assert began and [place.since_utc_ns for place in loop().taken] == began
    assert loop().time_utc_ns - machine.outcomes[EVENING + 58].sample.time_utc_ns > 7200 * NS
    for shadow in machine.daemon._loop._core.shadows.values():  # type: ignore[union-attr]
        assert shadow.compensation.status.seq == machine.outcomes[-1].sample.seq
    checked(machine)


async def test_a_model_that_begins_in_shadow_after_it_has_passed_it(tmp_path: Path) -> None:
    """Its warm-up ended before the service stood still, and it begins with the first sample after that."""
    machine = Looping(tmp_path, shown(extended()))
    stood: list[int] = []

    def at_poll() -> None:
        has_next = machine.daemon._loop._core.state.has_next  # type: ignore[union-attr]
        if has_next and not stood and machine.clock.utc_ns() % (60 * NS) == 0:
            stood.append(len(machine.outcomes))
            machine.clock.stand_still(1800.0)

    machine.at_poll = at_poll
    await machine.run(EVENING + 20)
    first = machine.candidates()[0]
    (present,) = [one.estimate for one in machine.outcomes if one.sample.seq == first.seq]
    assert stood and first.seq - machine.outcomes[stood[0] - 1].sample.seq >= 30
    # The effect of `extended` is a part of the gain: both are as far from what they were half an hour before.
    assert first.y_std_um == pytest.approx(present.y_std_um, rel=0.2)
    assert number(first.y_pred_um) == pytest.approx(number(present.y_pred_um), rel=0.15)
    checked(machine)


@pytest.mark.parametrize("begins", [540, 660])
async def test_a_zero_on_a_warm_machine_waits_for_what_the_machine_did_meanwhile(tmp_path: Path, begins: int) -> None:
    """T_Q is lost for half an hour, in which the heat changes; a person sets a zero in that time."""
    machine = Machine(tmp_path)
    answers: list[Any] = []

    def lose() -> None:
        machine.device.replaced[0] = Reading.bad(Quality.OPEN, "wire broken")

    machine.at_sample[begins] = lose
    machine.at_sample[begins + 15] = lambda: answers.append(machine.command("zero", b'{"mode": "warm"}'))
    machine.at_sample[begins + 30] = machine.device.replaced.clear
    await machine.run(begins + 90)
    assert answers[0] == {"ok": True, "text": "zero: acts once T_Q and AT have been there for a sample"}
    assert abs(number(machine.outcomes[begins + 28].estimate.residual_um)) > 8.0  # what it would be wrong by
    assert all(abs(number(one.estimate.residual_um)) < 3.0 for one in machine.outcomes[begins + 31 :])
    assert check_files(machine) == begins + 90


async def test_after_a_restart_a_zero_is_not_one_at_rest_by_what_the_machine_did_before(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    await machine.run_and_kill(620)  # cool for an hour
    await machine.sleep(60.0)  # it works meanwhile
    machine.at_sample[621] = lambda: machine.command("zero")
    await machine.run(15)
    zero = machine.events("zero")[-1]
    assert zero.data["mode"] == "warm" and zero.seq == machine.outcomes[621].sample.seq
