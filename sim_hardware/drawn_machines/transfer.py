"""Transfer functions: the published ones, or modes around them with lags that are distributed.

Nothing here has a mass or a temperature inside: heat and air lead to T_Q − AT and Y by linear functions, and an effect
is added.
Source of the numbers: M. Mareš, P. Bárta, equations (3) to (5), see `sim_hardware.physics.published`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim_hardware.drawn_machines.catalogue import Place
from sim_hardware.drawn_machines.duty import Duty, Habits, lag
from sim_hardware.drawn_machines.plant import Mask, Response, minutes
from sim_hardware.physics.published import DEFORMATION_POLES, DTF, TDTF, TTF, TTF_POLES, tustin

Array = NDArray[np.float64]
Function = Callable[[Array], Array]

#: How quickly a path changes where an effect on it begins or ends, min.
CHANGE_MIN = 20.0
#: Gains at rest and time constants, min, of the modes that the drawn functions lie around.
DTF_MODES = ((1.45, 20.9), (-0.43, 292.0))
TTF_MODES = ((0.055, 12.8), (0.19, 76.3))


@dataclass(frozen=True, slots=True, kw_only=True)
class Modes:
    """A sum of lags: y = Σ gain · L(τ) u.

    Parameters
    ----------
    gains, taus_min : tuple of float
        Gain at rest and time constant of each lag.
    """

    gains: tuple[float, ...]
    taus_min: tuple[float, ...]

    def __call__(self, u: Array) -> Array:
        """Return the response to a signal of one value a minute that has been 0."""
        start = np.concatenate(([0.0], u))
        parts = (g * lag(start, tau, 1.0)[1:] for g, tau in zip(self.gains, self.taus_min, strict=True))
        return np.asarray(sum(parts, np.zeros(u.size)))

    @classmethod
    def distributed(cls, rng: np.random.Generator, around: Sequence[tuple[float, float]]) -> Modes:
        """Draw modes around some, each lag a band of five lags."""
        gains, taus = [], []
        for gain, tau in around:
            centre, width = tau * rng.uniform(0.7, 1.4), rng.uniform(1.0, 2.5)
            gains += [gain * rng.uniform(0.75, 1.25) / 5.0] * 5
            taus += [centre * width**power for power in np.linspace(-0.5, 0.5, 5)]
        return cls(gains=tuple(gains), taus_min=tuple(taus))


def _published(numerator: Sequence[float], denominator: Sequence[float]) -> Function:
    b, a = tustin(numerator, denominator)
    return lambda u: np.asarray(lfilter(b, a, u))


class TransferMachine:
    """A machine of transfer functions.

    Parameters
    ----------
    rng : numpy.random.Generator
        What it is drawn by.
    published : bool
        Whether its functions are exactly the published ones.
    """

    inherent: tuple[Place, ...] = ()

    def __init__(self, rng: np.random.Generator, *, published: bool) -> None:
        self.dtf: Function = _published(DTF, DEFORMATION_POLES)
        self.tdtf: Function = _published(TDTF, DEFORMATION_POLES)
        self.ttf: Function = _published(TTF, TTF_POLES)
        if not published:
            self.dtf, self.ttf = Modes.distributed(rng, DTF_MODES), Modes.distributed(rng, TTF_MODES)
            slow = float(rng.uniform(80.0, 400.0))
            self.tdtf = Modes.distributed(
                rng, [(float(rng.uniform(-4.0, 6.0)), slow / 5.0), (float(rng.uniform(1.0, 6.0)), slow)]
            )
        self._sign = float(rng.choice([-1.0, 1.0]))
        # An effect has one to three lags of its own.
        scale = {"floor": 150.0}
        self._taus = {
            name: tuple(
                float(t) for t in rng.uniform(4.0, 60.0, int(rng.integers(1, 4))) * scale.get(name, 20.0) / 20.0
            )
            for name in ("coolant", "speed", "floor", "hidden")
        }
        self._power = float(rng.choice([1.0, 5.0 / 3.0, 2.0]))
        self._gain = self._sign * float(rng.uniform(0.05, 0.15))
        self._mode = float(rng.choice([rng.uniform(0.6, 0.85), rng.uniform(1.2, 1.6)]))

    def first_strength(self, effect: str) -> tuple[float, str, bool]:
        """Return a strength to begin with, its unit, and whether it is scaled to a wanted size."""
        return {
            "gain_dtf": (self._gain, "of the gain", False),
            "gain_tdtf": (self._sign * max(0.1, abs(self._gain)), "of the gain", False),
            "time_constant": (self._mode, "of 20.9 min", False),
            "nonlinear": (self._sign, "per 100 um", True),
        }.get(effect, (self._sign, "um at full signal", True))

    def run(self, duty: Duty, habits: Habits, effect: str, strength: float, on: Mask | None = None) -> Response:
        """Return the response over a duty, see `plant.Plant`."""
        heat, air = minutes(duty.columns["power_w"]), minutes(duty.columns["air_degc"])
        y_dtf, y_tdtf = self.dtf(heat), self.tdtf(air - air[0])
        part = self._part(duty, habits, effect, strength, y_dtf, y_tdtf, on) if strength else 0.0
        return Response(t_q_degc=air + self.ttf(heat), at_degc=air, y_um=y_dtf + y_tdtf + part, heat_w=heat)

    def _part(
        self,
        duty: Duty,
        habits: Habits,
        effect: str,
        strength: float,
        y_dtf: Array,
        y_tdtf: Array,
        on: Mask | None,
    ) -> Array:
        share = None if on is None else minutes(on.astype(np.float64))
        if effect in ("time_constant", "gain_dtf", "gain_tdtf", "nonlinear"):
            part = self._on_path(effect, strength, y_dtf, y_tdtf)
            return part if share is None else part * lag(share, CHANGE_MIN, 1.0)
        if effect == "speed":
            u = minutes(duty.share("spindle_rpm", habits) ** self._power)
        else:
            u = minutes(duty.columns[{"coolant": "coolant_degc", "floor": "floor_degc", "hidden": "hidden"}[effect]])
        if share is not None:
            u = u[0] + share * (u - u[0])
        return strength * np.asarray(np.mean([lag(u, tau, 1.0) - u[0] for tau in self._taus[effect]], axis=0))

    @staticmethod
    def _on_path(effect: str, strength: float, y_dtf: Array, y_tdtf: Array) -> Array:
        """Return what an effect adds to a path."""
        if effect == "time_constant":
            # (1 + τ₀ s) / (1 + τ s) on the path, τ = strength · τ₀.
            return np.asarray((1.0 / strength - 1.0) * (y_dtf - lag(y_dtf, 20.92 * strength, 1.0)))
        if effect == "nonlinear":
            return np.asarray(strength * y_dtf * np.abs(y_dtf) / 100.0)
        return strength * (y_dtf if effect == "gain_dtf" else y_tdtf)
