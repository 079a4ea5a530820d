"""A lumped network with nonlinear links: convection by temperature and speed, radiation, bearings that tighten.

Shaft, two bearings, housing front and rear, column and base are one mass each. A bearing conducts better where the
shaft is warmer than its housing (preload), its friction falls with the oil's temperature, surfaces lose heat by natural
convection and radiation, the shaft also by its speed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_hardware.drawn_machines.catalogue import Place
from sim_hardware.drawn_machines.duty import STEP_S, Duty, Habits, lag
from sim_hardware.drawn_machines.plant import Mask, Response, minutes

Array = NDArray[np.float64]

NODES = ("shaft", "front_bearing", "rear_bearing", "housing_front", "housing_rear", "column", "base")
SHAFT, FRONT, REAR, HOUSING, HOUSING_REAR, COLUMN, BASE = range(len(NODES))
KELVIN, STEFAN_BOLTZMANN = 273.15, 5.67e-8


class LumpedMachine:
    """Seven masses with drawn capacities, links, surfaces and levers."""

    inherent: tuple[Place, ...] = (
        ("nonlinear", "DTF", ""),
        ("scheduled", "DTF", "spindle_rpm"),
        ("scheduled", "TDTF", "spindle_rpm"),
    )

    def __init__(self, rng: np.random.Generator) -> None:
        kg = np.array(
            [rng.uniform(a, b) for a, b in ((8, 25), (7, 14), (7, 14), (20, 60), (20, 60), (150, 600), (300, 1200))]
        )
        self.capacity_j_per_k = 480.0 * kg
        self.pairs = np.array(
            [
                (SHAFT, FRONT),
                (SHAFT, REAR),
                (FRONT, HOUSING),
                (REAR, HOUSING_REAR),
                (HOUSING, HOUSING_REAR),
                (HOUSING_REAR, COLUMN),
                (COLUMN, BASE),
            ]
        )
        ranges = ((6, 25), (6, 25), (8, 30), (8, 30), (15, 60), (8, 50), (15, 80))
        self.link_w_per_k = np.array([rng.uniform(*r) for r in ranges])
        self.across = np.eye(len(NODES))[self.pairs[:, 0]] - np.eye(len(NODES))[self.pairs[:, 1]]
        #: Share by which a link conducts better per kelvin between its ends: only in the bearings.
        self.tighter_per_k = np.array([1, 1, 1, 1, 0, 0, 0]) * rng.uniform(0.005, 0.03)
        self.area_m2 = np.array(
            [rng.uniform(a, b) for a, b in ((0.03, 0.12), (0, 0), (0, 0), (0.1, 0.4), (0.1, 0.4), (1, 4), (1, 4))]
        )
        self.forced_w_per_m2k = np.array([rng.uniform(6, 20), 0, 0, *rng.uniform(2.0, 6.0, 4)])
        self.natural_w_per_m2k = float(rng.uniform(1.2, 2.2))
        self.emissivity = float(rng.uniform(0.5, 0.95))
        self.whirl = float(rng.uniform(0.05, 0.5))  # Growth of the shaft's film at full speed.
        self.thinner_per_k = float(rng.uniform(0.0005, 0.004))
        self.feet_w_per_k = float(rng.uniform(10.0, 60.0))
        signs = rng.choice([-1.0, 1.0], 2)
        self.growth_um_per_k = np.array(
            [
                rng.uniform(2.5, 6.0),
                0.0,
                0.0,
                rng.uniform(-0.8, 1.2),
                rng.uniform(-0.8, 0.5),
                signs[0] * rng.uniform(1.0, 5.0),
                signs[1] * rng.uniform(0.5, 3.0),
            ]
        )
        share = rng.uniform(0.5, 0.9)
        self.heated = {FRONT: share, SHAFT: 1.0 - share} if rng.random() < 0.6 else {SHAFT: share, REAR: 1.0 - share}
        warm = FRONT if FRONT in self.heated else SHAFT
        self.seat = int(rng.choice([warm, HOUSING if warm == FRONT else FRONT]))
        self.seat_lag_min, self.air_lag_min = float(rng.uniform(0.3, 2.0)), float(rng.uniform(0.3, 2.0))
        self.friction_at = REAR if self.seat in (FRONT, HOUSING) else FRONT
        self.cooled = int(rng.choice([HOUSING, HOUSING_REAR, COLUMN]))
        self.hidden_at = int(rng.choice([HOUSING_REAR, COLUMN, REAR]))
        self.friction_power = float(rng.choice([1.0, 5.0 / 3.0, 2.0]))
        self.fanned = np.isin(np.arange(len(NODES)), rng.permutation([SHAFT, HOUSING, HOUSING_REAR, COLUMN])[:3])
        self._weak = float(rng.uniform(0.3, 0.75))

    def first_strength(self, effect: str) -> tuple[float, str, bool]:
        """Return a strength to begin with, its unit, and whether it is scaled to a wanted size."""
        return {
            "coolant": (3.0, "W/K", True),
            "wet": (2.0, "W/K at full flow", True),
            "bearing": (30.0, "W at full speed, cold", True),
            "fan": (1.0, "of the film at full speed", True),
            "floor": (0.5, "of the floor's excursion", True),
            "more_power": (0.03, "of the motor's load", True),
            "hidden": (40.0, "W", True),
            "weak_bearing": (self._weak, "of a bearing's conductance", False),
        }[effect]

    def linear(self, duty: Duty, habits: Habits, effect: str, strength: float) -> tuple[Array, Array]:
        """Return a, W, and b, W/K, each of shape (n, 7): the heat a − b · T into each mass.

        Forced convection, feet, heat whose friction falls with temperature, and the effect, at every step of a duty.
        """
        given, air = duty.columns, duty.columns["air_degc"]
        speed = duty.share("spindle_rpm", habits)
        forced = np.repeat(self.forced_w_per_m2k[None, :], duty.n, axis=0)
        forced[:, SHAFT] *= 1.0 + self.whirl * speed
        if effect == "fan":
            forced[:, self.fanned] *= 1.0 + strength * duty.share("fan_rpm", habits)[:, None]
        b = forced * self.area_m2
        a = b * air[:, None]

        def couple(node: int, w_per_k: Array | float, degc: Array) -> None:
            b[:, node] += w_per_k
            a[:, node] += w_per_k * degc

        def friction(node: int, watts: Array) -> None:
            a[:, node] += watts
            couple(node, self.thinner_per_k * watts, air)

        floor_share = strength if effect == "floor" else 0.0
        couple(BASE, self.feet_w_per_k, habits.hall_degc + floor_share * (given["floor_degc"] - habits.hall_degc))
        for node, share in self.heated.items():
            friction(node, share * given["power_w"])
        if effect == "coolant":
            couple(self.cooled, strength, given["coolant_degc"])
        elif effect == "wet":
            couple(SHAFT, strength * duty.share("coolant_flow_lpm", habits), given["coolant_degc"])
        elif effect == "bearing":
            friction(self.friction_at, strength * speed**self.friction_power)
        elif effect == "more_power":
            a[:, HOUSING_REAR] += strength * given["motor_w"]
        elif effect == "hidden":
            a[:, self.hidden_at] += strength * given["hidden"]
        return a, b

    def links(self, effect: str = "none", strength: float = 0.0) -> Array:
        """Return the conductance of each link between ends of equal temperature, W/K, shape (7,)."""
        g = self.link_w_per_k.copy()
        if effect == "weak_bearing":
            g[2 if self.friction_at == FRONT else 3] *= 1.0 - strength
        return g

    def flows(self, degc: Array, air_degc: float, a: Array, b: Array, links_w_per_k: Array) -> Array:
        """Return the heat into each mass, W, shape (7,), at one moment."""
        above = degc - air_degc
        kelvin, air_k = degc + KELVIN, air_degc + KELVIN
        radiation = self.emissivity * STEFAN_BOLTZMANN * (kelvin * kelvin + air_k * air_k) * (kelvin + air_k)
        film = self.natural_w_per_m2k * np.sqrt(np.sqrt(np.abs(above))) + radiation
        across = self.across @ degc
        tightened = np.minimum(np.maximum(1.0 + self.tighter_per_k * across, 0.4), 2.0)
        return np.asarray(
            a - b * degc - self.area_m2 * film * above - (links_w_per_k * tightened * across) @ self.across
        )

    def run(self, duty: Duty, habits: Habits, effect: str, strength: float, on: Mask | None = None) -> Response:
        """Return the response over a duty, see `plant.Plant`.

        Raises
        ------
        ValueError
            If the effect is so strong that a step of 15 s is too long for it.
        """
        effect = effect if strength else "none"
        a, b = self.linear(duty, habits, effect, strength)
        links, air = self.links(effect, strength), duty.columns["air_degc"].tolist()
        per_step = STEP_S / self.capacity_j_per_k
        if np.max(per_step * (b.max(axis=0) + 2.0 * np.abs(self.across).T @ links)) > 1.0:
            raise ValueError(f"{effect} of {strength:g}: too strong for steps of {STEP_S:g} s")
        first = strength if on is None or on[0] else 0.0
        rest_a, rest_b = self.linear(duty.resting(), habits, effect, first)
        degc = self._settled(air[0], rest_a[0], rest_b[0], links if first else self.links())
        each = [links] * duty.n
        if on is not None:
            healthy_a, healthy_b = self.linear(duty, habits, "none", 0.0)
            a, b = np.where(on[:, None], a, healthy_a), np.where(on[:, None], b, healthy_b)
            healthy = self.links()
            each = [links if acts else healthy for acts in on]
        states = np.empty((duty.n, degc.size))
        for i in range(duty.n):
            degc = degc + per_step * self.flows(degc, air[i], a[i], b[i], each[i])
            states[i] = degc
        return Response(
            t_q_degc=minutes(lag(states[:, self.seat], self.seat_lag_min)),
            at_degc=minutes(lag(duty.columns["air_degc"], self.air_lag_min)),
            y_um=minutes(states @ self.growth_um_per_k),
            heat_w=minutes(duty.columns["power_w"]),
        )

    def _settled(self, air_degc: float, a: Array, b: Array, links: Array) -> Array:
        """Return the temperatures at which all flows balance, by Newton's method with a Jacobian by differences."""
        degc = np.full(len(NODES), air_degc)
        for _ in range(60):
            flow = self.flows(degc, air_degc, a, b, links)
            moved = (self.flows(degc + 0.01 * e, air_degc, a, b, links) - flow for e in np.eye(len(NODES)))
            degc = degc - np.linalg.solve(np.column_stack(list(moved)) / 0.01, flow)
            if np.max(np.abs(flow)) < 1e-6:
                break
        return degc
