"""The loop while the clock is set, the machine is off for days, a person asks twice, or its state is damaged."""

from __future__ import annotations

import msgspec
import pytest

from compensator.errors import CompensatorError, ServiceError
from compensator.messages import Sample
from compensator.service.compensation import Compensation
from compensator.service.loop.core import LOOP_STATE, SHADOW_MODEL, SHADOW_STATE, ModelLoop
from compensator.service.loop.run import LoopRun
from compensator.service.transfer.model_store import sha256_of
from tests.service.looping import Night, decisions, extended, machine, run, settings, shown
from tests.service.test_restart import QUILL

#: Samples are counted from 6 o'clock; the first diagnosis is 20 h later.
FIRST = 20 * 60
HOUR_NS = 3_600_000_000_000


def moved(one: Sample, hours: float) -> Sample:
    return msgspec.structs.replace(one, time_utc_ns=one.time_utc_ns + round(hours * HOUR_NS))


@pytest.mark.parametrize("hours", [-3.0, 3.0])
def test_a_clock_that_is_set_in_a_shadow_makes_no_decision_earlier(hours: float) -> None:
    loop = LoopRun(settings(), QUILL, Night(shown(extended())))
    source = machine(FIRST + 2000)
    steps = run(loop, source, FIRST + 300)
    steps += run(loop, (moved(one, hours) for one in source))
    adopted = [seq for seq, step, _ in decisions(steps) if step == "adopt"]
    # At least twelve hours were measured, whatever the clock says, and no hour counts twice.
    assert len(adopted) == 1 and adopted[0] >= FIRST + 12 * 60
    assert adopted[0] <= FIRST + 12 * 60 + 5 * 60


def test_a_weekend_is_no_time_in_which_a_candidate_was_compared() -> None:
    loop = LoopRun(settings(), QUILL, Night(shown(extended())))
    source = machine(FIRST + 300 + 3600 + 1500)
    steps = run(loop, source, FIRST + 300)
    loop.pause(3600)
    for _ in zip(range(3600), source, strict=False):
        pass
    steps += run(loop, source)
    adopted = [seq for seq, step, _ in decisions(steps) if step == "adopt"]
    # Twelve hours of measured Y after it: what was before is more than a day ago.
    assert all(seq >= FIRST + 300 + 3600 + 12 * 60 for seq in adopted)


def test_a_person_who_agrees_twice_or_dismisses_then_gets_one_adoption() -> None:
    loop = LoopRun(settings(loop={"policy": "propose"}), QUILL, Night(shown(extended())))
    source = machine(FIRST + 1500)
    steps = run(loop, source, FIRST + 1200)
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
    loop = LoopRun(settings(), QUILL, Night(shown(extended())))
    run(loop, machine(FIRST + 60))
    core = loop._core
    whole = core.attachments()
    present = Compensation(settings(), core.present)
    assert ModelLoop(settings(), present.model, whole).shadow is not None
    for damaged in (
        {name: data for name, data in whole.items() if name != SHADOW_MODEL},
        whole | {SHADOW_MODEL: whole[SHADOW_MODEL][:200]},
        whole | {SHADOW_MODEL: extended(2.0)},
        whole | {SHADOW_STATE: whole[SHADOW_STATE][:-20]},
        whole | {LOOP_STATE: whole[LOOP_STATE][:-20]},
        whole | {LOOP_STATE: whole[LOOP_STATE].replace(b'"schema":1', b'"schema":2')},
    ):
        with pytest.raises(CompensatorError):
            ModelLoop(settings(), present.model, damaged)


def test_effects_that_were_gone_back_from_wait_a_day_and_then_twice_as_long() -> None:
    loop = LoopRun(settings(), QUILL, Night(shown(extended())))
    found, effects = loop._core.loop, ["input:coolant_degc"]
    waits = []
    for now_h in (0, 30, 100):
        found._avoid_after_back(effects, now_h * HOUR_NS)
        waits.append((found.state.avoided[-1].until_utc_ns - now_h * HOUR_NS) / HOUR_NS)
    assert waits == [24.0, 48.0, 96.0]
    found._avoid_after_back(effects, 1000 * HOUR_NS)  # after a week without it counts anew
    assert found.state.avoided[-1].until_utc_ns == 1024 * HOUR_NS
