"""One model replaces another: its level at the decision, and who goes on beside it afterwards."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from compensator.config import LoopSettings
from compensator.events import Note
from compensator.service.loop.avoided import avoid_after_back, is_avoided
from compensator.service.loop.compared import Compared
from compensator.service.loop.ending import end, end_diagnosis, withdraw
from compensator.service.loop.place import gives_way, role_beside
from compensator.service.loop.proof import CANDIDATES
from compensator.service.loop.state import Exchange, InShadow, LoopState, same_effects


def decide_exchange(
    state: LoopState, action: Exchange, place: InShadow, compared: Callable[[InShadow], Compared]
) -> list[Note]:
    """Decide an exchange, and the level of the other model."""
    found, proposed = compared(place), state.proposed
    notes = []
    if proposed is not None and proposed is not place:
        notes = withdraw(state, proposed, "another model replaces the present one")
    state.exchange, state.incoming = action, place.sha256
    state.level_um = found.level_at_adoption_um if action == "adopt" else found.level_at_return_um
    if action == "adopt" and found.shown_level_um is not None:
        place.verdict = msgspec.structs.replace(place.verdict, y_moved=False)  # the effect has moved it
    return notes


def exchanged(
    state: LoopState,
    settings: LoopSettings,
    now_ns: int,
    sha256_before: str,
    compared: Callable[[InShadow], Compared],
) -> list[Note]:
    """Go on after a model in shadow has replaced the present one, whose hash was `sha256_before`.

    Returns
    -------
    list of Note
        What has ended with it.
    """
    back, level_um = state.exchange == "back", state.level_um
    incoming = state.place(state.incoming)
    assert incoming is not None
    before, state.effects, state.exchange, state.incoming = state.effects, incoming.effects, "", ""
    state.forget_errors()
    state.remove(incoming)
    running, notes = state.diagnosis, list[Note]()
    if running is not None and (running.candidate_sha256 or running.without):
        notes += end_diagnosis(state, "replaced")  # it was weighed beside the model that has gone
    state.forget_left_out()
    for place in state.found:
        place.role = role_beside(place, incoming.effects, settings)
    for place in state.found:
        compared(place).go_on_beside(incoming, level_um)
    if back:
        avoid_after_back(state, before, now_ns, longest_h=settings.watch_h)
        if state.watched is not None:
            notes += end(state, state.watched, "replaced")
        for place in state.found:
            if place.sha256 == incoming.sha256:
                notes += end(state, place, "replaced")
            elif is_avoided(state, place.effects, now_ns):
                notes += end(state, place, "avoided")
        return notes + _make_room(state, settings, now_ns)
    notes += _make_room(state, settings, now_ns)
    state.adopted_utc_ns = now_ns
    outgoing = InShadow(sha256=sha256_before, effects=before, role="before", since_utc_ns=now_ns)
    watched = state.watched
    if watched is not None and same_effects(before, incoming.effects):
        # Other parameters of the same effects end with the same effect: it stays the way back.
        watched.begin_anew()
        watched.since_utc_ns = now_ns
        state.found = [*state.found, outgoing]
        return notes
    if watched is not None:
        notes += end(state, watched, "replaced")
    state.watched = outgoing
    return notes


def _make_room(state: LoopState, settings: LoopSettings, now_ns: int) -> list[Note]:
    """End candidates for which there is no place: beside another model more are candidates."""
    notes = list[Note]()
    while len(state.candidates) > CANDIDATES and (last := gives_way(state, settings, now_ns)) is not None:
        notes += end(state, last, "gives_way")
    return notes
