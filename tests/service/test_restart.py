"""After any end the service goes on where it was: state, zero, number, offset."""

from __future__ import annotations

import asyncio
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compensator.config import LoadedConfig
from compensator.messages import number
from compensator.model.model_file import load_model, read_model_bytes
from compensator.recording.reading import decode, messages, read_messages, recordings
from compensator.recording.recorder import McapRecorder
from compensator.service.transfer.restart import resume
from drivers.reading import Quality, Reading
from tests.service.living import MACHINE, Machine, check_files, largest_step, settings

QUILL = read_model_bytes("quill")
STRONGER = QUILL.replace(b'name = "quill"', b'name = "stronger"') + (
    b'\n[[effect]]\nkind = "gain"\npath = "DTF"\nchange = 0.3\n'
)


@pytest.fixture(scope="module")
def awake(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    """The machine with a service that nobody interrupts."""
    machine = Machine(tmp_path_factory.mktemp("awake"))
    asyncio.run(machine.run(480))
    return machine


async def end(machine: Machine, how: str, samples: int) -> None:
    if how == "stop":
        await machine.run(samples)
    else:
        # 900 bytes off: the last offset is gone and the estimate torn, the sample whole.
        await machine.run_and_kill(samples, torn=900 if how == "torn" else 0)


@pytest.mark.parametrize(
    ("how", "gap_min", "tolerance_um"),
    [
        ("stop", 0.0, 0.0),
        ("kill", 0.0, 0.0),
        ("torn", 0.0, 0.2),
        ("stop", 25.0, 0.6),
        ("kill", 25.0, 0.6),
        ("torn", 120.0, 3.0),
    ],
)
async def test_goes_on_as_if_nothing_had_happened(
    tmp_path: Path, awake: Machine, how: str, gap_min: float, tolerance_um: float
) -> None:
    """What is left after the bridge is what changed between its two ends without being measured."""
    machine = Machine(tmp_path)
    await end(machine, how, 300)
    before = machine.outcomes[-1]
    await machine.sleep(gap_min)
    await machine.run(50)
    after = machine.outcomes[300:]
    whole = awake.by_time()
    assert after[0].offset.seq > before.offset.seq
    assert after[0].estimate.t_q_ref_degc == before.estimate.t_q_ref_degc
    assert after[0].estimate.y_ref_um == before.estimate.y_ref_um
    assert {o.offset.state for o in after} <= {"ok", "degraded"}
    assert not any("cold_start" in o.offset.reasons for o in after)
    # From the last offset that anybody got on, within the rate limit at every step.
    assert largest_step(machine.outcomes[299:]) <= 8.0 + 1e-9
    same = [whole[o.offset.time_utc_ns] for o in after]
    errors = [
        abs(number(a.estimate.y_pred_um) - number(b.estimate.y_pred_um)) for a, b in zip(after, same, strict=True)
    ]
    assert max(errors) <= tolerance_um
    if gap_min == 0.0 and how != "torn":
        assert [a.offset.y_offset_um for a in after] == [b.offset.y_offset_um for b in same]
    else:
        assert number(after[0].offset.y_offset_std_um) >= number(same[0].offset.y_offset_std_um)
    told = [event for event in machine.events("restart") if "missing" in event.data]
    assert told and told[-1].data["bridged"]
    assert check_files(machine) >= 349


async def test_a_gap_too_long_is_said_and_the_offset_moves_by_the_rate_alone(tmp_path: Path, awake: Machine) -> None:
    machine = Machine(tmp_path, settings(restart={"bridge_max_min": 30.0}))
    await machine.run_and_kill(300)
    await machine.sleep(60.0)
    await machine.run(60)
    after = machine.outcomes[300:]
    assert all("cold_start" in o.offset.reasons and o.offset.state == "degraded" for o in after)
    assert largest_step(machine.outcomes[299:]) <= 8.0 + 1e-9
    told = [event for event in machine.events("restart") if "missing" in event.data]
    assert len(told) == 1 and not told[0].data["bridged"] and "cannot be bridged" in told[0].text
    whole = awake.by_time()[after[0].offset.time_utc_ns]
    assert number(after[0].offset.y_offset_std_um) > 2.0 * number(whole.offset.y_offset_std_um)
    assert check_files(machine) == 360


async def test_a_weekend_away_finds_the_machine_as_it_is(tmp_path: Path) -> None:
    """Two days are longer than anything that is remembered: the machine counts as it is found, the zero stands."""
    machine = Machine(tmp_path)
    await machine.run_and_kill(300)
    await machine.sleep(2 * 24 * 60.0)
    await machine.run(30)
    after = machine.outcomes[300:]
    assert after[0].estimate.t_q_ref_degc == machine.outcomes[0].estimate.t_q_ref_degc
    assert largest_step(machine.outcomes[299:]) <= 8.0 + 1e-9
    residuals = [abs(number(o.estimate.residual_um)) for o in after]
    assert max(residuals) < 3.0 * max(number(o.offset.y_offset_std_um) for o in after)


async def test_a_clock_that_stands_before_the_recording_tells_no_gap(tmp_path: Path) -> None:
    """The battery of the host's clock is empty: how long it was off, nobody knows."""
    machine = Machine(tmp_path)
    await machine.run_and_kill(200)
    machine.clock.set_wall_clock(-7 * 24 * 3600.0)
    await machine.run(20)
    after = machine.outcomes[200:]
    assert all("cold_start" in o.offset.reasons for o in after)
    assert [o.offset.seq for o in after] == list(range(machine.outcomes[199].offset.seq + 1, after[-1].offset.seq + 1))
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    assert any("wall clock is before" in event.text for event in machine.events("restart"))


async def test_an_operator_hold_and_the_guards_survive_a_kill(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    machine.at_sample[100] = lambda: machine.command("hold")
    await machine.run_and_kill(150)
    await machine.run(20)
    held = machine.outcomes[101:]
    assert all(o.offset.state == "hold" and "operator_hold" in o.offset.reasons for o in held)
    assert len({o.offset.y_offset_um for o in held}) == 1
    # The rate guard still knows the last good value: a leap is not believed after a restart either.
    machine.device.replaced[0] = Reading.good(70.0)
    await machine.run(1)
    assert machine.outcomes[-1].sample.channels["t_q_degc"].quality == "too_fast"
    assert check_files(machine) == 171


def break_next_sample(machine: Machine) -> None:
    """Let the next sample fail in a defect that is gone after it."""
    compensation = machine.daemon._compensation  # type: ignore[union-attr]
    original = compensation._decision.decide

    def broken(*_: Any) -> Any:
        compensation._decision.decide = original  # type: ignore[method-assign]
        raise ZeroDivisionError("a defect")

    compensation._decision.decide = broken  # type: ignore[method-assign]


async def test_a_command_that_no_sample_follows_is_recorded_as_refused(tmp_path: Path) -> None:
    """It was answered that it acts at the next sample: who sent it must find that it did not."""
    machine, replies = Machine(tmp_path), []

    def send_and_stop() -> None:
        replies.extend(machine.command(name) for name in ["zero", *["resume"] * 20, "hold"])
        assert machine.daemon is not None
        machine.daemon.stop()

    machine.at_sample[100] = send_and_stop
    await machine.run(200)
    await machine.run(5)
    assert len(machine.outcomes) == 105 and all(reply["ok"] for reply in replies)
    sent = [event for path in recordings(machine.recordings, MACHINE) for event in messages(path, ("event",))]
    commands = [event for event in sent if event.kind in ("command", "command_refused")]
    assert [event.data["name"] for event in commands] == ["zero", *["resume"] * 20, "hold"]
    assert commands[-1].text == "hold: the service ended before the next sample; send it again"
    assert commands == machine.events("command_refused")
    assert "operator_hold" not in machine.outcomes[-1].offset.reasons


@pytest.mark.parametrize("changed", ["nothing", "configuration", "model", "state lost", "no zero on record"])
async def test_the_hold_of_an_internal_error_survives_a_restart_whatever_has_changed(
    tmp_path: Path, changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    zero = {"rest_rate_um_per_min": 0.2, "at_start": changed != "no zero on record"}
    machine = Machine(tmp_path, settings(zero=zero))
    write = McapRecorder.write
    with monkeypatch.context() as patch:
        if changed == "state lost":
            patch.setattr(McapRecorder, "write", lambda self, records, ns, **_: write(self, records, ns))
        machine.at_sample[60] = lambda: break_next_sample(machine)
        await machine.run(81)  # one sample of them fails
    if changed == "model":
        machine.configured = STRONGER
    elif changed != "nothing":
        machine.config_bytes = b"changed"
    machine.at_sample[100] = lambda: machine.command("resume")
    if changed == "no zero on record":
        machine.at_sample[90] = lambda: machine.command("zero")
    await machine.run(40)
    held = machine.outcomes[90 if changed == "no zero on record" else 60 : 100]
    assert all(o.offset.state == "hold" and "internal_error" in o.offset.reasons for o in held)
    assert len({o.offset.y_offset_um for o in held}) == 1
    assert not any("internal_error" in o.offset.reasons for o in machine.outcomes[101:])
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9


async def test_a_temperature_that_is_lost_across_the_restart_is_not_predicted_for_ever(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    await machine.run_and_kill(200)
    machine.device.replaced[0] = Reading.bad(Quality.OPEN, "wire broken")
    await machine.sleep(30.0)
    machine.at_sample[210] = machine.device.replaced.clear
    await machine.run(40)
    lost = machine.outcomes[200:210]
    assert all(o.offset.state == "hold" and "prediction_expired" in o.offset.reasons for o in lost)
    assert {o.offset.y_offset_um for o in lost} == {machine.outcomes[199].offset.y_offset_um}
    assert machine.outcomes[-1].offset.state == "ok"
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    assert abs(number(machine.outcomes[-1].estimate.residual_um)) < 1.5


async def test_another_configuration_takes_the_state_over_by_the_recordings(tmp_path: Path, awake: Machine) -> None:
    machine = Machine(tmp_path)
    machine.at_sample[290] = lambda: machine.command("hold")
    machine.at_sample[295] = lambda: machine.command("resume")
    await machine.run_and_kill(300)
    machine.config, machine.config_bytes = settings(loss={"predict_for_min": 11.0}), b"changed"
    await machine.run(60)
    whole = awake.by_time()
    after = machine.outcomes[300:]
    assert [o.estimate.y_pred_um for o in after] == [whole[o.offset.time_utc_ns].estimate.y_pred_um for o in after]
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    assert any("the configuration has changed" in event.text for event in machine.events("restart"))


async def test_another_model_is_warmed_up_on_the_recordings(tmp_path: Path) -> None:
    always = Machine(tmp_path / "always", model=STRONGER)
    await always.run(300)
    machine = Machine(tmp_path / "changed")
    machine.at_sample[180] = lambda: machine.command("hold")
    await machine.run_and_kill(220)
    machine.configured = STRONGER
    machine.at_sample[250] = lambda: machine.command("resume")
    await machine.run(75)
    whole = always.by_time()
    after = machine.outcomes[220:]
    for outcome in after:
        expected = whole[outcome.offset.time_utc_ns].estimate
        assert outcome.estimate.y_pred_um == expected.y_pred_um and outcome.estimate.heat_w == expected.heat_w
    assert all("operator_hold" in o.offset.reasons for o in after[:30])
    assert "model_changed" in after[30].offset.reasons and after[30].offset.state == "degraded"
    assert after[-1].offset.state == "ok"
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    assert any("the model has changed" in event.text for event in machine.events("restart"))


async def test_recordings_without_a_state_and_files_that_are_none(
    tmp_path: Path, awake: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recordings of an older version carry no state; something else may lie in the folder under such a name."""
    machine = Machine(tmp_path)
    write = McapRecorder.write

    def stateless(self: McapRecorder, records: Any, time_utc_ns: int, *, state: bytes = b"", **rest: Any) -> None:
        write(self, records, time_utc_ns, **rest)

    with monkeypatch.context() as patch:
        patch.setattr(McapRecorder, "write", stateless)
        await machine.run_and_kill(300)
    (machine.recordings / f"{MACHINE}_20260105T230000Z.mcap").write_bytes(b"")
    await machine.run(30)
    whole = awake.by_time()
    after = machine.outcomes[300:]
    assert [o.estimate.y_pred_um for o in after] == [whole[o.offset.time_utc_ns].estimate.y_pred_um for o in after]
    assert any("contains no state that can be used" in event.text for event in machine.events("restart"))


async def test_killed_again_and_again(tmp_path: Path) -> None:
    """Numbers never repeat, no offset is published that is not on disk, nothing jumps, every file works out."""
    machine = Machine(tmp_path)
    rng = np.random.default_rng(3)
    for _ in range(12):
        await machine.run_and_kill(int(rng.integers(5, 25)), torn=int(rng.integers(0, 2)) * int(rng.integers(1, 400)))
        await machine.sleep(float(rng.uniform(0.0, 6.0)))
    seqs = [o.offset.seq for o in machine.outcomes]
    assert all(b > a for a, b in itertools.pairwise(seqs))
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    assert len({o.estimate.t_q_ref_degc for o in machine.outcomes}) == 1
    assert check_files(machine) >= len(machine.outcomes) - 12


async def test_cut_anywhere_every_whole_record_counts(tmp_path: Path) -> None:
    """A power cut may end the file at any byte: what is whole is used, and the service starts."""
    machine = Machine(tmp_path)
    await machine.run_and_kill(40)
    path = recordings(machine.recordings, MACHINE)[-1]
    data = path.read_bytes()
    loaded = LoadedConfig(config=machine.config, path=tmp_path / "machine.toml", data=machine.config_bytes)
    model = load_model("quill")
    for cut in [*np.random.default_rng(5).integers(0, len(data), 60).tolist(), 0, 5, len(data) - 1]:
        path.write_bytes(data[:cut])
        samples = [decode(r, path) for r in read_messages(path, ("sample",))]
        offsets = [decode(r, path) for r in read_messages(path, ("offset",))]
        compensation = resume(loaded, model).compensation
        status = compensation.status
        assert status.seq == (samples[-1].seq if samples else -1)  # type: ignore[attr-defined]
        last_um = number(offsets[-1].y_offset_um) if offsets else 0.0  # type: ignore[attr-defined]
        assert status.handover.offset_um == last_um


@pytest.mark.parametrize("state", [b"{}", b"not JSON", b'{"schema": 99}'])
async def test_a_damaged_state_does_not_keep_the_service_from_starting(
    tmp_path: Path, state: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(tmp_path)
    write = McapRecorder.write
    with monkeypatch.context() as patch:
        patch.setattr(McapRecorder, "write", lambda self, records, ns, **_: write(self, records, ns, state=state))
        await machine.run_and_kill(100)
    await machine.run(20)
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    assert any(event.text for event in machine.events("restart"))


async def test_every_file_works_out_from_what_travels_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Midnight, restarts, a full disk, a defect, commands: each file alone gives all its outcomes again."""
    machine = Machine(tmp_path)
    await machine.sleep(14 * 60.0)  # to 20:00
    lost = Reading.bad(Quality.OPEN, "wire broken")
    machine.at_sample[50] = lambda: machine.command("zero")
    machine.at_sample[70] = lambda: machine.command("hold")
    machine.at_sample[90] = lambda: machine.command("resume")
    await machine.run_and_kill(150)
    await machine.sleep(45.0)  # to 23:15
    machine.at_sample[185] = lambda: machine.device.replaced.update({0: lost})  # across midnight
    machine.at_sample[215] = machine.device.replaced.clear
    full = [False]
    write = McapRecorder.write

    def failing(self: McapRecorder, records: Any, time_utc_ns: int, **rest: Any) -> None:
        if full[0]:
            self._give_up()
            raise OSError(28, "No space left on device")
        write(self, records, time_utc_ns, **rest)

    monkeypatch.setattr(McapRecorder, "write", failing)
    machine.at_sample[165] = lambda: (full.__setitem__(0, True), machine.command("zero", b'{"mode": "warm"}'))
    machine.at_sample[175] = lambda: full.__setitem__(0, False)
    machine.at_sample[230] = lambda: break_next_sample(machine)
    machine.at_sample[240] = lambda: machine.command("resume")
    await machine.run(120)
    kinds = {reason for o in machine.outcomes for reason in o.offset.reasons}
    assert {"recording_failed", "internal_error", "operator_hold", "predicting"} <= kinds
    assert check_files(machine) >= 265
    assert len(recordings(machine.recordings, MACHINE)) >= 5
    assert np.nanmax(np.abs(np.diff(machine.offsets()))) <= 8.0 + 1e-9
