r"""Heat conduction in finite volumes: quill, two bearings, housing, column, base.

.. math:: C \dot T = -K T + B u

is linear as long as fan and coolant keep their level; each level has its own exact step (matrix exponential). Geometry,
surfaces, bearings, the place of the heat and the seat of T_Q are drawn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from sim_hardware.drawn_machines.catalogue import Place
from sim_hardware.drawn_machines.duty import LEVELS, STEP_S, Duty, Habits, lag
from sim_hardware.drawn_machines.plant import Mask, Response, minutes

Array = NDArray[np.float64]

#: Steel or cast iron: density, specific heat, conductivity, expansion.
RHO_KG_PER_M3, C_J_PER_KGK, K_W_PER_MK, ALPHA_UM_PER_MK = 7800.0, 470.0, 48.0, 11.5
INPUTS = ("power", "air", "floor", "coolant", "motor", "friction", "hidden")


class ConductionMachine:
    """A chain of volumes with drawn dimensions.

    Attributes
    ----------
    capacity_j_per_k : array, shape (n,)
        Of the volumes.
    film_w_per_k : array, shape (n,)
        To the air.
    growth_um_per_k : array, shape (n,)
        What a kelvin in each volume adds to Y.
    """

    inherent: tuple[Place, ...] = ()

    def __init__(self, rng: np.random.Generator) -> None:
        nq, nh, nc = int(rng.integers(7, 15)), int(rng.integers(3, 7)), int(rng.integers(3, 6))
        length, diameter, bore = rng.uniform(0.3, 0.7), rng.uniform(0.06, 0.13), rng.uniform(0.02, 0.045)
        self.quill, self.housing = np.arange(nq), nq + np.arange(nh)
        self.column, self.base = nq + nh + np.arange(nc), nq + nh + nc
        n = self.base + 1
        self.capacity_j_per_k, self.film_w_per_k, self.growth_um_per_k = np.zeros(n), np.zeros(n), np.zeros(n)
        self._links: list[tuple[int, int, float]] = []
        section = np.pi / 4.0 * (diameter**2 - bore**2)
        free = rng.uniform(0.15, 0.5)  # Share of the quill that stands out of the housing.
        wetted = np.where(np.arange(nq) >= (1.0 - free) * nq, np.pi * diameter * length / nq, 0.0)
        self._chain(self.quill, length, section, wetted, rng.uniform(8.0, 25.0))
        wall, high, height = rng.uniform(0.02, 0.05), rng.uniform(0.2, 0.4), rng.uniform(0.7, 1.6)
        inside = length * (1.0 - free)
        self._chain(
            self.housing, inside, 4.0 * high * wall, np.full(nh, 4.0 * high * inside / nh), rng.uniform(4.0, 12.0)
        )
        sides = rng.uniform(1.2, 2.5)
        self._chain(
            self.column, height, rng.uniform(0.015, 0.05), np.full(nc, sides * height / nc), rng.uniform(4.0, 10.0)
        )
        self.capacity_j_per_k[self.base] = rng.uniform(300.0, 1200.0) * C_J_PER_KGK
        self.film_w_per_k[self.base] = rng.uniform(1.0, 4.0) * rng.uniform(3.0, 7.0)
        self._links.append((int(self.column[0]), self.base, rng.uniform(10.0, 60.0)))
        self.feet_w_per_k = float(rng.uniform(10.0, 60.0))
        # The housing's nose end is its last volume, its flange the first one.
        rear, front = int(rng.uniform(0.05, 0.35) * nq), int((1.0 - free) * nq) - 1
        self.bearings = (
            (rear, int(self.housing[0]), float(rng.uniform(4.0, 25.0))),
            (front, int(self.housing[-1]), float(rng.uniform(4.0, 25.0))),
        )
        gap = rng.uniform(1.0, 12.0) * np.pi * diameter * inside  # A thin film over the whole gap.
        within = self.quill[: front + 1]
        for node in within:
            self._links.append((int(node), int(self.housing[node * nh // (front + 1)]), gap / within.size))
        top = int(self.column[-1 - int(rng.integers(0, 2))])
        self._links.append((int(self.housing[0]), top, rng.uniform(8.0, 50.0)))
        self.growth_um_per_k[rear:nq] = ALPHA_UM_PER_MK * length / nq
        self.growth_um_per_k[self.housing] += rng.uniform(-0.2, 0.35) * ALPHA_UM_PER_MK * inside / nh
        self.growth_um_per_k[self.column] += (
            rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.5) * ALPHA_UM_PER_MK * height / nc
        )
        self._draw_places(rng, nq, front, rear)

    def _chain(self, nodes: NDArray[np.int_], length_m: float, section_m2: float, area_m2: Array, film: float) -> None:
        dx = length_m / nodes.size
        self.capacity_j_per_k[nodes] = RHO_KG_PER_M3 * C_J_PER_KGK * section_m2 * dx
        self.film_w_per_k[nodes] = film * area_m2
        self._links += [(int(a), int(a) + 1, K_W_PER_MK * section_m2 / dx) for a in nodes[:-1]]

    def _draw_places(self, rng: np.random.Generator, nq: int, front: int, rear: int) -> None:
        """Draw where heat enters, where T_Q sits, and where the effects act."""
        width = int(rng.integers(1, 4))
        first = int(rng.integers(rear, max(rear + 1, front - width + 1)))
        self.heated = self.quill[first : first + width]
        self.seat = int(np.clip(first + rng.integers(-1, width + 1), 0, nq - 1))
        self.seat_lag_min = float(rng.uniform(0.3, 1.5))
        self.air_lag_min = float(rng.uniform(0.3, 2.0))
        self.friction_at = self.bearings[int(abs(rear - self.seat) < abs(front - self.seat))]
        self.cooled = int(rng.choice([self.housing[0], self.housing[-1], self.column[-1], rear]))
        self.hidden_at = int(rng.choice([self.housing[0], self.column[-1], self.column[0], front]))
        self.friction_power = float(rng.choice([1.0, 5.0 / 3.0, 2.0]))
        self.fanned = rng.permutation([0, 1, 2])[: int(rng.integers(1, 4))].tolist()  # Quill, housing, column.
        self._weak = float(rng.uniform(0.3, 0.75))

    def first_strength(self, effect: str) -> tuple[float, str, bool]:
        """Return a strength to begin with, its unit, and whether it is scaled to a wanted size."""
        return {
            "coolant": (3.0, "W/K", True),
            "wet": (3.0, "W/K at full flow", True),
            "bearing": (30.0, "W at full speed", True),
            "fan": (0.5, "of the film at full speed", True),
            "floor": (0.5, "of the floor's excursion", True),
            "more_power": (0.03, "of the motor's load", True),
            "hidden": (30.0, "W", True),
            "weak_bearing": (self._weak, "of a bearing's conductance", False),
        }[effect]

    def matrices(
        self, effect: str = "none", strength: float = 0.0, fan: float = 0.0, flow: float = 0.0
    ) -> tuple[Array, Array]:
        """Return K, W/K, shape (n, n), and B, shape (n, 7), at a level of fan and coolant flow, each from 0 to 1."""
        n = self.base + 1
        film = self.film_w_per_k.copy()
        if effect == "fan":
            for group in self.fanned:
                film[(self.quill, self.housing, self.column)[group]] *= 1.0 + strength * fan
        weak = 1.0 - strength if effect == "weak_bearing" else 1.0
        bearings = [(a, b, g * (weak if (a, b, g) == self.friction_at else 1.0)) for a, b, g in self.bearings]
        K, B = np.diag(film), np.zeros((n, len(INPUTS)))
        for a, b, g in (*self._links, *bearings):
            K[[a, b], [a, b]] += g
            K[[a, b], [b, a]] -= g
        B[self.heated, 0] = 1.0 / self.heated.size
        B[:, 1] = film
        K[self.base, self.base] += self.feet_w_per_k
        B[self.base, 2] = self.feet_w_per_k
        if effect in ("coolant", "wet"):
            node, g = (self.cooled, strength) if effect == "coolant" else (int(self.quill[-1]), strength * flow)
            K[node, node] += g
            B[node, 3] = g
        B[self.housing[0], 4] = 1.0
        B[list(self.friction_at[:2]), 5] = 0.5
        B[self.hidden_at, 6] = 1.0
        return K, B

    def inputs(self, duty: Duty, habits: Habits, effect: str, strength: float | Array) -> Array:
        """Return u over a duty, shape (n, 7); the strength may be one for each step."""
        given, zero = duty.columns, np.zeros(duty.n)
        floor = habits.hall_degc + (strength if effect == "floor" else 0.0) * (given["floor_degc"] - habits.hall_degc)
        friction = strength * duty.share("spindle_rpm", habits) ** self.friction_power
        return np.column_stack(
            (
                given["power_w"],
                given["air_degc"],
                floor,
                given["coolant_degc"],
                strength * given["motor_w"] if effect == "more_power" else zero,
                friction if effect == "bearing" else zero,
                strength * given["hidden"] if effect == "hidden" else zero,
            )
        )

    def run(self, duty: Duty, habits: Habits, effect: str, strength: float, on: Mask | None = None) -> Response:
        """Return the response over a duty, see `plant.Plant`."""
        u = self.inputs(duty, habits, effect, strength if on is None else np.asarray(strength * on, dtype=np.float64))
        fan = np.round(LEVELS * duty.share("fan_rpm", habits)).astype(int) if effect == "fan" else np.zeros(duty.n, int)
        flow = np.round(LEVELS * duty.share("coolant_flow_lpm", habits)).astype(int) if effect == "wet" else 0 * fan
        off = np.zeros(duty.n, int) if on is None else (~on).astype(int)
        level = (fan + (LEVELS + 1) * flow + (LEVELS + 1) ** 2 * off).tolist()
        steps, added = {}, np.empty((duty.n, self.base + 1))
        for key in sorted(set(level)):
            is_off, rest = divmod(key, (LEVELS + 1) ** 2)
            here_strength = 0.0 if is_off else strength
            K, B = self.matrices(effect, here_strength, (rest % (LEVELS + 1)) / LEVELS, (rest // (LEVELS + 1)) / LEVELS)
            rate = -K / self.capacity_j_per_k[:, None]
            phi = expm(STEP_S * rate)
            steps[key] = phi
            here = np.array(level) == key
            added[here] = (
                u[here] @ (np.linalg.solve(rate, phi - np.eye(K.shape[0])) @ (B / self.capacity_j_per_k[:, None])).T
            )
        first = strength if on is None or on[0] else 0.0
        K, B = self.matrices(effect, first)
        degc = np.linalg.solve(K, B @ self.inputs(duty.resting(), habits, effect, first)[0])
        states = np.empty((duty.n, degc.size))
        for i, key in enumerate(level):
            degc = steps[key] @ degc + added[i]
            states[i] = degc
        return Response(
            t_q_degc=minutes(lag(states[:, self.seat], self.seat_lag_min)),
            at_degc=minutes(lag(duty.columns["air_degc"], self.air_lag_min)),
            y_um=minutes(states @ self.growth_um_per_k),
            heat_w=minutes(duty.columns["power_w"]),
        )
