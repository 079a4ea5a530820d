"""Recordings before version 2 of the loop's state: a candidate has to wait for the place of the model before."""

from __future__ import annotations

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.events import ComparisonVerdict
from compensator.service.loop.place import ADOPTION_H, leads
from compensator.service.loop.state import LoopState

_HOUR_NS = 3600 * NS


def has_to_wait(state: LoopState, settings: LoopSettings, now_ns: int, *, same_effects: bool) -> bool:
    """Return whether what a diagnosis finds has to wait, with one place.

    The model before an adoption keeps it until it has been judged and is not better so far. Without a misfit it also
    keeps it until an adoption is permitted again, and from other parameters of the same effects until it is clearly
    worse than the adopted model.
    """
    place = state.found
    if state.places > 1 or place is None or place.role != "before" or place.since_utc_ns != state.adopted_utc_ns:
        return False
    if place.verdict.verdict == ComparisonVerdict.NOT_JUDGED or leads(place.verdict, settings):
        return True
    errs = state.misfit_min >= 60.0 * settings.misfit_h
    is_early = now_ns - place.since_utc_ns < ADOPTION_H * _HOUR_NS
    return not errs and (is_early or (same_effects and place.verdict.verdict != ComparisonVerdict.WORSE))


def use_both(state: LoopState) -> None:
    """Go on with two places: the model before the last adoption moves to its own."""
    place, state.places = state.found, 2
    if place is not None and place.role == "before" and place.since_utc_ns == state.adopted_utc_ns:
        state.found, state.watched = None, place
