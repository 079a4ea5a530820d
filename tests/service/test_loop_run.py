"""The loop over simulated days: what it adopts, what it goes back from, and what it leaves alone."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.clock import NS
from compensator.config import Config, parse_config
from compensator.errors import ConfigError
from compensator.events import EventKind
from compensator.messages import ProbeRequest, Sample, number
from compensator.model.model_file import parse_model
from compensator.service.loop.record import usable_table
from compensator.service.loop.run import Diagnosed, LoopStep, OfflineLoop, warmed_on
from compensator.service.loop.trust import is_alarmed
from compensator.service.probing import ReceivedProbe
from compensator.service.transfer.model_store import sha256_of
from compensator.service.transfer.second_opinion import sensor_suspected
from tests.audit.made import CONFIG
from tests.service.looping import (
    DAY,
    LATER_NS,
    NIGHT,
    Night,
    decisions,
    errors,
    evening,
    extended,
    machine,
    run,
    settings,
    shown,
)
from tests.service.probed import COOLANT, PROBE, SENSOR
from tests.service.test_restart import QUILL


def test_an_effect_is_found_at_night_shadowed_and_adopted_without_a_jump() -> None:
    night = Night(shown(extended()))
    loop = OfflineLoop(settings(), QUILL, night)
    steps = run(loop, evening(NIGHT + DAY + 60))
    found = decisions(steps)
    assert [step for _, step, _ in found[:3]] == ["diagnose", "shadow", "adopt"]
    adopted = found[2][0]
    assert 12 * 60 <= adopted - found[0][0] <= 14 * 60
    assert loop.effects == ("input:coolant_degc",) and loop.phase == "watching"
    assert {step.model_sha256 for step in steps[adopted + 1 :]} == {sha256_of(extended())}
    events = [note for step in steps for note in step.events if note.kind == EventKind.ADOPT]
    assert [(event.data["action"], event.data["by"]) for event in events] == [("adopt", "loop")]
    assert events[0].data["comparison"]["verdict"] == "better"
    left = errors(steps)
    assert np.std(left[adopted + 60 :]) < 0.3 * np.std(left[:adopted])
    offsets = np.array([step.outcome.offset.y_offset_um for step in steps[1:]])
    assert np.max(np.abs(np.diff(offsets))) <= 8.0 + 1e-9
    # The second night finds what is there already.
    assert ("nothing", "unchanged") in [decision[1:] for decision in found[3:]]
    assert all(model == QUILL for _, model in night.asked)


@pytest.mark.parametrize("policy", ["adopt", "propose"])
def test_a_candidate_that_is_worse_is_neither_adopted_nor_proposed(policy: str) -> None:
    """The diagnosis has found the coolant, and today it does not act."""
    loop = OfflineLoop(settings(loop={"policy": policy}), QUILL, Night(shown(extended())))
    steps = run(loop, evening(NIGHT + 18 * 60, acts=lambda i: float(i < NIGHT)))
    found = [decision[1:] for decision in decisions(steps)]
    assert ("end", "worse") in found and not {"adopt", "propose"} & {step for step, _ in found}
    assert loop.effects == ()


def test_a_candidate_without_a_clear_difference_ends_after_its_time() -> None:
    tables = {"loop": {"policy": "adopt", "shadow_h": 6.0, "watch_h": 24.0}}
    loop = OfflineLoop(settings(**tables), QUILL, Night(shown(extended(0.02, 0.001)), shown(None, "adequate")))
    steps = run(loop, evening(NIGHT + DAY + 60, acts=lambda i: 0.0))
    found = [decision[1:] for decision in decisions(steps)]
    assert ("end", "no_difference") in found and "adopt" not in [step for step, _ in found]


def test_when_the_effect_ends_the_service_goes_back_by_itself() -> None:
    night = Night(shown(extended()), shown(extended()))
    loop = OfflineLoop(settings(), QUILL, night)
    ends = NIGHT + 960
    steps = run(loop, evening(NIGHT + 2 * DAY, acts=lambda i: float(i < ends)))
    found = [(seq, step) for seq, step, _ in decisions(steps) if step in ("adopt", "back")]
    assert [step for _, step in found] == ["adopt", "back"]
    assert ends < found[1][0] < ends + DAY and loop.effects == () and loop.phase == "idle"
    # It is not adopted again while it is remembered.
    assert decisions(steps)[-1][1:] == ("nothing", "avoided")


@pytest.mark.parametrize(
    "later",
    [
        shown(None, "adequate"),
        # Channels that make up for a source explain nothing.
        Diagnosed("unexplained", ("regression:coolant_degc",), extended(), "text"),
    ],
    ids=["nothing", "a remainder"],
)
def test_a_diagnosis_that_explains_nothing_brings_the_calibrated_model_into_shadow(later: Diagnosed) -> None:
    night = Night(shown(extended()), later)
    loop = OfflineLoop(settings(), QUILL, night)
    ends = NIGHT + 720
    steps = run(loop, evening(NIGHT + 2 * DAY, acts=lambda i: float(i < ends)))
    found = decisions(steps)
    assert next(step for _, step, _ in found if step in ("adopt", "back")) == "adopt"
    assert loop.effects == ()


@pytest.mark.parametrize("verdict", ["unexplained", "failed"])
def test_nothing_follows_from_a_diagnosis_that_explains_nothing(verdict: str) -> None:
    loop = OfflineLoop(settings(), QUILL, Night(Diagnosed(verdict, (), None, "text", "look at the sensor")))
    steps = run(loop, evening(NIGHT + 60))
    assert [decision[1:] for decision in decisions(steps)] == [("diagnose", "planned"), ("nothing", verdict)]
    assert not any(step.candidates for step in steps)


@pytest.mark.parametrize(
    ("model", "why"),
    [
        (b"rubbish", "refused"),
        (QUILL.replace(b"period_s = 60", b"period_s = 30"), "refused"),
        (extended().replace(b"coolant_degc", b"no_such_channel"), "refused"),
        (extended().replace(b"0.0002567", b"0.0005"), "refused"),
    ],
    ids=["rubbish", "nothing new", "unknown channel", "other paths"],
)
def test_rubbish_is_refused(model: bytes, why: str) -> None:
    found = Diagnosed("explained", ("input:coolant_degc",), model, "text")
    loop = OfflineLoop(settings(), QUILL, Night(found))
    steps = run(loop, evening(NIGHT + 60))
    assert [decision[1:] for decision in decisions(steps)] == [("diagnose", "planned"), ("nothing", why)]


def test_an_effect_of_the_measurement_is_never_part_of_a_candidate() -> None:
    drift = b'\n[[effect]]\nkind = "drift"\nrate_um_per_h = 0.2\n'
    loop = OfflineLoop(settings(), QUILL, Night(Diagnosed("explained", ("drift",), QUILL + drift, "text")))
    steps = run(loop, evening(NIGHT + 60))
    assert [decision[1:] for decision in decisions(steps)] == [("diagnose", "planned"), ("nothing", "refused")]


CHECKED = {"plausibility": {"false_alarm_days": 30.0, "residual_std_um": 0.6, "residual_correlation_min": 30.0}}


def test_a_sensor_fault_in_the_middle_of_a_shadow_begins_the_comparison_anew() -> None:
    """T_Q drifts under both models, while the candidate has an effect that is there."""
    begins, ends = NIGHT + 240, NIGHT + 540

    def drifting(i: int, values: dict[str, float]) -> None:
        if begins <= i < ends:
            values["t_q_degc"] += 0.02 * (i - begins)

    loop = OfflineLoop(settings(**CHECKED), QUILL, Night(shown(extended())))
    source = evening(ends + 15 * 60, acts=lambda i: float(i >= NIGHT), change=drifting)
    steps = run(loop, source)
    hours = [one.hours for step in steps for one in step.candidates if one.role == "candidate"]
    assert any(later == 0.0 < before for before, later in itertools.pairwise(hours)), "nothing was forgotten"
    adopted = next(seq for seq, step, _ in decisions(steps) if step == "adopt")
    assert adopted >= ends + 12 * 60 and loop.effects == ("input:coolant_degc",)


def adopted_at(loses: Callable[[int], bool]) -> int:
    """Run a night and a day with an effect, in which T_Q is missing in some samples; return when a model is adopted."""

    def losing(i: int, values: dict[str, float]) -> None:
        if loses(i):
            values["t_q_degc"] = math.nan

    loop = OfflineLoop(settings(), QUILL, Night(shown(extended())))
    return next(
        seq for seq, step, _ in decisions(run(loop, evening(NIGHT + 18 * 60, change=losing))) if step == "adopt"
    )


def test_what_a_line_loses_now_and_then_keeps_nothing_from_being_decided() -> None:
    """One sample in twenty, so there is no half an hour without a loss; a couple that was broken delays a decision."""
    whole = adopted_at(lambda i: False)
    assert whole <= adopted_at(lambda i: i % 20 == 0) <= whole + 60
    broken = range(whole - 61, whole - 1)
    assert broken.stop + 30 <= adopted_at(lambda i: i in broken) <= broken.stop + 180


def test_an_alarm_under_the_present_model_alone_is_a_reason_to_diagnose_and_no_fault_of_a_sensor() -> None:
    """To a check that knows one model a missing effect looks like a sensor that drifts."""
    loop = OfflineLoop(settings(**CHECKED), QUILL, Night(shown(extended())))
    steps = run(loop, machine(21 * 60))
    alarmed = [step for step in steps if sensor_suspected(step.outcome.offset.reasons)]
    assert len(alarmed) > 240
    found = [decision[1:] for decision in decisions(steps)]
    assert found[:2] == [("diagnose", "misfit"), ("shadow", "")]
    # What is found again meanwhile begins no other comparison.
    assert [step for step, _ in found].count("shadow") == 1 and ("adopt", "") in found
    assert not any(is_alarmed(step.outcome.offset.reasons) for step in steps[-30:])


def test_a_creeping_mount_does_not_make_a_better_model() -> None:
    """From the night on Y creeps by 1 µm/h; the candidate explains it by the coolant, which does not act."""
    creep = lambda i: max(i - NIGHT, 0) / 60.0  # noqa: E731
    loop = OfflineLoop(settings(), QUILL, Night(shown(extended(1.0))))
    steps = run(loop, evening(NIGHT + 14 * 60, acts=lambda i: 0.0, more=creep))
    assert "adopt" not in [step for _, step, _ in decisions(steps)]


def test_a_hand_on_the_machine_is_not_compared() -> None:
    loop = OfflineLoop(settings(), QUILL, Night(shown(extended())))
    source = evening(NIGHT + 61 + 600 + 900)
    run(loop, source, NIGHT + 60)
    (before,) = run(loop, source, 1)[0].candidates
    loop.hold()
    held = run(loop, source, 600)
    assert held[-1].candidates[0].hours <= before.hours + 0.5
    assert "adopt" not in [step for _, step, _ in decisions(held)]
    loop.resume()
    assert "adopt" in [step for _, step, _ in decisions(run(loop, source, 900))]


def test_after_an_adoption_under_a_hand_the_model_before_is_watched_all_the_same() -> None:
    tables = {"loop": {"policy": "propose", "shadow_h": 6.0}}
    loop = OfflineLoop(settings(**tables), QUILL, Night(shown(extended())))
    ends = NIGHT + 600
    source = evening(NIGHT + 1800, acts=lambda i: float(i < ends))
    run(loop, source, NIGHT + 420)
    assert loop.phase == "proposed"
    loop.hold()
    loop.accept()
    held = run(loop, source, 60)
    assert loop.phase == "watching" and np.ptp([number(step.outcome.offset.y_offset_um) for step in held]) == 0.0
    loop.resume()
    assert "back" in [step for _, step, _ in decisions(run(loop, source))]


def test_a_missing_channel_of_the_candidate_does_not_judge_it() -> None:
    def missing(i: int, values: dict[str, float]) -> None:
        if i > NIGHT + 30:
            values["coolant_degc"] = math.nan

    loop = OfflineLoop(settings(), QUILL, Night(shown(extended())))
    steps = run(loop, evening(NIGHT + 18 * 60, change=missing))
    assert "adopt" not in [step for _, step, _ in decisions(steps)]
    last = [one for step in steps for one in step.candidates][-1]
    assert last.hours <= 1.0 and "channel_missing:coolant_degc" in last.reasons


def test_no_diagnosis_while_sensors_contradict_each_other_or_a_temperature_is_missing() -> None:
    def missing(i: int, values: dict[str, float]) -> None:
        if NIGHT - 60 <= i < NIGHT + 90:
            values["at_degc"] = math.nan

    night = Night(shown(None, "adequate"))
    steps = run(OfflineLoop(settings(), QUILL, night), evening(NIGHT + 200, acts=lambda i: 0.0, change=missing))
    assert NIGHT + 90 + 29 <= decisions(steps)[0][0] <= NIGHT + 90 + 31 and len(night.asked) == 1


@pytest.mark.parametrize("lost", [(), ("y_um",), ("t_q_degc",)], ids=["whole", "without Y", "without T_Q"])
def test_a_run_continues_from_its_state_with_the_same_bits(lost: tuple[str, ...]) -> None:
    """Also where a channel was missing for ten minutes before it: its state then has values that are missing."""

    def whole() -> OfflineLoop:
        return OfflineLoop(settings(), QUILL, Night(shown(extended())))

    def losing(i: int, values: dict[str, float]) -> None:
        if NIGHT + 285 <= i < NIGHT + 295:
            values.update(dict.fromkeys(lost, math.nan))

    one, resumed = whole(), whole()
    source = evening(NIGHT + 900, change=losing)
    run(one, source, NIGHT + 300)
    resumed.restore(one.state())
    rest = list(source)
    for a, b in zip(run(one, iter(rest)), run(resumed, iter(rest)), strict=True):
        assert (a.outcome.offset, a.candidates, a.events) == (b.outcome.offset, b.candidates, b.events)
    assert one.effects == resumed.effects == ("input:coolant_degc",)


def test_a_kill_in_the_middle_of_a_diagnosis_makes_it_again() -> None:
    night = Night(shown(extended()))
    loop = OfflineLoop(settings(), QUILL, night)
    source = evening(NIGHT + 60)
    run(loop, source, NIGHT + 1)
    assert len(night.asked) == 1
    again = OfflineLoop(settings(), QUILL, night)
    again.restore(loop.state())
    steps = run(again, source, 3)
    assert len(night.asked) == 2 and steps[-1].candidates


def test_a_candidate_that_is_new_passes_a_pause_too() -> None:
    """The diagnosis has ended with the last sample before it."""
    loop, samples = OfflineLoop(settings(), QUILL, Night(shown(extended()))), evening(NIGHT + 120)
    steps = [loop.process(sample) for sample in itertools.islice(samples, NIGHT - 30)]
    while ("diagnose", "planned") not in [found[1:] for found in decisions(steps)]:
        steps.append(loop.process(next(samples)))
    loop.pause(30)
    sample = next(itertools.islice(samples, 30, None))
    (candidate,) = loop.process(sample).candidates
    model = parse_model(extended(), source="candidate")
    always = warmed_on(settings(), model, [step.outcome for step in steps])
    always.pause(30)
    assert candidate.y_pred_um == always.process(sample).estimate.y_pred_um


def test_a_proposal_is_withdrawn_when_it_is_no_longer_better() -> None:
    tables = {"loop": {"policy": "propose", "shadow_h": 6.0}}
    loop = OfflineLoop(settings(**tables), QUILL, Night(shown(extended())))
    ends = NIGHT + 480
    steps = run(loop, evening(NIGHT + DAY, acts=lambda i: float(i < ends)))
    found = [decision[1:] for decision in decisions(steps)]
    assert found[:3] == [("diagnose", "planned"), ("shadow", ""), ("propose", "")]
    assert ("withdraw", "") in found or ("end", "worse") in found
    assert loop.effects == () and {step.model_sha256 for step in steps} == {sha256_of(QUILL)}


def test_the_table_of_a_diagnosis_leaves_out_what_must_not_be_used() -> None:
    loop = OfflineLoop(settings(**CHECKED), QUILL, Night(shown(None, "adequate")))
    source = machine(900)
    steps = run(loop, source, 300)
    loop.hold()
    steps += run(loop, source, 60)
    loop.resume()
    outcomes = [step.outcome for step in [*steps, *run(loop, source)]]
    assert any(is_alarmed(outcome.offset.reasons) for outcome in outcomes)
    apart = msgspec.structs.replace(outcomes[700].offset, reasons=["t_q_at_apart"])
    outcomes[700] = msgspec.structs.replace(outcomes[700], offset=apart)
    y = usable_table(outcomes).columns["y_um"]
    left_out = {*range(300, 360), *range(641, 701)}
    assert {int(i) for i in np.flatnonzero(np.isnan(y))} == left_out
    assert np.isfinite(usable_table(outcomes).columns["t_q_degc"]).all()


PROBED = {"probe": {"std_um": 0.5, "measured_max_um": 80.0, "largest_um": 60.0}}


def probed(loop: OfflineLoop, samples: Iterator[Sample], every: int, seed: int = 3) -> list[LoopStep]:
    """Run a machine without a displacement sensor, whose Y is probed now and then."""
    rng, steps, known = np.random.default_rng(seed), list[LoopStep](), 0.0
    for i, one in enumerate(samples):
        y = number(one.channels["y_um"].mean)
        channels = {name: channel for name, channel in one.channels.items() if name != "y_um"}
        received = []
        if steps and i % every == every - 1 and i > 60:
            offset = steps[-1].outcome.offset
            applied = number(offset.y_offset_um) + number(offset.y_offset_rate_um_per_min) / 6.0
            request = ProbeRequest(
                schema=1,
                time_utc_ns=offset.time_utc_ns + 10 * NS,
                axis="y",
                measured_um=known + applied + 0.5 * float(rng.normal()),
                offset_applied_um=applied,
                feature="sphere",
            )
            received = [ReceivedProbe(request=request, received_utc_ns=offset.time_utc_ns + 12 * NS)]
        known = y
        steps.append(loop.process(msgspec.structs.replace(one, channels=channels), received))
    return steps


def without_sensor(**changes: Any) -> Config:
    found = settings(**PROBED, **changes)
    return msgspec.structs.replace(found, channel=[one for one in found.channel if one.name != "y_um"])


@pytest.mark.parametrize("y_moved_utc_ns", [0, LATER_NS])
def test_from_probes_alone_a_better_model_is_adopted_and_nothing_is_counted_twice(y_moved_utc_ns: int) -> None:
    """A drift that is named is no reason to wait for a zero: what creeps both models are corrected for."""
    found_by_night = dataclasses.replace(shown(extended()), y_moved_utc_ns=y_moved_utc_ns)
    loop = OfflineLoop(without_sensor(), QUILL, Night(found_by_night))
    source = list(evening(NIGHT + DAY, noise_um=0.0))
    steps = probed(loop, iter(source), 30)
    assert sum(probe.taken for step in steps for probe in step.outcome.probes) > 40
    found = decisions(steps)
    assert [step for _, step, _ in found[:3]] == ["diagnose", "shadow", "adopt"]
    event = next(note for step in steps for note in step.events if note.kind == EventKind.ADOPT)
    comparison = event.data["comparison"]
    assert comparison["measured_by"] == "probe" and comparison["probes"] >= 8 and comparison["hours"] >= 12.0
    # The candidate goes on with what it has learned itself, beside its effect: what was compared is what is deployed.
    last = next(step for step in reversed(steps[: found[2][0] + 1]) if step.candidates)
    judged_um = number(last.candidates[0].y_pred_um) - number(last.outcome.estimate.y_pred_um)
    assert event.data["difference_um"] == pytest.approx(-judged_um, abs=1e-9) and abs(judged_um) < 0.5
    truth = np.array([number(one.channels["y_um"].mean) for one in source])
    left = truth + np.array([number(step.outcome.offset.y_offset_um) for step in steps])
    adopted = found[2][0]
    assert np.std(left[adopted + 120 :]) < 0.5 * np.std(left[NIGHT:adopted])
    last = [one for step in steps for one in step.candidates if one.innovations_um][-1]
    assert (last.role == "before" and last.residual_um is None) or math.isnan(number(last.residual_um))


def test_from_probes_alone_a_false_candidate_is_not_adopted() -> None:
    loop = OfflineLoop(without_sensor(), QUILL, Night(shown(extended())))
    steps = probed(loop, evening(NIGHT + DAY, noise_um=0.0, acts=lambda i: 0.0), 30)
    assert "adopt" not in [step for _, step, _ in decisions(steps)]


def test_a_probe_mount_that_creeps_does_not_make_a_better_model() -> None:
    """From the night on the feature creeps by 1 µm/h; the candidate explains it by the coolant, which does not act."""
    creep = lambda i: max(i - NIGHT, 0) / 60.0  # noqa: E731
    tables = {"loop": {"policy": "adopt", "shadow_h": 6.0}}
    for gain in (1.0, -1.0):
        loop = OfflineLoop(without_sensor(**tables), QUILL, Night(shown(extended(gain))))
        steps = probed(loop, evening(NIGHT + DAY, noise_um=0.0, acts=lambda i: 0.0, more=creep), 30)
        assert sum(probe.taken for step in steps[NIGHT:] for probe in step.outcome.probes) > 20
        assert "adopt" not in [step for _, step, _ in decisions(steps)]


def test_a_loop_without_measured_y_is_refused() -> None:
    data = CONFIG[:SENSOR] + CONFIG[COOLANT:] + b'\n[loop]\npolicy = "adopt"\n'
    with pytest.raises(ConfigError, match=r"loop.policy = 'adopt': nothing measures Y, expected a channel 'y_um' or"):
        parse_config(data, source="test")
    parse_config(data + PROBE, source="test")
    parse_config(data.replace(b'"adopt"', b'"off"'), source="test")
