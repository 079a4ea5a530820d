"""An effect of the present model that has ended: the service goes on without it, and with the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.errors import ModelError
from compensator.events import DiagnosisData
from compensator.model.model_file import parse_model
from compensator.recording.reading import messages, recordings
from compensator.service.loop.avoided import avoid
from compensator.service.loop.loop import Loop
from compensator.service.loop.run import LoopRun, LoopStep
from compensator.service.loop.schedule import begin_if_due
from compensator.service.loop.state import LoopState, Place
from compensator.service.loop.weighing import weigh, without_effect
from compensator.service.transfer.model_store import sha256_of
from tests.service.living import MACHINE
from tests.service.looping import (
    DAY,
    QUILL,
    Night,
    decisions,
    errors,
    extended,
    heat_w,
    machine,
    run,
    settings,
    shown,
    stronger,
    together,
)
from tests.service.test_loop_run import CHECKED
from tests.service.test_loop_service import Looping, checked
from tests.service.test_restart import QUILL as QUILL_FILE

HOUR_NS = 3600 * NS
NOW_NS = 100 * HOUR_NS
BOTH = together(extended(), stronger(0.2))
EFFECTS = ["input:coolant_degc", "gain:DTF"]
NIGHTLY = {"policy": "adopt", "every_h": 24, "shadow_h": 6.0}


def test_without_the_effect_that_has_ended_the_service_goes_on_with_the_other() -> None:
    """The coolant stops to act a day after the adoption; the gain stays. No diagnosis finds it."""
    assert QUILL.dtf is not None
    y_um = QUILL.dtf.sampled.response(heat_w(4 * DAY))
    ends, night = 2 * DAY, Night(shown(BOTH))
    loop = LoopRun(settings(loop=NIGHTLY, **CHECKED), QUILL_FILE, night)
    source = machine(4 * DAY, lambda i: float(i < ends), more=lambda i: 0.2 * float(y_um[i]))
    steps = run(loop, source)
    (back,) = [seq for seq, step, _ in decisions(steps) if step == "back"]
    assert loop.effects == ("gain:DTF",) and ends < back < ends + DAY // 2
    notes = [note for step in steps for note in step.events if note.data.get("step") == "back"]
    assert "back to the model without input:coolant_degc, which is better" in notes[0].text
    # The diagnoses are as many as misfits and nights: what is no diagnosis is none of them.
    found = [note.data for step in steps for note in step.events if note.kind == "diagnosis"]
    assert len(night.asked) == sum(not data.get("without") for data in found)
    assert {data["without"] for data in found if data.get("without")} <= set(EFFECTS)
    left = errors(steps[back + 60 :])
    assert np.std(left) < 0.5 * np.std(errors(steps[ends:back]))
    assert _jumps(steps) <= 8.0 + 1e-9


@pytest.mark.parametrize(("policy", "step"), [("adopt", "back"), ("propose", "propose")])
def test_what_a_diagnosis_finds_with_fewer_effects_is_a_way_back_where_no_person_decides(
    policy: str, step: str
) -> None:
    """It does not know its level: measured Y was shifted before. The present level stays."""
    assert QUILL.dtf is not None
    y_um = QUILL.dtf.sampled.response(heat_w(4 * DAY))
    ends, night = 2 * DAY, Night(shown(BOTH))
    loop = LoopRun(settings(loop=NIGHTLY | {"policy": policy, "every_h": 12}), QUILL_FILE, night)
    source = machine(4 * DAY, lambda i: float(i < ends), more=lambda i: 0.2 * float(y_um[i]) + 8.0 * (i > 300))
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
        assert loop.effects == ("gain:DTF",) and np.std(errors(steps[-DAY // 2 :])) < 1.0


def _jumps(steps: list[LoopStep]) -> float:
    offsets = np.array([step.outcome.offset.y_offset_um for step in steps[1:]])
    return float(np.max(np.abs(np.diff(offsets))))


def misfit(*places: Place, effects: list[str] = EFFECTS, **changes: Any) -> LoopState:
    """The state of a loop whose model has erred for four hours."""
    last = {"planned_utc_ns": NOW_NS, "adopted_utc_ns": NOW_NS - 24 * HOUR_NS}
    return LoopState(effects=effects, found=list(places), misfit_min=240.0, **(last | changes))


def begun(state: LoopState) -> tuple[str, str]:
    """Return what begins now, without which effect; and let it end."""
    assert state.diagnosis is None
    notes = begin_if_due(state, LoopSettings(), NOW_NS, NOW_NS)
    found, state.diagnosis = state.diagnosis, None
    assert found is not None and bool(notes) is not bool(found.without)
    return found.why, found.without


def test_each_effect_is_left_out_once_before_a_diagnosis_of_a_misfit() -> None:
    state = misfit()
    assert [begun(state) for _ in range(3)] == [
        ("misfit", "input:coolant_degc"),
        ("misfit", "gain:DTF"),
        ("misfit", ""),
    ]
    assert begin_if_due(state, LoopSettings(), NOW_NS, NOW_NS) == [] and state.diagnosis is None
    later = NOW_NS + 4 * HOUR_NS
    begin_if_due(state, LoopSettings(), later, NOW_NS)
    assert state.diagnosis is not None and state.diagnosis.without == "input:coolant_degc"


def test_what_runs_already_or_is_avoided_is_not_begun() -> None:
    before = Place(sha256="a" * 64, effects=["gain:DTF"], role="before", since_utc_ns=NOW_NS)
    assert begun(misfit(before)) == ("misfit", "gain:DTF")
    state = misfit(before)
    avoid(state, ["input:coolant_degc"], NOW_NS, 24.0)
    assert begun(state) == ("misfit", "")


def test_a_person_decides_about_the_effects_of_the_calibrated_model() -> None:
    assert begun(misfit(adopted_utc_ns=0)) == ("misfit", "")
    assert begun(misfit(effects=[])) == ("misfit", "")
    # It was adopted by the loop, and then a person has calibrated the machine with these effects.
    state = misfit()
    begin_if_due(state, LoopSettings(), NOW_NS, NOW_NS)
    loop = Loop(LoopSettings(), 60.0, EFFECTS, state)
    present = parse_model(BOTH, source="test")
    found = without_effect(BOTH, EFFECTS[0])
    weighed = weigh(found, settings(), calibrated=BOTH, present=present, in_shadow=[])
    assert weighed.candidate is None and weighed.data.refused
    assert loop.receive(weighed.data, NOW_NS) == [] and loop.wanted is None


def test_the_last_effect_ends_long_after_the_model_before_it_was_compared() -> None:
    """The diagnoses name it all the time: most of their records have it."""
    ends = 3 * DAY
    tables = {"loop": NIGHTLY | {"watch_h": 24.0}} | CHECKED
    loop = LoopRun(settings(**tables), QUILL_FILE, Night(shown(extended())))
    steps = run(loop, machine(4 * DAY, lambda i: float(i < ends)))
    found = decisions(steps)
    (back,) = [seq for seq, step, _ in found if step == "back"]
    assert ("end", "watched") in [one[1:] for one in found if one[0] < ends] and ends < back < ends + DAY // 2
    assert steps[-1].model_sha256 == sha256_of(QUILL_FILE)


def test_at_a_planned_time_nothing_is_left_out() -> None:
    state = misfit()
    state.planned_utc_ns -= 6 * HOUR_NS
    assert begun(state) == ("planned", "")


def test_an_interruption_ends_it_without_a_word() -> None:
    state = misfit()
    begin_if_due(state, LoopSettings(), NOW_NS, NOW_NS)
    loop = Loop(LoopSettings(), 60.0, EFFECTS, state)
    assert loop.wanted is not None and loop.wanted.without == "input:coolant_degc"
    assert loop.restarted() == [] and loop.wanted is None


def test_it_is_a_way_back_and_ways_back_share_what_they_must_show() -> None:
    state = misfit()
    begin_if_due(state, LoopSettings(), NOW_NS, NOW_NS)
    loop = Loop(LoopSettings(policy="propose"), 60.0, EFFECTS, state)
    less = DiagnosisData(
        verdict="without", effects=["gain:DTF"], candidate_sha256="b" * 64, without="input:coolant_degc", fewer=True
    )
    assert loop.receive(less, NOW_NS) == []
    (note,) = loop.begin()
    assert note.data["role"] == "before" and "without input:coolant_degc, which may have ended" in note.text
    loop.shadow_begins("b" * 64, ["gain:DTF"], NOW_NS, "before")
    assert [place.role for place in state.found] == ["before"] and not state.candidates


def test_a_model_without_an_effect_has_the_others_and_its_own_paths() -> None:
    less = without_effect(BOTH, "input:coolant_degc")
    assert less.model == stronger(0.2) and less.effects == ("gain:DTF",)
    with pytest.raises(ModelError, match="no effect drift"):
        without_effect(BOTH, "drift")


class Warm(Looping):
    """A machine whose growth is larger by a fifth than its calibration, beside the coolant."""

    def effect_um(self) -> float:
        return super().effect_um() + 0.2 * self.world.truth("y_um")


async def test_the_service_records_it_and_a_replay_decides_it_again_over_a_kill(tmp_path: Path) -> None:
    ended = list[int]()
    service = Warm(tmp_path, shown(BOTH), acts=lambda i: float(not ended))
    checks = b"\n[plausibility]\nfalse_alarm_days = 30.0\nresidual_std_um = 0.6\nresidual_correlation_min = 30.0\n"
    service.use(service.config_bytes.replace(b"shadow_h = 6.0", b"shadow_h = 6.0\nmisfit_h = 1.0") + checks)
    await service.run(960, until=lambda outcome: service.store.in_use() == BOTH)
    await service.run(5)
    ended.append(service.minute())
    await service.run(960, until=lambda _: ("shadow", "") in service.steps()[3:])
    await service.run_and_kill(30)
    await service.run(960, until=lambda _: ("back", "") in service.steps())
    await service.run(10)
    events = [one for path in recordings(service.recordings, MACHINE) for one in messages(path, ("event",))]
    assert any(event.data.get("without") == "input:coolant_degc" for event in events if event.kind == "diagnosis")
    checked(service)
