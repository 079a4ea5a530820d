"""Effects that are not adopted again for some time: the service went back from them, or a person did not want them."""

from __future__ import annotations

from collections.abc import Sequence

from compensator.clock import HOUR_NS
from compensator.service.loop.state import Avoided, LoopState, same_effects

#: For how long effects are avoided when the service has gone back from them for the first time, h.
_FIRST_H = 24.0


def is_avoided(state: LoopState, effects: Sequence[str], now_ns: int) -> bool:
    """Return whether a candidate with these effects is avoided now."""
    return any(one.until_utc_ns > now_ns for one in _alike(state, effects))


def avoid(state: LoopState, effects: Sequence[str], now_ns: int, hours: float) -> None:
    """Avoid effects for some hours."""
    until_ns = now_ns + round(hours * HOUR_NS)
    state.avoided = [*state.avoided, Avoided(effects=list(effects), until_utc_ns=until_ns)]


def avoid_after_back(state: LoopState, effects: Sequence[str], now_ns: int, *, longest_h: float) -> None:
    """Avoid effects that were gone back from: an effect may come again, so twice as long each time."""
    oldest_ns = now_ns - round(longest_h * HOUR_NS)
    state.avoided = [one for one in state.avoided if one.until_utc_ns > oldest_ns]
    avoid(state, effects, now_ns, min(_FIRST_H * 2 ** len(_alike(state, effects)), longest_h))


def _alike(state: LoopState, effects: Sequence[str]) -> list[Avoided]:
    return [one for one in state.avoided if same_effects(one.effects, effects)]
