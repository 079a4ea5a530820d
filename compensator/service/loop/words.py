"""Texts of the loop's events for people; programs read their data."""

from __future__ import annotations

from collections.abc import Sequence

from compensator.events import ComparisonData, DiagnosisData, EventKind, LoopAction, LoopData, Note
from compensator.service.loop.place import role_of
from compensator.service.transfer.second_opinion import described


def named(effects: Sequence[str]) -> str:
    """Return the effects of a model in words."""
    return ", ".join(effects) or "no added effect"


def begins(found: DiagnosisData, beside: ComparisonData | None = None, *, why: str = "") -> Note:
    """Say what of a diagnosis begins to run in shadow.

    Parameters
    ----------
    found : DiagnosisData
        The diagnosis.
    beside : ComparisonData, optional
        Its comparison with the candidate whose place it gets.
    why : str
        Reason of the decision.
    """
    text = f"a candidate is compared with the present model: {named(found.effects)}"
    if found.calibrated:
        found_again = "nothing is found that the calibrated model lacks"
        if found.verdict != "adequate":
            found_again = f"the effects of the present model are not found again ({found.verdict})"
        text = f"{found_again}: the calibrated model is compared with the present one"
    if beside is not None:
        text += f"; the candidate before gives its place to it; {_beside(beside, 'that one')}"
    data = LoopData(
        step=LoopAction.SHADOW,
        why=why,
        role=role_of(found),
        model_sha256=found.candidate_sha256,
        effects=found.effects,
        comparison=beside,
    )
    return Note(EventKind.LOOP, text, data.table())


def replaced(newcomer: DiagnosisData, beside: ComparisonData) -> str:
    """Return why a proposed candidate gives its place to a newcomer."""
    return f"{named(newcomer.effects)} is clearly better; {_beside(beside, 'proposed')}"


def _beside(found: ComparisonData | None, rival: str) -> str:
    """Return how a newcomer compares with a candidate on the same hours."""
    if found is None or found.present_rms_um is None or found.candidate_rms_um is None:
        return "nothing was measured in the hours of both"
    shown = "too little to judge"
    if found.deviations is not None:
        shown = f"by the changes of Y {found.deviations:+.1f} standard deviations for it"
    return (
        f"on the same {found.hours:.3g} h: {rival} {found.present_rms_um:.1f} µm rms, "
        f"this one {found.candidate_rms_um:.1f}; {shown}"
    )


def ended(why: str, verdict: ComparisonData) -> str:
    """Return why a shadow has ended."""
    return {
        "limits": "the candidate reaches limits that the present model keeps",
        "worse": f"the candidate is worse: {described(verdict)}",
        "no_answer": f"nobody answered the proposal: {described(verdict)}",
        "no_difference": f"the candidate shows no clear difference: {described(verdict)}",
        "watched": f"the model before is no longer compared: {described(verdict)}",
        "dismissed": "the candidate is dismissed by an operator",
    }[why]


def nothing_follows(
    why: str, found: DiagnosisData, beside: ComparisonData | None = None, *, is_proposed: bool = False
) -> Note:
    """Say why nothing follows from a diagnosis, with its comparison with a candidate if there is one."""
    effects = named(found.effects)
    kept = "clearly worse than the candidate in shadow, which stays"
    if is_proposed:
        kept = "not clearly better than what is proposed, which stays"
    words = {
        "failed": f"the diagnosis failed: {found.needs}",
        "unexplained": f"the diagnosis explains nothing that can be compensated ({found.verdict}); {found.needs}",
        "refused": f"the candidate cannot be used: {found.refused}",
        "nothing_found": f"the diagnosis finds nothing that can be compensated; {found.needs}",
        "unchanged": f"the diagnosis finds what the model has: {effects}",
        "in_shadow": f"the diagnosis finds what is in shadow already: {effects}",
        "avoided": f"{effects}: the service went back from it, or an operator dismissed it, a short time ago",
        "waits": f"{effects}: waits while another model takes over, or is proposed; looked for again later",
        "shown_less": f"{effects}: {kept}; {_beside(beside, 'proposed' if is_proposed else 'that one')}",
    }
    data = LoopData(
        step=LoopAction.NOTHING,
        why=why,
        effects=found.effects,
        model_sha256=found.candidate_sha256,
        comparison=beside,
    )
    return Note(EventKind.LOOP, words[why].rstrip("; "), data.table())
