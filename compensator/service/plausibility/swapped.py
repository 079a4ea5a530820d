"""Whether T_Q and AT read each other's temperature: exchanged plugs, wires or addresses.

Both then jump together, each to where the other one was; the sample in which it happens is a mean of both ways. While
they are exchanged the shifted engine is given each reading as that of the other channel, so its state is right when the
plugs are back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from compensator.arrays import NAN
from compensator.model.engine import Engine
from compensator.model.observer import Forecast
from compensator.service.plausibility.jump_signs import NEAR, is_heat
from compensator.service.plausibility.jump_state import Exchanged

#: After readings that fitted neither way also within the smallest jump that is looked for, or this part of what the two
#: temperatures differ by: what is uncertain because something else was wrong shows nothing.
_PART = 0.2
#: As they are exchanged, within this part: a little of the sample before may have been a mean of both ways.
_FIRST_PART = 0.1
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


@dataclass(frozen=True, slots=True)
class Natural:
    """What temperatures do by themselves.

    Parameters
    ----------
    least_k : float
        Smallest jump that is looked for, K.
    t_q_change_k, at_change_k : float
        Part of the permitted change of a sample that the temperature itself makes, K.
    """

    least_k: float
    t_q_change_k: float
    at_change_k: float

    def most_k(self, expected: Forecast) -> float:
        """Return by how much a reading may differ after others that fitted neither way, K."""
        return self.least_k if math.isfinite(self.least_k) else _PART * abs(expected.t_q_k - expected.at_k)

    def air_k(self, expected: Forecast) -> float:
        """Return by how much AT may move in a sample, K: less than what tells the two channels apart."""
        return min(self.at_change_k, _PART * abs(expected.t_q_k - expected.at_k))

    def may_be_heat(self, engine: Engine, k: float, std_k: float) -> bool:
        """Return whether T_Q may differ by so much from what is expected."""
        return abs(k) <= NEAR * std_k or (abs(k) <= self.t_q_change_k and is_heat(engine.model, engine.drive_for(k)))


def ways(engine: Engine, readings: Mapping[str, float], natural: Natural, *, is_doubtful: bool) -> Ways:
    """Return how two readings fit what an engine expects.

    Parameters
    ----------
    engine : Engine
        The engine.
    readings : mapping of str to float
        T_Q and AT as they are read, °C; none is missing.
    natural : Natural
        What temperatures do by themselves.
    is_doubtful : bool
        Whether the readings before fitted neither way.
    """
    expected = engine.forecast(NAN)
    most_k = natural.most_k(expected) if is_doubtful else math.inf
    if NEAR * expected.t_q_std_k > most_k:
        return Ways.NEITHER
    (at_k, t_q_k), cost = _differences(engine, readings)
    (at_swapped_k, t_q_swapped_k), swapped_cost = _differences(engine, other_way_round(readings))
    near_k = max(min(NEAR * expected.at_std_k, most_k), natural.air_k(expected))
    is_straight = abs(at_k) <= near_k and natural.may_be_heat(engine, t_q_k, expected.t_q_std_k)
    is_swapped = abs(at_swapped_k) <= near_k and natural.may_be_heat(engine, t_q_swapped_k, expected.t_q_std_k)
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
    apart_k = expected.t_q_k - expected.at_k
    (at_k, t_q_k), swapped_cost = _differences(engine, other_way_round(readings))
    is_near = all(
        abs(k) <= max(NEAR * std, _FIRST_PART * apart_k)
        for k, std in ((at_k, expected.at_std_k), (t_q_k, expected.t_q_std_k))
    )
    if is_near and _differences(engine, readings)[1] - swapped_cost > _SURE:
        return "yes"
    at_k, t_q_k = readings["at_degc"] - expected.at_k, readings["t_q_degc"] - expected.t_q_k
    is_between = 0.0 < at_k < apart_k
    have_moved = abs(at_k) > NEAR * expected.at_std_k and abs(t_q_k) > NEAR * expected.t_q_std_k
    is_even = abs(at_k + t_q_k) <= NEAR * math.hypot(expected.at_std_k, expected.t_q_std_k)
    return "perhaps" if is_between and have_moved and is_even else "no"


def what_fits(engine: Engine, readings: Mapping[str, float], natural: Natural) -> dict[str, float]:
    """Return the one temperature that is read where it is expected, by one of both channels; NaN for the other one.

    A door moves AT, and T_Q is where it was; a couple that is off keeps its own temperature from being read.
    """
    expected = engine.forecast(NAN)
    most_k = natural.most_k(expected)
    values, found = readings.values(), dict.fromkeys(_OTHER, NAN)
    if NEAR * expected.t_q_std_k <= most_k:
        near = [v for v in values if natural.may_be_heat(engine, v - expected.t_q_k, expected.t_q_std_k)]
        if len(near) == 1:
            return found | {"t_q_degc": near[0]}
    near = [value for value in values if abs(value - expected.at_k) <= NEAR * expected.at_std_k <= most_k]
    return found | {"at_degc": near[0]} if len(near) == 1 else found


def other_way_round(readings: Mapping[str, float]) -> dict[str, float]:
    """Return each reading as that of the other channel."""
    return {name: readings[other] for name, other in _OTHER.items()}


def _differences(engine: Engine, readings: Mapping[str, float]) -> tuple[tuple[float, float], float]:
    """Return by how much AT and T_Q differ from what is expected, K, and half the sum of their squared deviations."""
    expected = engine.forecast(readings["at_degc"])
    at_k, t_q_k = readings["at_degc"] - expected.at_k, readings["t_q_degc"] - expected.t_q_k
    return (at_k, t_q_k), 0.5 * ((at_k / expected.at_std_k) ** 2 + (t_q_k / expected.t_q_std_k) ** 2)
