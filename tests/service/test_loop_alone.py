"""A loop on outcomes made by hand: the present model lacks an effect of some µm, the other one has it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest

from compensator.clock import HOUR_NS, NS
from compensator.config import LoopSettings
from compensator.events import DiagnosisData
from compensator.service.loop.avoided import avoid, is_avoided
from compensator.service.loop.decisions import LoopDecisions
from compensator.service.loop.state import InShadow, Role, decode_loop
from compensator.service.loop.words import ended
from compensator.service.outcome import Outcome
from compensator.service.transfer.second_opinion import described
from compensator.service.transfer.two_models import BLOCK_NS

#: A planned diagnosis is 8 h later.
BEGIN_NS = 1_767_592_800 * NS
SUSPECT = ("implausible:t_q_degc",)
YEAR_MIN = 365 * 1440
DEAD = ("channel_missing:coolant_degc",)
Reasons = Callable[[int], Sequence[str]]


def outcome(minute: int, residual_um: float, y_um: float, reasons: Sequence[str], *probes_um: float) -> Outcome:
    """An outcome as far as the loop reads it; a probe shows so much beyond the prediction, ±1.5 µm."""
    shown = [SimpleNamespace(innovation_um=one, innovation_std_um=1.5, taken=True) for one in probes_um]
    sample = SimpleNamespace(time_utc_ns=BEGIN_NS + minute * 60 * NS, period_s=60.0)
    estimate = SimpleNamespace(residual_um=residual_um, y_um=y_um, y_base_um=0.0)
    offset = SimpleNamespace(reasons=list(reasons))
    return cast(Outcome, SimpleNamespace(sample=sample, estimate=estimate, offset=offset, notes=[], probes=shown))


def place(name: str, role: Role = "candidate") -> InShadow:
    return InShadow(sha256=name * 64, effects=[f"input:{name}"], role=role, since_utc_ns=BEGIN_NS)


@dataclass(frozen=True)
class Decided:
    """What a loop has decided, and when."""

    hour: float
    step: str
    why: str


def decided(
    loop: LoopDecisions,
    hours: float,
    present: Reasons,
    others: dict[str, Reasons],
    shift_um: float = 0.0,
    other_level_um: float = 0.0,
    ahead: Callable[[int], int] = lambda _: 0,
) -> Iterator[Decided]:
    """Run a loop, until it exchanges models; diagnoses find nothing. Others are named by their first letter.

    The mount of the displacement sensor has shifted Y by `shift_um`; the others are off by `other_level_um` more. The
    clock is ahead by so many minutes.
    """
    noise = np.random.default_rng(1)
    for minute in range(1, round(60 * hours)):
        effect_um = 5.0 * math.sin(minute / 90.0) + 3.0 * math.sin(minute / 37.0)
        y_um = 30.0 * math.sin(minute / 70.0) + effect_um + shift_um
        own, other = noise.normal(shift_um, 0.4, 2)
        other += other_level_um
        clock, taken = minute + ahead(minute), loop.state.taken
        known = {one.sha256: outcome(clock, other, y_um, others[one.sha256[0]](minute)) for one in taken}
        for note in loop.step(outcome(clock, effect_um + own, y_um, present(minute)), known):
            yield Decided(minute / 60.0, note.data["step"], note.data.get("why", ""))
        if loop.state.diagnosis is not None:
            loop.receive(DiagnosisData(verdict="adequate", effects=[], needs=""), BEGIN_NS + clock * 60 * NS)
        if loop.state.exchange:
            return


def loop_of(*found: InShadow, watched: InShadow | None = None, **settings: Any) -> LoopDecisions:
    loop = LoopDecisions(LoopSettings(**{"policy": "adopt", "every_h": 12} | settings), 60.0, ["gain:DTF"])
    loop.state.found, loop.state.watched = list(found), watched
    return loop


def never(_minute: int) -> Sequence[str]:
    return ()


def after(first: int, reasons: Sequence[str] = SUSPECT) -> Reasons:
    return lambda minute: reasons if minute >= first else ()


def between(first: int, end: int) -> Reasons:
    return lambda minute: ("offset_limited",) if first <= minute < end else ()


def test_what_is_better_is_adopted_once_its_hours_show_it() -> None:
    assert list(decided(loop_of(place("a")), 24, never, {"a": never})) == [Decided(6.0, "adopt", "")]


def test_models_that_all_err_are_diagnosed_while_nothing_is_decided() -> None:
    with_one = list(decided(loop_of(watched=place("b", "before")), 30, after(121), {"b": after(121)}))
    alone = list(decided(loop_of(), 30, after(121), {}))
    assert [one for one in with_one if one.step != "wait"] == alone and {one.step for one in alone} == {"diagnose"}
    assert with_one[0] == Decided(5.0, "diagnose", "misfit")


def test_a_newcomer_without_an_alarm_lets_no_older_models_judge_that_have_one() -> None:
    loop = loop_of(place("a"), place("n"))
    notes = decided(loop, 24, after(0), {"a": after(0), "n": never})
    assert [(one.step, one.why) for one in notes if one.step != "diagnose"] == [("adopt", "")]
    assert loop.state.incoming[0] == "n"
    assert loop.state.found[0].comparison.first_ns == 0 < loop.state.found[1].comparison.first_ns


@pytest.mark.parametrize(("shift_um", "step"), [(6.0, "adopt"), (0.0, "wait")])
def test_what_leaves_a_constant_is_compared_while_all_models_suspect_a_sensor(shift_um: float, step: str) -> None:
    """A mount that has slipped alarms every model until the next zero; the changes of Y are right all the same."""
    notes = decided(loop_of(place("a")), 24, after(0), {"a": after(0)}, shift_um)
    assert [one.step for one in notes if one.step != "diagnose"][-1] == step


@pytest.mark.parametrize(("level_um", "steps"), [(0.0, ["back"]), (30.0, [])])
def test_the_zero_speaks_against_a_way_back_that_only_changes_show(level_um: float, steps: list[str]) -> None:
    """The model before moves as Y does, and its level is 30 µm off where the present one is wrong by 5."""
    notes = decided(loop_of(watched=place("b", "before")), 24, never, {"b": never}, other_level_um=level_um)
    assert [one.step for one in notes if one.step != "diagnose"] == steps


def waited(loop: LoopDecisions, hours: range, reasons: Reasons) -> list[tuple[float, str, str]]:
    """Run a loop whose models have the same alarms; return what it says of waiting: when, step and text."""
    said, noise = [], np.random.default_rng(1)
    for minute in range(60 * hours.start + 1, 60 * hours.stop + 1):
        own, other = map(float, noise.normal(0.0, 0.4, 2))
        known = {one.sha256: outcome(minute, other, own, reasons(minute)) for one in loop.state.taken}
        notes = loop.step(outcome(minute, own, own, reasons(minute)), known)
        said += [(minute / 60.0, note.data["step"], note.text) for note in notes if note.data["step"][:4] == "wait"]
        loop.state.diagnosis = None
    return said


def test_that_nothing_is_compared_for_long_is_said_once_and_so_is_its_end() -> None:
    """The alarm comes and goes: what is compared for some minutes is forgotten again."""

    def alarmed(minute: int) -> Sequence[str]:
        return SUSPECT if 120 <= minute < 900 and minute % 100 > 5 else ()

    loop = loop_of(place("a"), place("b"))
    (begun, step, text), (over, step_over, text_over) = waited(loop, range(24), alarmed)
    assert (step, step_over) == ("wait", "wait_over")
    assert 8.0 < begun < 8.5 and over == pytest.approx((899 + 30) / 60.0, abs=0.02)
    assert text == (
        "nothing is compared: implausible:t_q_degc under all models since 2026-01-05 08:00 UTC; check these sensors, "
        "then set a zero"
    )
    assert text_over == "models are compared again: no sensor is suspected under all of them any longer"
    assert waited(loop_of(place("a")), range(24), lambda minute: SUSPECT if minute < 300 else ()) == []


def test_what_it_waits_for_goes_on_after_a_restart_and_ends_with_what_waits() -> None:
    whole, first = loop_of(place("a")), loop_of(place("a"))
    assert waited(first, range(3), after(0)) == []
    again = loop_of()
    again.state = decode_loop(msgspec.json.encode(first.state))
    (said,) = waited(whole, range(8), after(0))
    assert waited(again, range(3, 8), after(0)) == [said]
    again.give_up("by_hand", "ended")
    ((_, step, text),) = waited(again, range(8, 9), after(0))
    assert (step, text) == ("wait_over", "no model waits any longer to be compared")


def test_a_candidate_that_was_never_compared_says_why() -> None:
    loop = loop_of(place("a"))
    assert described(loop.state.found[0].verdict) == "no verdict: nothing has been compared yet"
    waited(loop, range(1), after(0, ("implausible:t_q_degc", "implausible:y_um")))
    (waits,) = loop.state.found
    why = "nothing is compared while a sensor is suspected under both models (implausible:t_q_degc, implausible:y_um)"
    assert described(waits.verdict) == f"no verdict: {why}"
    assert ended("gives_way", waits.verdict).endswith(f"promises least; no verdict: {why}")
    waited(loop, range(1, 2), never)
    assert "suspected" not in described(waits.verdict) and waits.verdict.samples > 0


def test_what_was_compared_before_both_models_had_an_alarm_is_forgotten() -> None:
    loop = loop_of(place("a"), place("n"))
    list(decided(loop, 5, after(240), {"a": after(240), "n": never}))
    assert loop.state.found[0].comparison.first_ns == 0 < loop.state.found[1].comparison.first_ns


@pytest.mark.parametrize(("role", "expected"), [("before", "back"), ("candidate", "adopt")])
def test_a_dead_channel_of_the_model_in_force_does_not_block_another_one(role: Role, expected: str) -> None:
    other = place("b", role)
    loop = loop_of(watched=other) if role == "before" else loop_of(other)
    steps = [one.step for one in decided(loop, 30, lambda _: DEAD, {"b": never}) if one.step != "diagnose"]
    assert steps == [expected]


def test_an_unknown_state_is_diagnosed_and_judges_nothing() -> None:
    """After a stop over the weekend it lasts for days; a diagnosis starts from a state of its own."""
    cold = decided(loop_of(place("b")), 30, lambda _: ("cold_start",), {"b": lambda _: ("cold_start",)})
    assert {one.step for one in cold} == {"diagnose"}


@pytest.mark.parametrize("role", ["before", "candidate"])
def test_a_model_that_lacks_a_channel_is_not_judged(role: Role) -> None:
    other = place("b", role)
    loop = loop_of(watched=other) if role == "before" else loop_of(other)
    assert {one.step for one in decided(loop, 30, never, {"b": lambda _: DEAD})} == {"diagnose"}


@pytest.mark.parametrize(("minutes", "expected"), [(29, [("adopt", "")]), (30, [("end", "limits")])])
def test_a_candidate_ends_by_a_limit_where_it_stays_there(minutes: int, expected: list[tuple[str, str]]) -> None:
    limited = between(240, 240 + minutes)
    steps = [(one.step, one.why) for one in decided(loop_of(place("a")), 7, never, {"a": limited})]
    assert steps[:1] == expected


def test_a_candidate_at_a_limit_is_not_adopted() -> None:
    limited = between(350, 371)
    assert next(decided(loop_of(place("a")), 8, never, {"a": limited})).hour > 371 / 60


def test_a_candidate_that_leaves_a_limit_begins_to_count_anew() -> None:
    def limited(minute: int) -> Sequence[str]:
        return ("offset_limited",) if 200 <= minute < 260 and minute != 229 else ()

    steps = [(one.step, one.why) for one in decided(loop_of(place("a")), 4.3, never, {"a": limited})]
    assert ("end", "limits") not in steps


def diagnosed(
    loop: LoopDecisions, *innovations_um: float, every: int = 40, ahead: Callable[[int], int] = lambda _: 0
) -> list[tuple[float, str]]:
    """Run a day with probes alone, or without, by a clock that may be ahead, min; return the diagnoses that begin."""
    begun = []
    for minute in range(1, 1440):
        index, rest = divmod(minute, every)
        shown = [innovations_um[index % len(innovations_um)]] if innovations_um and rest == 0 else []
        present = outcome(minute + ahead(minute), math.nan, math.nan, (), *shown)
        notes = loop.step(present, {})
        begun += [(minute / 60.0, note.data["why"]) for note in notes if note.data["step"] == "diagnose"]
        if loop.state.diagnosis is not None:
            loop.receive(DiagnosisData(verdict="adequate", effects=[], needs=""), present.sample.time_utc_ns)
    return begun


def test_a_clock_that_was_ahead_for_some_minutes_keeps_nothing_from_being_diagnosed() -> None:
    loop = loop_of()
    found = diagnosed(loop, ahead=lambda minute: YEAR_MIN if 100 <= minute < 110 else 0)
    assert [why for hour, why in found if hour > 110 / 60] == ["planned", "planned"]
    assert loop.state.diagnosed_utc_ns < BEGIN_NS + YEAR_MIN * 60 * NS


def test_probes_that_show_more_than_is_expected_are_a_misfit() -> None:
    quiet, chip = [1.0, -1.6, 0.4, 1.9, -0.7], 40.0
    planned = [(8.0, "planned"), (20.0, "planned")]
    assert diagnosed(loop_of(), *quiet) == planned
    assert diagnosed(loop_of(), *quiet, *quiet, chip, *quiet, *quiet) == planned  # one chip is none
    # An effect shows in a few probes, and the correction by probes takes it away; then 3 h until a diagnosis.
    effect = [*quiet, *quiet, -6.0, 5.0, 4.0, -3.0, *quiet * 10]
    (hour, why), *later = diagnosed(loop_of(), *effect)[1:]
    assert why == "misfit" and 8.5 < hour < 12.5
    # The last row that has one of the four ends with the 22nd probe, 24 are remembered, one comes each 40 min.
    assert [hour for hour, why in later if why == "misfit" and hour > 38 * 40 / 60] == []
    assert later


def test_probes_before_a_change_of_the_model_say_nothing_about_the_new_one() -> None:
    loop = loop_of()
    diagnosed(loop, -6.0, 5.0)
    assert loop.state.misfit_min > 0.0 and decode_loop(msgspec.json.encode(loop.state)) == loop.state
    loop.model_changed(["gain:DTF"], calibrated=[], now_ns=BEGIN_NS + 1440 * 60 * NS)
    loop.step(outcome(1441, math.nan, math.nan, ()), {})
    assert loop.state.misfit_min == 0.0


@pytest.mark.parametrize("effects", [[], ["gain:DTF"]])
def test_a_way_back_from_a_model_without_effects_keeps_no_effect_from_being_left_out(effects: list[str]) -> None:
    """To be without an effect is what is diagnosed when the last one has ended: nobody has refused that."""
    loop = LoopDecisions(LoopSettings(), 60.0, effects)
    loop.model_changed(["input:coolant_degc"], 10 * HOUR_NS, calibrated=[], back=True)
    assert [one.effects for one in loop.state.avoided] == ([effects] if effects else [])


def test_what_was_shown_while_the_clock_was_ahead_counts_as_if_it_had_been_right() -> None:
    """The first two hours by a clock that is 100 h ahead: six hours in all are measured after four more."""
    loop = loop_of(place("a"), every_h=168)
    list(decided(loop, 2, never, {"a": never}, ahead=lambda _: 6000))
    state, (found,) = loop.state, loop.state.found
    avoid(state, ["gain:TDTF"], BEGIN_NS + 102 * HOUR_NS, 168.0)
    assert found.comparison.blocks and state.error.blocks
    assert list(decided(loop, 24, never, {"a": never}))[-1] == Decided(4.0, "adopt", "")
    now_ns = BEGIN_NS + 4 * HOUR_NS
    assert max(number * BLOCK_NS for number, _ in state.error.blocks) <= now_ns
    assert is_avoided(state, ["gain:TDTF"], now_ns + 163 * HOUR_NS)
    assert not is_avoided(state, ["gain:TDTF"], now_ns + 165 * HOUR_NS)
