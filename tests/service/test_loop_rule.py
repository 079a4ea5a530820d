"""By which rule a candidate is judged: the newest one bets for its effects."""

from __future__ import annotations

import numpy as np

from compensator.events import ComparisonData, ComparisonVerdict
from compensator.service.loop.run import LoopRun
from compensator.service.transfer.comparison import SURE_PART
from compensator.service.transfer.evidence import evidence
from compensator.service.transfer.model_store import sha256_of
from tests.service.looping import DAY, Night, decisions, extended, machine, run, settings, shown
from tests.service.test_loop_watch import HOUR_NS, follows, watching
from tests.service.test_restart import QUILL

SHORT = {"loop": {"policy": "adopt", "every_h": 8, "at_utc": "02:00", "shadow_h": 6.0}}
#: So noisy that eight hours show nothing yet.
NOISY_UM = 3.0


def first_looks(beta: float, noise: float, *, trials: int, seed: int, count: int = 72) -> np.ndarray:
    """Return after how many changes four deviations are first shown, by both measures; infinite if never."""
    rng, found = np.random.default_rng(seed), np.full((trials, 2), np.inf)
    for shown_at in found:
        moves, error = rng.normal(size=count), noise * rng.normal(size=count)
        for n in range(8, count + 1, 2):
            weighed = evidence(beta * moves[:n] + error[:n], moves[:n])
            reached = np.array([weighed.deviations, weighed.likelihood]) >= 4.0
            shown_at[reached & np.isinf(shown_at)] = n
    return found


def test_a_right_candidate_shows_itself_earlier_and_a_right_present_model_is_hardly_ever_refuted() -> None:
    by_deviations, by_likelihood = np.median(first_looks(1.0, 1.2, trials=20, seed=3), axis=0)
    assert by_likelihood < 0.6 * by_deviations
    # Looked at again and again; the candidate is nothing to do with Y.
    assert not np.isfinite(first_looks(0.0, 1.2, trials=100, seed=4)).any()


def test_a_candidate_that_is_neither_better_nor_worse_is_refused_more_often_than_by_likelihood_alone() -> None:
    rng, alone, both = np.random.default_rng(6), 0, 0
    for _ in range(60):
        moves = rng.normal(size=48)
        weighed = evidence(0.5 * moves + 1.2 * rng.normal(size=48), moves)
        alone += abs(weighed.likelihood) >= 3.0
        both += abs(weighed.likelihood) >= 3.0 and abs(weighed.deviations) >= 3.0 * SURE_PART
    assert both <= 0.7 * alone


def test_the_newest_parameters_take_the_place_and_the_comparison_goes_on() -> None:
    night = Night(shown(extended(2.0)), shown(extended()))
    loop = LoopRun(settings(**SHORT), QUILL, night)
    steps = run(loop, machine(2 * DAY, noise_um=NOISY_UM))
    found = [decision for decision in decisions(steps) if decision[1] in ("shadow", "adopt")]
    assert [step for _, step, _ in found] == ["shadow", "shadow", "adopt"]
    first, second, adopted = (seq for seq, _, _ in found)
    # The newest one has been compared for its own six hours, and is what is adopted.
    assert second - first == 8 * 60 and adopted - second >= 6 * 60 - 1
    assert steps[-1].model_sha256 == sha256_of(extended())
    (event,) = [note for step in steps for note in step.events if note.kind == "adopt"]
    assert event.data["comparison"]["hours"] >= 13.5


def test_what_an_earlier_candidate_has_shown_adopts_none_that_is_worse() -> None:
    loop = LoopRun(settings(**SHORT), QUILL, Night(shown(extended()), shown(extended(7.0))))
    steps = run(loop, machine(DAY + 600, noise_um=NOISY_UM))
    assert "adopt" not in [step for _, step, _ in decisions(steps)]


def test_a_candidate_with_other_effects_takes_a_free_place_and_what_others_have_shown_stays_theirs() -> None:
    loop, now_ns = watching(ComparisonData(verdict=ComparisonVerdict.NOT_JUDGED))
    running = loop.state.diagnosis
    loop.shadow_begins("c" * 64, ["delay:DTF"], now_ns - HOUR_NS)
    loop.state.diagnosis = running
    (first,) = loop.state.found
    shown = first.verdict = ComparisonData(verdict=ComparisonVerdict.ALIKE, deviations=2.5, ratio=0.8)
    assert follows(loop, now_ns) == ("shadow", "")
    loop.shadow_begins("b" * 64, ["input:coolant_degc"], now_ns)
    assert [(place.sha256[0], place.verdict.verdict) for place in loop.state.found] == [
        ("c", "alike"),
        ("b", "not_judged"),
    ]
    assert loop.state.found[0].verdict == shown and loop.state.candidate is first
