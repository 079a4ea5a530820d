"""An effect of the present model that has ended: the service goes on without it, and with the others."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.clock import NS
from compensator.config import LoopSettings
from compensator.errors import ModelError
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData
from compensator.model.effects import effect_from
from compensator.model.model_file import parse_model
from compensator.model.model_writer import dump_model
from compensator.recording.reading import messages, recordings
from compensator.service.loop.avoided import avoid
from compensator.service.loop.decisions import LoopDecisions
from compensator.service.loop.run import OfflineLoop
from compensator.service.loop.schedule import begin_if_due
from compensator.service.loop.state import InShadow, LoopState, Role
from compensator.service.loop.weighing import failed, weigh, without_effect
from compensator.service.transfer.model_store import sha256_of
from tests.service.living import MACHINE, largest_step
from tests.service.looping import (
    DAY,
    NIGHT,
    QUILL,
    Night,
    about,
    decisions,
    errors,
    evening,
    extended,
    grown,
    machine,
    run,
    settings,
    shown,
    stronger,
    together,
)
from tests.service.test_loop_run import CHECKED
from tests.service.test_loop_service import Looping, checked
from tests.service.test_loop_weighing import remainder
from tests.service.test_restart import QUILL as QUILL_FILE

HOUR_NS = 3600 * NS
NOW_NS = 100 * HOUR_NS
BOTH = together(extended(), stronger(0.2))
EFFECTS = ["input:coolant_degc", "gain:DTF"]
NIGHTLY = {"policy": "adopt", "every_h": 24, "shadow_h": 6.0}


def test_without_the_effect_that_has_ended_the_service_goes_on_with_the_other() -> None:
    """The coolant stops to act a day after the adoption; the gain stays. No diagnosis finds it."""
    ends, night = 2 * DAY, Night(shown(BOTH))
    loop = OfflineLoop(settings(loop=NIGHTLY, **CHECKED), QUILL_FILE, night)
    source = machine(ends + 12 * 60, lambda i: float(i < ends), more=grown(0.2))
    steps = run(loop, source)
    (back,) = [seq for seq, step, _ in decisions(steps) if step == "back"]
    assert loop.effects == ("gain:DTF",) and ends < back < ends + DAY // 2
    notes = [note for step in steps for note in step.events if note.data.get("step") == "back"]
    assert "back to the model without input:coolant_degc, which alone is right about the zero" in notes[0].text
    # The diagnoses are as many as misfits and nights: what is no diagnosis is none of them.
    found = [note.data for step in steps for note in step.events if note.kind == "diagnosis"]
    assert len(night.asked) == sum(not data.get("without") for data in found)
    assert {data["without"] for data in found if data.get("without")} <= set(EFFECTS)
    left = errors(steps[back + 60 :])
    assert np.std(left) < 0.5 * np.std(errors(steps[ends:back]))
    assert largest_step([step.outcome for step in steps]) <= 8.0 + 1e-9


@pytest.mark.parametrize(("policy", "step"), [("adopt", "back"), ("propose", "propose")])
def test_what_a_diagnosis_finds_with_fewer_effects_is_a_way_back_where_no_person_decides(
    policy: str, step: str
) -> None:
    """It does not know its level: measured Y was shifted before. The present level stays."""
    gain = grown(0.2)
    ends, night = NIGHT + 24 * 60, Night(shown(BOTH))
    loop = OfflineLoop(settings(loop=NIGHTLY | {"policy": policy, "every_h": 12}), QUILL_FILE, night)
    source = evening(ends + DAY, lambda i: float(i < ends), more=lambda i: gain(i) + 8.0 * (i > 120))
    steps = run(loop, source, 1)
    while len(loop.effects) < 2:
        steps += run(loop, source, 1)
        if loop.phase == "proposed":
            loop.accept()
    steps += run(loop, source, ends - len(steps))
    night.found = [shown(stronger(0.19))]
    steps = run(loop, source)
    assert {one for _, one, _ in decisions(steps)} & {"adopt", "back", "propose"} == {step}
    if step == "back":
        assert loop.effects == ("gain:DTF",) and np.std(errors(steps[-DAY // 3 :])) < 1.0


def misfit(*places: InShadow, effects: list[str] = EFFECTS, **changes: Any) -> LoopState:
    """The state of a loop whose model has erred for four hours; the loop has added its effects."""
    last = {"misfit_min": 240.0, "planned_utc_ns": NOW_NS, "adopted_utc_ns": NOW_NS - 24 * HOUR_NS}
    return LoopState(effects=effects, found=list(places), **(last | changes))


def begun(state: LoopState, after_h: float = 0.0) -> tuple[str, str]:
    """Return what begins then, without which effect; and let it end."""
    assert state.diagnosis is None
    now_ns = NOW_NS + round(after_h * HOUR_NS)
    notes = begin_if_due(state, LoopSettings(), now_ns, NOW_NS)
    found, state.diagnosis = state.diagnosis, None
    assert found is not None and bool(notes) is not bool(found.without)
    return found.why, found.without


def one(name: str, *effects: str, role: Role = "before", deviations: float | None = None) -> InShadow:
    found = InShadow(sha256=name * 64, effects=list(effects), role=role, since_utc_ns=NOW_NS)
    found.verdict = ComparisonData(verdict=ComparisonVerdict.ALIKE, deviations=deviations, hours=8.0)
    return found


def test_each_effect_is_left_out_once_before_a_diagnosis_planned_or_not() -> None:
    for planned_ns in (NOW_NS, NOW_NS - 6 * HOUR_NS):
        state = misfit(planned_utc_ns=planned_ns)
        assert [begun(state)[1] for _ in range(3)] == [*EFFECTS, ""]
        # What is compared no longer is compared again when the misfit has lasted twice as long.
        state.diagnosed_utc_ns = NOW_NS + HOUR_NS
        assert begin_if_due(state, LoopSettings(), NOW_NS + HOUR_NS, NOW_NS) == [] and state.diagnosis is None
        assert begun(state, 2.0)[1] == EFFECTS[0]


def test_what_was_to_be_left_out_is_so_although_the_alarm_is_over_for_a_moment() -> None:
    state = misfit()
    begun(state)
    state.misfit_min = 0.0
    assert begun(state)[1] == "gain:DTF"


def test_frequent_diagnoses_keep_nothing_from_being_left_out() -> None:
    """Planned each four hours, and a misfit counts after ten: none is long enough after the last one."""
    state = misfit(misfit_min=12 * 60.0, diagnosed_utc_ns=NOW_NS - HOUR_NS)
    assert begun(state) == ("misfit", EFFECTS[0])


def test_what_runs_already_or_is_avoided_is_not_begun() -> None:
    before = one("a", "gain:DTF")
    assert begun(misfit(before)) == ("misfit", "gain:DTF")
    state = misfit(before)
    avoid(state, ["input:coolant_degc"], NOW_NS, 24.0)
    assert begun(state) == ("misfit", "")


def test_a_person_decides_about_the_effects_of_the_calibrated_model() -> None:
    assert begun(misfit(effects=[])) == ("misfit", "")
    assert begun(misfit(base_effects=EFFECTS[:1])) == ("misfit", "gain:DTF")
    # The loop had adopted it, and then a person takes it for the calibrated model.
    loop = LoopDecisions(LoopSettings(), 60.0, EFFECTS, misfit())
    loop.model_changed(EFFECTS, NOW_NS, calibrated=EFFECTS)
    assert begun(loop.state) == ("misfit", "")
    # Back to what the loop had adopted before, these are still its own.
    loop = LoopDecisions(LoopSettings(), 60.0, [*EFFECTS, "delay:DTF"], misfit())
    loop.model_changed(EFFECTS, NOW_NS, calibrated=[], back=True)
    assert begun(loop.state) == ("misfit", EFFECTS[0])


@pytest.mark.parametrize("watch_h", [24.0, 168.0])
def test_the_last_effect_ends_whether_the_model_before_it_is_still_watched_or_not(watch_h: float) -> None:
    """The diagnoses name it all the time: most of their records have it. So has what was compared until the misfit."""
    ends = NIGHT + 2 * DAY
    tables = {"loop": NIGHTLY | {"watch_h": watch_h}} | CHECKED
    loop = OfflineLoop(settings(**tables), QUILL_FILE, Night(shown(extended())))
    steps = run(loop, evening(ends + 12 * 60, lambda i: float(i < ends)))
    found = decisions(steps)
    (back,) = [seq for seq, step, _ in found if step == "back"]
    assert ends < back < ends + 10 * 60
    assert (("end", "watched") in [one[1:] for one in found if one[0] < ends]) is (watch_h == 24.0)
    assert steps[-1].model_sha256 == sha256_of(QUILL_FILE)


@pytest.mark.parametrize("how", ["restart", "wrong temperature", "exchange"])
def test_what_is_interrupted_is_begun_again(how: str) -> None:
    state = misfit()
    begun(state)
    begin_if_due(state, LoopSettings(), NOW_NS, NOW_NS)
    loop = LoopDecisions(LoopSettings(policy="adopt"), 60.0, EFFECTS, state)
    assert loop.wanted is not None and loop.wanted.without == "gain:DTF"
    if how == "restart":
        assert loop.restarted() == []
    elif how == "wrong temperature":
        loop._forget_wrong()
    else:
        state.found = [one("c", *EFFECTS, "delay:DTF", role="candidate")]
        loop.accept()
        loop.exchanged(NOW_NS, "d" * 64)
        assert begun(state) == ("misfit", EFFECTS[0])
    assert loop.wanted is None and begun(state)[1] == "gain:DTF"


def test_one_that_fails_is_not_begun_again_before_the_next_diagnosis() -> None:
    state = misfit()
    begin_if_due(state, LoopSettings(), NOW_NS, NOW_NS)
    loop = LoopDecisions(LoopSettings(), 60.0, EFFECTS, state)
    failure = weigh(failed("no disk", without=EFFECTS[0]), settings(), calibrated=QUILL_FILE, present=QUILL)
    (note,) = loop.receive(failure.data, NOW_NS)
    assert note.text == "the model without input:coolant_degc cannot be made: no disk"
    assert begun(state)[1] == "gain:DTF"


def test_it_is_a_way_back_with_a_place_of_its_own() -> None:
    candidates = [one(name, f"gain:{name}", role="candidate", deviations=3.9) for name in "xyz"]
    state = misfit(*candidates)
    begin_if_due(state, LoopSettings(), NOW_NS, NOW_NS)
    loop = LoopDecisions(LoopSettings(policy="propose"), 60.0, EFFECTS, state)
    less = DiagnosisData(
        verdict="", effects=["gain:DTF"], candidate_sha256="b" * 64, without="input:coolant_degc", fewer=True
    )
    assert loop.receive(less, NOW_NS) == []
    (note,) = loop.begin()
    assert note.data["role"] == "before" and "without input:coolant_degc, which may have ended" in note.text
    loop.shadow_begins("b" * 64, ["gain:DTF"], NOW_NS, "before")
    assert state.candidates == candidates and [place.sha256[0] for place in state.ways_back] == ["b"]


@pytest.mark.parametrize(
    ("incoming", "place", "policy", "role"),
    [
        (["gain:DTF"], one("a", "input:coolant_degc"), "adopt", "candidate"),  # it would add an effect
        ([], one("a", "input:coolant_degc"), "propose", "candidate"),
        (["gain:DTF"], one("a"), "propose", "before"),
        ([*EFFECTS, "fan"], one("a", *EFFECTS, role="candidate"), "adopt", "before"),
        ([*EFFECTS, "fan"], one("a", *EFFECTS, role="candidate"), "propose", "candidate"),  # a person decides
    ],
)
def test_beside_another_model_a_way_back_may_be_a_candidate_and_the_other_way_round(
    incoming: list[str], place: InShadow, policy: Any, role: str
) -> None:
    place = msgspec.json.decode(msgspec.json.encode(place), type=InShadow)
    other = InShadow(sha256="b" * 64, effects=incoming, role="candidate", since_utc_ns=NOW_NS)
    loop = LoopDecisions(LoopSettings(policy=policy), 60.0, EFFECTS, misfit(place, other))
    loop.state.exchange, loop.state.incoming = "adopt", other.sha256
    loop.exchanged(NOW_NS, "c" * 64)
    assert loop.state.found[0].role == role


def test_where_more_are_candidates_after_an_exchange_than_have_places_one_ends() -> None:
    places = [*(one(name, f"gain:{name}", role="candidate", deviations=2.0) for name in "xyz"), one("w", "gain:DTF")]
    other = InShadow(sha256="b" * 64, effects=["input:coolant_degc"], role="before", since_utc_ns=NOW_NS)
    loop = LoopDecisions(LoopSettings(policy="adopt"), 60.0, EFFECTS, misfit(*places, other))
    loop.state.exchange, loop.state.incoming = "back", other.sha256
    assert about(loop.exchanged(NOW_NS, "c" * 64)) == [("end", "gives_way")] and len(loop.state.candidates) == 3


def test_a_way_back_that_is_worse_ends_and_the_model_before_is_watched_on() -> None:
    state = misfit(one("a", "gain:DTF"), watched=one("b"), clean_min=30.0)
    loop = LoopDecisions(LoopSettings(), 60.0, EFFECTS, state)
    for place in state.taken:
        place.verdict = ComparisonData(verdict=ComparisonVerdict.WORSE, deviations=-9.0, hours=8.0)
    assert [about(loop._decide(place, NOW_NS, is_judged=True)) for place in state.taken] == [[], [("end", "worse")]]
    assert [place.sha256[0] for place in state.taken] == ["b"]


def test_a_model_without_an_effect_has_the_others_and_its_own_paths() -> None:
    less = without_effect(BOTH, "input:coolant_degc", calibrated=QUILL_FILE)
    assert less.model == stronger(0.2) and less.effects == ("gain:DTF",)
    with pytest.raises(ModelError, match="no effect drift"):
        without_effect(BOTH, "drift", calibrated=QUILL_FILE)
    # An effect of that name may be the calibrated model's.
    with pytest.raises(ModelError, match="no effect input:coolant_degc beside those of the calibrated one"):
        without_effect(together(extended(), stronger(0.2)), "input:coolant_degc", calibrated=extended())
    twice = together(stronger(0.1), stronger(0.2))
    assert without_effect(twice, "gain:DTF", calibrated=stronger(0.1)).model == stronger(0.1)


def test_without_its_last_named_effect_it_is_the_calibrated_model() -> None:
    """What explains nothing was fitted beside the names."""
    effects = *parse_model(stronger(0.2), source="test").effects, effect_from(*remainder("coolant_degc"))
    with_rest = dump_model(dataclasses.replace(QUILL, effects=effects)).encode()
    less = without_effect(with_rest, "gain:DTF", calibrated=QUILL_FILE)
    present = parse_model(with_rest, source="test")
    weighed = weigh(less, settings(), calibrated=QUILL_FILE, present=present)
    assert weighed.candidate == QUILL_FILE and weighed.data.calibrated and weighed.data.without == "gain:DTF"


class Warm(Looping):
    """A machine whose growth is larger by a fifth than its calibration, beside the coolant."""

    def effect_um(self) -> float:
        return super().effect_um() + 0.2 * self.world.truth("y_um")


async def test_the_service_records_it_and_a_replay_decides_it_again_over_a_kill(tmp_path: Path) -> None:
    ended = list[int]()
    service = Warm(tmp_path, shown(BOTH), acts=lambda i: float(not ended))
    checks = b"\n[plausibility]\nfalse_alarm_days = 30.0\nresidual_std_um = 0.6\nresidual_correlation_min = 30.0\n"
    service.use(service.config_bytes.replace(b"shadow_h = 6.0", b"shadow_h = 6.0\nmisfit_h = 1.0") + checks)
    await service.run(960, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(BOTH))
    ended.append(service.minute())

    def names(_: Any) -> list[str]:
        status = next(json.loads(sent) for name, sent in reversed(service.published) if name == "status")
        return [*status["loop"]["effects"], *status["loop"]["others"]]

    await service.run(960, until=lambda outcome: any(one.startswith("gain:DTF") for one in names(outcome)))
    await service.run_and_kill(30)
    await service.run(960, until=lambda outcome: outcome.offset.model_sha256 != sha256_of(BOTH))
    await service.run(10)
    assert ("back", "") in service.steps()
    events = [one for path in recordings(service.recordings, MACHINE) for one in messages(path, ("event",))]
    assert any(event.data.get("without") == "input:coolant_degc" for event in events if event.kind == "diagnosis")
    checked(service)
