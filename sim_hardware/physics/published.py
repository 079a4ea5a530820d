"""The published transfer functions as a machine.

M. Mareš, P. Bárta, Mechatronic approach in modeling, identification and control of thermal deformation of
quill: equations (3) to (5). Time in them is in minutes; DTF is in µm/W, TDTF in µm/K of the ambient's change,
TTF in K/W of T_Q − AT. The functions were identified in discrete time at 60 s, and Tustin's rule at 60 s
reproduces those polynomials, which are run here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim_hardware.physics.effects.base import UndeclaredEffect, overriding
from sim_hardware.physics.plant import REST_DEGC, Inputs

Array = NDArray[np.float64]

STEP_S = 60.0

# Coefficients of s³ … s⁰ as printed.
DTF = (-0.01453, -0.00769, 0.04279, 0.0001065)
TDTF = (0.1279, 0.5118, 0.5127, 0.001081)
DEFORMATION_POLES = (1.0, 0.6899, 0.03288, 0.0001046)
TTF = (0.008079, 0.01629, 0.0002567)
TTF_POLES = (1.0, 0.09112, 0.001022)


def tustin(numerator: Sequence[float], denominator: Sequence[float], step_min: float = 1.0) -> tuple[Array, Array]:
    r"""Return the polynomials in z⁻¹ for :math:`s = \frac{2}{h} \frac{1 - z^{-1}}{1 + z^{-1}}`.

    Examples
    --------
    >>> b, a = tustin([1.0], [1.0, 0.0])
    >>> b.tolist(), a.tolist()
    ([0.5, 0.5], [1.0, -1.0])
    """
    order = len(denominator) - 1
    up, down = np.array([1.0, 1.0]), np.array([2.0, -2.0]) / step_min

    def substitute(coefficients: Sequence[float]) -> Array:
        total = np.zeros(order + 1)
        for power, c in enumerate(reversed(list(coefficients))):
            term = np.array([c])
            for factor in [down] * power + [up] * (order - power):
                term = np.convolve(term, factor)
            total += term
        return total

    b, a = substitute(numerator), substitute(denominator)
    return b / a[0], a / a[0]


class Filter:
    """One discrete transfer function, transposed direct form II in plain floats."""

    def __init__(self, numerator: Sequence[float], denominator: Sequence[float]) -> None:
        b, a = tustin(numerator, denominator)
        self._b: list[float] = b.tolist()
        self._a: list[float] = a.tolist()
        self._w = [0.0] * len(self._b)

    def step(self, u: float) -> float:
        """Return the output for the next input."""
        b, a, w = self._b, self._a, self._w
        y = b[0] * u + w[0]
        for i in range(1, len(b)):
            w[i - 1] = b[i] * u - a[i] * y + w[i]
        return y


def step_responses(minutes: int, heat_w: float = 90.0) -> tuple[Array, Array, Array]:
    """Return y (µm) and T_Q − AT (K) after a step of heat, and y after +1 K of air, by minute."""
    one = np.ones(minutes + 1)
    dtf, tdtf = tustin(DTF, DEFORMATION_POLES), tustin(TDTF, DEFORMATION_POLES)
    ttf = tustin(TTF, TTF_POLES)
    y, air = lfilter(*dtf, heat_w * one), lfilter(*tdtf, one)
    return np.asarray(y), np.asarray(lfilter(*ttf, heat_w * one)), np.asarray(air)


class PublishedQuill:
    """The quill by the paper's equations.

    The functions step at whole minutes, with the inputs of the first step of that minute, and their outputs are
    constant until the next minute: a sample (a mean over one minute) is exactly one step. T_Q is the present
    ambient temperature plus the function's output.

    Parameters
    ----------
    effects : sequence of UndeclaredEffect
        Undeclared effects that act on the outputs (probe, joint, thermocouple).

    Raises
    ------
    ValueError
        For an effect that needs masses and films.

    Examples
    --------
    >>> quill = PublishedQuill()
    >>> for _ in range(61):
    ...     quill.advance(60.0, Inputs(heat_w=90.0))
    >>> round(quill.signals()["y_um"], 1)
    114.3
    """

    def __init__(self, effects: Sequence[UndeclaredEffect] = ()) -> None:
        for effect in effects:
            if effect.reveal().thermal:
                raise ValueError(f"{effect!r} needs a machine of masses: use QuillMachine")
        actions = [effect.begin() for effect in effects]
        self._joints = overriding(actions, "growth_um")
        self._probes = overriding(actions, "probe_um")
        self._thermocouples = overriding(actions, "t_q_degc")
        self._dtf = Filter(DTF, DEFORMATION_POLES)
        self._tdtf = Filter(TDTF, DEFORMATION_POLES)
        self._ttf = Filter(TTF, TTF_POLES)
        self._inputs = Inputs()
        self._t_s = 0.0
        self._next_s = 0.0
        self._y_um = 0.0
        self._rise_k = 0.0

    def advance(self, dt_s: float, inputs: Inputs) -> None:
        """Advance by `dt_s` seconds with constant inputs.

        Raises
        ------
        ValueError
            If `dt_s` is negative or not finite.
        """
        if not 0.0 <= dt_s < math.inf:
            raise ValueError(f"dt_s = {dt_s}: must be a finite number of seconds, not negative")
        self._inputs = inputs
        self._t_s += dt_s
        # A microsecond of slack: ten steps of 6.0 s must not make eleven minutes out of rounding.
        while self._next_s < self._t_s - 1e-6:
            self._minute(inputs)
            self._next_s += STEP_S

    def signals(self) -> dict[str, float]:
        """Return the true values now: temperatures in °C, the displacement in µm, and the inputs."""
        y_um = self._y_um
        for action in self._probes:
            y_um = action.probe_um(self._t_s, y_um)
        ambient_degc = self._inputs.ambient_degc
        return {
            "t_q_degc": ambient_degc + self._rise_k,
            "at_degc": ambient_degc,
            "y_um": y_um,
            "base_degc": ambient_degc,
            "housing_degc": ambient_degc,
            **self._inputs.channels(),
        }

    def _minute(self, inputs: Inputs) -> None:
        growth_um = self._dtf.step(inputs.heat_w)
        for action in self._joints:
            growth_um = action.growth_um(growth_um)
        self._y_um = growth_um + self._tdtf.step(inputs.ambient_degc - REST_DEGC)
        # The thermocouple's lag acts on the rise: a change of the ambient temperature acts on T_Q at once.
        self._rise_k = self._ttf.step(inputs.heat_w)
        for action in self._thermocouples:
            self._rise_k = action.t_q_degc(self._next_s, self._rise_k)
