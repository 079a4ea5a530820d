"""A machine that grows along several axes, tilts, and whose screw grows: lumped masses beside those of a quill.

Each direction has two masses of its own, one warmed by the heat source, one by the air, and grows in proportion to
their temperatures. Over a step with constant inputs a mass follows its exact solution,

    T(t + dt) = T_end + (T(t) − T_end) exp(−dt / tau).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sim_hardware.physics.plant import REST_DEGC, Inputs, Plant


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """How a machine grows in one direction.

    Parameters
    ----------
    name : str
        Signal, with its unit.
    per_w : float
        Growth at rest by 1 W of heat.
    heat_tau_min : float
        Time constant of the mass at the heat source, min.
    per_k : float
        Growth at rest by 1 K of the air.
    air_tau_min : float
        Time constant of the mass in the air, min.
    """

    name: str
    per_w: float
    heat_tau_min: float
    per_k: float
    air_tau_min: float


#: A milling machine: Z grows most, X little; two probes at two heights at the tool; the screw of Y.
USUAL = (
    Growth(name="x_um", per_w=0.15, heat_tau_min=35.0, per_k=0.8, air_tau_min=60.0),
    Growth(name="z_um", per_w=0.9, heat_tau_min=25.0, per_k=2.5, air_tau_min=90.0),
    Growth(name="low_um", per_w=0.30, heat_tau_min=20.0, per_k=1.0, air_tau_min=80.0),
    Growth(name="high_um", per_w=0.55, heat_tau_min=20.0, per_k=1.4, air_tau_min=80.0),
    Growth(name="y_slope_um_per_m", per_w=0.4, heat_tau_min=45.0, per_k=11.0, air_tau_min=70.0),
)


class MachineOfAxes:
    """A machine that grows in further directions.

    Parameters
    ----------
    plant : Plant
        The machine with its temperatures and Y.
    growths : sequence of Growth
        Its further directions.
    """

    def __init__(self, plant: Plant, growths: Sequence[Growth] = USUAL) -> None:
        self._plant = plant
        self._growths = tuple(growths)
        self._masses = [[0.0, 0.0] for _ in self._growths]

    def advance(self, dt_s: float, inputs: Inputs) -> None:
        """Advance by `dt_s` seconds with constant inputs."""
        self._plant.advance(dt_s, inputs)
        for growth, masses in zip(self._growths, self._masses, strict=True):
            ends = (growth.per_w * inputs.heat_w, growth.per_k * (inputs.ambient_degc - REST_DEGC))
            for i, (end, tau_min) in enumerate(zip(ends, (growth.heat_tau_min, growth.air_tau_min), strict=True)):
                masses[i] = end + (masses[i] - end) * math.exp(-dt_s / (60.0 * tau_min))

    def signals(self) -> dict[str, float]:
        """Return the true values now."""
        further = {growth.name: sum(masses) for growth, masses in zip(self._growths, self._masses, strict=True)}
        return {**self._plant.signals(), **further}
