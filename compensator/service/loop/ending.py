"""What ends, with the event that says why: a proposal, a model in shadow, what was said to begin and does not."""

from __future__ import annotations

from compensator.events import ComparisonData, EventKind, LoopAction, LoopData, Note
from compensator.service.loop.place import role_of
from compensator.service.loop.state import InShadow, LoopState
from compensator.service.loop.words import does_not_begin, ended, named

#: Reason of an end that comes from outside of the loop: an internal error, or a disk that refuses the model.
FAILED_OUTSIDE = "failed"


def note_of(
    state: LoopState,
    place: InShadow,
    step: LoopAction,
    text: str,
    *,
    why: str = "",
    comparison: ComparisonData | None = None,
) -> Note:
    """Return the event of a decision about a model in shadow, with the figures on which it rests."""
    data = LoopData(
        step=step,
        why=why,
        role=place.role,
        model_sha256=place.sha256,
        effects=place.effects,
        since_utc_ns=place.since_utc_ns,
        comparison=comparison if comparison is not None else place.verdict,
        level_um=state.level_um if state.exchange else None,
    )
    return Note(EventKind.LOOP, text, data.table())


def withdraw(
    state: LoopState, place: InShadow, text: str, *, why: str = "", comparison: ComparisonData | None = None
) -> list[Note]:
    """Withdraw a proposal; its candidate goes on."""
    place.is_proposed = False
    text = f"the proposal is withdrawn: {text}"
    return [note_of(state, place, LoopAction.WITHDRAW, text, why=why, comparison=comparison)]


def end(state: LoopState, place: InShadow, why: str, text: str = "") -> list[Note]:
    """End a shadow, and an exchange with it."""
    text = text or f"the model with {named(place.effects)} is compared no longer: {ended(why, place.verdict)}"
    notes = [note_of(state, place, LoopAction.END, text, why=why)]
    state.remove(place)
    if state.incoming == place.sha256:
        state.exchange, state.incoming = "", ""
    return notes


def end_diagnosis(state: LoopState, why: str, text: str = "") -> list[Note]:
    """End a diagnosis that is under way, and what it has found; it is said if that was said to begin.

    What was to be left out is not forgotten, unless it cannot be: it is begun again.
    """
    running, state.diagnosis = state.diagnosis, None
    if running is not None and running.without and why != FAILED_OUTSIDE:
        state.to_leave_out = [running.without, *state.to_leave_out]
    if running is None or running.found is None or not running.is_next:
        return []
    found = running.found
    data = LoopData(
        step=LoopAction.END,
        why=why,
        role=role_of(found),
        model_sha256=found.candidate_sha256,
        effects=found.effects,
    )
    return [Note(EventKind.LOOP, does_not_begin(found.effects, text or ended(why)), data.table())]
