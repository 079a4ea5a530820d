"""A model that a diagnosis has found, on the record before it runs in shadow, and beside the candidate that does.

What a candidate has shown on live data is not thrown away for a model that is worse. Both are compared on the same
hours, by the rule by which a candidate is adopted, as if the one in shadow were the present model. These hours were
diagnosed, so the newcomer knows them: what is clearly worse even there does not get the place, and that of a proposed
candidate only what is clearly better (`place.keeps_place`). A second effect beside the first shows there, and so does
the end of the first one.
"""

from __future__ import annotations

import numpy as np

from compensator.clock import NS
from compensator.config import Loop as LoopSettings
from compensator.events import ComparisonData, EventKind
from compensator.service.loop.change import changed_at
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.proof import is_clearly_better
from compensator.service.loop.state import Place
from compensator.service.loop.trust import is_disturbed
from compensator.service.outcome import Outcome
from compensator.service.transfer.comparison import BLOCK_NS, Block, ComparedProbe, Comparison, ComparisonState
from compensator.service.transfer.evidence import FLOOR_UM
from compensator.service.transfer.second_opinion import is_unusable


class Newcomer:
    """What a newcomer's model shows on the record.

    Parameters
    ----------
    period_s : float
        Length of a sample, s.

    Attributes
    ----------
    error : ErrorBlocks
        Its errors since the last zero.
    """

    def __init__(self, period_s: float) -> None:
        self.error = ErrorBlocks()
        self._period_s = period_s
        #: The model beside itself: its block means and probes.
        self._alone = Comparison(period_s)

    def update(self, outcome: Outcome) -> None:
        """Add a sample of the newcomer's model."""
        self.error.update(outcome)
        if any(note.kind == EventKind.ZERO for note in outcome.notes):
            self._alone.set_zero()
        if not (is_unusable(outcome) or is_disturbed(outcome.offset.reasons)):
            self._alone.add(outcome, outcome, suspected=False)

    def beside(self, rival: Place, settings: LoopSettings) -> ComparisonData:
        """Compare the newcomer with a candidate, as if that were the present model.

        On the hours of its comparison, or, where only that shows the newcomer, since that one errs otherwise: an effect
        that has ended has acted in the hours before.
        """
        whole = self._since(0, rival, settings)
        since_ns = _erring_since(rival)
        if since_ns is None or is_clearly_better(whole):
            return whole
        last = self._since(since_ns, rival, settings)
        return last if is_clearly_better(last) else whole

    def _since(self, from_ns: int, rival: Place, settings: LoopSettings) -> ComparisonData:
        shown, own = rival.comparison, self._alone.state
        before = {block.number: block for block in shown.blocks if block.number * BLOCK_NS >= from_ns}
        zeros: dict[tuple[int, int], int] = {}
        blocks = []
        for block in own.blocks:
            other = before.get(block.number)
            if other is None or other.means is None or block.means is None:
                continue
            # Changes count about one zero, and of one candidate.
            zero = zeros.setdefault((other.zeros, block.zeros), len(zeros))
            squares, means = (other.squares[1], block.squares[1]), (other.means[1], block.means[1], block.means[2])
            blocks.append(Block(zero, block.number, min(other.samples, block.samples), squares, means))
        innovations = {probe.time_utc_ns: probe.other_um for probe in own.probes}
        probes = [
            ComparedProbe(probe.time_utc_ns, probe.other_um, innovations[probe.time_utc_ns])
            for probe in shown.probes
            if probe.time_utc_ns in innovations and probe.time_utc_ns >= from_ns
        ]
        first_ns = max(shown.first_ns, from_ns)
        state = ComparisonState(blocks=blocks, probes=probes, first_ns=first_ns, last_ns=shown.last_ns)
        return Comparison(self._period_s, state).verdict(deviations=settings.deviations)


def _erring_since(place: Place) -> int | None:
    """Return since when a candidate errs otherwise than before, ns since 1970 UTC; None if it does not."""
    blocks = [block for block in place.comparison.blocks if block.means is not None]
    times_s = np.array([block.number * BLOCK_NS / NS for block in blocks])
    at_s = changed_at(times_s, np.array([block.means[1] for block in blocks if block.means is not None]), FLOOR_UM)
    return round(at_s) * NS if at_s is not None else None
