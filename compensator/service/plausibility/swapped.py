"""Whether T_Q and AT read each other's temperature: exchanged plugs, wires or addresses.

Both then jump together, each to where the other one was; the sample in which it happens is a mean of both ways. While
they are exchanged the shifted engine is given each reading as that of the other channel, so its state is right when the
plugs are back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum

from compensator.arrays import NAN
from compensator.model.engine import Engine
from compensator.service.plausibility.jump_state import Exchanged

#: A reading fits within so many standard deviations of what is expected.
_NEAR = 4.0
#: One way is sure if the other one is less likely by so much: half a sum of squared deviations.
_SURE = 12.0
_OTHER = {"t_q_degc": "at_degc", "at_degc": "t_q_degc"}


class Ways(Enum):
    """How two readings belong to the two channels."""

    #: As they are, or the other way round.
    STRAIGHT, SWAPPED = "straight", "swapped"
    #: Both fit, as on a cold machine, the first way better or the second one.
    RATHER_STRAIGHT, RATHER_SWAPPED = "rather straight", "rather swapped"
    NEITHER = "neither"


def ways(engine: Engine, readings: Mapping[str, float], t_q_change_k: float = 0.0) -> Ways:
    """Return how two readings fit what an engine expects.

    Parameters
    ----------
    engine : Engine
        The engine.
    readings : mapping of str to float
        T_Q and AT as they are read, °C; none is missing.
    t_q_change_k : float
        By how much T_Q may differ from that because heat is switched, K.
    """
    is_straight, cost = _fit(engine, readings, t_q_change_k)
    is_swapped, swapped_cost = _fit(engine, other_way_round(readings), t_q_change_k)
    if not (is_straight or is_swapped):
        return Ways.NEITHER
    if is_straight and cost <= swapped_cost:
        return Ways.STRAIGHT if swapped_cost - cost > _SURE else Ways.RATHER_STRAIGHT
    return Ways.SWAPPED if is_swapped and cost - swapped_cost > _SURE else Ways.RATHER_SWAPPED


def exchange_of(engine: Engine, readings: Mapping[str, float]) -> Exchanged:
    """Return whether readings that have jumped are those of the other channel; perhaps: a mean of both ways.

    Of a mean one reading is as much too low as the other one is too high. Where T_Q was below AT before, and is above
    it now, an exchange that nobody noticed has ended: that is none.
    """
    expected = engine.forecast(NAN)
    if not expected.t_q_k > expected.at_k:
        return "no"
    if ways(engine, readings) == Ways.SWAPPED:
        return "yes"
    at_k, t_q_k = readings["at_degc"] - expected.at_k, readings["t_q_degc"] - expected.t_q_k
    apart_k = expected.t_q_k - expected.at_k
    is_between = 0.0 < at_k < apart_k
    have_moved = abs(at_k) > _NEAR * expected.at_std_k and abs(t_q_k) > _NEAR * expected.t_q_std_k
    is_even = abs(at_k + t_q_k) <= _NEAR * math.hypot(expected.at_std_k, expected.t_q_std_k)
    return "perhaps" if is_between and have_moved and is_even else "no"


def other_way_round(readings: Mapping[str, float]) -> dict[str, float]:
    """Return each reading as that of the other channel."""
    return {name: readings[other] for name, other in _OTHER.items()}


def _fit(engine: Engine, readings: Mapping[str, float], t_q_change_k: float) -> tuple[bool, float]:
    """Return whether readings fit what an engine expects, and half the sum of their squared deviations."""
    expected = engine.forecast(readings["at_degc"])
    at_k, t_q_k = readings["at_degc"] - expected.at_k, readings["t_q_degc"] - expected.t_q_k
    at_std_k, t_q_std_k = expected.at_std_k, expected.t_q_std_k
    fits = abs(at_k) <= _NEAR * at_std_k and abs(t_q_k) <= max(_NEAR * t_q_std_k, t_q_change_k)
    return fits, 0.5 * ((at_k / at_std_k) ** 2 + (t_q_k / t_q_std_k) ** 2)
