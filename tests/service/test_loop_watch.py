"""The model before an adoption: it is compared beside whatever a diagnosis finds meanwhile."""

from __future__ import annotations

import asyncio
import errno
import itertools
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from msgspec.structs import replace

from compensator.clock import NS
from compensator.config import LoopSettings
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData, Note
from compensator.messages import Sample
from compensator.model.model_file import parse_model
from compensator.recording.reading import recordings
from compensator.service.compensation import Compensation
from compensator.service.loop import live
from compensator.service.loop.choice import Choice
from compensator.service.loop.core import ShadowedLoop
from compensator.service.loop.decisions import LoopDecisions
from compensator.service.loop.found import Found
from compensator.service.loop.run import LoopStep, OfflineLoop
from compensator.service.loop.state import InShadow, LoopState, Running
from compensator.service.loop.weighing import Weighed
from compensator.service.outcome import Outcome
from compensator.service.replay import opening_of
from compensator.service.transfer import model_store, warm_up
from compensator.service.transfer.adoption import Adoption, ModelRequest
from compensator.service.transfer.model_store import ModelStore, sha256_of
from compensator.service.transfer.second_opinion import sensor_suspected
from compensator.service.transfer.shadow import Shadow
from tests.service.living import MACHINE
from tests.service.looping import DAY, Night, decisions, extended, machine, run, settings, shown, stronger
from tests.service.test_loop_run import CHECKED
from tests.service.test_loop_service import Asked, Looping, checked, in_phase, replayed
from tests.service.test_restart import QUILL

HOUR_NS = 3600 * NS
ADOPTED_NS = 1_000_000 * HOUR_NS
NOT_JUDGED, ALIKE, WORSE = ComparisonVerdict.NOT_JUDGED, ComparisonVerdict.ALIKE, ComparisonVerdict.WORSE


SIX_HOURS = {"loop": {"policy": "adopt", "shadow_h": 6.0, "every_h": 4}}


def adopted(
    night: Night, acts: Callable[[int], float], tables: Mapping[str, Any] = SIX_HOURS, **changes: Any
) -> tuple[OfflineLoop, Iterator[Sample]]:
    """Run a machine until the first candidate is adopted; return the loop and the samples after it."""
    loop, source = OfflineLoop(settings(**tables), QUILL, night), machine(4 * DAY, acts, **changes)
    for one in source:
        loop.process(one)
        if loop.phase == "watching":
            return loop, source
    raise AssertionError


@pytest.mark.parametrize("change", [0.1, -0.1])
def test_the_way_back_stays_open_whatever_is_found_meanwhile(change: float) -> None:
    """The effect ends at the adoption, and each diagnosis finds another gain, which is not there."""
    night, ended = Night(shown(extended())), list[int]()
    loop, source = adopted(night, lambda i: float(not ended))
    steps = run(loop, source, 1)
    ended.append(steps[0].outcome.sample.seq)
    night.found = [shown(stronger(change))]
    steps += run(loop, source, DAY)
    found = decisions(steps)
    back = next(seq for seq, step, _ in found if step == "back")
    roles = [{one.role for one in step.candidates} for step in steps if step.outcome.sample.seq == back]
    assert roles == [{"before", "candidate"}] and back - ended[0] < DAY // 2
    assert [step for seq, step, _ in found if seq < back].count("shadow") >= 1
    assert loop.effects == () and "adopt" not in [step for _, step, _ in found]
    # What was found goes on beside the model that is in force now, and the hours of both count.
    before, after = (
        [one for step in steps if step.outcome.sample.seq == at for one in step.candidates][-1]
        for at in (back, back + 1)
    )
    assert after.role == "candidate" and before.hours - 1.0 <= after.hours <= before.hours
    assert after.present_rms_um != before.present_rms_um


def test_other_parameters_are_adopted_and_the_model_before_both_stays_the_way_back() -> None:
    """The first candidate has a third of the effect; then the whole of it is adopted, then the effect ends."""
    night, ended = Night(shown(extended(1.0))), list[int]()
    loop, source = adopted(night, lambda i: float(not ended))
    night.found = [shown(extended())]
    loop._core.state.adopted_utc_ns -= 24 * HOUR_NS  # an adoption is permitted at once
    steps = list[LoopStep]()
    for one in source:
        steps.append(loop.process(one))
        if steps[-1].model_sha256 == sha256_of(extended()):
            break
    first, second = [seq for seq, step, _ in decisions(steps) if step in ("shadow", "adopt")][:2]
    assert second - first >= 6 * 60 - 1
    (text,) = [note.text for step in steps for note in step.events if note.data.get("step") == "adopt"]
    assert "with input:coolant_degc, newer parameters of the present effects; last" in text
    beside = {one.model_sha256 for one in run(loop, source, 1)[0].candidates}
    assert beside == {sha256_of(QUILL), sha256_of(extended(1.0))}
    ended.append(one.seq)
    steps = run(loop, source, DAY)
    assert loop.effects == () and steps[-1].model_sha256 == sha256_of(QUILL)
    assert [step for _, step, _ in decisions(steps) if step in ("adopt", "back")] == ["back"]


def test_a_couple_that_drifts_while_both_are_compared_judges_neither_and_changes_no_model() -> None:
    night, began = Night(shown(extended())), list[int]()

    def drifting(i: int, values: dict[str, float]) -> None:
        if began:
            values["t_q_degc"] += 0.01 * (i - began[0])

    loop, source = adopted(night, lambda i: 1.0, SIX_HOURS | CHECKED, change=drifting)
    night.found = [shown(stronger(0.1))]
    while len(run(loop, source, 1)[0].candidates) < 2:
        pass
    assert loop._core.state.adopted_utc_ns > 24 * HOUR_NS  # two adoptions are apart
    loop._core.state.adopted_utc_ns -= 24 * HOUR_NS  # an adoption would be permitted
    steps = run(loop, source, 90)
    began.append(steps[-1].outcome.sample.seq)
    steps += run(loop, source, 500)
    assert any(sensor_suspected(step.outcome.offset.reasons) for step in steps)
    hours = [one.hours for step in steps for one in step.candidates if one.role == "before"]
    assert max(hours) > 0.0 == hours[-1]  # what was compared until it was suspected is forgotten
    last = [step.outcome.sample.seq for step in steps if len(step.candidates) == 2][-1]
    assert last == steps[-1].outcome.sample.seq or (last, "end", "worse") in decisions(steps)
    assert not {"adopt", "back"} & {step for _, step, _ in decisions(steps)}
    assert loop.effects == ("input:coolant_degc",)


def test_both_shadows_continue_from_a_state_with_the_same_bits() -> None:
    night = Night(shown(extended()))
    loop, source = adopted(night, lambda i: 1.0)
    night.found = [shown(stronger(0.1))]
    while len(run(loop, source, 1)[0].candidates) < 2:
        pass
    run(loop, source, 45)
    resumed = OfflineLoop(settings(**SIX_HOURS), QUILL, night)
    resumed.restore(loop.state())
    source, again = itertools.tee(source)
    for a, b in zip(run(loop, source, 60), run(resumed, again, 60), strict=True):
        assert (a.outcome.offset, a.candidates, a.events) == (b.outcome.offset, b.candidates, b.events)
    assert len(a.candidates) == 2


def watching(verdict: ComparisonData, *, hours: float = 30.0, misfit_h: float = 0.0) -> tuple[LoopDecisions, int]:
    """A loop so many hours after an adoption, with a diagnosis that has ended, and the time."""
    now_ns = ADOPTED_NS + round(hours * HOUR_NS)
    before = InShadow(sha256="a" * 64, effects=[], role="before", since_utc_ns=ADOPTED_NS, verdict=verdict)
    state = LoopState(
        watched=before,
        adopted_utc_ns=ADOPTED_NS,
        misfit_min=60.0 * misfit_h,
        diagnosis=Running(from_utc_ns=ADOPTED_NS, to_utc_ns=now_ns, why="planned"),
    )
    return LoopDecisions(LoopSettings(policy="adopt"), 60.0, ["gain:DTF"], state), now_ns


def follows(loop: LoopDecisions, now_ns: int, *, same: bool = False) -> tuple[str, str]:
    """Return what follows from a diagnosis that has found another effect, or the same with other parameters."""
    found = DiagnosisData(verdict="explained", effects=["input:coolant_degc"], candidate_sha256="b" * 64)
    found = replace(found, same_effects=same, change_deviations=9.0 if same else None)
    (note,) = loop.receive(found, now_ns) or loop.begin()
    return note.data["step"], note.data.get("why", "")


def test_the_model_that_is_watched_does_not_run_twice() -> None:
    loop, now_ns = watching(judged(NOT_JUDGED))
    assert loop.state.watched is not None
    sha256 = loop.state.watched.sha256
    found = DiagnosisData(verdict="explained", effects=["gain:TDTF"], candidate_sha256=sha256)
    (note,) = loop.receive(found, now_ns)
    assert (note.data["step"], note.data["why"]) == ("nothing", "in_shadow")


def judged(verdict: ComparisonVerdict, deviations: float | None = None, ratio: float | None = None) -> ComparisonData:
    return ComparisonData(verdict=verdict, deviations=deviations, ratio=ratio)


@pytest.mark.parametrize("same", [True, False])
@pytest.mark.parametrize("verdict", [judged(NOT_JUDGED), judged(ALIKE, 2.5, 0.8), judged(WORSE, -9.0, 3.0)])
def test_a_candidate_does_not_wait_for_the_model_before(verdict: ComparisonData, *, same: bool) -> None:
    loop, now_ns = watching(verdict, hours=1.0)
    assert follows(loop, now_ns, same=same) == ("shadow", "")
    loop.shadow_begins("b" * 64, ["input:coolant_degc"], now_ns)
    assert [place.sha256[0] for place in loop.state.taken] == ["a", "b"]
    assert loop.state.watched is not None and loop.state.watched.verdict == verdict
    assert loop.state.phase == "shadow"


def may_adopt(loop: LoopDecisions, now_ns: int) -> bool:
    """Return whether a candidate that is clearly better is adopted."""
    loop.shadow_begins("b" * 64, ["input:coolant_degc"], now_ns)
    (found,) = loop.state.found
    found.verdict = ComparisonData(
        verdict=ComparisonVerdict.BETTER,
        measured_by="sensor",
        present_rms_um=5.0,
        candidate_rms_um=1.0,
        deviations=9.0,
        ratio=0.3,
    )
    chosen = Choice(loop.state, LoopSettings(policy="adopt"), loop.compared).adopted([found], now_ns)
    assert chosen in (found, None)
    return chosen is found


@pytest.mark.parametrize(("verdict", "may"), [(judged(ALIKE, 2.5, 0.8), False), (judged(ALIKE, 0.5, 1.0), True)])
def test_a_candidate_is_not_adopted_while_the_model_before_is_better_so_far(
    verdict: ComparisonData, *, may: bool
) -> None:
    assert may_adopt(*watching(verdict)) == may


@pytest.mark.parametrize(("hours", "may"), [(5.9, False), (6.1, True)])
def test_between_two_adoptions_is_as_long_as_a_candidate_is_compared(hours: float, *, may: bool) -> None:
    assert may_adopt(*watching(judged(ALIKE, 0.5, 1.0), hours=hours)) == may


def test_a_candidate_neither_replaces_a_decided_exchange_nor_outlives_it() -> None:
    loop, now_ns = watching(judged(WORSE, -9.0, 3.0))
    loop.state.exchange, loop.state.incoming = "back", "a" * 64
    assert follows(loop, now_ns) == ("nothing", "waits")
    for sha256 in ("c" * 64, ""):
        loop, now_ns = watching(judged(WORSE, -9.0, 3.0))
        loop.shadow_begins("b" * 64, ["input:coolant_degc"], now_ns)
        loop.state.exchange, loop.state.incoming = "adopt", "b" * 64
        running = loop.state.diagnosis = Running(from_utc_ns=0, to_utc_ns=1, why="planned", candidate_sha256=sha256)
        loop.state.watched = None
        assert loop.exchanged(now_ns, "d" * 64) == []
        assert loop.state.diagnosis == (None if sha256 else running)
        assert loop.state.phase == "watching" and loop.state.watched is not None
        assert loop.state.watched.sha256 == "d" * 64 and loop.state.found == []


def test_after_a_way_back_what_is_avoided_or_in_force_is_compared_no_longer() -> None:
    for sha256, effects, why in (
        ("b" * 64, ["input:coolant_degc"], ""),
        ("b" * 64, ["gain:DTF"], "avoided"),  # it was gone back from these
        ("a" * 64, [], "replaced"),
    ):
        loop, now_ns = watching(judged(ComparisonVerdict.BETTER, 9.0, 0.3))
        loop.shadow_begins(sha256, effects, now_ns, role="candidate" if effects else "before")
        loop.state.exchange, loop.state.incoming = "back", "a" * 64
        ends = [(note.data["step"], note.data["why"]) for note in loop.exchanged(now_ns + HOUR_NS, "d" * 64)]
        assert ends == ([("end", why)] if why else [])
        assert loop.state.watched is None and bool(loop.state.found) == (not why)
        assert loop.state.place("d" * 64) is None


@pytest.mark.parametrize("action", ["adopt", "back"])
def test_the_model_before_that_an_exchange_leaves_without_a_place_ends_with_an_event(action: Any) -> None:
    loop, now_ns = watching(judged(ALIKE, 0.5, 1.0))
    loop.shadow_begins("c" * 64, ["delay:DTF"], now_ns, role="candidate" if action == "adopt" else "before")
    loop.state.exchange, loop.state.incoming = action, "c" * 64
    (note,) = loop.exchanged(now_ns + HOUR_NS, "d" * 64)
    assert (note.data["step"], note.data["why"], note.data["model_sha256"]) == ("end", "replaced", "a" * 64)
    assert note.data["role"] == "before"


def begun() -> tuple[LoopDecisions, int]:
    """A loop that has said that a candidate begins before the next sample."""
    loop, now_ns = watching(judged(ALIKE, 0.5, 1.0))
    assert follows(loop, now_ns) == ("shadow", "") and loop.state.has_next
    return loop, now_ns


@pytest.mark.parametrize(
    ("ends", "why"),
    [
        (lambda loop, now_ns: gone_back(loop, now_ns), "replaced"),
        (lambda loop, now_ns: loop.restarted(), "interrupted"),
        (lambda loop, now_ns: loop.give_up_one("", "no memory"), "failed"),
        (lambda loop, now_ns: loop.model_changed([], now_ns, calibrated=[]), "by_hand"),
    ],
)
def test_what_was_said_to_begin_and_does_not_ends_with_an_event(ends: Any, why: str) -> None:
    loop, now_ns = begun()
    assert loop.state.diagnosis is not None
    sha256 = loop.state.diagnosis.candidate_sha256
    found = [
        (note.data["step"], note.data.get("why", ""), note.data.get("model_sha256")) for note in ends(loop, now_ns)
    ]
    assert ("end", why, sha256) in found and not loop.state.has_next


def gone_back(loop: LoopDecisions, now_ns: int) -> list[Note]:
    loop.state.exchange, loop.state.incoming = "back", "a" * 64
    return loop.exchanged(now_ns, "d" * 64)


def test_a_result_that_comes_while_another_one_waits_decides_nothing() -> None:
    loop, now_ns = begun()
    waits = loop.state.diagnosis
    for found in (DiagnosisData(verdict="adequate"), DiagnosisData(verdict="explained", candidate_sha256="e" * 64)):
        assert loop.receive(found, now_ns) == [] and loop.state.diagnosis is waits


def test_a_warm_up_that_nothing_waits_for_does_not_end_the_diagnosis_under_way(tmp_path: Path) -> None:
    """A person has dismissed what was warmed up; it fails after the next diagnosis has begun."""
    core = ShadowedLoop(settings(), parse_model(QUILL, source="test"), {})
    core.state.diagnosis = under_way = Running(from_utc_ns=0, to_utc_ns=1, why="misfit")
    parts = live.LoopParts(core=core, model=QUILL, store=Mock(), diagnose=Mock())
    loop = live.ServiceLoop(settings(), parts, tmp_path, events=Mock(), journal=Mock(), clock=Mock())
    dismissed = DiagnosisData(verdict="explained", candidate_sha256="c" * 64)
    wanted = Running(from_utc_ns=0, to_utc_ns=1, why="misfit")
    loop._warming = Found(wanted, Weighed(dismissed, b""), "", why="the candidate cannot be warmed up")
    loop.hand_over(Mock())
    assert core.state.diagnosis is under_way and loop._warming is None


def test_the_result_of_a_diagnosis_that_has_ended_is_not_taken_for_that_of_the_next_one(tmp_path: Path) -> None:
    """A defect has ended the first one while its process ran on, and the next one has begun meanwhile."""
    core = ShadowedLoop(settings(), parse_model(QUILL, source="test"), {})
    core.state.diagnosis = under_way = Running(from_utc_ns=0, to_utc_ns=2, why="planned")
    parts = live.LoopParts(core=core, model=QUILL, store=Mock(), diagnose=Mock())
    events = Mock()
    loop = live.ServiceLoop(settings(), parts, tmp_path, events=events, journal=Mock(), clock=Mock())
    nothing = Weighed(DiagnosisData(verdict="adequate"), None)
    for to_utc_ns, taken in ((1, False), (2, True)):
        wanted = Running(from_utc_ns=0, to_utc_ns=to_utc_ns, why="planned")
        loop._found = Found(wanted, nothing, "nothing to deploy")
        loop.hand_over(Mock())
        assert events.note.called is taken and (core.state.diagnosis is under_way) is not taken
    assert loop._found is None


async def test_the_service_keeps_both_shadows_over_a_kill_and_its_replay_makes_the_same_of_both(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()), shown(extended(2.0)), every_h=8)
    await machine.run(1800, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    await machine.run(1200, until=in_phase(machine, "shadow"))
    await machine.run_and_kill(100)
    await machine.run(30)
    assert machine.steps()[2:] == [("adopt", ""), ("diagnose", "planned"), ("shadow", "")]
    last = machine.candidates()[-60:]
    assert [(one.role, one.model_sha256) for one in last] == 30 * [
        ("before", sha256_of(QUILL)),
        ("candidate", sha256_of(extended(2.0))),
    ]
    status = next(json.loads(sent) for name, sent in reversed(machine.published) if name == "status")
    assert status["loop"]["effects"] == ["input:coolant_degc"] and status["loop"]["before_effects"] == []
    checked(machine)
    path = recordings(machine.recordings, MACHINE)[-1]
    opening = opening_of(path)
    assert (opening["before.toml"], opening["candidate.toml"]) == (QUILL, extended(2.0))
    for role in (b'"role":"before"', b'"role":"candidate"'):
        one_left_out = replayed(path, lambda group, role=role: [one for one in group if role not in one.body])
        assert one_left_out.topic == "candidate"


async def test_a_candidate_in_its_warm_up_does_not_take_the_place_after_an_operators_yes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Looping(tmp_path, shown(extended()), shown(stronger(0.1)), policy="propose", every_h=8)
    machine.use(machine.config_bytes.replace(b"shadow_h = 6.0", b"shadow_h = 48.0"))
    await machine.run(1800, until=in_phase(machine, "shadow"))
    works, adopted, warmed = warm_up.warm_up, threading.Event(), threading.Event()

    def late(*arguments: Any, **settings: Any) -> Any:
        machine.at_sample[len(machine.outcomes) + 5] = Asked(machine, "adopt", candidate=True, force=True)
        machine.waits_for_diagnoses = False
        found = works(*arguments, **settings)
        assert adopted.wait(60.0)
        warmed.set()
        return found

    def at_adoption(outcome: Outcome) -> bool:
        if outcome.offset.model_sha256 != sha256_of(extended()):
            return False
        adopted.set()
        machine.waits_for_diagnoses = True
        return [one.offset.model_sha256 for one in machine.outcomes[-30:]].count(sha256_of(extended())) == 30

    monkeypatch.setattr("compensator.service.loop.found.warm_up", late)
    await machine.run(1800, until=at_adoption)
    assert warmed.is_set() and machine.steps()[-2:] == [("diagnose", "planned"), ("adopt", "by_hand")]
    assert {one.role for one in machine.candidates()[-29:]} == {"before"}
    assert opening_of(recordings(machine.recordings, MACHINE)[-1])["before.toml"] == QUILL
    checked(machine)


async def test_a_disk_that_is_full_on_the_way_back_keeps_it_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, outcomes = settings(), list[Outcome]()
    present = Compensation(config, parse_model(extended(), source="present"))
    before = Compensation(config, parse_model(QUILL, source="before"))
    for one in machine(30):
        outcomes.append(present.process(one))
        before.process(one)
    core = ShadowedLoop(config, present.model, {})
    core.state.watched = InShadow(sha256=sha256_of(QUILL), effects=[], role="before", since_utc_ns=1)
    core.state.exchange, core.state.incoming = "back", sha256_of(QUILL)
    core.shadows[sha256_of(QUILL)] = Shadow(before, QUILL)
    store = ModelStore(tmp_path, QUILL, "vmc-07")
    store.adopt(extended(), name="extended", time_utc_ns=1, by_loop=True)
    events, files = Mock(), Mock()
    loop = live.ServiceLoop(
        config,
        live.LoopParts(core=core, model=extended(), store=store, diagnose=Mock()),
        tmp_path,
        events=events,
        journal=files,
        clock=Mock(utc_ns=lambda: 2),
    )

    async def sample() -> Compensation:
        loop.after_sample()
        await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
        loop.hand_over(present)
        return loop.before_sample(present)

    works = model_store.replace_file
    monkeypatch.setattr(model_store, "replace_file", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    assert [await sample() for _ in range(3)] == 3 * [present]
    assert core.state.exchange == "back" and store.in_use() == extended()
    ((_, said, data),) = [call.args for call in events.note.call_args_list]  # once
    assert said.startswith("the way back waits: ") and "No space left on device" in said and data["ok"] is False
    reply: Future[dict[str, Any]] = Future()
    adoption = Adoption(config, tmp_path, store, events, files, clock=Mock(), running=lambda: present, loop=loop)
    adoption.begin("back", ModelRequest(), reply, Mock(data=dict))
    assert "No space left on device" in reply.result(timeout=0)["text"]
    # Where it has ended otherwise, neither another exchange nor a later way back waits for that.
    core.state.exchange = "adopt"
    assert loop.waits_for == ""
    core.state.exchange = ""
    loop.hand_over(present)
    core.state.exchange = "back"
    assert loop.waits_for == ""
    monkeypatch.setattr(model_store, "replace_file", works)
    assert await sample() is before
    assert store.in_use() == QUILL and core.state.phase == "idle" and core.state.exchange == ""
