"""Which models run in shadow beside the present one, and what follows from a diagnosis.

What a diagnosis has found takes a free place; with the effects of a candidate it takes over what that one has shown.
Where all places are taken the candidate that promises least gives way. A way back has a place of its own: it does not
depend on what is found meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence

from compensator.clock import HOUR_NS
from compensator.config import LoopSettings
from compensator.events import ComparisonData, DiagnosisData
from compensator.service.loop.avoided import is_avoided
from compensator.service.loop.proof import BETTER_PART, CANDIDATES
from compensator.service.loop.state import InShadow, LoopState, Role, is_fewer, same_effects

#: A model is better so far if it has shown this part of the deviations that it must show.
LEADS = 0.5
#: A candidate with the effects of the present model must differ from it by so many standard deviations: what is closer
#: is the same. Which of the two is better is not decided by this.
DIFFERS = 1.0
#: What is compared counts for so long, in `shadow_h`, and the least of it, h; of a candidate as long as the record that
#: is diagnosed.
_REMEMBERED, _REMEMBERED_H = 2.0, 24.0
#: Newer parameters of its effects take the place of a candidate after so many times `shadow_h`: not all hours count.
_YOUNG = 1.25
#: A candidate has had the time to be judged after so many times `shadow_h`.
_HAS_TIME = 2.0


def remembered_h(settings: LoopSettings, role: Role) -> float:
    """Return for how long what is compared counts, h."""
    hours = max(_REMEMBERED * settings.shadow_h, _REMEMBERED_H)
    return max(settings.record_h, hours) if role == "candidate" else hours


def role_of(found: DiagnosisData) -> Role:
    """Return the role of a candidate: to the calibrated model, or to fewer effects, the service goes back."""
    return "before" if found.calibrated or found.fewer else "candidate"


def role_beside(place: InShadow, effects: Sequence[str], settings: LoopSettings) -> Role:
    """Return the role of a model in shadow beside a present one with other effects."""
    if not is_fewer(place.effects, effects):
        return "candidate"
    return "before" if settings.policy == "adopt" else place.role


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
    if state.place(found.candidate_sha256) is not None:
        return "in_shadow"
    if not found.calibrated and is_avoided(state, found.effects, now_ns):
        return "avoided"
    before = with_effects(state, role, found.effects)
    if before is not None:
        # What gave its place too often would never be judged by its own hours.
        is_young = now_ns - before.since_utc_ns < _YOUNG * settings.shadow_h * HOUR_NS
        if before.verdict.measured_by == "probe":
            is_young = is_young or len(before.comparison.own_probes) < _YOUNG * settings.probes
        return "in_shadow" if is_young or is_asked(before, settings) else ""
    return "waits" if state.exchange else ""


def with_effects(state: LoopState, role: Role, effects: Sequence[str]) -> InShadow | None:
    """Return what was found with the effects and the role of another model, which then goes on with its comparison."""
    alike = [place for place in state.found if place.role == role and same_effects(place.effects, effects)]
    return alike[0] if alike and not state.exchange else None


def gives_way(state: LoopState, settings: LoopSettings, now_ns: int) -> InShadow | None:
    """Return the candidate that gives its place to another one with other effects; None if a place is free.

    It is the one with the least log likelihood ratio for each hour of evidence (`InShadow.promise`), of those that have
    been judged for `shadow_h`, where it is noise before, or have had the time for that: what is never compared keeps no
    place. Only where none has, of all. What is proposed stays.
    """
    if len(state.candidates) < CANDIDATES:
        return None

    def is_new(place: InShadow) -> bool:
        has_time = now_ns - place.since_utc_ns >= _HAS_TIME * settings.shadow_h * HOUR_NS
        return place.verdict.hours < settings.shadow_h and not has_time

    return min(
        (place for place in state.candidates if not place.is_proposed), key=lambda place: (is_new(place), place.promise)
    )


def is_asked(candidate: InShadow, settings: LoopSettings) -> bool:
    """Return whether a person reads the proposal of a candidate.

    It must still be there at the answer: whatever is newer comes after it.
    """
    return candidate.is_proposed and settings.policy == "propose"


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
