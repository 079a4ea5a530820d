r"""A quill as masses that store, conduct and lose heat, and that expand.

.. math:: y = \alpha \left( \sum_i \Delta x \, \theta_i + L_n \theta_n + l_h \theta_h + l_f \theta_f + l_r
          \theta_r \right)

with the rises θ over 20 °C of the quill's nodes, nose, housing, and of the column's front and rear wall. The
quill grows towards +Y; the housing's slow warming moves it back (negative lever), and so does the column,
which bends while its front wall is warmer than its rear wall.

The conduction is stepped exactly (``network.py``). What is not linear, the film's dependence on temperature
and everything that an effect adds, is held over a substep of at most 10 s, which is short against every time
constant on which it acts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_hardware.physics.design import QuillDesign
from sim_hardware.physics.effects.base import UndeclaredEffect, overriding
from sim_hardware.physics.film import Film
from sim_hardware.physics.layout import Layout
from sim_hardware.physics.plant import REST_DEGC, Inputs

Array = NDArray[np.float64]

SHORTEST_STEP_S = 1.0


class QuillMachine:
    """The quill of the experiment, its headstock, column and base.

    Parameters
    ----------
    design : QuillDesign, optional
        Dimensions; by default the sized ones.
    effects : sequence of UndeclaredEffect
        Undeclared effects that act.
    longest_substep_s : float
        Bound for the splitting, s.

    Examples
    --------
    >>> machine = QuillMachine()
    >>> for _ in range(60):
    ...     machine.advance(60.0, Inputs(heat_w=90.0))
    >>> 105.0 < machine.signals()["y_um"] < 120.0
    True
    """

    def __init__(
        self,
        design: QuillDesign | None = None,
        effects: Sequence[UndeclaredEffect] = (),
        longest_substep_s: float = 10.0,
    ) -> None:
        design = design or QuillDesign()
        for effect in effects:
            design = effect.alter(design)
        self.design = design
        self._longest_s = longest_substep_s
        self.layout = Layout(design)
        self.film = Film(
            self.layout.area_m2, design.forced_w_per_m2k, design.face_height_m, design.emissivity, REST_DEGC
        )
        self.conduction = self.layout.conduction(self.film.linear_w_per_k)
        actions = [effect.begin() for effect in effects]
        self._fans = overriding(actions, "forced_factor")
        self._heats = overriding(actions, "add_heat")
        self._joints = overriding(actions, "growth_um")
        self._probes = overriding(actions, "probe_um")
        self._thermocouples = overriding(actions, "t_q_degc")
        self.degc: Array = np.full(len(self.layout.names), REST_DEGC)
        self._at_degc = REST_DEGC
        self._inputs = Inputs()
        self._t_s = 0.0
        self._pending_s = 0.0
        self._observe()

    def advance(self, dt_s: float, inputs: Inputs) -> None:
        """Advance by `dt_s` seconds with constant inputs.

        Steps under a second are accumulated while the inputs stay the same, and the signals do not change
        meanwhile: the displacement changes by at most 0.1 µm in that time.

        Raises
        ------
        ValueError
            If `dt_s` is negative or not finite.
        """
        if not 0.0 <= dt_s < math.inf:
            raise ValueError(f"dt_s = {dt_s}: must be a finite number of seconds, not negative")
        if inputs is not self._inputs:
            if self._pending_s and inputs != self._inputs:
                self._flush()
            self._inputs = inputs
        self._pending_s += dt_s
        if self._pending_s >= SHORTEST_STEP_S:
            self._flush()

    def signals(self) -> dict[str, float]:
        """Return the true values now: temperatures in °C, the displacement in µm, and the inputs."""
        y_um = self._y_um
        for action in self._probes:
            y_um = action.probe_um(self._t_s, y_um)
        return {
            "t_q_degc": self._t_q_degc,
            "at_degc": self._at_degc,
            "y_um": y_um,
            "base_degc": float(self.degc[self.layout.base]),
            "housing_degc": float(self.degc[self.layout.housing]),
            **self._inputs.channels(),
        }

    def settle(self, inputs: Inputs) -> None:
        """Set the steady state of these inputs, without advancing time."""
        self._inputs = inputs
        self._at_degc = inputs.ambient_degc
        linear = self.film.linear_w_per_k * inputs.ambient_degc
        self.degc = np.full(len(self.degc), inputs.ambient_degc)
        # Half of the change at each pass: an effect's films may be stronger than the linear part.
        for _ in range(400):
            target = self.conduction.steady(linear + self._heat_w(inputs))
            moved = target - self.degc
            self.degc = self.degc + 0.5 * moved
            if float(np.max(np.abs(moved))) < 1e-10:
                break
        self._observe()

    def stored_j(self) -> float:
        """Return the heat stored above 20 °C, J."""
        return float(self.conduction.capacity_j_per_k @ (self.degc - REST_DEGC))

    def to_air_w(self) -> float:
        """Return the heat flow from all surfaces to the air now, W."""
        air_degc = self._inputs.ambient_degc
        h = self.film.coefficient(self.degc, air_degc, self._forced_factor(self._inputs))
        return float((h * self.film.area_m2) @ (self.degc - air_degc))

    def _flush(self) -> None:
        """Step over the accumulated time."""
        dt_s, self._pending_s = self._pending_s, 0.0
        count = math.ceil(dt_s / self._longest_s - 1e-9)
        h_s = dt_s / count
        inputs = self._inputs
        phi, psi = self.conduction.step(h_s)
        linear = self.film.linear_w_per_k * inputs.ambient_degc
        keep = math.exp(-h_s / self.design.at_lag_s)
        for _ in range(count):
            self.degc = phi @ self.degc + psi @ (linear + self._heat_w(inputs))
            self._at_degc = inputs.ambient_degc + keep * (self._at_degc - inputs.ambient_degc)
            self._t_s += h_s
            self._observe()

    def _heat_w(self, inputs: Inputs) -> Array:
        """Return the heat into every node beyond the linear conduction, W."""
        heat_w = self.film.excess_w(self.degc, inputs.ambient_degc, self._forced_factor(inputs))
        heat_w[self.layout.plate] += inputs.heat_w
        for action in self._heats:
            action.add_heat(heat_w, self._t_s, inputs, self.degc, self.layout.places)
        return heat_w

    def _forced_factor(self, inputs: Inputs) -> float:
        factor = 1.0
        for action in self._fans:
            factor *= action.forced_factor(inputs)
        return factor

    def _observe(self) -> None:
        """Compute the signals at the probe and the thermocouple from the temperatures."""
        rise_k = self.degc - REST_DEGC
        growth_um = float(self.layout.growth_um_per_k @ rise_k)
        for action in self._joints:
            growth_um = action.growth_um(growth_um)
        self._y_um = growth_um + float(self.layout.frame_um_per_k @ rise_k)
        self._t_q_degc = float(self.degc[self.layout.sensor])
        for action in self._thermocouples:
            self._t_q_degc = action.t_q_degc(self._t_s, self._t_q_degc)
