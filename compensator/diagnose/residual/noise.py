"""Is what is left noise? Its levels, and what is compared with them.

Two levels are known: what the sensors' noise alone makes of the residual, and the base model's own error from its
calibration. The thresholds differ by the question that is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from compensator.arrays import Vector
from compensator.data.runs import Run, noise_of
from compensator.model.thermal_model import ThermalModel

#: Largest error of its own that a base model is granted, as a share of the deformation's standard deviation. One whose
#: calibration missed by more lacks something.
OWN_SHARE = 0.1
#: The base model's own error may leave this many times as much.
OWN_TIMES = 1.3
#: A residual up to this many times the base model's own error may come by itself on another day.
EXPECTED_TIMES = 1.4
#: For the verdict, what is left counts as noise up to this many times its level (rms).
VERDICT_TIMES = 1.5
#: A base model is adequate only where it leaves no more than this many times its level on held-out blocks (rms).
FORETOLD_TIMES = 2.5
#: Few values whose noise is stated leave no more than this quantile of what chance makes of it.
CHANCE = 0.99
#: An impulse, as long as the slow modes need.
_IMPULSE = np.concatenate(([1.0], np.zeros(2999)))


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseTest:
    """What noise and the base model's own error may leave.

    Parameters
    ----------
    count : int
        Number of samples used.
    noise_um : float
        What the sensors' noise alone makes of the residual, µm rms.
    own_error_um : float
        The base model's own error as its calibration states it, µm rms; 0 where none is stated.
    freedom : int
        Where Y was measured now and then: number of values less what zeros and initial states may absorb. The noise of
        a value is stated then, and what is left is compared with what chance makes of so few values. 0 elsewhere.
    """

    count: int
    noise_um: float
    own_error_um: float
    freedom: int = 0

    @property
    def allowance(self) -> float:
        """Sum of squares that the own error may leave, µm²."""
        return self.count * (OWN_TIMES * self.own_error_um) ** 2

    def is_expected(self, cost: float) -> bool:
        """Return whether what is left may come by itself on another day, so that nothing more is looked for in it."""
        return cost < self.count * (self.noise_um**2 + (EXPECTED_TIMES * self.own_error_um) ** 2)

    def is_foretold(self, rms_um: float) -> bool:
        """Return whether what a base leaves on held-out blocks may be noise and own error."""
        return rms_um**2 < FORETOLD_TIMES**2 * (self.noise_um**2 + (OWN_TIMES * self.own_error_um) ** 2)

    def is_explained(self, cost: float) -> bool:
        """Return whether the verdict may say that what is left is noise."""
        if self.freedom:
            return cost < self.noise_um**2 * float(chi2.ppf(CHANCE, self.freedom)) + self.allowance
        return cost < VERDICT_TIMES**2 * (self.count * self.noise_um**2 + self.allowance)


def own_error_um(model: ThermalModel, noise_um: float, spread_um: float) -> float:
    """Return the base model's own error from its calibration, less the noise, µm rms, as far as one is granted."""
    return min(_missed_um(model, noise_um), OWN_SHARE * spread_um)


def is_far_off(model: ThermalModel, noise_um: float, spread_um: float) -> bool:
    """Return whether a calibration missed by more than is granted: it lacks something."""
    return _missed_um(model, noise_um) > OWN_SHARE * spread_um


def _missed_um(model: ThermalModel, noise_um: float) -> float:
    # The noise of a calibration says nothing about its paths.
    return float(np.sqrt(max((model.held_out_rms_um or 0.0) ** 2 - noise_um**2, 0.0)))


def noise_floor(model: ThermalModel, runs: Sequence[Run]) -> float:
    """Return what the sensors' noise alone makes of the residual, µm.

    White noise of the probe, and that of both thermocouples through the model.
    """
    noise = noise_of(runs)
    by_t_q = _by_t_q(model)
    by_at = -by_t_q + (model.tdtf.sampled.response(_IMPULSE) if model.tdtf else 0.0)
    parts = (noise["y_um"], noise["t_q_degc"] * np.linalg.norm(by_t_q), noise["at_degc"] * np.linalg.norm(by_at))
    return float(np.sqrt(sum(part**2 for part in parts)))


def _by_t_q(model: ThermalModel) -> Vector:
    """Return the response of the DTF's share to an impulse of T_Q, µm/K."""
    return model.dtf.sampled.response(drive_of(model, _IMPULSE))


def drive_of(model: ThermalModel, difference_k: Vector) -> Vector:
    """Return what drives the DTF: the heat by the plain inverse, or T_Q − AT itself in a direct model."""
    if model.ttf is None:
        return difference_k
    return model.ttf.sampled.inverse_response(difference_k)
