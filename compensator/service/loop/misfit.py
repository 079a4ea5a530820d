"""For how long measured Y has contradicted the present model: the residual of a displacement sensor, or probes."""

from __future__ import annotations

from collections.abc import Sequence

from compensator.messages import number
from compensator.service.loop.state import LoopState
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
