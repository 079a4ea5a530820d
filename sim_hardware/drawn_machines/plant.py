"""What every family gives: the response of a machine to a duty with an effect of some strength."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_hardware.drawn_machines.catalogue import Place
from sim_hardware.drawn_machines.duty import PER_MIN, Duty, Habits

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    """True values, means over each minute, shape (minutes,): T_Q, air at the sensor, displacement, heat."""

    t_q_degc: Array
    at_degc: Array
    y_um: Array
    heat_w: Array


class Plant(Protocol):
    """A machine of some physics."""

    inherent: tuple[Place, ...]

    def first_strength(self, effect: str) -> tuple[float, str, bool]:
        """Return a strength to begin with, its unit, and whether it is scaled to a wanted size."""

    def run(self, duty: Duty, habits: Habits, effect: str, strength: float, on: Mask | None = None) -> Response:
        """Return the response over a duty, the steps before the recording included; strength 0 is no effect.

        `on`, shape (steps of the duty,), says when the effect acts; without it always.
        """


def minutes(values: Array) -> Array:
    """Return the mean over each minute of a signal on the duty's grid.

    Examples
    --------
    >>> minutes(np.array([1.0, 2.0, 3.0, 4.0, 5.0])).tolist()
    [2.5]
    """
    n = values.size // PER_MIN
    return np.asarray(values[: n * PER_MIN].reshape(n, PER_MIN).mean(axis=1))
