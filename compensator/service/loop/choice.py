"""Which of the candidates that are better than the present model is adopted or proposed.

One that no other candidate and no way back surpasses: that is clearly better on the hours of both, by the rule of the
verdict with the first one as the present model. Of several the one that shows most.

One that has all effects of another one and more, and cannot be adopted yet because its level is not known, does not
keep that one out: measured Y speaks for the further effects and not against those of both. It goes on beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from compensator.clock import HOUR_NS
from compensator.config import LoopSettings
from compensator.events import ComparisonData
from compensator.service.loop.compared import Compared
from compensator.service.loop.place import is_asked, leads
from compensator.service.loop.proof import is_clearly_better
from compensator.service.loop.state import InShadow, LoopState, is_fewer, same_effects


class Choice:
    """Chooses a candidate after new verdicts; two of them are compared once.

    Parameters
    ----------
    state : LoopState
        State of the loop.
    settings : config.LoopSettings
        `[loop]`.
    compared : callable
        Returns what is compared of a model in shadow and the present one.
    """

    def __init__(self, state: LoopState, settings: LoopSettings, compared: Callable[[InShadow], Compared]) -> None:
        self._state, self._settings, self._compared = state, settings, compared
        self._beside: dict[tuple[str, str], ComparisonData] = {}

    def beside(self, place: InShadow, rival: InShadow) -> ComparisonData:
        """Compare a candidate with another one."""
        pair = place.sha256, rival.sha256
        if pair not in self._beside:
            self._beside[pair] = self._compared(place).beside(rival)
        return self._beside[pair]

    def better(self, judged: Sequence[InShadow], now_ns: int) -> list[InShadow]:
        """Return the candidates to choose from, the best first: what is proposed with a new verdict only."""
        asked = self._state.proposed
        if asked is not None and is_asked(asked, self._settings):
            return []
        return [
            place
            for place in sorted(self._state.candidates, key=lambda place: -place.shows)
            if (place in judged or not place.is_proposed)
            and not place.limited_min
            and self._compared(place).is_better(now_ns)
        ]

    def adopted(self, better: Sequence[InShadow], now_ns: int) -> InShadow | None:
        """Return the one that is adopted without a person."""
        if not self._may_adopt(now_ns):
            return None
        for place in better:
            is_kept_out = any(not self._has_more_and_waits(one, place) for one in self._surpassing(place))
            if not is_kept_out and self._compared(place).level_um is not None:
                return place
        return None

    def proposed(self, better: Sequence[InShadow]) -> InShadow | None:
        """Return the one that a person is asked about, in the place of a proposed one that it surpasses.

        Under `adopt` nobody is asked for a zero because of newer parameters: they are adopted once they are better
        about the zero there is.
        """
        before, by_hand = self._state.proposed, self._settings.policy == "propose"
        for place in better:
            is_next = before is None or (place is not before and self._surpasses(place, before))
            is_known = not by_hand and same_effects(place.effects, self._state.effects)
            if is_known or not is_next or any(self._surpassing(place)):
                continue
            if by_hand or self._compared(place).level_um is None:
                return place
        return None

    def gone_back_to(self, judged: Sequence[InShadow]) -> InShadow | None:
        """Return the model that the service goes back to; while a newcomer waits only the one before may be it."""
        state = self._state
        ways = [
            place
            for place in judged
            if place.role == "before"
            and (place is state.watched or not state.has_next)
            and self._compared(place).is_better_to_go_back_to(is_new=place is not state.watched)
        ]
        best = [one for one in ways if not any(self._surpasses(other, one) for other in ways if other is not one)]
        return max(best or ways, key=lambda place: place.shows, default=None)

    def _may_adopt(self, now_ns: int) -> bool:
        """Return whether the loop may adopt a model now.

        Not before `shadow_h` have passed since the last adoption; and not while a way back is better so far: the model
        before would give its place to the present one.
        """
        state, since_ns = self._state, now_ns - self._state.adopted_utc_ns
        if self._settings.policy != "adopt":
            return False
        if state.adopted_utc_ns and since_ns < self._settings.shadow_h * HOUR_NS:
            return False
        return not any(leads(place.verdict, self._settings) for place in state.ways_back)

    def _surpassing(self, place: InShadow) -> Iterator[InShadow]:
        others = (*self._state.candidates, *self._state.ways_back)
        return (one for one in others if one is not place and self._surpasses(one, place))

    def _surpasses(self, place: InShadow, rival: InShadow) -> bool:
        return is_clearly_better(self.beside(place, rival))

    def _has_more_and_waits(self, one: InShadow, place: InShadow) -> bool:
        """Return whether a candidate has all effects of another one and more, and cannot be adopted yet."""
        return is_fewer(place.effects, of=one.effects) and self._compared(one).level_um is None
