"""Probes of a machine without a displacement sensor: taken, refused, recorded and replayed; nothing jumps."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.audit.machine_audit import Audit, audit
from compensator.audit.other_model import compare
from compensator.cli import main
from compensator.clock import NS
from compensator.codes import ProbeCode
from compensator.config import Probe as ProbeSettings
from compensator.config import Zenoh
from compensator.demo.machine import configuration
from compensator.errors import ServiceError
from compensator.messages import ProbeRequest, number
from compensator.model.correction import ProbeCorrection
from compensator.model.model_file import parse_model
from compensator.model.thermal_model import Path as ModelPath
from compensator.recording.container import Container
from compensator.recording.reading import recordings
from compensator.service.command_client import send_probe
from compensator.service.compensation import Compensation, Outcome
from compensator.service.loading import load
from compensator.service.probing.past import offsets_at, predicted_at, published_at
from compensator.service.probing.probing import Probing
from compensator.service.probing.received import ProbeRefused, ReceivedProbe, read_probe
from compensator.service.probing.state import PastSample, ProbingState
from compensator.service.probing.wanted import wanted_after
from compensator.service.publisher import Publisher
from compensator.service.state import decode_state
from compensator.service.transfer.shadow import Shadow
from tests.audit.made import CONFIG, other_model
from tests.audit.tampering import Line, lines_of, rewrite, with_new_values
from tests.ports import free_port
from tests.service.living import MACHINE, largest_step
from tests.service.looping import machine as loop_machine
from tests.service.looping import settings as loop_settings
from tests.service.looping import stronger
from tests.service.probed import PROBE, PROBED, RATE_UM, ProbedMachine
from tests.service.records import QUILL
from tests.service.simulated import START_NS
from tests.service.test_compensation_day import MISSING
from tests.service.test_jumps_beside import probed

MINUTE_NS = 60 * NS


def look(machine: ProbedMachine) -> Audit:
    return audit(recordings(machine.recordings, MACHINE))


def nothing_jumped(machine: ProbedMachine) -> bool:
    """Whether no offset changed by more than permitted, and everything is in the audit."""
    found = look(machine)
    assert found.clean and found.samples == len(machine.outcomes), found
    return largest_step(machine.outcomes) <= RATE_UM + 1e-9


def wanted_because(machine: ProbedMachine) -> str:
    return str(machine.last_status()["wanted_why"])


async def test_hourly_probes_take_a_gain_error_away(tmp_path: Path) -> None:
    alone, probed = ProbedMachine(tmp_path / "alone"), ProbedMachine(tmp_path / "probed")
    probed.each_hour(1040)
    await alone.run(1080)
    await probed.run(1080)
    before, after = (np.sqrt(np.mean(machine.left_um()[300:] ** 2)) for machine in (alone, probed))
    assert after < 0.2 * before
    assert set(probed.codes()) == {"taken"} and len(probed.codes()) == 17
    assert all(reply.result()["ok"] for reply in probed.replies)
    assert nothing_jumped(probed) and len(probed.outcomes) == 1080
    std = np.array([number(outcome.offset.y_offset_std_um) for outcome in probed.outcomes])[300:]
    # The device has no noise, which the stated deviation allows for.
    assert 0.25 < np.sqrt(np.mean((probed.left_um()[300:] / std) ** 2)) < 1.3


async def test_the_deviation_falls_at_a_probe_and_grows_after_it(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(400)
    await machine.run(420)
    std = np.array([number(outcome.offset.y_offset_std_um) for outcome in machine.outcomes])
    # Sample n is the outcome with index n − 1; a probe after it acts with the next one.
    assert all(std[at] < std[at - 1] for at in range(120, 400, 60))
    assert all(std[at + 58] > std[at] for at in range(60, 360, 60))


async def test_the_sign_is_that_of_the_deformation(tmp_path: Path) -> None:
    """The tool stands 5 µm too far in +Y with the offset acting, so the offset becomes smaller by most of that."""
    machine = ProbedMachine(tmp_path, gain=1.0, noise_um=0.0)
    machine.at_sample[20] = lambda: machine.probe(5.0)
    await machine.run(24)
    offsets = machine.offsets()
    assert -5.0 < offsets[22] - offsets[19] < -3.5
    (probe,) = machine.recorded()
    assert number(probe.deformation_um) == pytest.approx(number(probe.measured_um) - number(probe.offset_applied_um))


Changes = Callable[[ProbedMachine], dict[str, Any]]
REFUSED: list[tuple[str, Changes]] = [
    (ProbeCode.MISMATCH, lambda one: {"offset_applied_um": one.applied_um() + 4.0}),
    (ProbeCode.MISMATCH, lambda one: {"offset_applied_um": -one.applied_um()}),
    (ProbeCode.TOO_OLD, lambda one: {"time_utc_ns": one.clock.utc_ns() - 31 * MINUTE_NS}),
    (ProbeCode.TOO_OLD, lambda one: {"time_utc_ns": 0}),
    (ProbeCode.FUTURE, lambda one: {"time_utc_ns": one.clock.utc_ns() + 20 * NS}),
    (ProbeCode.FUTURE, lambda one: {"time_utc_ns": 2**63 - 1}),
    (ProbeCode.OUT_OF_BOUNDS, lambda one: {"measured_um": 61.0}),
    (ProbeCode.OUT_OF_BOUNDS, lambda one: {"measured_um": -1e12}),
    (ProbeCode.OUT_OF_BOUNDS, lambda one: {"offset_applied_um": 1e9}),
    (ProbeCode.OUT_OF_BOUNDS, lambda one: {"std_um": 0.0}),
    (ProbeCode.OUT_OF_BOUNDS, lambda one: {"std_um": 1e6}),
    (ProbeCode.AXIS, lambda one: {"axis": "z"}),
]


@pytest.mark.parametrize(("code", "changes"), REFUSED)
async def test_a_probe_that_cannot_be_used_changes_nothing_and_is_recorded(
    tmp_path: Path, code: str, changes: Changes
) -> None:
    machine, without = ProbedMachine(tmp_path / "a"), ProbedMachine(tmp_path / "b")
    machine.at_sample[70] = lambda: machine.probe(**changes(machine))
    await machine.run(75)
    await without.run(75)
    reply = machine.replies[0].result()
    assert (reply["ok"], reply["code"]) == (False, code) and "\n" not in reply["text"]
    (probe,) = machine.recorded()
    assert (probe.taken, probe.code, probe.seq) == (False, code, machine.outcomes[70].sample.seq)
    assert [event.data["code"] for event in machine.events("probe")] == [code]
    assert np.array_equal(machine.offsets(), without.offsets())
    assert nothing_jumped(machine)
    # Another one is asked for at once; that of another axis was none of Y.
    assert wanted_because(machine) == (ProbeCode.FIRST if code == ProbeCode.AXIS else code)


MALFORMED = [
    b"",
    b"nonsense",
    b"[]",
    b"{}",
    b"\xff\xfe",
    b"[" * 5000,
    b'{"schema":1}',
]
WRONG: list[dict[str, Any]] = [
    {"extra": 1},
    {"schema": 2},
    {"schema": "1"},
    {"time_utc_ns": 1.5},
    {"time_utc_ns": -1},
    {"time_utc_ns": 2**70},
    {"measured_um": "3"},
    {"measured_um": None},
    {"measured_um": True},
    {"measured_um": float("nan")},
    {"measured_um": float("inf")},
    {"measured_um": -1e300},
    {"stopped_s": 1e300},
    {"offset_applied_um": [1]},
    {"feature": "x" * 65},
    {"feature": "a\nb"},
    {"feature": "sphere-1\n"},
    {"feature": "a\u2028b"},
    {"feature": "a\u202eb"},
    {"tool": "\u0085"},
    {"feature": 7},
    {"stopped_s": -1.0},
    {"axis": None},
]
USUAL = {"schema": 1, "time_utc_ns": 1, "axis": "y", "measured_um": 3.2, "offset_applied_um": -12.3}


@pytest.mark.parametrize(
    "payload", [*MALFORMED, *(json.dumps(USUAL | wrong).encode() for wrong in WRONG), b'{"measured_um":1e999}']
)
def test_a_payload_that_is_no_probe_is_refused_in_one_line(payload: bytes) -> None:
    with pytest.raises(ProbeRefused) as refused:
        read_probe(payload)
    assert refused.value.code == ProbeCode.MALFORMED and "\n" not in str(refused.value)


def test_the_probe_of_the_contract_is_read() -> None:
    text = b"""{"schema": 1, "time_utc_ns": 1763680000000000000, "axis": "y", "measured_um": 3.2, "std_um": 1.0,
 "offset_applied_um": -12.3, "feature": "sphere-1", "tool": "probe", "stopped_s": 20.0}"""
    assert read_probe(text).measured_um == 3.2
    assert read_probe(json.dumps(USUAL).encode()).std_um is None
    assert read_probe(json.dumps(USUAL | {"feature": "Bohrung Ø12, 左"}).encode()).feature == "Bohrung Ø12, 左"
    # All without a name are one feature; only the bridge, which cannot know whether they are, refuses such a line.
    unnamed = [{key: value for key, value in USUAL.items() if key != "feature"}, USUAL | {"feature": ""}]
    assert [read_probe(json.dumps(one).encode()).feature for one in unnamed] == ["", ""]


async def test_payloads_that_are_none_are_recorded_and_change_nothing(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.at_sample[60] = lambda: [machine.send(b"nonsense") for _ in range(50)]
    machine.at_sample[61] = machine.probe
    await machine.run(65)
    assert all(reply.result()["code"] == ProbeCode.MALFORMED for reply in machine.replies[:50])
    # A flood does not fill the recording.
    assert machine.codes() == [ProbeCode.MALFORMED] * 10 + [ProbeCode.TOO_MANY, "taken"]
    assert "40 more were refused" in machine.recorded()[10].text
    assert nothing_jumped(machine)


async def test_refused_probes_leave_the_places_to_good_ones(tmp_path: Path) -> None:
    machine, once = ProbedMachine(tmp_path / "a"), ProbedMachine(tmp_path / "b")

    def flood() -> None:
        good = machine.measured()
        for k in range(30):
            machine.send(good | {"offset_applied_um": good["offset_applied_um"] + 5.0 + k / 10.0})
        machine.send(good)

    machine.at_sample[60], once.at_sample[60] = flood, once.probe
    await machine.run(65)
    await once.run(65)
    assert machine.replies[-1].result()["ok"]
    assert sorted(machine.codes()) == sorted([ProbeCode.MISMATCH] * 20 + [ProbeCode.TOO_MANY, "taken"])
    assert any("10 more were refused" in probe.text for probe in machine.recorded())
    assert np.array_equal(machine.offsets(), once.offsets()) and nothing_jumped(machine)


async def test_probes_without_a_place_are_recorded_and_a_replay_leaves_them_out(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.at_sample[60] = lambda: [
        machine.probe(time_utc_ns=machine.clock.utc_ns() - k * 2 * NS, feature=f"f{k % 5}") for k in range(25)
    ]
    await machine.run(65)
    assert machine.codes().count(ProbeCode.TOO_MANY) == 5 and len(machine.codes()) == 25
    assert [reply.result()["code"] for reply in machine.replies[20:]] == [ProbeCode.TOO_MANY] * 5
    assert nothing_jumped(machine)


async def test_a_probe_counts_once(tmp_path: Path) -> None:
    machine, once = ProbedMachine(tmp_path / "a"), ProbedMachine(tmp_path / "b")
    sent: list[dict[str, Any]] = []

    def probe() -> None:
        sent.append(machine.measured())
        machine.send(sent[0])
        machine.send(sent[0])  # in the same interval
        machine.send(sent[0] | {"time_utc_ns": sent[0]["time_utc_ns"] + NS // 2})  # rounded otherwise on another way

    machine.at_sample[60] = probe
    machine.at_sample[65] = lambda: machine.send(sent[0])  # after the first has acted
    once.at_sample[60] = once.probe
    await machine.run(70)
    await once.run(70)
    assert machine.codes() == ["taken", *[ProbeCode.DUPLICATE] * 3]
    assert [reply.result()["ok"] for reply in machine.replies] == [True, False, False, False]
    assert np.array_equal(machine.offsets(), once.offsets())
    assert wanted_because(machine) == ""  # a duplicate asks for nothing
    assert nothing_jumped(machine)


async def test_two_features_of_one_time_are_two_probes(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)

    def both() -> None:
        one = machine.measured()
        machine.send(one)
        machine.send(one | {"feature": "bore-2", "measured_um": one["measured_um"] + 3.0})
        machine.send(one | {"feature": "bore-2", "measured_um": one["measured_um"] + 4.0})

    machine.at_sample[60] = both
    await machine.run(63)
    assert machine.codes() == ["taken", "taken", ProbeCode.DUPLICATE] and nothing_jumped(machine)


async def test_a_chip_is_refused_and_another_probe_is_asked_for(tmp_path: Path) -> None:
    machine, clean = ProbedMachine(tmp_path / "a"), ProbedMachine(tmp_path / "b")
    for one in (machine, clean):
        one.each_hour(300)
    chip = {"feature": "sphere-1"}
    machine.at_sample[290] = lambda: machine.probe(20.0, **chip)
    clean.at_sample[290] = lambda: clean.rng.normal()
    said: list[str] = []
    machine.at_sample[292] = lambda: said.append(wanted_because(machine))
    await machine.run(320)
    await clean.run(320)
    assert machine.codes() == ["taken"] * 4 + [ProbeCode.OUTLIER] and said == [ProbeCode.OUTLIER]
    assert np.max(np.abs(machine.offsets() - clean.offsets())) < 0.3
    assert machine.last_status()["probe_wanted"] is True and nothing_jumped(machine)


async def test_three_probes_that_agree_are_believed_and_the_offset_moves_at_its_rate(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(300)
    for at in (290, 300, 310):
        machine.at_sample[at] = lambda: machine.probe(20.0)
    await machine.run(330)
    assert machine.codes()[-3:] == [ProbeCode.OUTLIER, ProbeCode.OUTLIER, ProbeCode.BELIEVED]
    moved = machine.offsets()[315] - machine.offsets()[309]
    assert -24.0 < moved < -14.0 and nothing_jumped(machine)
    assert "rate_limited" in machine.outcomes[310].offset.reasons


async def test_before_a_zero_and_after_it(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(240)
    machine.at_sample[250] = lambda: machine.command("zero", b'{"mode":"warm"}')
    before: list[dict[str, Any]] = []
    machine.at_sample[251] = lambda: machine.send(machine.measured(time_utc_ns=machine.clock.utc_ns() - 30 * NS))
    machine.at_sample[249] = lambda: before.append(machine.measured())
    machine.at_sample[252] = lambda: machine.send(before[0])
    machine.at_sample[255] = machine.probe
    await machine.run(270)
    assert machine.codes() == ["taken"] * 3 + [ProbeCode.BEFORE_ZERO] * 2 + ["taken"]
    zeroed = machine.outcomes[250]
    assert number(zeroed.estimate.y_pred_um) == pytest.approx(0.0, abs=1.0)  # growth of one sample
    assert nothing_jumped(machine)


async def test_a_zero_takes_the_correction_away_and_keeps_the_gains(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(480)
    await machine.run(500)
    assert machine.daemon is not None
    state = decode_state(machine.daemon._compensation.state()).probing
    assert state is not None and state.correction["active"]
    gain = np.array(state.correction["bank"]["states"])[:, 1]
    assert abs(np.mean(gain) - 0.1) < 0.05
    machine.daemon._compensation.zero("warm")
    machine.daemon._compensation.process(machine.outcomes[-1].sample)
    after = decode_state(machine.daemon._compensation.state()).probing
    assert after is not None and after.correction["active"] and not after.features and len(after.samples) == 1
    assert machine.daemon._compensation.wanted.why == ProbeCode.FIRST
    assert np.array_equal(np.array(after.correction["bank"]["states"])[:, 1], gain)
    assert sum(after.correction["bank"]["weights"]) == pytest.approx(1.0)


async def test_after_a_warm_zero_the_gains_go_on_to_act(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(700)
    machine.at_sample[710] = lambda: machine.command("zero", b'{"mode":"warm"}')
    await machine.run(900)
    assert machine.codes()[-1] == "taken"
    zero = 720  # The offset has moved to the zero by then.
    left, moved = machine.left_um()[zero:], np.ptp(machine.offsets()[zero:])
    assert moved > 15.0 and np.ptp(left) < 0.04 * moved
    assert all(2.0 < number(outcome.offset.y_offset_std_um) < 4.0 for outcome in machine.outcomes[zero:])
    assert nothing_jumped(machine)


async def test_a_doubtful_probe_asks_for_another_one(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path, gain=1.0, noise_um=0.0)
    machine.at_sample[200] = lambda: machine.probe(20.0)
    machine.at_sample[210] = machine.probe
    await machine.run(206)
    assert machine.codes() == ["taken"] and wanted_because(machine) == ProbeCode.DOUBTED
    wrong, std = abs(machine.left_um()[-1]), number(machine.outcomes[-1].offset.y_offset_std_um)
    assert wrong < 2.0 * std
    await machine.run(14)
    assert wanted_because(machine) != ProbeCode.DOUBTED
    assert abs(machine.left_um()[-1]) < 1.5 and nothing_jumped(machine)


def test_a_doubt_that_says_nothing_any_more_asks_for_nothing() -> None:
    """Both hypotheses agree after some probes; their probabilities stay as they were."""
    correction, rng, shares = ProbeCorrection(["DTF", "TDTF"]), np.random.default_rng(1), (20.0, 2.0)
    doubts, asked = 0, 0
    for k in range(60):
        correction.step(shares, 60.0)
        wrong_um = 5.5 if k == 20 else 0.0
        correction.update(22.0 + wrong_um + rng.normal(0.0, 1.5), 1.5, 22.0, shares)
        doubts += correction.doubt > 0.1
        last = PastSample(0, 22.0, 0.0, shares, 0.0, 0.0, 0.0, False)
        state = ProbingState(correction={}, samples=[last])
        asked += wanted_after(state, correction, 1.0, None).why == ProbeCode.DOUBTED
    assert doubts > 10 and asked < 5, (doubts, asked)


async def test_a_probe_during_a_hold_and_one_from_before_it(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    before: list[dict[str, Any]] = []
    machine.at_sample[60] = machine.probe
    machine.at_sample[100] = lambda: (before.append(machine.measured()), machine.command("hold"))
    machine.at_sample[105] = machine.probe
    machine.at_sample[106] = lambda: machine.send(before[0])
    asked: list[bool] = []
    machine.at_sample[108] = lambda: asked.append(machine.last_status()["probe_wanted"])
    machine.at_sample[110] = lambda: machine.command("resume")
    await machine.run(130)
    assert machine.codes() == ["taken", ProbeCode.DURING_HOLD, "taken"]
    # None could be used during the hold, so none is asked for.
    assert asked == [False] and len(set(machine.offsets()[101:110])) == 1
    assert nothing_jumped(machine)


async def test_before_the_first_zero_there_is_no_offset(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.device.replaced[1] = MISSING
    machine.at_sample[4] = lambda: machine.send({**USUAL, "time_utc_ns": machine.clock.utc_ns()})
    machine.at_sample[6] = machine.device.replaced.clear
    await machine.run(10)
    assert machine.codes() == [ProbeCode.NO_OFFSET] and look(machine).clean


async def test_a_lost_temperature_makes_a_probe_weigh_less(tmp_path: Path) -> None:
    """What the prediction does not know is no error of the model: the innovation is expected to be larger."""
    stds = []
    for name in ("whole", "lost"):
        machine = ProbedMachine(tmp_path / name)
        machine.each_hour(240)
        if name == "lost":
            machine.at_sample[241] = lambda one=machine: one.device.replaced.update({0: MISSING})  # type: ignore[misc]
        machine.at_sample[249] = machine.probe
        machine.at_sample[250] = machine.device.replaced.clear
        await machine.run(260)
        stds.append(number(machine.recorded()[-1].innovation_std_um))
        assert nothing_jumped(machine)
    assert stds[1] > 1.2 * stds[0]


async def test_a_probe_of_a_sample_that_failed_is_recorded_as_undecided(tmp_path: Path, monkeypatch: Any) -> None:
    """So is one that was refused before it, and the next one is taken once an operator has looked."""
    machine, process, defects = ProbedMachine(tmp_path), Compensation.process, [ZeroDivisionError("a defect")]

    def fail_once(compensation: Compensation, raw: Any) -> Any:
        if len(machine.outcomes) == 60 and defects:
            raise defects.pop()
        return process(compensation, raw)

    def probe_and_rubbish() -> None:
        machine.command("probe", b"rubbish")
        machine.probe()

    monkeypatch.setattr(Compensation, "process", fail_once)
    machine.at_sample[60] = probe_and_rubbish
    machine.at_sample[61] = lambda: machine.command("resume")
    machine.at_sample[65] = machine.probe
    await machine.run(80)
    assert not defects and machine.codes() == [ProbeCode.MALFORMED, "internal_error", "taken"]
    assert look(machine).clean


async def test_a_probe_that_no_sample_follows_is_recorded_as_undecided(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)

    def probe_and_stop() -> None:
        machine.probe()
        assert machine.daemon is not None
        asyncio.get_running_loop().call_soon(machine.daemon.stop)

    machine.at_sample[30] = probe_and_stop
    machine.at_sample[35] = machine.probe  # as the service ends
    await machine.run(50)
    await machine.run(5)
    assert machine.codes() == [ProbeCode.TIME_UNKNOWN] * 2
    assert all("ended" in probe.text for probe in machine.recorded())
    assert [reply.result()["ok"] for reply in machine.replies] == [True, False]
    await machine.run(5)
    assert nothing_jumped(machine)


async def test_a_control_that_still_moves_to_a_new_offset_is_believed(tmp_path: Path) -> None:
    """After a correction of some µm the control takes most of a minute; what it applies meanwhile is no mismatch."""
    machine = ProbedMachine(tmp_path)
    machine.each_hour(200)

    def probe_underway() -> None:
        before, now = (number(outcome.offset.y_offset_um) for outcome in machine.outcomes[-2:])
        assert abs(now - before) > 2.0
        applied = 0.5 * (before + now)
        machine.probe(offset_applied_um=applied, measured_um=machine.truth_um() + applied)

    machine.at_sample[61] = probe_underway
    await machine.run(70)
    assert machine.codes() == ["taken", "taken"]


# ---------------------------------------------------------------------- restarts and other models


@pytest.mark.parametrize("torn", [0, 700])
async def test_a_kill_between_probes_loses_nothing(tmp_path: Path, torn: int) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(400)
    await machine.run_and_kill(250, torn=torn)
    await machine.sleep(3.0)
    await machine.run(100)
    assert machine.codes() == ["taken"] * 5 and largest_step(machine.outcomes) <= RATE_UM + 1e-9
    assert wanted_because(machine) != ProbeCode.FIRST
    audited = look(machine)
    assert audited.clean and audited.samples == 350


async def test_probes_of_before_and_of_during_a_restart(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(200)
    await machine.run(220)
    earlier = machine.measured(time_utc_ns=machine.clock.utc_ns() - 20 * NS)
    await machine.sleep(6.0)
    during = machine.measured(time_utc_ns=machine.clock.utc_ns() - 60 * NS)
    at = len(machine.outcomes)
    machine.at_sample[at + 3] = lambda: machine.send(earlier)
    machine.at_sample[at + 4] = lambda: machine.send(during)
    await machine.run(20)
    # That of before is compared with what the state contains; for the other nothing was predicted.
    assert machine.codes()[3:] == ["taken", ProbeCode.TIME_UNKNOWN]
    assert nothing_jumped(machine)


async def test_a_clock_that_was_set_back_makes_times_unknown_and_later_probes_are_taken(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(200)
    machine.at_sample[150] = lambda: machine.clock.set_wall_clock(-7200.0)
    machine.at_sample[153] = lambda: machine.send(machine.measured(time_utc_ns=machine.clock.utc_ns() - 10 * MINUTE_NS))
    await machine.run(200)
    assert machine.codes() == ["taken", "taken", ProbeCode.TIME_UNKNOWN, "taken"]
    assert nothing_jumped(machine)


@pytest.mark.parametrize("set_back", [(), (80,), (80, 100)])
def test_a_model_keeps_what_it_has_learned_though_the_clock_was_set_back(set_back: tuple[int, ...]) -> None:
    probe = ProbeSettings(std_um=0.5, measured_max_um=200.0, largest_um=60.0, tolerance_um=3.0)
    conf = msgspec.structs.replace(loop_settings(), probe=probe)
    present, outcome, truth_um = Compensation(conf, QUILL), None, 0.0
    shadow = Shadow(Compensation(conf, parse_model(stronger(0.2), source="test")), b"")
    for i, sample in enumerate(loop_machine(150, lambda i: 0.0)):
        if outcome is not None and i % 20 == 0:
            present.receive_probes([probed(truth_um, outcome.offset)])
        truth_um = number(sample.channels["y_um"].mean)
        channels = {name: one for name, one in sample.channels.items() if name != "y_um"}
        channels["y_um"] = msgspec.structs.replace(
            sample.channels["y_um"], mean=None, quality="invalid", device_quality="invalid"
        )
        time_ns = sample.time_utc_ns - sum(300 * NS for at in set_back if i >= at)
        outcome = present.process(msgspec.structs.replace(sample, channels=channels, time_utc_ns=time_ns))
        shadow.process(outcome)
    other = shadow.compensation
    assert other.probing is not None and other.probing.state.correction != {}
    learned = other.probing.state.correction
    other.continue_from(present.status.handover)
    assert other.probing.state.correction == learned


def test_a_probe_of_the_sample_before_a_raised_level_shows_no_part_of_it() -> None:
    """Y is larger by as much: the probe comes after the adoption, and lies between two samples."""
    probe = ProbeSettings(std_um=0.5, measured_max_um=200.0, largest_um=60.0, tolerance_um=3.0)
    conf = msgspec.structs.replace(loop_settings(), probe=probe)
    shown_um = []
    for raised_um in (0.0, 6.0):
        compensation, outcomes, truth_um = Compensation(conf, QUILL), list[Outcome](), 0.0
        for i, sample in enumerate(loop_machine(61, lambda i: 0.0)):
            if i == 60:
                compensation.raise_level(raised_um)
                truth_um += raised_um
            if i in (20, 40, 60):
                compensation.receive_probes([probed(truth_um, outcomes[-1].offset)])
            truth_um = number(sample.channels["y_um"].mean)
            outcomes.append(compensation.process(sample))
        shown_um.append([number(one.innovation_um) for outcome in outcomes for one in outcome.probes])
    assert len(shown_um[0]) == 3 and shown_um[1] == pytest.approx(shown_um[0], abs=1e-9)


async def test_a_restart_reproduces_the_correction(tmp_path: Path) -> None:
    """Killed or not, the same samples and probes give the same offsets, bit for bit."""
    whole, killed = ProbedMachine(tmp_path / "a"), ProbedMachine(tmp_path / "b")
    for machine in (whole, killed):
        machine.each_hour(300)
    await whole.run(300)
    await killed.run_and_kill(200)
    await killed.run(100)
    assert np.array_equal(whole.offsets(), killed.offsets())


async def test_another_model_goes_on_with_the_correction(tmp_path: Path) -> None:
    """Adopted at the moment of a probe: the offset does not move by more than it may, the deviation stays."""
    machine = ProbedMachine(tmp_path)
    machine.each_hour(1100)
    model = msgspec.json.encode({"model": other_model().decode(), "force": True})
    machine.at_sample[600] = lambda: (machine.probe(), machine.command("adopt", model))
    machine.at_sample[601] = machine.probe
    await machine.run(890)
    (adopted,) = [event for event in machine.events("adopt") if event.data["ok"]]
    assert abs(adopted.data["difference_um"]) < 0.05
    at = next(i for i, o in enumerate(machine.outcomes) if o.offset.model_sha256 == adopted.data["new_sha256"])
    before, after = machine.outcomes[at - 1].offset, machine.outcomes[at].offset
    assert abs(number(after.y_offset_um) - number(before.y_offset_um)) < 2.0
    assert number(after.y_offset_std_um) < 1.5 * number(before.y_offset_std_um)
    assert set(machine.codes()) == {"taken"} and nothing_jumped(machine)
    assert len(machine.outcomes) == 890
    left = machine.left_um()
    assert np.sqrt(np.mean(left[at:] ** 2)) < 2.5


@pytest.mark.parametrize("changed", ["configuration", "model"])
async def test_a_restart_with_another_configuration_or_model_goes_on_with_the_correction(
    tmp_path: Path, changed: str
) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(1000)
    await machine.run(590)
    last = number(machine.outcomes[-1].offset.y_offset_um)
    if changed == "model":
        machine.configured = other_model()
    else:
        machine.config_bytes = PROBED + b"# changed\n"
    await machine.run(200)
    assert any(f"the {changed} has changed" in event.text for event in machine.events("restart"))
    first = machine.outcomes[590].offset
    assert abs(number(first.y_offset_um) - last) < 2.0 and wanted_because(machine) != ProbeCode.FIRST
    assert np.sqrt(np.mean(machine.left_um()[590:] ** 2)) < 2.5
    assert set(machine.codes()) == {"taken"} and nothing_jumped(machine)


async def test_a_run_of_another_model_uses_the_probes_that_were_taken(tmp_path: Path) -> None:
    """With the same model it gives the recorded offsets; with another the probes make up for the difference."""
    machine = ProbedMachine(tmp_path)
    machine.each_hour(500)
    machine.at_sample[130] = lambda: machine.probe(offset_applied_um=machine.applied_um() + 5.0)
    machine.at_sample[250] = lambda: machine.probe(20.0)
    await machine.run(300)
    await machine.sleep(3.0)
    await machine.run(250)
    files = recordings(machine.recordings, MACHINE)
    same = compare(files, machine.daemon._compensation.model)  # type: ignore[union-attr]
    assert same.samples == 550 and same.own.offsets.peak == 0.0
    other = compare(files, parse_model(other_model(), source="test"))
    assert 0.0 < other.own.offsets.rms < 2.5


# ---------------------------------------------------------------------- when a probe is wanted


async def test_the_time_by_which_a_probe_is_wanted_comes_true(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    seen: list[dict[str, Any]] = []
    machine.each_hour(250)
    machine.at_sample[245] = lambda: seen.append(machine.last_status())
    await machine.run(900)
    foretold = seen[0]
    assert foretold["probe_wanted"] is False and foretold["wanted_why"] == ""
    assert foretold["wanted_std_um"] < foretold["wanted_tolerance_um"] == 3.0
    statuses = [json.loads(data) for name, data in machine.published if name == "status"]
    first = next(s for s in statuses[245:] if s["probe_wanted"])
    assert first["wanted_why"] == ProbeCode.DEVIATION and first["wanted_std_um"] > 3.0
    assert first["wanted_by_ns"] == first["time_utc_ns"]
    # The shares of the paths change meanwhile, so an early forecast is not exact; the last one is.
    assert foretold["wanted_by_ns"] > foretold["time_utc_ns"]
    (last,) = [s for s in statuses if s["seq"] == first["seq"] - 1]
    assert abs(last["wanted_by_ns"] - first["time_utc_ns"]) < 25 * MINUTE_NS


def written(folder: Path, table: bytes) -> Path:
    """Write the configuration of a machine with a table of probes."""
    text = configuration(
        "vmc-07", {"rtu": "/dev/ttyS90", "dcon": "/dev/ttyS91", "tcp": 1502, "plc": 1503, "data": 1, "command": 2}, 7447
    )
    path = folder / "machine.toml"
    path.write_bytes(text.encode() + table)
    return path


def test_a_tolerance_below_the_noise_of_a_probe_is_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, PROBE.replace(b"tolerance_um = 3.0", b"tolerance_um = 0.5"))
    assert main(["check", "--config", str(path)]) == 0
    said = capsys.readouterr()
    assert (
        "probe_tolerance" in said.err
        and "probes: on, one value ±1 µm, at most 60 µm, correction at most 40 µm" in said.out
    )
    assert "tolerance 0.5 µm" in said.out and "probe_bounds" not in said.err
    written(tmp_path, PROBE.replace(b"measured_max_um = 60.0", b"measured_max_um = 30.0"))
    assert main(["check", "--config", str(path)]) == 0
    assert "[probe_bounds]" in capsys.readouterr().err


def test_probes_older_than_the_samples_that_are_kept_are_warned_of_and_refused_by_that_name(tmp_path: Path) -> None:
    """300 samples of 5 s are 25 min, and the default is 30."""
    settings = ProbeSettings(std_um=1.0, measured_max_um=60.0, largest_um=40.0)
    probing = Probing(settings, ["DTF", "TDTF"], offset_max_um=200.0, period_s=5.0)

    def code(age_min: float) -> str:
        time_ns = START_NS - round(age_min * MINUTE_NS)
        request = ProbeRequest(
            schema=1, time_utc_ns=time_ns, axis="y", measured_um=1.0, offset_applied_um=0.0, feature="bore"
        )
        try:
            probing.check(ReceivedProbe(request=request, received_utc_ns=START_NS))
        except ProbeRefused as refused:
            return refused.code
        return ""

    for at in range(360):
        probing.add(PastSample(START_NS - (359 - at) * 5 * NS, 0.0, 0.0, (0.0, 0.0), 0.1, math.nan, math.nan, False))
        probing.publish(0.0, 0.0, is_held=False)
        if at == 100:
            assert code(29.95) == ProbeCode.TIME_UNKNOWN  # before the first one: no other was forgotten
    assert [code(minutes) for minutes in (24.9, 26.0, 29.9, 30.1)] == ["", *[ProbeCode.TOO_OLD] * 3]

    setup = load(str(written(tmp_path, PROBE)))
    assert not any(remark.code == "probe_oldest" for remark in setup.warnings())
    paths = {name: getattr(setup.model, name).continuous for name in ("ttf", "dtf", "tdtf")}
    sampled: dict[str, Any] = {name: ModelPath.from_continuous(one, 5.0) for name, one in paths.items()}
    short = dataclasses.replace(setup, model=dataclasses.replace(setup.model, period_s=5.0, **sampled))
    (remark,) = (remark for remark in short.warnings() if remark.code == "probe_oldest")
    assert "probe.oldest_min = 30 is more than 300 samples of 5 s: an older probe than 25 min" in remark


async def test_the_first_probe_is_asked_for(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.at_sample[10] = machine.probe
    reasons: list[str] = []
    for at in (9, 13):
        machine.at_sample[at] = lambda: reasons.append(wanted_because(machine))
    await machine.run(15)
    assert reasons == [ProbeCode.FIRST, ""]


async def test_a_correction_at_its_limit_is_a_reason(tmp_path: Path) -> None:
    limited = PROBED.replace(b"largest_um = 40.0", b"largest_um = 4.0")
    machine = ProbedMachine(tmp_path, gain=1.0, config=limited, noise_um=0.0)
    machine.at_sample[20] = lambda: machine.probe(10.0)
    await machine.run(25)
    after = machine.outcomes[-1]
    assert "correction_limited" in after.offset.reasons and after.offset.state == "degraded"
    shares = after.estimate.y_dtf_um + after.estimate.y_tdtf_um
    assert number(after.estimate.y_pred_um) - shares == pytest.approx(4.0)
    # What is not applied is unknown to the receiver, too.
    assert number(after.offset.y_offset_std_um) > 4.5
    assert nothing_jumped(machine)


# ---------------------------------------------------------------------- the last samples


def past(*values: tuple[float, float, float]) -> list[PastSample]:
    """Samples with minute, prediction and offset; the rate is 1 µm/min."""
    return [
        PastSample(round(t * MINUTE_NS), y, 1.0, (y, 0.0), 0.1, offset, -1.0, False, MINUTE_NS // 2)
        for t, y, offset in values
    ]


def test_a_time_between_two_samples_is_between_their_predictions() -> None:
    samples = past((1, 10.0, -10.0), (2, 12.0, -12.0), (5, 20.0, math.nan))
    # A prediction belongs to the middle of its minute, its offset to the end.
    found = predicted_at(samples, round(0.75 * MINUTE_NS), 60.0)
    assert found is not None and found.y_um == pytest.approx(10.5)
    assert found.contributions_um == pytest.approx((10.5, 0.0))
    # Before the first, in a gap, and just behind its edge, where the rate foretells it.
    assert predicted_at(samples, round(0.4 * MINUTE_NS), 60.0) is None
    assert predicted_at(samples, round(3.5 * MINUTE_NS), 60.0) is None
    behind = predicted_at(samples, round(2.5 * MINUTE_NS), 60.0)
    assert behind is not None and behind.y_um == pytest.approx(13.0)
    assert predicted_at(samples, round(6.6 * MINUTE_NS), 60.0) is None


@pytest.mark.parametrize(("interval_s", "behind_s"), [(60.0, 0.0), (20.0, 20.0), (1.0, 29.5)])
async def test_a_prediction_belongs_to_the_middle_of_its_polls(
    tmp_path: Path, interval_s: float, behind_s: float
) -> None:
    config = PROBED.replace(b"poll_interval_s = 60.0", f"poll_interval_s = {interval_s}".encode())
    machine = ProbedMachine(tmp_path, config=config)
    await machine.run(2)
    assert machine.daemon is not None
    state = decode_state(machine.daemon._compensation.state()).probing
    assert state is not None
    last = state.samples[-1]
    assert last.time_ns - last.middle_ns == behind_s * NS


@pytest.mark.parametrize(("interval_s", "begin_s", "behind_s"), [(20.0, 30, 10.0), (20.0, 45, 0.0), (1.0, 45, 7.0)])
async def test_the_polls_of_a_first_sample_are_its_last(
    tmp_path: Path, interval_s: float, begin_s: int, behind_s: float
) -> None:
    """A service that starts within a sample has only its end: the polls are as far apart as in a whole one."""
    config = PROBED.replace(b"poll_interval_s = 60.0", f"poll_interval_s = {interval_s}".encode())
    machine = ProbedMachine(tmp_path, config=config)
    await machine.clock.sleep(begin_s)
    await machine.run(2)
    assert machine.daemon is not None
    state = decode_state(machine.daemon._compensation.state()).probing
    assert state is not None
    assert [sample.behind_ns for sample in state.samples] == [behind_s * NS, 0.5 * (60.0 - interval_s) * NS]


def test_the_offset_of_a_time_is_followed_with_its_rate_and_expires() -> None:
    samples = past((1, 10.0, -10.0), (2, 12.0, -13.0), (3, 12.0, math.nan))
    assert offsets_at(samples, round(2.5 * MINUTE_NS), 60.0) == pytest.approx((-13.5, -10.0))
    assert offsets_at(samples[:1], round(1.5 * MINUTE_NS), 60.0) == pytest.approx((-10.5, -10.0))
    # The rate is followed for 75 s, the offset is valid for 150 s.
    assert offsets_at(samples[:1], round(3.2 * MINUTE_NS), 60.0) == pytest.approx((-11.25, -10.0))
    assert published_at(samples[:1], round(3.4 * MINUTE_NS), 60.0) is not None
    assert published_at(samples[:1], round(3.6 * MINUTE_NS), 60.0) is None
    assert published_at(samples, round(0.5 * MINUTE_NS), 60.0) is None


# ---------------------------------------------------------------------- audit, and a machine without probes


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (rb'"measured_um":[^,]+', b'"measured_um":1.25'),
        (rb'"feature":"sphere-1"', b'"feature":"sphere-2"'),
        (rb'"taken":true', b'"taken":false'),
        (rb'"measured_um":[^,]+', b'"measured_um":null'),
    ],
)
async def test_a_changed_probe_is_found_even_under_a_new_chain(tmp_path: Path, old: bytes, new: bytes) -> None:
    machine = ProbedMachine(tmp_path)
    for at in (60, 90, 120):
        machine.at_sample[at] = machine.probe
    await machine.run(130)
    (path,) = recordings(machine.recordings, MACHINE)
    _, contents = lines_of(path)

    def change(lines: list[Line]) -> list[Line]:
        at = [i for i, line in enumerate(lines) if line.topic == "probe"][1]
        changed = re.sub(old, new, lines[at].data, count=1)
        assert changed != lines[at].data
        lines[at] = replace(lines[at], data=changed)
        return with_new_values(lines, contents)

    rewrite(path, change)
    found = look(machine)
    assert not found.clean
    (file,) = found.files
    assert file.difference is not None and file.differing > 0


async def test_without_the_table_everything_is_as_without_probes(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path, config=CONFIG)
    machine.at_sample[20] = lambda: machine.send(machine.measured())
    await machine.run(30)
    reply = machine.replies[0].result()
    assert (reply["ok"], reply["code"]) == (False, ProbeCode.NOT_CONFIGURED)
    (path,) = recordings(machine.recordings, MACHINE)
    with Container(path) as container:
        topics = {channel.topic for channel in container.survey(whole=True).channels.values()}
    assert "/probe" not in topics and not {name for name in machine.last_status() if "wanted" in name}
    assert machine.daemon is not None and b"probing" not in machine.daemon._compensation.state()


async def test_no_sample_is_late_by_probes(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    for at in range(40, 100):
        machine.at_sample[at] = lambda: [
            machine.probe(feature=f"f{i}", time_utc_ns=machine.clock.utc_ns() - i * 2 * NS) for i in range(20)
        ]
    await machine.run(100)
    assert machine.daemon is not None and machine.daemon.latency_s
    # The median: another program of this computer may delay a single one.
    usual = float(np.median(list(machine.daemon.latency_s)[40:]))
    assert usual < 0.5, usual
    assert np.diff([outcome.sample.time_utc_ns for outcome in machine.outcomes]).tolist() == [MINUTE_NS] * 99
    assert ProbeCode.TOO_MANY_FEATURES in machine.codes()


def test_only_the_machine_of_the_key_hears_a_probe() -> None:
    heard: list[tuple[str, bytes]] = []
    settings = Zenoh(prefix="shop/vmc-07", listen=[f"tcp/127.0.0.1:{free_port()}"])
    probe = ProbeRequest(schema=1, time_utc_ns=5, axis="y", measured_um=1.0, offset_applied_um=-2.0, feature="a")

    def hear(name: str, payload: bytes, sender: Any) -> dict[str, Any]:
        heard.append((name, payload))
        return {"ok": True, "text": name, "code": ""}

    with Publisher(settings, hear):
        client = Zenoh(prefix="shop/vmc-07", connect=settings.listen)
        assert send_probe(client, probe, timeout_s=5.0)["ok"]
        with pytest.raises(ServiceError):
            send_probe(msgspec.structs.replace(client, prefix="shop/vmc-08"), probe, timeout_s=1.0)
    ((name, payload),) = heard
    assert name == "probe" and read_probe(payload) == probe
