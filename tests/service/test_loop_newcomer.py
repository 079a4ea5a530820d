"""What is proposed under `adopt` keeps its place until a newcomer explains measured Y clearly better."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from compensator.recording.reading import messages, recordings
from compensator.service.loop.run import Diagnosed, LoopRun, LoopStep
from compensator.service.transfer.model_store import sha256_of
from tests.service.living import MACHINE
from tests.service.looping import (
    DAY,
    QUILL,
    Night,
    crept,
    decisions,
    extended,
    heat_w,
    machine,
    run,
    settings,
    shown,
    stronger,
    together,
)
from tests.service.test_loop_level import WarmAtFirst, begun, warm_at_first
from tests.service.test_loop_service import changed, checked, in_phase, replayed
from tests.service.test_restart import QUILL as QUILL_FILE

TWICE = {"loop": {"every_h": 12, "shadow_h": 6.0}}
SAMPLES = 4 * DAY
#: The first diagnosis is made before the effect begins, the second one after it; what that finds is proposed by now.
LATER = 36 * 60
NOTHING = shown(None, "adequate")


def stronger_dtf(change: float, acts: Callable[[int], bool]) -> Callable[[int], float]:
    """What a gain of the DTF adds to Y, beside a mount that creeps so that no level is known, µm."""
    assert QUILL.dtf is not None
    y_um = QUILL.dtf.sampled.response(heat_w(SAMPLES))
    return lambda i: crept(i) + change * float(y_um[i]) * acts(i)


def about(steps: list[LoopStep]) -> list[tuple[str, str]]:
    """Return what was decided, without the diagnoses that begin."""
    return [(step, why) for _, step, why in decisions(steps) if step != "diagnose"]


def events_of(steps: list[LoopStep], step: str, why: str = "") -> list[dict[str, Any]]:
    notes = [note for one in steps for note in one.events if note.kind == "loop"]
    return [dict(note.data) for note in notes if (note.data["step"], note.data.get("why", "")) == (step, why)]


def adopting(*found: Diagnosed) -> LoopRun:
    return LoopRun(settings(**TWICE), QUILL_FILE, Night(*found))


def test_a_proposal_keeps_its_place_against_what_explains_less_and_is_adopted_after_a_zero() -> None:
    loop = adopting(NOTHING, shown(extended()), shown(stronger(0.1)))
    samples = machine(SAMPLES, begun, more=crept, change=warm_at_first)
    steps = run(loop, samples, 40 * 60)
    assert about(steps) == [("nothing", "nothing_found"), ("shadow", ""), ("propose", ""), ("nothing", "shown_less")]
    (data,) = events_of(steps, "nothing", "shown_less")
    assert data["effects"] == ["gain:DTF"] and data["comparison"]["deviations"] < -4.0
    assert loop.phase == "proposed"
    loop.compensation.zero("warm")
    steps += run(loop, samples)
    assert steps[-1].model_sha256 == sha256_of(extended())


def test_a_second_effect_beside_the_first_takes_the_place_and_says_on_which_figures() -> None:
    both = together(extended(), stronger(0.3))
    loop = adopting(NOTHING, shown(extended()), shown(extended()), shown(both))
    more = stronger_dtf(0.3, lambda i: i >= LATER)
    steps = run(loop, machine(SAMPLES, begun, more=more, change=warm_at_first), 46 * 60)
    assert about(steps)[2:] == [("propose", ""), ("nothing", "in_shadow"), ("withdraw", "replaced"), ("shadow", "")]
    (data,) = events_of(steps, "withdraw", "replaced")
    assert data["comparison"]["verdict"] == "better" and data["comparison"]["deviations"] >= 4.0
    assert steps[-1].candidates[-1].model_sha256 == sha256_of(both)


def test_the_end_of_one_of_two_effects_takes_the_place() -> None:
    both = together(extended(), stronger(0.12))
    loop = adopting(NOTHING, shown(both), shown(both), shown(extended()))
    more = stronger_dtf(0.12, lambda i: DAY // 2 <= i < LATER)
    steps = run(loop, machine(SAMPLES, begun, more=more, change=warm_at_first), 46 * 60)
    assert about(steps)[2:] == [("propose", ""), ("nothing", "in_shadow"), ("withdraw", "replaced"), ("shadow", "")]
    (data,) = events_of(steps, "withdraw", "replaced")
    # Only since the proposed one errs otherwise: before it was right.
    assert data["comparison"]["hours"] < 12.0


def test_a_kill_before_a_newcomer_is_weighed_changes_nothing() -> None:
    night = Night(NOTHING, shown(extended()), shown(stronger(0.1)))
    loop = LoopRun(settings(**TWICE), QUILL_FILE, night)
    source = machine(SAMPLES, begun, more=crept, change=warm_at_first)
    run(loop, source, 31 * 60)
    assert loop.phase == "proposed"
    resumed = LoopRun(settings(**TWICE), QUILL_FILE, Night(shown(stronger(0.1))))
    resumed.restore(loop.state())
    samples, again = itertools.tee(itertools.islice(source, 120))
    steps = run(loop, samples)
    for a, b in zip(steps, run(resumed, again), strict=True):
        assert (a.outcome.offset, a.candidates, a.events) == (b.outcome.offset, b.candidates, b.events)
    assert about(steps) == [("nothing", "shown_less")]


async def proposed(folder: Path, *found: Any) -> WarmAtFirst:
    """A service that looks twice a day and finds this in turn, run until a candidate is proposed."""
    service = WarmAtFirst(folder, *found, acts=begun, before_night=8 * 60)
    service.use(service.config_bytes.replace(b"every_h = 24", b"every_h = 12"))
    await service.run(2400, until=in_phase(service, "proposed"))
    return service


async def test_a_newcomer_that_has_shown_less_is_forgotten_when_the_next_diagnosis_begins(tmp_path: Path) -> None:
    service = await proposed(tmp_path, NOTHING, shown(extended()), shown(stronger(0.1)), NOTHING)
    later = itertools.count()
    await service.run(1700, until=lambda _: len(service.asked) == 4 and next(later) == 20)
    steps = [step for step in service.steps() if step[0] != "diagnose"]
    assert steps[steps.index(("propose", "")) + 1] == ("nothing", "shown_less")
    assert sha256_of(stronger(0.1)) not in {one.model_sha256 for one in service.candidates()}
    checked(service)


@pytest.mark.parametrize(
    ("first", "second", "decided"),
    [
        ([extended()], stronger(0.1), [("nothing", "shown_less")]),
        ([together(extended(), stronger(0.03))], extended(), [("withdraw", "replaced"), ("shadow", "")]),
    ],
)
async def test_the_service_decides_by_what_was_warmed_up_and_a_replay_decides_it_again(
    tmp_path: Path, first: list[bytes], second: bytes, decided: list[tuple[str, str]]
) -> None:
    found = [NOTHING, *map(shown, first), shown(second)]
    service = await proposed(tmp_path, *found)
    assert len(service.asked) == 1 + len(first)
    later = itertools.count()
    await service.run(900, until=lambda _: len(service.asked) == len(found) and next(later) == 20)
    steps = [step for step in service.steps() if step[0] != "diagnose"]
    assert steps[steps.index(("propose", "")) + 1 :] == decided
    assert service.candidates()[-1].model_sha256 == sha256_of(first[0] if len(decided) == 1 else second)
    checked(service)
    step, why = decided[0]
    files = recordings(service.recordings, MACHINE)
    deciding = next(path for path in files if (step, why) in decisions_of(path))
    assert replayed(deciding, lambda group: group) is None
    assert replayed(deciding, changed("event", why.encode(), b"waits")).topic == "event"


def decisions_of(path: Path) -> list[tuple[str, str]]:
    events = [event for event in messages(path, ("event",)) if event.kind == "loop"]
    return [(event.data["step"], event.data.get("why", "")) for event in events]
