"""By which rule a candidate is judged: the newest one bets for its effects."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from compensator.config import LoopSettings
from compensator.events import ComparisonData, ComparisonVerdict
from compensator.service.loop.compared import Compared
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.run import OfflineLoop
from compensator.service.loop.state import InShadow
from compensator.service.transfer.model_store import sha256_of
from compensator.service.transfer.refutation import evidence
from compensator.service.transfer.two_models import BLOCK_NS, SURE_PART, Block, Comparison, ComparisonState
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


def compared(effect_um: np.ndarray, error_um: np.ndarray) -> Comparison:
    """What a model leaves, and what another one does that lacks an effect, in blocks of half an hour."""
    moves = 10.0 * np.sin(np.arange(error_um.size) / 3.0)
    means = zip(error_um, error_um + effect_um, moves, strict=True)
    blocks = [Block(0, n, 30, (0.0, 0.0), (float(a), float(b), float(y))) for n, (a, b, y) in enumerate(means)]
    return Comparison(60.0, ComparisonState(blocks=blocks, first_ns=1, last_ns=error_um.size * BLOCK_NS))


def test_where_an_effect_has_ended_the_hours_since_speak_for_the_model_before() -> None:
    rng = np.random.default_rng(5)
    acts = 8.0 * rng.normal(size=48)
    acting, ended = acts.copy(), acts.copy()
    acting[-14:], ended[:-14] = 0.0, 0.0
    both = compared(acting - ended, 0.3 * rng.normal(size=48) + ended)
    assert both.verdict().verdict != ComparisonVerdict.BETTER
    latest = both.latest()
    assert latest is not None and latest.verdict == ComparisonVerdict.BETTER and latest.hours < 9.0
    assert compared(acts[:9], np.zeros(9)).latest() is None  # as many changes as judge a model, and none before them


def test_a_right_model_is_hardly_ever_left_for_some_hours_that_speak_against_it() -> None:
    rng = np.random.default_rng(7)
    for _ in range(30):
        noisy = compared(rng.normal(size=96), 1.2 * rng.normal(size=96))
        for hours in range(12, 49, 4):
            part = Comparison(60.0, msgspec.structs.replace(noisy.state, blocks=noisy.state.blocks[: 2 * hours]))
            found = part.latest()
            assert found is not None and found.verdict != ComparisonVerdict.BETTER


def test_the_newest_parameters_take_the_place_and_the_comparison_goes_on() -> None:
    night = Night(shown(extended(2.0)), shown(extended()))
    loop = OfflineLoop(settings(**SHORT), QUILL, night)
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
    loop = OfflineLoop(settings(**SHORT), QUILL, Night(shown(extended()), shown(extended(7.0))))
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


def taken_over(blocks: int, own: int, wrong: float) -> Compared:
    """What is compared of newer parameters, with as many blocks before them and as many of their own."""
    rng = np.random.default_rng(9)
    place = InShadow(sha256="b" * 64, effects=["delay:DTF"], role="candidate", since_utc_ns=blocks * BLOCK_NS)
    for n in range(blocks + own):
        moves, error = 2.0 * float(rng.normal()), 2.0 * float(rng.normal())
        means = (error, error - wrong * moves, moves)
        place.comparison.blocks.append(Block(int(n >= blocks), n, 30, (30 * means[0] ** 2, 30 * means[1] ** 2), means))
    place.comparison.zeros, place.comparison.model_ns = 1, blocks * BLOCK_NS
    place.comparison.first_ns, place.comparison.last_ns = 1, (blocks + own) * BLOCK_NS
    compared = Compared(place, LoopSettings(), 60.0, ErrorBlocks())
    compared.judge()
    return compared


@pytest.mark.parametrize("own", [0, 2])
def test_before_their_own_hours_judge_all_hours_are_said_and_end_nothing(own: int) -> None:
    slightly, clearly = (taken_over(40, own, wrong) for wrong in (0.4, 2.0))
    assert slightly._place.verdict.verdict == "alike" and -4.0 < slightly._place.shows < 0.0
    assert clearly._place.verdict.verdict == "worse" and not clearly.is_worse
    assert taken_over(40, 30, 2.0).is_worse


def test_two_candidates_are_compared_by_blocks_of_the_same_samples() -> None:
    """A zero divides the half hour 3 for both; in the half hour 6 the second one has taken over."""
    compared = [InShadow(sha256=name * 64, effects=[], role="candidate", since_utc_ns=1) for name in "ab"]
    for place, by in zip(compared, (1.0, 2.0), strict=True):
        parts = [(0, 2), (0, 3), (1, 3), (1, 4), (1, 5), *([(1, 6)] if by == 1.0 else [(1, 6), (2, 6)]), (2, 7)]
        means = [(0.0, by * (10 * zero + number), 0.0) for zero, number in parts]
        rows = zip(parts, means, strict=True)
        place.comparison.blocks = [Block(*part, 15, (0.0, 0.0), mean) for part, mean in rows]
    state = beside_state(compared[1], compared[0])
    assert [block.number for block in state.blocks] == [2, 3, 3, 4, 5, 7]
    assert all(block.means is not None and block.means[1] == 2.0 * block.means[0] for block in state.blocks)
    assert len({block.zeros for block in state.blocks}) == 3


def beside_state(place: InShadow, rival: InShadow) -> ComparisonState:
    Compared(place, LoopSettings(), 60.0, ErrorBlocks()).go_on_beside(rival, 0.0)
    return place.comparison


@pytest.mark.parametrize("right_from", [0, 40])
def test_newer_parameters_are_judged_by_all_hours_or_by_their_own_whichever_show_more(right_from: int) -> None:
    """The effect acts all the time, or from the beginning of their own hours on."""
    takes_over, now = 40, 56
    rng = np.random.default_rng(8)
    place = InShadow(sha256="b" * 64, effects=["delay:DTF"], role="candidate", since_utc_ns=takes_over * BLOCK_NS)
    for n in range(now):
        moves, error = 2.0 * float(rng.normal()), 0.3 * float(rng.normal())
        own, other = (moves + error, error) if n >= right_from else (error, error - moves)
        zero = int(n >= takes_over)
        place.comparison.blocks.append(Block(zero, n, 30, (30 * own**2, 30 * other**2), (own, other, moves)))
    place.comparison.zeros, place.comparison.model_ns = 1, takes_over * BLOCK_NS
    place.comparison.first_ns, place.comparison.last_ns = 1, now * BLOCK_NS
    compared = Compared(place, LoopSettings(), 60.0, ErrorBlocks())
    compared.judge()
    assert place.verdict.verdict == "better" and compared.is_better((takes_over + 13) * BLOCK_NS)
    assert place.verdict.hours == pytest.approx((now - right_from) / 2.0, abs=0.1)
