"""Which of the two places beside the present model a model gets, and what follows from a diagnosis.

What a diagnosis finds gives its place to what a later one finds, which knows more, but not to what is worse on the same
hours (`newcomer`); a proposal is held more firmly.
The model before an adoption has a place of its own for as long as it is watched: the way back does not depend on what
is found meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.events import ComparisonData, ComparisonVerdict, DiagnosisData
from compensator.service.loop.avoided import is_avoided
from compensator.service.loop.proof import BETTER_PART, is_clearly_better
from compensator.service.loop.shadow import Role
from compensator.service.loop.state import LoopState, Place, PlaceName

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


def remembered_h(settings: LoopSettings, role: Role) -> float:
    """Return for how long what is compared counts, h."""
    hours = max(_REMEMBERED * settings.shadow_h, _REMEMBERED_H)
    return max(settings.record_h, hours) if role == "candidate" else hours


def role_of(found: DiagnosisData) -> Role:
    """Return the role of a candidate: the calibrated model is one from before, and the service goes back to it."""
    return "before" if found.calibrated else "candidate"


def why_nothing(state: LoopState, settings: LoopSettings, found: DiagnosisData, now_ns: int) -> str:
    """Return why no candidate follows from a diagnosis; empty if one does."""
    role = role_of(found)
    if found.refused:
        return "refused"
    if not found.candidate_sha256:
        return {"failed": "failed", "adequate": "nothing_found"}.get(found.verdict, "unexplained")
    if found.same_effects and (found.change_deviations or 0.0) < DIFFERS:
        return "unchanged"
    # A model that runs in shadow is compared, and gone back to or adopted, from there.
    if found.in_shadow and state.taken:
        return "in_shadow"
    if not found.calibrated and is_avoided(state, found.effects, now_ns):
        return "avoided"
    if state.candidate is not None and is_asked(state.candidate, settings):
        return "in_shadow" if takes_over(state, role, found.effects) else "waits"
    if takes_over(state, role, found.effects):
        assert state.candidate is not None
        # What gave its place too often would never be compared for its own hours.
        return "in_shadow" if now_ns - state.candidate.since_utc_ns < settings.shadow_h * _HOUR_NS else ""
    return "waits" if state.exchange else ""


def takes_over(state: LoopState, role: Role, effects: Sequence[str]) -> bool:
    """Return whether a candidate has the effects of the one in shadow: then the comparison goes on with it."""
    candidate = state.candidate
    if candidate is None or role != "candidate":
        return False
    return not state.exchange and sorted(candidate.effects) == sorted(effects)


def is_asked(candidate: Place, settings: LoopSettings) -> bool:
    """Return whether a person reads the proposal of a candidate.

    It must still be there at the answer: whatever is newer comes after it.
    """
    return candidate.is_proposed and settings.policy == "propose"


def rival_of(state: LoopState, settings: LoopSettings) -> Place | None:
    """Return the candidate beside which what a diagnosis has found must show itself; None if it just gets the place.

    With the same effects it takes over what that one has shown, unless a person reads the proposal.
    """
    found, candidate = state.diagnosis.found if state.diagnosis is not None else None, state.candidate
    if found is None or candidate is None:
        return None
    if takes_over(state, role_of(found), found.effects) and not is_asked(candidate, settings):
        return None
    return candidate


def keeps_place(candidate: Place, beside: ComparisonData, settings: LoopSettings) -> bool:
    """Return whether a candidate keeps its place against what is compared with it as the present model.

    A proposed one gives it to what is clearly better, another one to all that is not clearly worse.
    """
    if candidate.is_proposed:
        return is_asked(candidate, settings) or not is_clearly_better(beside)
    return beside.verdict == ComparisonVerdict.WORSE


def place_of_outgoing(state: LoopState, effects: Sequence[str], adopted: Sequence[str]) -> PlaceName:
    """Return the place that the present model gets at an adoption.

    Other parameters of the same effects end with the same effect: a model before them stays the one that is watched.
    """
    is_refined = state.watched is not None and sorted(effects) == sorted(adopted)
    return "found" if is_refined else "watched"


def falls(found: ComparisonData, settings: LoopSettings) -> bool:
    """Return whether a proposal falls: the present model is more likely, as clearly as another one `leads`.

    Less than what it was proposed on is no reason: its evidence may stay near the limit for days.
    """
    return found.deviations is not None and found.deviations <= -LEADS * settings.deviations


def leads(found: ComparisonData, settings: LoopSettings) -> bool:
    """Return whether the model in shadow is better so far."""
    if found.deviations is None or found.ratio is None:
        return False
    return found.deviations >= LEADS * settings.deviations and found.ratio <= BETTER_PART
