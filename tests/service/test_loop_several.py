"""Several candidates in shadow at once: each keeps what it has shown, and the best of them is adopted."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compensator.clock import NS
from compensator.config import LoopSettings
from compensator.errors import ServiceError
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData
from compensator.recording.reading import messages, recordings
from compensator.service.loop.core import ShadowedLoop
from compensator.service.loop.decisions import LoopDecisions
from compensator.service.loop.proof import CANDIDATES, shared
from compensator.service.loop.run import Diagnosed, LoopStep, OfflineLoop
from compensator.service.loop.state import InShadow, LoopState, Running
from compensator.service.replay import opening_of
from compensator.service.transfer.model_store import sha256_of
from tests.service.living import MACHINE
from tests.service.looping import (
    DAY,
    QUILL,
    Night,
    about,
    crept,
    decisions,
    extended,
    grown,
    machine,
    run,
    settings,
    shown,
    stronger,
    together,
)
from tests.service.test_loop_level import WarmAtFirst, begun, from_noon, warm_at_first
from tests.service.test_loop_service import EVENING, Asked, Looping, changed, checked, in_phase, replayed
from tests.service.test_restart import QUILL as QUILL_FILE

#: A diagnosis each eight hours, and none of them is adopted before the next one.
EARLY = {"every_h": 8, "at_utc": "02:00", "shadow_h": 12.0}
TWICE = {"loop": {"every_h": 12, "shadow_h": 6.0}}
#: The first diagnosis is made before the effect begins, the second one after it; what that finds is proposed by now.
LATER = 36 * 60
NOTHING = shown(None, "adequate")
HOUR_NS = 3600 * NS
NOW_NS = 100 * HOUR_NS
DAY_NS = 24 * HOUR_NS


def decided(steps: list[LoopStep]) -> list[tuple[str, str]]:
    """Return what was decided, without the diagnoses that begin."""
    return [(step, why) for _, step, why in decisions(steps) if step != "diagnose"]


def events_of(steps: list[LoopStep], step: str, why: str = "") -> list[dict[str, Any]]:
    notes = [note for one in steps for note in one.events if note.kind == "loop"]
    return [dict(note.data) for note in notes if (note.data["step"], note.data.get("why", "")) == (step, why)]


def decisions_of(path: Path) -> list[tuple[str, str]]:
    events = [event for event in messages(path, ("event",)) if event.kind == "loop"]
    return [(event.data["step"], event.data.get("why", "")) for event in events]


def stronger_dtf(change: float, acts: Callable[[int], bool]) -> Callable[[int], float]:
    """What a gain of the DTF adds to Y, beside a mount that creeps so that no level is known, µm."""
    gain = grown(change)
    return lambda i: crept(i) + gain(i) * acts(i)


def place(name: str, deviations: float | None, *, role: Any = "candidate", hours: float = 8.0) -> InShadow:
    found = InShadow(sha256=name * 64, effects=[f"gain:{name}"], role=role, since_utc_ns=NOW_NS - 8 * HOUR_NS)
    found.verdict = ComparisonData(verdict=ComparisonVerdict.ALIKE, deviations=deviations, hours=hours)
    return found


def full(*places: InShadow, policy: Any = "adopt") -> LoopDecisions:
    """A loop all of whose places are taken, and a diagnosis that has ended."""
    diagnosis = Running(from_utc_ns=NOW_NS - 36 * HOUR_NS, to_utc_ns=NOW_NS, why="planned")
    return LoopDecisions(LoopSettings(policy=policy), 60.0, [], LoopState(found=list(places), diagnosis=diagnosis))


def found(effects: list[str]) -> DiagnosisData:
    return DiagnosisData(verdict="explained", effects=effects, candidate_sha256="n" * 64)


def test_where_all_places_are_taken_what_shows_least_gives_way() -> None:
    loop = full(place("a", 2.0), place("b", -1.5), place("c", None))
    assert len(loop.state.found) == CANDIDATES
    assert loop.receive(found(["gain:DTF"]), NOW_NS) == []
    assert about(loop.begin()) == [("end", "gives_way"), ("shadow", "")]
    assert loop.begin() == []  # said once
    loop.shadow_begins("n" * 64, ["gain:DTF"], NOW_NS)
    assert [one.sha256[0] for one in loop.state.found] == ["a", "c", "n"]
    assert loop.state.found[0].verdict.deviations == 2.0


@pytest.mark.parametrize(
    ("others", "gives_way"),
    [
        (({"deviations": 0.5}, {"deviations": 0.2}), "c"),  # what has just begun stays
        (({"deviations": 2.0, "hours": 30.0}, {"deviations": 1.5}), "b"),  # by the hour
        (({"deviations": -2.0}, {"deviations": -2.0, "hours": 30.0}), "b"),
        (({"deviations": 1.0, "hours": 3.0}, {"deviations": -1.0, "hours": 3.0}), "c"),  # of those that have no chance
    ],
)
def test_what_promises_least_by_the_hour_gives_way_and_nothing_by_noise(others: Any, gives_way: str) -> None:
    young = place("a", None, hours=0.0)
    loop = full(young, *(place(name, **settings) for name, settings in zip("bc", others, strict=True)))
    loop.receive(found(["gain:DTF"]), NOW_NS)
    ended, _ = loop.begin()
    assert ended.data["why"] == "gives_way" and ended.data["model_sha256"][0] == gives_way


def test_what_is_never_compared_keeps_no_place() -> None:
    """A candidate whose channel is dead, or whose state is not known, for twice the time that judges one."""
    dead = place("a", None, hours=0.0)
    dead.since_utc_ns = NOW_NS - 12 * HOUR_NS
    loop = full(dead, place("b", 0.5), place("c", 3.9))
    loop.receive(found(["gain:DTF"]), NOW_NS)
    assert loop.begin()[0].data["model_sha256"][0] == "a"


class Stands:
    """Stands for what is compared of a candidate that is better than the present model."""

    def __init__(self, one: InShadow, surpasses: str = "", level_um: float | None = 0.0) -> None:
        self.one, self._surpasses, self.level_um, self.asked = one, surpasses, level_um, list[str]()
        self.level_at_adoption_um, self.shown_level_um = level_um or 0.0, level_um
        self.level_at_return_um, self.goes_back, self.is_alone_right = 0.0, True, False

    def is_better_to_go_back_to(self, *, is_new: bool) -> bool:
        return self.goes_back

    def is_better(self, now_ns: int) -> bool:
        return True

    def beside(self, rival: InShadow) -> ComparisonData:
        self.asked.append(rival.sha256)
        if rival.sha256[0] not in self._surpasses:
            return ComparisonData(verdict=ComparisonVerdict.ALIKE, deviations=0.0, ratio=1.0)
        return ComparisonData(
            verdict=ComparisonVerdict.BETTER, deviations=9.0, ratio=0.3, present_rms_um=3.0, candidate_rms_um=1.0
        )


def chosen(*stand: Stands, present: Sequence[str] = (), policy: Any = "adopt") -> list[tuple[str, str]]:
    """Return what a loop decides about candidates after new verdicts; each pair is compared at most once."""
    loop = full(*(one.one for one in stand), policy=policy)
    loop.state.effects = list(present)
    loop.state.diagnosis = None
    loop.compared = lambda one: next(found for found in stand if found.one is one)  # type: ignore
    notes = loop._choose([one.one for one in stand], NOW_NS)
    assert all(len(one.asked) == len(set(one.asked)) for one in stand)
    return [(note.data["step"], note.data["model_sha256"][0]) for note in notes]


def test_what_has_more_effects_and_whose_level_is_not_known_keeps_out_none_that_can_be_adopted() -> None:
    part, whole, other = place("a", 5.0), place("b", 8.0), place("c", 6.0)
    whole.effects = [*part.effects, "gain:more"]
    for level_um, decision in ((None, ("adopt", "a")), (0.0, ("adopt", "b"))):
        assert chosen(Stands(part), Stands(whole, "a", level_um)) == [decision]
    # Measured Y speaks against the effect of a: it has none of those of c.
    assert chosen(Stands(part), Stands(other, "a", None)) == [("propose", "c")]
    assert chosen(Stands(part), Stands(whole, "a", None), Stands(other, "a")) == [("adopt", "c")]


def test_of_several_ways_back_the_one_is_taken_that_shows_most_and_no_other_surpasses() -> None:
    before, fewer = place("a", 9.0, role="before"), place("b", 5.0, role="before")
    assert chosen(Stands(before), Stands(fewer, "a")) == [("back", "b")]
    assert chosen(Stands(fewer), Stands(before)) == [("back", "a")]
    # A way back comes before what is new, and what it surpasses is not adopted before it has shown enough by itself.
    assert chosen(Stands(place("c", 9.0)), Stands(fewer)) == [("back", "b")]
    for surpasses, decisions_made in (("c", []), ("", [("adopt", "c")])):
        waits = Stands(place("b", 1.0, role="before"), surpasses)
        waits.goes_back = False
        assert chosen(Stands(place("c", 9.0)), waits) == decisions_made


def test_a_pair_of_candidates_is_compared_once() -> None:
    proposed = place("a", 5.0)
    proposed.is_proposed = True
    stand = Stands(proposed, "", None), Stands(place("b", 8.0), "ac", None), Stands(place("c", 6.0), "a", None)
    assert chosen(*stand) == [("withdraw", "a"), ("propose", "b")]


def test_nobody_is_asked_for_a_zero_because_of_newer_parameters_of_the_present_effects() -> None:
    newer = place("a", 5.0)
    assert chosen(Stands(newer, "", None), present=newer.effects) == []
    assert chosen(Stands(newer, "", 0.0), present=newer.effects) == [("adopt", "a")]
    # A person who decides about each model decides about these, too.
    assert chosen(Stands(newer, "", None), present=newer.effects, policy="propose") == [("propose", "a")]


@pytest.mark.parametrize("policy", ["propose", "adopt"])
def test_what_is_proposed_never_gives_way(policy: Any) -> None:
    proposed = place("a", -1.0)
    proposed.is_proposed = True
    loop = full(proposed, place("b", 1.0), place("c", 3.0), policy=policy)
    loop.receive(found(["gain:DTF"]), NOW_NS)
    loop.begin()
    loop.shadow_begins("n" * 64, ["gain:DTF"], NOW_NS)
    assert [one.sha256[0] for one in loop.state.found] == ["a", "c", "n"] and loop.state.candidate is proposed


def test_with_the_effects_of_a_candidate_it_takes_over_and_nothing_gives_way() -> None:
    loop = full(place("a", 2.0), place("b", -1.5), place("c", 3.0))
    loop.receive(found(["gain:a"]), NOW_NS)
    assert about(loop.begin()) == [("shadow", "")]
    loop.shadow_begins("n" * 64, ["gain:a"], NOW_NS)
    assert [one.sha256[0] for one in loop.state.found] == ["b", "c", "n"]
    assert loop.state.found[-1].verdict.deviations == 2.0


def test_other_parameters_of_what_a_person_reads_wait_also_if_it_is_proposed_while_they_are_warmed_up() -> None:
    for early in (True, False):
        loop = full(place("a", 2.0), policy="propose")
        loop.state.found[0].is_proposed = early
        notes = loop.receive(found(["gain:a"]), NOW_NS)
        loop.state.found[0].is_proposed = True
        assert about(notes + loop.begin()) == [("nothing", "in_shadow")]
        assert loop.state.diagnosis is None and [one.sha256[0] for one in loop.state.found] == ["a"]


def test_an_answer_is_about_the_candidate_that_it_names() -> None:
    for answer in (lambda loop, sha: loop.accept(sha), lambda loop, sha: loop.dismiss(NOW_NS, sha)):
        loop = full(place("a", 2.0), place("b", 3.0))
        with pytest.raises(
            ServiceError, match=r"candidate cccccccccccc has given its place.* bbbbbbbbbbbb with gain:b"
        ):
            answer(loop, "c" * 64)
        assert len(loop.state.candidates) == 2 and not loop.state.exchange and not loop.state.avoided
        (note,) = answer(loop, "a" * 64)
        assert note.data["model_sha256"] == "a" * 64
        assert loop.state.incoming == "a" * 64 or [one.sha256[0] for one in loop.state.found] == ["b"]


def test_of_several_none_refutes_a_right_model_more_often_than_a_single_one_may() -> None:
    """Likelihood ratios of a model that is right, at each of 1,000 looks; one in 200 may exceed 200."""
    trials, looks, step = 10_000, 1000, 0.2
    once = float(np.sqrt(2.0 * np.log(200.0)))
    of_several = float(np.sqrt(once**2 + shared(4.0, CANDIDATES) ** 2 - 4.0**2))
    rng, largest = np.random.default_rng(5), np.full((trials, CANDIDATES), -np.inf)
    log_l = np.zeros((trials, CANDIDATES))
    for _ in range(looks):
        log_l += step * rng.normal(size=log_l.shape) - 0.5 * step**2
        largest = np.maximum(largest, log_l)
    rates = [float(np.mean(np.any(largest >= limit**2 / 2.0, axis=1))) for limit in (once, of_several)]
    deviation = np.sqrt(1.0 / 200.0 / trials)
    assert rates[0] > 1.0 / 200.0 + 3.0 * deviation > rates[1] > 0.0


def test_the_right_candidate_is_adopted_although_a_later_diagnosis_names_another_effect() -> None:
    loop = OfflineLoop(settings(loop=EARLY), QUILL_FILE, Night(shown(extended()), shown(stronger(0.1))))
    steps = run(loop, machine(DAY + 180))
    assert decided(steps)[:3] == [("shadow", ""), ("shadow", ""), ("adopt", "")] or decided(steps)[:4] == [
        ("shadow", ""),
        ("shadow", ""),
        ("end", "worse"),
        ("adopt", ""),
    ]
    assert steps[-1].model_sha256 == sha256_of(extended())


def test_of_two_that_are_better_the_one_is_adopted_that_the_other_does_not_surpass() -> None:
    """Half of the effect beside a gain that is not there is better than nothing, and was there first."""
    half = together(extended(1.5), stronger(0.005))
    loop = OfflineLoop(settings(loop=EARLY | {"every_h": 4}), QUILL_FILE, Night(shown(half), shown(extended())))
    steps = run(loop, machine(DAY + 180))
    (adopted, *_) = events_of(steps, "adopt")
    assert adopted["model_sha256"] == sha256_of(extended())
    at = next(seq for seq, step, _ in decisions(steps) if step == "adopt")
    (before,) = [step for step in steps if step.outcome.sample.seq == at]
    assert {one.model_sha256: one.verdict for one in before.candidates}[sha256_of(half)] == "better"


def adopting(*found: Diagnosed) -> OfflineLoop:
    return OfflineLoop(settings(**TWICE), QUILL_FILE, Night(*found))


def test_a_proposal_stays_beside_what_explains_less_and_is_adopted_after_a_zero() -> None:
    loop = adopting(NOTHING, shown(extended()), shown(stronger(0.1)))
    samples = from_noon(50 * 60, begun, more=crept, change=warm_at_first)
    steps = run(loop, samples, 30 * 60)
    assert decided(steps)[:4] == [("nothing", "nothing_found"), ("shadow", ""), ("propose", ""), ("shadow", "")]
    assert loop.phase == "proposed"
    loop.compensation.zero("warm")
    steps += run(loop, samples)
    assert steps[-1].model_sha256 == sha256_of(extended())


def test_a_second_effect_beside_the_first_is_proposed_in_its_place_and_says_on_which_figures() -> None:
    both = together(extended(), stronger(0.3))
    loop = adopting(NOTHING, shown(extended()), shown(extended()), shown(both))
    # It is right for half a day, so that the mount that crept before leaves its level open for all of the test.
    begins, more = 12 * 60, stronger_dtf(0.3, lambda i: i >= LATER)
    warm = functools.partial(warm_at_first, begins=begins)
    steps = run(loop, machine(52 * 60, lambda i: float(i >= begins), more=more, change=warm))
    made = decided(steps)
    assert made[2:5] == [("propose", ""), ("nothing", "in_shadow"), ("shadow", "")]
    at = made.index(("withdraw", "surpassed"))
    assert made[at + 1] == ("propose", "")
    (data,) = events_of(steps, "withdraw", "surpassed")
    assert data["comparison"]["verdict"] == "better" and data["comparison"]["deviations"] >= 4.0
    assert data["model_sha256"] == sha256_of(extended())
    assert events_of(steps, "propose")[-1]["model_sha256"] == sha256_of(both)


def test_after_an_adoption_the_others_go_on_beside_the_new_model_by_the_hours_of_both() -> None:
    """As if the adopted one had been the present model all the time."""
    other = together(extended(), stronger(0.02))
    loop = OfflineLoop(settings(loop=EARLY | {"every_h": 4}), QUILL_FILE, Night(shown(extended()), shown(other)))
    source = machine(3 * DAY)
    steps = list[LoopStep]()
    while not steps or steps[-1].model_sha256 != sha256_of(extended()):
        steps += run(loop, source, 1)
    (before,) = [one for one in steps[-2].candidates if one.model_sha256 == sha256_of(other)]
    (after,) = [one for one in steps[-1].candidates if one.model_sha256 == sha256_of(other)]
    assert before.hours - 1.0 <= after.hours <= before.hours
    assert before.deviations is not None and after.deviations is not None
    assert before.deviations > 4.0 and after.deviations < -4.0
    assert after.present_rms_um is not None and before.present_rms_um is not None
    assert after.present_rms_um < 0.5 * before.present_rms_um


class Early(Looping):
    """A service that looks each eight hours, and compares for longer."""

    def __init__(self, folder: Path, *found: Any, shadow_h: float = 12.0, **settings: Any) -> None:
        super().__init__(folder, *found, **settings)
        data = self.config_bytes.replace(b"every_h = 24", b"every_h = 8")
        self.use(data.replace(b"shadow_h = 6.0", b"shadow_h = %.1f" % shadow_h))


async def test_the_service_runs_them_over_a_kill_and_a_replay_makes_the_same_of_each(tmp_path: Path) -> None:
    models = extended(), stronger(0.004)
    service = Early(tmp_path, *map(shown, models), shadow_h=48.0)
    await service.run(960, until=lambda _: len(service.asked) == 2)
    await service.run(30)
    await service.run_and_kill(100)
    await service.run(30)
    last = service.candidates()[-20:]
    assert {one.model_sha256 for one in last} == {sha256_of(models[0]), sha256_of(models[1])}
    assert {one.role for one in last} == {"candidate"}
    # What a status shows comes last.
    assert last[-1].model_sha256 == sha256_of(extended())
    checked(service)
    path = recordings(service.recordings, MACHINE)[-1]
    opening = opening_of(path)
    assert (opening["candidate.toml"], opening["candidate_2.toml"]) == (models[0], models[1])
    for model in models:
        sha = sha256_of(model).encode()
        less = replayed(
            path, lambda group, sha=sha: [one for one in group if one.topic != "candidate" or sha not in one.body]
        )
        assert less.topic == "candidate"


async def proposed(folder: Path, *found: Any) -> WarmAtFirst:
    """A service that looks twice a day and finds this in turn, run until a candidate is proposed."""
    service = WarmAtFirst(folder, *found, acts=begun, before_night=14 * 60)
    service.use(service.config_bytes.replace(b"every_h = 24", b"every_h = 12"))
    await service.run(2400, until=in_phase(service, "proposed"))
    return service


async def test_the_service_proposes_what_surpasses_a_proposal_and_a_replay_decides_it_again(tmp_path: Path) -> None:
    first, second = together(extended(), stronger(0.03)), extended()
    service = await proposed(tmp_path, NOTHING, shown(first), shown(second))
    assert len(service.asked) == 2
    await service.run(2400, until=service.decides("withdraw", "surpassed"))
    await service.run(20)
    steps = [step for step in service.steps() if step[0] != "diagnose"]
    at = steps.index(("withdraw", "surpassed"))
    assert steps[at - 2 : at + 2] == [("propose", ""), ("shadow", ""), ("withdraw", "surpassed"), ("propose", "")]
    assert service.candidates()[-1].model_sha256 == sha256_of(second)
    checked(service)
    files = recordings(service.recordings, MACHINE)
    deciding = next(path for path in files if ("withdraw", "surpassed") in decisions_of(path))
    assert replayed(deciding, lambda group: group) is None
    assert replayed(deciding, changed("event", b"surpassed", b"waits")).topic == "event"


@pytest.mark.parametrize("name", ["adopt", "dismiss"])
async def test_an_answer_to_a_candidate_that_has_given_its_place_is_refused(tmp_path: Path, name: str) -> None:
    """Another one with the same effects takes the place between the answer and the sample with which it acts."""
    service = Early(tmp_path, shown(extended()), shown(extended(2.0)), shadow_h=6.0, acts=lambda i: 0.5)
    arguments = {"candidate": True, "force": True} if name == "adopt" else {"sha256": sha256_of(extended())[:12]}
    asked = Asked(service, name, **arguments)

    def between() -> None:
        loop = service.daemon._loop if service.daemon is not None else None
        core = loop._core if loop is not None else None
        if core is not None and core.state.has_next and core.state.candidate is not None and asked.reply is None:
            asked()

    await service.run(EVENING + 120)
    found = service.candidates()[-1]
    assert found.model_sha256 == sha256_of(extended())
    service.at_poll = between
    await service.run(600, until=lambda _: asked.reply is not None)
    await service.run(10)
    assert asked.answer["ok"] and asked.answer["model_sha256"] == sha256_of(extended())
    (refused,) = service.events("command_refused")
    assert f"candidate {sha256_of(extended())[:12]} has given its place" in refused.text
    assert service.store.in_use() == QUILL_FILE and service.candidates()[-1].model_sha256 == sha256_of(extended(2.0))
    checked(service)


def newer_parameters() -> LoopDecisions:
    """A loop with one candidate, and newer parameters of its effects that are warmed up."""
    loop = LoopDecisions(settings().loop, 60.0, [])
    effects = ["gain DTF", "input:coolant_degc"]
    loop.state.found = [InShadow(sha256="a" * 64, effects=effects, role="candidate", since_utc_ns=NOW_NS - DAY_NS)]
    loop.state.diagnosis = Running(from_utc_ns=0, to_utc_ns=NOW_NS, why="night")
    # A diagnosis lists them by what they remove.
    found = DiagnosisData(verdict="explained", candidate_sha256="b" * 64, effects=effects[::-1])
    assert loop.receive(found, NOW_NS) == [] and loop.state.diagnosis is not None
    return loop


def test_newer_parameters_of_what_a_person_dismisses_do_not_begin() -> None:
    loop = newer_parameters()
    assert about(loop.dismiss(NOW_NS)) == [("end", "dismissed")]
    assert loop.begin() == [] and loop.state.diagnosis is None and not loop.state.found


def test_newer_parameters_of_what_waits_for_a_zero_wait_for_it_too() -> None:
    loop = newer_parameters()
    loop.state.found[0].is_proposed = True
    assert about(loop.begin()) == [("shadow", "")]
    loop.shadow_begins("b" * 64, ["gain DTF", "input:coolant_degc"], NOW_NS)
    assert [(one.sha256[0], one.is_proposed) for one in loop.state.found] == [("b", True)]


def test_what_is_in_force_again_does_not_run_beside_itself() -> None:
    # Weighed beside another model; the service has gone back since.
    core = ShadowedLoop(settings(), QUILL, {})
    core.state.diagnosis = Running(from_utc_ns=0, to_utc_ns=NOW_NS, why="night")
    found = DiagnosisData(verdict="adequate", candidate_sha256=QUILL.sha256, calibrated=True, present_sha256="b" * 64)
    assert about(core.receive(found, NOW_NS)) == [("nothing", "replaced")]
    assert core.state.diagnosis is None
