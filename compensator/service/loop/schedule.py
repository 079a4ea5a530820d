"""When a diagnosis begins: at planned times, and while the model errs, each time that this has lasted twice as long.

A model errs, too, when one of its effects has ended. A diagnosis shows that late, as most of its record has the effect:
so while a model errs it is compared with itself without each effect that the loop has added.
"""

from __future__ import annotations

from collections import Counter

from compensator.clock import HOUR_NS, NS
from compensator.config import Loop as LoopSettings
from compensator.events import EventKind, LoopAction, LoopData, Note
from compensator.service.loop.avoided import is_avoided
from compensator.service.loop.ending import end_diagnosis
from compensator.service.loop.state import LoopState, Running, same_effects


def pass_planned(state: LoopState, settings: LoopSettings, now_ns: int) -> int:
    """Return the last planned time, ns since 1970 UTC; at the first sample it counts as done."""
    at_ns, every_ns = 60 * settings.at_min * NS, settings.every_h * HOUR_NS
    planned_ns = (now_ns - at_ns) // every_ns * every_ns + at_ns
    # One after the last planned time was made while the clock was ahead.
    state.planned_utc_ns = min(state.planned_utc_ns or planned_ns, planned_ns)
    return planned_ns


def begin_if_due(state: LoopState, settings: LoopSettings, now_ns: int, planned_ns: int) -> list[Note]:
    """Begin a diagnosis if it is time, or before it what leaves out an effect.

    Named is what has lasted long enough to be seen, which nobody knows before: so the first diagnosis of a misfit is
    made after `misfit_h`, and the next one when there is twice as much of it on record. So is an effect left out.
    """

    def lasts_twice_as_long(since_ns: int) -> bool:
        return errs(state, settings) and (now_ns - since_ns) / (60 * NS) >= state.misfit_min / 2.0

    from_ns = now_ns - round(settings.record_h * HOUR_NS)
    if lasts_twice_as_long(state.left_out_utc_ns):
        state.left_out_utc_ns, state.to_leave_out = now_ns, list(Counter(state.effects) - Counter(state.base_effects))
    effect = _may_have_ended(state, now_ns)
    if effect:
        state.diagnosis = Running(from_utc_ns=from_ns, to_utc_ns=now_ns, why="misfit", without=effect)
        return []
    if planned_ns > state.planned_utc_ns:
        why = "planned"
    elif lasts_twice_as_long(state.diagnosed_utc_ns):
        why = "misfit"
    else:
        return []
    state.planned_utc_ns, state.diagnosed_utc_ns = planned_ns, now_ns
    state.diagnosis = Running(from_utc_ns=from_ns, to_utc_ns=now_ns, why=why)
    return [_begins(state.diagnosis)]


def errs(state: LoopState, settings: LoopSettings) -> bool:
    """Return whether measured and predicted Y have diverged for long."""
    return state.misfit_min >= 60.0 * settings.misfit_h


def _may_have_ended(state: LoopState, now_ns: int) -> str:
    """Return the next effect without which the present model is to be compared, and is not yet; empty without one."""
    while state.to_leave_out:
        effect, *state.to_leave_out = state.to_leave_out
        others = [one for one in state.effects if one != effect]
        is_compared = any(same_effects(place.effects, others) for place in state.taken)
        if not is_compared and not is_avoided(state, others, now_ns):
            return effect
    return ""


def begin_again(state: LoopState) -> list[Note]:
    """Begin a diagnosis once more that the end of the service has interrupted."""
    running, notes = state.diagnosis, end_diagnosis(state, "interrupted")
    if running is None or running.without:
        return notes
    if running.attempts > 1:
        data = LoopData(step=LoopAction.END, why="interrupted")
        text = "a diagnosis was interrupted twice: the next one is made when it is planned"
        return [*notes, Note(EventKind.LOOP, text, data.table())]
    state.diagnosis = Running(
        from_utc_ns=running.from_utc_ns, to_utc_ns=running.to_utc_ns, why="again", attempts=running.attempts + 1
    )
    return [*notes, _begins(state.diagnosis)]


def _begins(running: Running) -> Note:
    text = f"a diagnosis of the last {(running.to_utc_ns - running.from_utc_ns) / HOUR_NS:g} h begins"
    if running.why == "misfit":
        text += ": measured and predicted Y have diverged"
    data = LoopData(
        step=LoopAction.DIAGNOSE, why=running.why, from_utc_ns=running.from_utc_ns, to_utc_ns=running.to_utc_ns
    )
    return Note(EventKind.LOOP, text, data.table())
