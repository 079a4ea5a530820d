"""Who has the place of the shadow: whether what a diagnosis finds gets it.

A candidate gives it to that of a later diagnosis, which knows more. The model before an adoption keeps it until it is
no longer needed: a candidate that took it at once would end the comparison by which the service goes back.
"""

from __future__ import annotations

from collections.abc import Sequence

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData
from compensator.service.loop.avoided import is_avoided
from compensator.service.loop.proof import BETTER_PART
from compensator.service.loop.shadow import Role
from compensator.service.loop.state import LoopState

#: Least time between two adoptions, which is that after going back from a model, too, h.
ADOPTION_H = 24.0
#: A model is better so far if it has shown this part of the deviations that it must show.
LEADS = 0.5
#: A candidate with the effects of the present model must differ from it by so many standard deviations.
DIFFERS = 4.0
#: What is compared counts for so long, in `shadow_h`, and the least of it, h; of a candidate as long as the record that
#: is diagnosed.
_REMEMBERED, _REMEMBERED_H = 2.0, 24.0
_HOUR_NS = 3600 * NS


def remembered_h(settings: LoopSettings) -> float:
    """Return for how long what is compared counts, h."""
    return max(_REMEMBERED * settings.shadow_h, _REMEMBERED_H)


def role_of(found: DiagnosisData) -> Role:
    """Return the role of a candidate: the calibrated model is one from before, and the service goes back to it."""
    return "before" if found.calibrated else "candidate"


def why_nothing(state: LoopState, settings: LoopSettings, found: DiagnosisData, now_ns: int) -> str:
    """Return why no candidate follows from a diagnosis; empty if one does."""
    shadow, role = state.shadow, role_of(found)
    if found.refused:
        return "refused"
    if not found.candidate_sha256:
        return {"failed": "failed", "adequate": "nothing_found"}.get(found.verdict, "unexplained")
    if found.same_effects and (found.change_deviations or 0.0) < DIFFERS:
        return "unchanged"
    if found.in_shadow and shadow is not None and shadow.role == role:
        return "in_shadow"
    if not found.calibrated and is_avoided(state, found.effects, now_ns):
        return "avoided"
    if takes_over(state, role, found.effects):
        assert shadow is not None
        # What gave its place too often would never be compared for its own hours.
        return "in_shadow" if now_ns - shadow.since_utc_ns < settings.shadow_h * _HOUR_NS else ""
    return "waits" if has_to_wait(state, settings, now_ns, same_effects=found.same_effects) else ""


def takes_over(state: LoopState, role: Role, effects: Sequence[str]) -> bool:
    """Return whether a candidate has the effects of the one in shadow: then the comparison goes on with it."""
    shadow = state.shadow
    if shadow is None or role != "candidate" or shadow.role != role:
        return False
    return not state.exchange and sorted(shadow.effects) == sorted(effects)


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
