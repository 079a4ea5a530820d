"""Before another model takes over, both are compared on the measured Y on record."""

from __future__ import annotations

import asyncio
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.audit.machine_audit import audit
from compensator.clock import HOUR_NS
from compensator.codes import ProbeCode
from compensator.config import parse_config
from compensator.events import ComparisonData, ComparisonVerdict
from compensator.messages import Probe
from compensator.model.model_file import parse_model
from compensator.recording.reading import messages, recordings
from compensator.service.compensation import Compensation
from compensator.service.probing.received import unused_probe
from compensator.service.transfer.refutation import evidence
from compensator.service.transfer.second_opinion import described, second_opinion
from compensator.service.transfer.two_models import Comparison, ComparisonState, changed
from tests.audit.made import CONFIG
from tests.service.living import MACHINE, Machine, largest_step, settings
from tests.service.probed import PROBED, ProbedMachine
from tests.service.records import sample
from tests.service.simulated import START_NS
from tests.service.test_adoption import Asked, adopted, payload
from tests.service.test_restart import QUILL, STRONGER

HOURS_24 = 1440


def gain(change: float, name: str = "other") -> bytes:
    """The published model with a DTF that is stronger by a part."""
    return QUILL.replace(b'name = "quill"', f'name = "{name}"'.encode()) + (
        f'\n[[effect]]\nkind = "gain"\npath = "DTF"\nchange = {change}\n'.encode()
    )


class Measured(Machine):
    """A machine whose displacement sensor has noise, and more that is not deformation."""

    def __init__(self, folder: Path, more: Callable[[int], float] = lambda sample: 0.0, **options: Any) -> None:
        data = CONFIG.replace(b"poll_interval_s = 10.0", b"poll_interval_s = 60.0")
        super().__init__(folder, options.pop("config", parse_config(data, source="test")), **options)
        self.config_bytes = data
        rng = np.random.default_rng(7)
        self.device.sources[2] = lambda: (
            self.world.truth("y_um") + 0.4 * float(rng.normal()) + float(more(len(self.outcomes)))
        )

    def opinion(self, present: bytes, candidate: bytes) -> Any:
        models = (parse_model(data, source="test") for data in (present, candidate))
        return second_opinion(self.recordings, self.config, *models)


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """A shift on record with the right model."""
    machine = Measured(tmp_path_factory.mktemp("day"))
    asyncio.run(machine.run(700))
    return machine


async def test_the_model_of_another_machine_is_refused_with_figures_and_taken_by_force(tmp_path: Path) -> None:
    machine = Measured(tmp_path)
    # What is foreseen of the offset is compared below with what it does: the machine hardly moves on meanwhile.
    machine.promises.patience_s = 10.0
    wrong = gain(0.4)
    refused = machine.at_sample[900] = Asked(machine, "adopt", payload(wrong))
    forced = Asked(machine, "adopt", payload(wrong, force=True))
    back = Asked(machine, "back")

    def one_after_the_other(outcome: Any) -> bool:
        if refused.reply is not None and refused.reply.done() and forced.reply is None:
            assert machine.store.in_use() == QUILL
            forced()
        if outcome.offset.model_sha256 != machine.outcomes[0].offset.model_sha256 and back.reply is None:
            back()
        return back.reply is not None and outcome.offset.model_sha256 == machine.outcomes[0].offset.model_sha256

    await machine.run(1300, one_after_the_other)
    answer = refused.answer
    assert not answer["ok"] and "clearly worse" in answer["text"] and "--force" in answer["text"]
    found = answer["comparison"]
    assert found["verdict"] == "worse" and found["measured_by"] == "sensor" and found["deviations"] < -10.0
    assert found["present_rms_um"] < 1.0 and found["candidate_rms_um"] > 10.0 and 14.0 < found["hours"] < 16.0
    for figure in (f"present {found['present_rms_um']:.1f} µm rms", f"this one {found['candidate_rms_um']:.1f}"):
        assert figure in answer["text"]
    assert "the offset would move by" in answer["text"] and "\n" not in answer["text"]
    assert forced.answer["ok"] and forced.answer["comparison"]["verdict"] == "worse"
    assert "is adopted with the next sample against measured Y, " in forced.answer["text"]
    assert "against measured Y" not in back.answer["text"]
    # The way back is better, and would not be refused in any case.
    assert back.answer["ok"] and back.answer["comparison"]["verdict"] == "better"
    # The recording carries the figures: refused, by force, back.
    events = [event for path in recordings(machine.recordings, MACHINE) for event in messages(path, ("event",))]
    told = [event.data for event in events if event.kind == "adopt"]
    # What the offset would move by is said before it moves.
    moves = [
        (event.text.count("the offset moves"), event.text.count("would move"))
        for event in events
        if event.kind == "adopt"
    ]
    assert moves == [(0, 1), (1, 0), (1, 0)]
    assert [(data["ok"], data["comparison"]["verdict"]) for data in told] == [
        (False, "worse"), (True, "worse"), (True, "better"),
    ]  # fmt: skip
    assert told[0]["comparison"] == json.loads(json.dumps(found, allow_nan=False))
    # What was foreseen of the offset is what it does.
    assert told[1]["comparison"]["offset_change_um"] == pytest.approx(told[1]["difference_um"], rel=0.02)
    assert largest_step(machine.outcomes) <= 8.0 + 1e-9
    audited = audit(recordings(machine.recordings, MACHINE))
    assert audited.clean and audited.samples == len(machine.outcomes)


async def test_a_better_model_is_taken_with_figures(tmp_path: Path) -> None:
    machine = Measured(tmp_path, model=STRONGER)
    asked = machine.at_sample[700] = Asked(machine, "adopt", payload(QUILL))
    await machine.run(1000, adopted(QUILL, then=1))
    found = asked.answer["comparison"]
    assert asked.answer["ok"] and found["verdict"] == "better" and found["deviations"] > 10.0
    assert found["candidate_rms_um"] < 1.0 < found["present_rms_um"]
    event = machine.events("adopt")[-1]
    assert event.data["comparison"] == found and "µm rms, this one" in event.text


async def test_without_measured_y_a_model_is_taken_and_that_is_said(tmp_path: Path) -> None:
    channels = [channel for channel in settings().channel if channel.name != "y_um"]
    machine = Machine(tmp_path, msgspec.structs.replace(settings(), channel=channels))
    asked = machine.at_sample[600] = Asked(machine, "adopt", payload(STRONGER))
    await machine.run(900, adopted(STRONGER, then=1))
    assert asked.answer["ok"] and "no verdict: no measured Y in the last 24 h" in asked.answer["text"]
    found = asked.answer["comparison"]
    assert (found["verdict"], found["why"]) == ("not_judged", "no_y") and found["offset_change_um"] != 0.0


async def test_an_hour_of_measured_y_does_not_judge(tmp_path: Path) -> None:
    machine = Measured(tmp_path)
    asked = machine.at_sample[60] = Asked(machine, "adopt", payload(gain(0.5)))
    await machine.run(300, adopted(gain(0.5)))
    found = asked.answer["comparison"]
    assert asked.answer["ok"] and (found["verdict"], found["why"]) == ("not_judged", "too_little")
    assert found["hours"] == pytest.approx(1.0, abs=0.1) and "h: present" in asked.answer["text"]


async def test_only_the_last_day_counts(tmp_path: Path) -> None:
    """Y was wrong the day before, and the service was stopped between."""
    machine = Measured(tmp_path, lambda sample: 0.2 * sample if sample < 240 else 0.0)
    await machine.run(240)
    machine.at_sample[280] = functools.partial(machine.command, "zero", b'{"mode": "warm"}')
    await machine.run(HOURS_24 + 60)
    found = machine.opinion(QUILL, gain(0.1))
    assert found.verdict == "worse" and found.present_rms_um < 1.0 and found.hours == pytest.approx(24.0, abs=0.1)
    assert found.samples > 0.97 * HOURS_24


def test_models_that_predict_alike_are_not_refused(day: Measured) -> None:
    found = day.opinion(QUILL, gain(0.0))
    assert found.verdict == "alike" and "no clear difference" in described(found)
    assert found.offset_change_um == pytest.approx(0.0, abs=1e-9)


def test_both_models_are_judged_alike(day: Measured) -> None:
    there, back = day.opinion(QUILL, gain(0.1)), day.opinion(gain(0.1), QUILL)
    assert (there.verdict, back.verdict) == ("worse", "better")
    assert there.deviations == pytest.approx(-back.deviations)
    assert there.present_rms_um == back.candidate_rms_um
    assert there.offset_change_um == pytest.approx(-back.offset_change_um)


@pytest.mark.parametrize(
    "more",
    [
        lambda sample: -30.0 * (sample > 400),
        lambda sample: 25.0 * (sample > 200) - 25.0 * (sample > 550),
        lambda sample: -0.05 * sample,
    ],
    ids=["step", "twice", "creep"],
)
async def test_a_sensor_that_was_moved_refuses_no_better_model(tmp_path: Path, more: Callable[[int], float]) -> None:
    """By its values Y would speak for the weaker model; by its changes it speaks for the right one."""
    machine = Measured(tmp_path, more)
    await machine.run(700)
    odd = []
    for other in (gain(0.1), gain(-0.1)):
        assert machine.opinion(other, QUILL).verdict == "better"
        odd.append(machine.opinion(QUILL, other))
        assert odd[-1].verdict == "worse"
    moved = [found for found in odd if found.y_moved]
    assert moved and all("about the zero it looks otherwise" in described(found) for found in moved)
    assert all(f"(its error changes {found.ratio:.2g} times as much; it is" in described(found) for found in moved)
    assert all(found.ratio is not None and 1.05 < found.ratio < 100.0 for found in odd)


def test_where_y_has_moved_the_figures_of_the_verdict_come_first() -> None:
    """The errors about the zero say the contrary, which must not read as the reason."""
    found = ComparisonData(
        verdict=ComparisonVerdict.WORSE,
        hours=12.0,
        present_rms_um=0.8,
        candidate_rms_um=0.5,
        deviations=-5.1,
        ratio=1.4,
        y_moved=True,
    )
    text = (
        "last 12 h: by the changes of measured Y this one is worse than the present one (its error changes 1.4 times "
        "as much; it is refuted by 5 standard deviations); about the zero it looks otherwise (present 0.8 µm rms, "
        "this one 0.5)"
    )
    assert described(found) == text
    assert "(it is refuted" in described(changed(found, ratio=None))


@pytest.mark.parametrize("noise_um", [0.0, 0.3])
async def test_a_dead_sensor_judges_no_model(tmp_path: Path, noise_um: float) -> None:
    channels = [msgspec.structs.replace(channel, stuck_after_min=None) for channel in settings().channel]
    machine = Measured(tmp_path, config=msgspec.structs.replace(settings(), channel=channels))
    rng = np.random.default_rng(4)
    machine.device.sources[2] = lambda: 5.0 + noise_um * float(rng.normal())
    await machine.run(700)
    for change in (0.4, -0.4):
        found = machine.opinion(QUILL, gain(change))
        assert (found.verdict, found.why) == ("not_judged", "unrelated")


async def test_a_suspected_sensor_judges_no_model(tmp_path: Path) -> None:
    """The service names measured Y, and not the model, for nearly the whole record."""
    checks = {"false_alarm_days": 365.0, "residual_std_um": 2.0, "residual_correlation_min": 240.0}
    machine = Measured(tmp_path, lambda sample: 40.0 * (sample > 60), config=settings(plausibility=checks))
    await machine.run(700)
    suspected = ["implausible:y_um" in outcome.offset.reasons for outcome in machine.outcomes]
    assert sum(suspected) > 450
    found = machine.opinion(QUILL, gain(0.4))
    assert (found.verdict, found.why) == ("not_judged", "suspect") and "suspected a sensor" in described(found)
    # What both leave is shown all the same.
    assert found.present_rms_um is not None and f"present {found.present_rms_um:.1f} µm rms" in described(found)


async def test_temperatures_that_measured_y_has_shown_to_be_right_keep_no_model_unjudged(tmp_path: Path) -> None:
    """T_Q fell below AT for hours. The model in force saw by its own Y that it was right again; a weak one never."""
    checks = {"t_q_below_at_after_min": 30.0, "false_alarm_days": 30.0, "residual_std_um": 2.0}
    guarded = settings(plausibility=checks, guards={"t_q_below_at_max_k": 2.0, "suspect_jumps": True})
    machine = Measured(tmp_path, config=guarded)
    t_q = machine.device.sources[0]
    fallen_k = functools.partial(np.interp, xp=[400, 460, 600, 660], fp=[0.0, 20.0, 20.0, 0.0])
    machine.device.sources[0] = lambda: t_q() - float(fallen_k(len(machine.outcomes)))
    await machine.run(1100)
    waits = ["t_q_at_exchanged" in outcome.offset.reasons for outcome in machine.outcomes]
    assert any(waits[400:600]) and not any(waits[800:])
    # The six hours before that, and all after it.
    found = machine.opinion(QUILL, gain(-0.8))
    assert found.verdict == "worse" and found.samples > 400 + 300


async def test_probes_judge_where_there_is_no_sensor(tmp_path: Path) -> None:
    """A model without most of the DTF; the one that is right up to 10 % is corrected by the probes and stays."""
    machine = ProbedMachine(tmp_path)
    machine.each_hour(1400, every=90)
    wrong, better = gain(-0.8), gain(0.1)
    refused = machine.at_sample[1300] = Asked(machine, "adopt", payload(wrong))
    taken = Asked(machine, "adopt", payload(better))

    def then(outcome: Any) -> bool:
        if refused.reply is not None and refused.reply.done() and taken.reply is None:
            taken()
        return arrived(outcome)

    arrived = adopted(better, then=2)
    await machine.run(1500, then)
    found = refused.answer["comparison"]
    assert not refused.answer["ok"] and found["verdict"] == "worse" and found["measured_by"] == "probe"
    assert found["probes"] >= 13 and f"{found['probes']} probe(s)" in refused.answer["text"]
    assert found["present_rms_um"] < 1.5 and found["candidate_rms_um"] > 2.0
    # It would need a larger correction than `largest_um`, so the offset would move.
    assert abs(found["offset_change_um"]) > 10.0
    assert taken.answer["ok"] and taken.answer["comparison"]["verdict"] in ("alike", "better")
    # Otherwise the corrected deformation stays as it is at the exchange, and that is foreseen.
    assert abs(taken.answer["comparison"]["offset_change_um"]) < 0.05
    audited = audit(recordings(machine.recordings, MACHINE))
    assert audited.clean and audited.samples == len(machine.outcomes)


async def test_a_chip_on_the_probe_refuses_no_model(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path, gain=1.0, config=PROBED)
    machine.each_hour(1300, every=80)
    for at in (400, 960):
        machine.at_sample[at] = functools.partial(machine.probe, wrong_um=35.0)
    await machine.run(1300)
    models = [parse_model(data, source="test") for data in (QUILL, gain(0.05))]
    found = second_opinion(machine.recordings, machine.config, *models)
    assert found.verdict == "alike" and found.present_rms_um < 1.5
    assert found.probes == len([probe for probe in machine.recorded() if probe.taken]) - 1  # the first is the zero


async def test_few_probes_do_not_judge(tmp_path: Path) -> None:
    machine = ProbedMachine(tmp_path)
    machine.each_hour(700, every=150)
    await machine.run(700)
    models = [parse_model(data, source="test") for data in (QUILL, gain(-0.8))]
    found = second_opinion(machine.recordings, machine.config, *models)
    assert (found.verdict, found.why, found.probes) == ("not_judged", "too_little", 4)  # the first one is the zero
    assert "at least 8 probes" in described(found)


@pytest.mark.parametrize("without", ["present", "other", "both"])
def test_a_probe_that_a_model_cannot_compare_ends_no_verdict(without: str) -> None:
    """A model that was not there at its time says nothing of it; the probe is of no use for a comparison."""
    outcome = Compensation(settings(), parse_model(QUILL, source="test")).process(sample(0, {}))
    comparison, rng = Comparison(60.0), np.random.default_rng(1)

    def probe(innovation_um: float | None) -> Probe:
        unused = unused_probe(MACHINE, START_NS, ProbeCode.MISMATCH, "")
        std_um = None if innovation_um is None else 0.5
        return msgspec.structs.replace(unused, taken=True, innovation_um=innovation_um, innovation_std_um=std_um)

    for number in range(30):
        noise_um, more_um = rng.normal(size=2).tolist()
        pair = [probe(5.0 * more_um + noise_um), probe(noise_um)]
        if number == 5:
            pair = [probe(None) if without in (name, "both") else probe(1.0) for name in ("present", "other")]
        at = msgspec.structs.replace(outcome.sample, time_utc_ns=START_NS + number * HOUR_NS)
        both = [msgspec.structs.replace(outcome, sample=at, probes=(one,)) for one in pair]
        comparison.add(*both, suspected=False)
    found = comparison.verdict()
    assert (found.verdict, found.probes) == ("better", 29)
    kept = msgspec.json.encode(comparison.state)
    assert msgspec.json.decode(kept, type=ComparisonState) == comparison.state


def test_a_record_that_cannot_be_replayed_is_said(tmp_path: Path) -> None:
    found = Measured(tmp_path).opinion(QUILL, STRONGER)
    assert (found.verdict, found.why) == ("not_judged", "no_record") and "no recorded zero" in described(found)


@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.8])
def test_errors_that_are_alike_for_hours_are_not_counted_as_independent(correlation: float) -> None:
    """Two equally wrong models: a verdict by chance is rare, also where a plain count would give many."""
    rng, by_chance, plain = np.random.default_rng(11), 0, 0
    count, trials = 47, 400

    def walk() -> np.ndarray:
        values = [float(rng.normal())]
        for _ in range(count - 1):
            values.append(correlation * values[-1] + float(rng.normal()))
        return np.array(values)

    for _ in range(trials):
        difference, error = 3.0 * walk(), 3.0 * walk()
        found = evidence(0.5 * difference + error, difference)
        by_chance += abs(found.deviations) > 4.0
        plain += abs(found.deviations) * np.sqrt(count / found.effective) > 4.0
    assert by_chance <= 0.01 * trials
    assert plain > by_chance or correlation < 0.7
