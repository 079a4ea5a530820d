"""Texts of the loop's events for people; programs read their data."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from compensator.clock import NS
from compensator.events import ComparisonData, DiagnosisData, EventKind, LoopAction, LoopData, Note
from compensator.service.loop.place import role_of
from compensator.service.loop.state import NO_VERDICT
from compensator.service.transfer.second_opinion import described


def named(effects: Sequence[str]) -> str:
    """Return the effects of a model in words."""
    return ", ".join(effects) or "no added effect"


def begins(found: DiagnosisData) -> Note:
    """Say what of a diagnosis begins to run in shadow."""
    text = f"a candidate is compared with the present model: {named(found.effects)}"
    if found.fewer:
        text = f"fewer effects are compared with those of the present model: {named(found.effects)}"
    if found.calibrated:
        found_again = "nothing is found that the calibrated model lacks"
        if found.verdict != "adequate":
            found_again = f"the effects of the present model are not found again ({found.verdict})"
        text = f"{found_again}: the calibrated model is compared with the present one"
    if found.without:
        text = f"the present model is compared with itself without {found.without}, which may have ended"
    data = LoopData(
        step=LoopAction.SHADOW,
        role=role_of(found),
        model_sha256=found.candidate_sha256,
        effects=found.effects,
    )
    return Note(EventKind.LOOP, text, data.table())


def surpassed(effects: Sequence[str], beside: ComparisonData) -> str:
    """Return why a proposed candidate is proposed no longer: another one is clearly better on the hours of both."""
    assert beside.deviations is not None
    return (
        f"{named(effects)} is clearly better; on the same {beside.hours:.3g} h: proposed "
        f"{beside.present_rms_um:.1f} µm rms, this one {beside.candidate_rms_um:.1f}; by the changes of Y "
        f"{beside.deviations:+.1f} standard deviations for it"
    )


def does_not_begin(effects: Sequence[str], why: str) -> str:
    """Return that what was said to begin does not."""
    return f"{named(effects)} is not compared: {why}"


def ended(why: str, verdict: ComparisonData = NO_VERDICT) -> str:
    """Return why a model is compared no longer."""
    return {
        "limits": "it reaches limits that the present model keeps",
        "worse": f"it is worse; {described(verdict)}",
        "no_answer": f"nobody answered the proposal; {described(verdict)}",
        "gives_way": f"the place is needed, and this one promises least; {described(verdict)}",
        "no_difference": f"it has shown no clear difference for `watch_h`; {described(verdict)}",
        "watched": f"the last change was `watch_h` ago; {described(verdict)}",
        "dismissed": "an operator has dismissed it",
        "avoided": "the service has gone back from its effects",
        "was_wrong": "a temperature was wrong while it was found or compared, as measured Y shows now",
        "replaced": "another model has replaced the present one",
        "interrupted": "the service was interrupted before it began",
    }[why]


def waits(since_utc_ns: int, suspects: Sequence[str]) -> Note:
    """Say that nothing is compared, since when, and what is suspected."""
    since = datetime.fromtimestamp(since_utc_ns // NS, UTC)
    text = (
        f"nothing is compared: {', '.join(suspects)} under all models since {since:%Y-%m-%d %H:%M} UTC; check these "
        "sensors, then set a zero"
    )
    data = LoopData(step=LoopAction.WAIT, why="suspected", since_utc_ns=since_utc_ns, reasons=list(suspects))
    return Note(EventKind.LOOP, text, data.table())


def wait_over(since_utc_ns: int, *, is_compared: bool) -> Note:
    """Say that what `waits` said is over."""
    text = (
        "models are compared again: no sensor is suspected under all of them any longer"
        if is_compared
        else "no model waits any longer to be compared"
    )
    data = LoopData(step=LoopAction.WAIT_OVER, why="" if is_compared else "ended", since_utc_ns=since_utc_ns)
    return Note(EventKind.LOOP, text, data.table())


def nothing_follows(why: str, found: DiagnosisData) -> Note:
    """Say why nothing follows from a diagnosis."""
    effects = named(found.effects)
    if found.without:
        effects = f"the model without {found.without}"
    unexplained = f"the diagnosis explains nothing that can be compensated ({found.verdict})"
    if found.verdict == "explained":
        unexplained = "what the diagnosis explains cannot be compensated"
    words = {
        "failed": f"{f'{effects} cannot be made' if found.without else 'the diagnosis failed'}: {found.needs}",
        "unexplained": f"{unexplained}; {found.needs}",
        "refused": f"the candidate cannot be used: {found.refused}",
        "nothing_found": f"the diagnosis finds nothing that can be compensated; {found.needs}",
        "unchanged": f"the diagnosis finds what the model has: {effects}",
        "in_shadow": f"the diagnosis finds what is in shadow already: {effects}",
        "avoided": f"{effects}: the service went back from it, or an operator dismissed it, a short time ago",
        "replaced": f"{effects}: another model has replaced the present one meanwhile; looked for again later",
        "waits": f"{effects}: waits while another model takes over; looked for again later",
    }
    data = LoopData(step=LoopAction.NOTHING, why=why, effects=found.effects, model_sha256=found.candidate_sha256)
    return Note(EventKind.LOOP, words[why].rstrip("; "), data.table())
