"""When a diagnosis begins: at planned times, and while the model errs, each time that this has lasted twice as long.

A model errs, too, when one of its effects has ended. A diagnosis shows that late, as most of its record has the effect:
so while a model errs it is compared with itself without each effect that the loop has added.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from compensator.clock import HOUR_NS, NS
from compensator.config import LoopSettings
from compensator.events import EventKind, LoopAction, LoopData, Note
from compensator.messages import number
from compensator.service.loop.avoided import is_avoided
from compensator.service.loop.ending import end_diagnosis
from compensator.service.loop.state import LoopState, Running, same_effects
from compensator.service.loop.trust import is_alarmed
from compensator.service.outcome import Outcome, sets_zero
from compensator.service.probing import UNKNOWN_UM

#: Probes that are judged together, and the sum of the squares of all but the largest, which may be a chip, that a right
#: model exceeds once in a thousand times (4 million simulated rows). What each shows beyond the prediction is in its
#: standard deviations.
_TOGETHER, _UNEXPECTED = 8, 16.7
#: No probe counts for more deviations: two chips are no large misfit.
_CLIP = 3.0
#: Probes that are remembered. A correction by probes soon takes a misfit away, and does not explain it.
_REMEMBERED = 24


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


def count_misfit(state: LoopState, present: Outcome, minutes: float, *, oldest_ns: int) -> None:
    """Count a sample: the time of a misfit goes on while measured Y, or what probes have shown, is unexpected.

    Probes count that are about the last zero, and not older than the record that is diagnosed.
    """
    if sets_zero(present):
        state.probes_shown = []
    shown = [
        max(-_CLIP, min(_CLIP, number(probe.innovation_um) / number(probe.innovation_std_um)))
        for probe in present.probes
        if number(probe.innovation_std_um) < UNKNOWN_UM
    ]
    now_ns = present.sample.time_utc_ns
    kept = [one for one in state.probes_shown if one[0] >= oldest_ns]
    state.probes_shown = [*kept, *((now_ns, one) for one in shown)][-_REMEMBERED:]
    is_misfit = is_alarmed(present.offset.reasons) or _is_unexpected([one for _, one in state.probes_shown])
    state.misfit_min = state.misfit_min + minutes if is_misfit else 0.0


def _is_unexpected(shown: Sequence[float]) -> bool:
    """Return whether some probes in a row show more than a right model lets expect."""
    squares = [each * each for each in shown]
    rows = (squares[i : i + _TOGETHER] for i in range(len(squares) - _TOGETHER + 1))
    return any(sum(row) - max(row) > _UNEXPECTED for row in rows)


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
