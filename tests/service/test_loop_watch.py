"""The model before an adoption: how long it keeps its place beside the adopted one."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData
from compensator.recording.reading import recordings
from compensator.service.loop import live
from compensator.service.loop.loop import Loop
from compensator.service.loop.run import LoopRun
from compensator.service.loop.shadow import Role
from compensator.service.loop.state import Compared, LoopState, Running
from compensator.service.outcome import Outcome
from compensator.service.replay import opening_of
from compensator.service.transfer.model_store import sha256_of
from tests.service.living import MACHINE
from tests.service.looping import DAY, Night, decisions, extended, machine, run, settings, shown
from tests.service.test_loop_service import Asked, Looping, checked, in_phase
from tests.service.test_restart import QUILL

HOUR_NS = 3600 * NS
ADOPTED_NS = 1_000_000 * HOUR_NS
NOT_JUDGED, ALIKE, WORSE = ComparisonVerdict.NOT_JUDGED, ComparisonVerdict.ALIKE, ComparisonVerdict.WORSE


def test_other_parameters_found_meanwhile_do_not_stop_the_way_back() -> None:
    """The effect ends at the adoption, and each diagnosis finds it smaller."""
    tables = {"loop": {"policy": "adopt", "shadow_h": 6.0, "every_h": 4}}
    night, ended = Night(shown(extended())), list[int]()
    loop = LoopRun(settings(**tables), QUILL, night)
    source = machine(2 * DAY, acts=lambda i: float(not ended))
    for one in source:
        loop.process(one)
        if loop.phase == "watching":
            break
    ended.append(one.seq)
    night.found = [shown(extended(2.0))]
    steps = run(loop, source)
    found = decisions(steps)
    back = next(seq for seq, step, _ in found if step == "back")
    assert {decision[1:] for decision in found if decision[0] < back} == {("diagnose", "planned"), ("nothing", "waits")}
    candidates = [step.candidate for step in steps if step.candidate and step.outcome.sample.seq <= back]
    assert {one.role for one in candidates} == {"before"} and back - ended[0] < DAY // 2


def watching(
    hours: float,
    verdict: ComparisonData,
    misfit_h: float = 0.0,
    *,
    since_h: float = 0.0,
    role: Role = "before",
) -> tuple[Loop, int]:
    """A loop so many hours after an adoption, with a diagnosis that has ended, and the time."""
    since_ns = ADOPTED_NS + round(since_h * HOUR_NS)
    now_ns = since_ns + round(hours * HOUR_NS)
    state = LoopState(
        phase="watching" if role == "before" else "shadow",
        shadow=Compared(sha256="a" * 64, effects=[], role=role, since_utc_ns=since_ns),
        adopted_utc_ns=ADOPTED_NS,
        misfit_min=60.0 * misfit_h,
        verdict=verdict,
        diagnosis=Running(from_utc_ns=ADOPTED_NS, to_utc_ns=now_ns, why="planned"),
    )
    return Loop(LoopSettings(policy="adopt"), 60.0, ["gain:DTF"], state), now_ns


def follows(loop: Loop, now_ns: int, *, same: bool = False) -> tuple[str, str]:
    """Return what follows from a diagnosis that has found another effect, or the same with other parameters."""
    found = DiagnosisData(verdict="explained", effects=["input:coolant_degc"], candidate_sha256="b" * 64)
    found = replace(found, same_effects=same, change_deviations=9.0 if same else None)
    (note,) = loop.receive(found, now_ns)
    return note.data["step"], note.data.get("why", "")


def judged(verdict: ComparisonVerdict, deviations: float | None = None, ratio: float | None = None) -> ComparisonData:
    return ComparisonData(verdict=verdict, deviations=deviations, ratio=ratio)


@pytest.mark.parametrize(
    ("hours", "verdict", "misfit_h", "other_waits", "same_waits"),
    [
        (100.0, judged(NOT_JUDGED), 0.0, True, True),
        (100.0, judged(ALIKE, 0.5, 1.0), 0.0, False, True),
        (100.0, judged(ALIKE, 2.5, 0.8), 0.0, True, True),
        (23.9, judged(WORSE, -9.0, 3.0), 0.0, True, True),
        (24.0, judged(WORSE, -9.0, 3.0), 0.0, False, False),
        (10.0, judged(WORSE, -9.0, 3.0), 3.0, False, False),
        (10.0, judged(NOT_JUDGED), 3.0, True, True),
        (10.0, judged(ALIKE, 0.5, 1.0), 3.0, False, False),
        (10.0, judged(ALIKE, 0.5, 1.0), 2.9, True, True),
        (10.0, judged(ALIKE, 2.5, 0.8), 3.0, True, True),
    ],
)
def test_a_candidate_waits_until_the_model_before_is_not_better_and_something_else_is_needed(
    hours: float, verdict: ComparisonData, misfit_h: float, *, other_waits: bool, same_waits: bool
) -> None:
    for same, waits in ((False, other_waits), (True, same_waits)):
        loop, now_ns = watching(hours, verdict, misfit_h)
        assert follows(loop, now_ns, same=same) == (("nothing", "waits") if waits else ("shadow", ""))
        assert (loop.state.diagnosis is None) == waits
        assert loop.state.shadow is not None and loop.state.shadow.sha256 == "a" * 64


def test_the_calibrated_model_that_a_diagnosis_has_brought_gives_way_to_a_candidate() -> None:
    assert follows(*watching(1.0, judged(NOT_JUDGED), since_h=50.0)) == ("shadow", "")


def test_a_candidate_neither_replaces_a_decided_exchange_nor_outlives_it() -> None:
    loop, now_ns = watching(50.0, judged(WORSE, -9.0, 3.0))
    loop.state.exchange = "back"
    assert follows(loop, now_ns) == ("nothing", "waits")
    for sha256 in ("c" * 64, ""):
        loop, now_ns = watching(50.0, judged(WORSE, -9.0, 3.0))
        assert loop.state.shadow is not None
        loop.state.exchange = "adopt"
        running = loop.state.diagnosis = Running(from_utc_ns=0, to_utc_ns=1, why="planned", candidate_sha256=sha256)
        loop.exchanged(now_ns, "d" * 64)
        assert loop.state.diagnosis == (None if sha256 else running)
        assert loop.state.phase == "watching" and loop.state.shadow.sha256 == "d" * 64


async def test_the_service_keeps_the_model_before_over_a_kill_and_its_replay_decides_the_same(tmp_path: Path) -> None:
    machine = Looping(tmp_path, shown(extended()), shown(extended(2.0)))
    await machine.run(1800, until=lambda outcome: outcome.offset.model_sha256 == sha256_of(extended()))
    await machine.run_and_kill(200)
    await machine.run(1000, until=lambda _: len(machine.asked) == 2)
    await machine.run(20)
    assert machine.steps()[2:] == [("adopt", ""), ("diagnose", "planned"), ("nothing", "waits")]
    assert machine.events("loop")[-1].text.startswith("input:coolant_degc: waits while the model before")
    assert {one.role for one in machine.candidates()[-20:]} == {"before"}
    checked(machine)


async def test_a_candidate_in_its_warm_up_does_not_take_the_place_after_an_operators_yes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Looping(tmp_path, shown(extended()), shown(extended(2.0)), policy="propose")
    await machine.run(1800, until=in_phase(machine, "proposed"))
    works, adopted, warmed = live.warm_up, threading.Event(), threading.Event()

    def late(*arguments: Any, **settings: Any) -> Any:
        machine.at_sample[len(machine.outcomes) + 5] = Asked(machine, "adopt", candidate=True)
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

    monkeypatch.setattr(live, "warm_up", late)
    await machine.run(1800, until=at_adoption)
    assert warmed.is_set() and machine.steps()[-2:] == [("shadow", ""), ("adopt", "by_hand")]
    assert {one.role for one in machine.candidates()[-29:]} == {"before"}
    assert opening_of(recordings(machine.recordings, MACHINE)[-1])["candidate.toml"] == QUILL
    checked(machine)
