"""What was decided otherwise in recordings before version 3 of the loop's state; their audit goes by the rule of then.

Rule 1 has one place: a candidate has to wait for the place of the model before. Up to rule 2 a proposal falls as soon
as its candidate is not shown to be the better one any more.
"""

from __future__ import annotations

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.events import ComparisonVerdict
from compensator.service.loop.place import ADOPTION_H, leads
from compensator.service.loop.state import RULE, LoopState, Place

_HOUR_NS = 3600 * NS


def has_to_wait(state: LoopState, settings: LoopSettings, now_ns: int, *, same_effects: bool) -> bool:
    """Return whether what a diagnosis finds has to wait, with one place.

    The model before an adoption keeps it until it has been judged and is not better so far. Without a misfit it also
    keeps it until an adoption is permitted again, and from other parameters of the same effects until it is clearly
    worse than the adopted model.
    """
    place = state.found
    if state.rule > 1 or place is None or place.role != "before" or place.since_utc_ns != state.adopted_utc_ns:
        return False
    if place.verdict.verdict == ComparisonVerdict.NOT_JUDGED or leads(place.verdict, settings):
        return True
    errs = state.misfit_min >= 60.0 * settings.misfit_h
    is_early = now_ns - place.since_utc_ns < ADOPTION_H * _HOUR_NS
    return not errs and (is_early or (same_effects and place.verdict.verdict != ComparisonVerdict.WORSE))


def falls_early(state: LoopState, place: Place) -> bool:
    """Return whether a proposal falls because its candidate is not shown to be better any more."""
    return state.rule <= 2 and place.verdict.verdict != ComparisonVerdict.BETTER


def use_present_rule(state: LoopState) -> None:
    """Go on by the present rule: with one place, the model before the last adoption moves to its own."""
    place, had_one, state.rule = state.found, state.rule == 1, RULE
    if had_one and place is not None and place.role == "before" and place.since_utc_ns == state.adopted_utc_ns:
        state.found, state.watched = None, place
