"""Who has the place of the shadow after an adoption: the model before, until it is no longer needed.

A candidate that took it at once would end the comparison by which the service goes back.
"""

from __future__ import annotations

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.events import ComparisonData, ComparisonVerdict
from compensator.service.loop.proof import BETTER_PART
from compensator.service.loop.state import LoopState

#: Least time between two adoptions, which is that after going back from a model, too, h.
ADOPTION_H = 24.0
#: A model is better so far if it has shown this part of the deviations that it must show.
LEADS = 0.5
_HOUR_NS = 3600 * NS


def leads(found: ComparisonData, settings: LoopSettings) -> bool:
    """Return whether the model in shadow is better so far."""
    if found.deviations is None or found.ratio is None:
        return False
    return found.deviations >= LEADS * settings.deviations and found.ratio <= BETTER_PART


def has_to_wait(state: LoopState, settings: LoopSettings, now_ns: int, *, same_effects: bool) -> bool:
    """Return whether what a diagnosis finds now has to wait for a later diagnosis.

    The model before an adoption keeps its place until it has been judged and is not better so far: else the service may
    have to go back to it. Without a misfit it also keeps it until an adoption is permitted again, and from other
    parameters of the same effects until it is clearly worse than the adopted model.
    """
    shadow, verdict = state.shadow, state.verdict.verdict
    if state.exchange:
        return True
    if shadow is None or shadow.role != "before" or shadow.since_utc_ns != state.adopted_utc_ns:
        return False
    if verdict == ComparisonVerdict.NOT_JUDGED or leads(state.verdict, settings):
        return True
    errs = state.misfit_min >= 60.0 * settings.misfit_h
    is_early = now_ns - shadow.since_utc_ns < ADOPTION_H * _HOUR_NS
    return not errs and (is_early or (same_effects and verdict != ComparisonVerdict.WORSE))
