"""A proposal stays until measured Y speaks against it: evidence that hovers at the limit makes no line come and go."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

from compensator.messages import Sample
from compensator.service.loop.place import LEADS
from compensator.service.loop.run import LoopStep, OfflineLoop
from compensator.service.outcome import Outcome
from compensator.service.transfer.model_store import sha256_of
from compensator.service.transfer.two_models import BLOCK_NS, DEVIATIONS
from tests.service.looping import DAY, NIGHT, Night, decisions, evening, extended, run, settings, shown, stronger
from tests.service.test_loop_run import CHECKED
from tests.service.test_loop_service import Asked, Looping, checked, in_phase
from tests.service.test_restart import QUILL

#: What is compared counts for a day at least: so long after the effect has become smaller nothing else is left of it.
PROPOSING = {"policy": "propose", "shadow_h": 6.0, "record_h": 12.0}
#: The candidate is right for twelve hours.
RIGHT_H = 12


def proposing(left: float, *, seed: int = 1) -> tuple[OfflineLoop, Iterator[Sample]]:
    """Return a candidate that is right for some hours, and the samples; then its effect acts by a part only."""
    loop = OfflineLoop(settings(loop=PROPOSING), QUILL, Night(shown(extended())))
    ends = NIGHT + 60 * RIGHT_H
    return loop, evening(NIGHT + 9 * DAY // 4, acts=lambda i: 1.0 if i < ends else left, noise_um=1.5, seed=seed)


def about_it(steps: Sequence[LoopStep]) -> list[str]:
    """Return what is said about proposals."""
    return [step for _, step, _ in decisions(steps) if step in ("propose", "withdraw", "end")]


def test_a_proposal_stays_while_its_evidence_hovers_and_is_the_same_after_a_kill() -> None:
    loop, source = proposing(0.5, seed=2)
    steps = run(loop, source, NIGHT + 2 * DAY)
    (proposed,) = loop._core.state.found
    assert loop.phase == "proposed" and proposed.verdict.verdict == "alike"
    resumed = OfflineLoop(settings(loop=PROPOSING), QUILL, Night(shown(extended())))
    resumed.restore(loop.state())
    assert resumed.phase == "proposed"
    source, again = itertools.tee(source)
    after = run(loop, source)
    for a, b in zip(after, run(resumed, again), strict=True):
        assert (a.outcome.offset, a.candidates, a.events) == (b.outcome.offset, b.candidates, b.events)
    assert about_it(steps + after) == ["propose"] and loop.phase == "proposed"
    verdicts = [one.verdict for step in steps + after for one in step.candidates]
    assert "better" in verdicts and verdicts[-1] == "alike"


def test_a_proposal_falls_once_when_the_present_model_is_better_so_far() -> None:
    steps = run(*proposing(0.4))
    assert about_it(steps)[:2] == ["propose", "withdraw"] and about_it(steps).count("propose") == 1
    (withdrawn,) = (
        note for step in steps for note in step.events if note.kind == "loop" and note.data["step"] == "withdraw"
    )
    assert -DEVIATIONS < withdrawn.data["comparison"]["deviations"] <= -LEADS * DEVIATIONS


def test_a_proposal_stands_on_no_evidence_that_a_suspected_sensor_has_given() -> None:
    begins = NIGHT + 10 * 60

    def drifting(i: int, values: dict[str, float]) -> None:
        if i >= begins:
            values["t_q_degc"] += 0.03 * (i - begins)

    tables = CHECKED | {"loop": PROPOSING}
    loop = OfflineLoop(settings(**tables), QUILL, Night(shown(extended())))
    steps = run(loop, evening(begins + 360, acts=lambda i: float(i >= NIGHT), change=drifting))
    assert about_it(steps) == ["propose", "withdraw"]
    (text,) = (note.text for step in steps for note in step.events if "withdrawn" in note.text)
    assert text == "the proposal is withdrawn: a sensor is suspected, so what was compared does not count"


async def test_the_service_keeps_it_over_a_kill_and_a_replay_makes_it_again(tmp_path: Path) -> None:
    proposed_at: list[int] = []

    def acts(i: int) -> float:
        return 0.5 if proposed_at and i >= proposed_at[0] else 1.0

    service = Looping(tmp_path, shown(extended()), policy="propose", acts=acts)
    service.use(service.config_bytes + b"record_h = 8.0\n")

    def is_alike(outcome: Outcome) -> bool:
        # Compared is half an hour at once, and what has been recorded is read for it.
        return outcome.sample.time_utc_ns % BLOCK_NS == 0 and service.candidates()[-1].verdict == "alike"

    await service.run(960, until=in_phase(service, "proposed", lambda: proposed_at.append(service.minute() // 2)))
    await service.run(600)
    await service.run_and_kill(120)
    await service.run(1800, until=is_alike)
    await service.run_and_kill(60)
    await service.run(30)
    assert service.steps() == [("diagnose", "planned"), ("shadow", ""), ("propose", "")]
    assert service.candidates()[-1].verdict == "alike" and service.store.in_use() == QUILL
    assert service.candidates()[-1].model_sha256 == sha256_of(extended())
    checked(service)


def test_a_proposal_stays_while_later_diagnoses_find_the_same_effects() -> None:
    """Whoever reads it in the morning can still say yes at noon."""
    night = Night(shown(extended()), shown(extended(2.9)), shown(extended(3.1)))
    loop = OfflineLoop(settings(loop={"policy": "propose", "every_h": 12, "shadow_h": 6.0}), QUILL, night)
    steps = run(loop, evening(NIGHT + 3 * DAY // 2 + 60))
    found = [decision[1:] for decision in decisions(steps)]
    after = found[found.index(("propose", "")) + 1 :]
    assert len(night.asked) >= 4 and loop.phase == "proposed"
    assert {step for step, _ in after} == {"diagnose", "nothing"} and ("nothing", "in_shadow") in after


def test_a_proposal_stays_beside_others_of_later_diagnoses_until_nobody_has_answered_for_long() -> None:
    night = Night(shown(extended()), shown(stronger(0.1)))
    loop = OfflineLoop(
        settings(loop={"policy": "propose", "every_h": 12, "shadow_h": 6.0, "watch_h": 36.0}), QUILL, night
    )
    steps = run(loop, evening(NIGHT + 45 * 60))
    found = [decision[1:] for decision in decisions(steps)]
    after = found[found.index(("propose", "")) + 1 :]
    until = after.index(("end", "no_answer"))
    assert ("shadow", "") in after[:until] and not {step for step, _ in after[:until]} & {"propose", "withdraw"}


async def test_that_nothing_is_compared_is_recorded_and_replayed(tmp_path: Path) -> None:
    """T_Q drifts under all models for longer than the comparison lasts; then the couple is put right, and zero set."""
    service = Looping(tmp_path, shown(extended()), policy="propose")
    checks = b"[plausibility]\nfalse_alarm_days = 30.0\nresidual_std_um = 0.6\nresidual_correlation_min = 30.0\n"
    service.use(service.config_bytes + checks)
    t_q, ends = service.device.sources[0], list[int]()
    service.device.sources[0] = lambda: t_q() + (0.02 * max(service.minute() - 240, 0) if not ends else 0.0)

    await service.run(1500, until=service.decides("wait"))
    (text,) = (event.text for event in service.events("loop") if event.data["step"] == "wait")
    assert text.startswith("nothing is compared: ") and "implausible" in text and " under all models since " in text
    ends.append(service.minute())
    service.at_sample[len(service.outcomes) + 60] = Asked(service, "zero")
    await service.run(400, until=service.decides("wait_over"))
    await service.run_and_kill(20)
    found = [step for step, _ in service.steps()]
    assert found.count("wait") == found.count("wait_over") == 1
    checked(service)
