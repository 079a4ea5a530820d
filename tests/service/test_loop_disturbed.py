"""The loop while the clock is set, the machine is off for days, a person asks twice, or its state is damaged."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from compensator.config import LoopSettings
from compensator.errors import CompensatorError, ServiceError
from compensator.messages import Sample
from compensator.service.compensation import Compensation
from compensator.service.loop.avoided import avoid, avoid_after_back, is_avoided
from compensator.service.loop.core import LOOP_STATE, ShadowedLoop, shadow_files
from compensator.service.loop.run import OfflineLoop
from compensator.service.loop.schedule import begin_if_due, pass_planned
from compensator.service.loop.state import STATE_SCHEMA, LoopState
from compensator.service.transfer.model_store import sha256_of
from tests.service.looping import NIGHT, Night, decisions, evening, extended, run, settings, shown
from tests.service.test_restart import QUILL

HOUR_NS = 3_600_000_000_000


def moved(one: Sample, hours: float) -> Sample:
    return msgspec.structs.replace(one, time_utc_ns=one.time_utc_ns + round(hours * HOUR_NS))


@pytest.mark.parametrize("hours", [-3.0, 3.0])
def test_a_clock_that_is_set_in_a_shadow_makes_no_decision_earlier(hours: float) -> None:
    loop = OfflineLoop(settings(), QUILL, Night(shown(extended())))
    source = evening(NIGHT + 17 * 60)
    steps = run(loop, source, NIGHT + 300)
    steps += run(loop, (moved(one, hours) for one in source))
    adopted = [seq for seq, step, _ in decisions(steps) if step == "adopt"]
    # At least twelve hours were measured, whatever the clock says, and no hour counts twice.
    assert len(adopted) == 1 and adopted[0] >= NIGHT + 12 * 60
    assert adopted[0] <= NIGHT + 12 * 60 + 5 * 60


def test_a_weekend_is_no_time_in_which_a_candidate_was_compared() -> None:
    loop = OfflineLoop(settings(), QUILL, Night(shown(extended())))
    source = evening(NIGHT + 300 + 3600 + 15 * 60)
    steps = run(loop, source, NIGHT + 300)
    loop.pause(3600)
    for _ in zip(range(3600), source, strict=False):
        pass
    steps += run(loop, source)
    adopted = [seq for seq, step, _ in decisions(steps) if step == "adopt"]
    # Twelve hours of measured Y after it: what was before is more than a day ago.
    assert all(seq >= NIGHT + 300 + 3600 + 12 * 60 for seq in adopted)


def test_a_clock_that_is_behind_by_a_month_ends_nothing_that_waits() -> None:
    """A flat battery: the service starts with a wrong time, which is set right some minutes later."""
    loop = OfflineLoop(settings(loop={"policy": "propose"}), QUILL, Night(shown(extended())))
    source = evening(NIGHT + 1500)
    run(loop, source, NIGHT + 1200)
    now_ns = run(loop, source, 1)[0].outcome.sample.time_utc_ns
    avoid(loop._core.state, ["gain:DTF"], now_ns, 168.0)
    assert loop.phase == "proposed"
    loop.pause(None)
    steps = run(loop, (moved(one, -24.0 * 30) for one in source), 6)
    steps += run(loop, source, 200)
    assert loop.phase == "proposed" and decisions(steps) == []
    now_ns = steps[-1].outcome.sample.time_utc_ns
    assert is_avoided(loop._core.state, ["gain:DTF"], now_ns + 164 * HOUR_NS)
    assert not is_avoided(loop._core.state, ["gain:DTF"], now_ns + 166 * HOUR_NS)


def test_after_a_weekend_nothing_is_diagnosed_before_there_is_a_record() -> None:
    """The planned times that have passed meanwhile count as done, and so does what the model has erred by."""
    loop = OfflineLoop(settings(loop={"misfit_h": 2.0}), QUILL, Night(shown(None, "adequate")))
    source = evening(NIGHT + 120 + 3600 + 1000)
    run(loop, source, NIGHT + 120)
    loop._core.state.misfit_min = 600.0
    loop.pause(3600)
    for _ in zip(range(3600), source, strict=False):
        pass
    begun = [seq for seq, step, _ in decisions(run(loop, source)) if step == "diagnose"]
    assert begun and begun[0] >= NIGHT + 120 + 3600 + 120


def test_a_person_who_agrees_twice_or_dismisses_then_gets_one_adoption() -> None:
    loop = OfflineLoop(settings(loop={"policy": "propose"}), QUILL, Night(shown(extended())))
    source = evening(NIGHT + 1500)
    steps = run(loop, source, NIGHT + 1200)
    assert loop.phase == "proposed"
    loop.accept()
    loop.accept()
    loop.dismiss()
    steps += run(loop, source, 30)
    assert [step for _, step, _ in decisions(steps)].count("adopt") == 1
    assert "end" not in [step for _, step, _ in decisions(steps)]
    assert steps[-1].model_sha256 == sha256_of(extended()) and loop.phase == "watching"
    with pytest.raises(ServiceError, match="there is no candidate now"):
        loop.accept()


def test_a_shadow_whose_model_or_state_is_damaged_is_refused() -> None:
    loop = OfflineLoop(settings(), QUILL, Night(shown(extended())))
    run(loop, evening(NIGHT + 60))
    core = loop._core
    whole = core.attachments()
    present = Compensation(settings(), core.present)
    assert ShadowedLoop(settings(), present.model, whole).shadows.keys() == {sha256_of(extended())}
    model, state = shadow_files(core.state)[sha256_of(extended())]
    for damaged in (
        {name: data for name, data in whole.items() if name != model},
        whole | {model: whole[model][:200]},
        whole | {model: extended(2.0)},
        whole | {state: whole[state][:-20]},
        whole | {LOOP_STATE: whole[LOOP_STATE][:-20]},
        whole | {LOOP_STATE: whole[LOOP_STATE].replace(b'{"schema":%d' % STATE_SCHEMA, b'{"schema":8')},
    ):
        with pytest.raises(CompensatorError):
            ShadowedLoop(settings(), present.model, damaged)


def test_effects_that_were_gone_back_from_wait_a_day_and_then_twice_as_long() -> None:
    state, effects, waits = LoopState(), ["input:coolant_degc"], []
    for now_h in (0, 30, 100):
        avoid_after_back(state, effects, now_h * HOUR_NS, longest_h=168.0)
        waits.append((state.avoided[-1].until_utc_ns - now_h * HOUR_NS) / HOUR_NS)
    assert waits == [24.0, 48.0, 96.0]
    assert is_avoided(state, effects, 195 * HOUR_NS) and not is_avoided(state, effects, 197 * HOUR_NS)
    # After a week without it counts anew.
    avoid_after_back(state, effects, 1000 * HOUR_NS, longest_h=168.0)
    assert state.avoided[-1].until_utc_ns == 1024 * HOUR_NS


def test_a_misfit_is_diagnosed_each_time_that_it_has_lasted_twice_as_long() -> None:
    tables, state, began = LoopSettings(policy="adopt", misfit_h=3.0, every_h=24, at_utc="00:00"), LoopState(), []
    for minute in range(1, 23 * 60):
        state.misfit_min, now_ns = float(minute), minute * HOUR_NS // 60
        if begin_if_due(state, tables, now_ns, pass_planned(state, tables, now_ns)):
            began.append(minute / 60.0)
            state.diagnosis = None
    assert began == [3.0, 6.0, 12.0]


def broken(values: dict[str, float]) -> None:
    values["t_q_degc"] = math.nan


def jumped(values: dict[str, float]) -> None:
    values["at_degc"] += 4.0


def stuck(values: dict[str, float]) -> None:
    values["t_q_degc"] = 31.0


@pytest.mark.parametrize("fault", [broken, jumped, stuck])
def test_a_fault_of_a_couple_that_begins_in_a_shadow_makes_no_better_model(fault: Callable[[Any], None]) -> None:
    """The candidate explains by the coolant, which does not act, and from the fourth hour on Y is predicted wrong."""

    def change(i: int, values: dict[str, float]) -> None:
        if i >= NIGHT + 240:
            fault(values)

    loop = OfflineLoop(settings(), QUILL, Night(shown(extended(1.0))))
    steps = run(loop, evening(NIGHT + 15 * 60, acts=lambda i: 0.0, change=change))
    found = [step for _, step, _ in decisions(steps)]
    assert "shadow" in found and "adopt" not in found and loop.effects == ()
