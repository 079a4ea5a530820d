"""Duty cycles of a machine: inputs over time, by seed, on a grid of 10 s."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim_hardware.physics.plant import REST_DEGC, Inputs
from sim_hardware.physics.schedules import cabinet, coolant, flow_while, levels, shop_air

Array = NDArray[np.float64]

GRID_S = 10.0
HOUR_S = 3600.0
#: Rest at the start of a working day, s.
IDLE_S = 1800.0

CHANNELS = ("heat_w", "ambient_degc", "coolant_degc", "coolant_flow_lpm", "spindle_rpm", "fan_rpm")


class Duty:
    """Duty cycle: inputs on a grid, constant in between.

    Parameters
    ----------
    duration_s : float
        Length, s; after that the last inputs remain.
    **columns : array or float
        Inputs by the names of :class:`Inputs`, each of the grid's length or constant. Other names are
        channels without an effect.

    Examples
    --------
    >>> duty = Duty.step(heat_w=90.0, hours=2.0)
    >>> duty.at(3600.0).heat_w
    90.0
    """

    def __init__(self, duration_s: float, **columns: Array | float) -> None:
        self.duration_s = duration_s
        n = int(np.ceil(duration_s / GRID_S)) + 1
        self.columns: dict[str, Array] = {k: np.broadcast_to(v, n).astype(np.float64) for k, v in columns.items()}
        self.extra_names = [name for name in columns if name not in CHANNELS]
        self._named = [name for name in columns if name in CHANNELS]
        #: Inputs of each time that was asked for: days are drawn long, and few of them are run to their end.
        self._inputs: list[Inputs | None] = [None] * n

    def at(self, t_s: float) -> Inputs:
        """Return the inputs at a time, s."""
        # A microsecond of slack, so that sums of steps such as 0.1 s do not fall short of the grid.
        i = min(max(int((t_s + 1e-6) / GRID_S), 0), len(self._inputs) - 1)
        inputs = self._inputs[i]
        if inputs is None:
            extras = {name: float(self.columns[name][i]) for name in self.extra_names}
            inputs = Inputs(**{name: float(self.columns[name][i]) for name in self._named}, extras=extras)
            self._inputs[i] = inputs
        return inputs

    @classmethod
    def step(cls, heat_w: float = 90.0, hours: float = 24.0, ambient_degc: float = REST_DEGC) -> Duty:
        """Return constant inputs from the start."""
        return cls(hours * HOUR_S, heat_w=heat_w, ambient_degc=ambient_degc)

    @classmethod
    def paper_calibration(cls, seed: int = 0, ambient_swing_k: float = 1.0) -> Duty:
        """Return 12 h with 90 W from 0:30 to 6:30 in air that swings by ±`ambient_swing_k` a day."""
        return cls._blocks(12.0, [(0.5, 90.0), (6.5, 0.0)], seed, ambient_swing_k)

    @classmethod
    def paper_validation(cls, seed: int = 1, ambient_swing_k: float = 1.0) -> Duty:
        """Return 16 h with 0, 60, 30, 90 and 0 W."""
        blocks = [(1.0, 60.0), (4.5, 30.0), (8.0, 90.0), (12.0, 0.0)]
        return cls._blocks(16.0, blocks, seed, ambient_swing_k)

    @classmethod
    def working_day(cls, seed: int, hours: float = 24.0) -> Duty:
        """Return a realistic job: heat at several levels, spindle, coolant with its thermostat, fan, air.

        The channels have independent schedules, so that their effects can be distinguished; the coolant flows
        mostly while the spindle turns. ``cabinet_degc`` and ``hydraulic_bar`` have no effect.
        """
        random = np.random.default_rng([seed, 7])
        n = int(np.ceil(hours * HOUR_S / GRID_S)) + 1
        heat_w = levels(random, n, np.array([0.0, 0.0, 30.0, 45.0, 60.0, 75.0, 90.0]), (20.0, 150.0))
        rpm = levels(random, n, np.array([0.0, 0.0, 1500.0, 3000.0, 4500.0, 6000.0, 8000.0]), (6.0, 90.0))
        # The shift starts on a cold machine: a service that sets its zero at the start must find it at rest.
        idle = int(IDLE_S / GRID_S)
        heat_w[:idle] = rpm[:idle] = 0.0
        flow_lpm = flow_while(random, rpm > 0.0)
        air_degc = shop_air(random, n, doors_per_day=8.0)
        return cls(
            hours * HOUR_S,
            heat_w=heat_w,
            ambient_degc=air_degc,
            coolant_degc=coolant(random, air_degc, flow_lpm),
            coolant_flow_lpm=flow_lpm,
            spindle_rpm=rpm,
            fan_rpm=levels(random, n, np.array([0.0, 1000.0, 2000.0, 3000.0]), (40.0, 200.0)),
            cabinet_degc=cabinet(random, air_degc),
            hydraulic_bar=60.0 + lfilter([0.02], [1.0, -0.98], random.normal(0.0, 2.0, n)),
        )

    @classmethod
    def _blocks(cls, hours: float, blocks: list[tuple[float, float]], seed: int, swing_k: float) -> Duty:
        """Return heat by blocks of (start in h, W) in the air of a quiet laboratory."""
        n = int(np.ceil(hours * HOUR_S / GRID_S)) + 1
        hour = np.arange(n) * GRID_S / HOUR_S
        heat_w = np.zeros(n)
        for start, watts in blocks:
            heat_w[hour >= start - 1e-9] = watts
        random = np.random.default_rng([seed, 3])
        return cls(hours * HOUR_S, heat_w=heat_w, ambient_degc=shop_air(random, n, 0.0, swing_k))
