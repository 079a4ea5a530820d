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


def has_to_wait(state: LoopState, settings: LoopSettings, now_ns: int) -> bool:
    """Return whether what a diagnosis finds now has to wait for a later diagnosis.

    The model before an adoption keeps its place until it is clearly worse than the adopted one and an adoption is
    permitted again. A misfit needs a candidate sooner, but only once the model before has been judged and is not better
    so far: else the service may have to go back to it.
    """
    shadow, found = state.shadow, state.verdict
    if state.exchange:
        return True
    if shadow is None or shadow.role != "before" or shadow.since_utc_ns != state.adopted_utc_ns:
        return False
    errs = state.misfit_min >= 60.0 * settings.misfit_h
    if found.verdict == ComparisonVerdict.WORSE:
        return not errs and now_ns - shadow.since_utc_ns < ADOPTION_H * _HOUR_NS
    return not errs or found.verdict == ComparisonVerdict.NOT_JUDGED or leads(found, settings)
