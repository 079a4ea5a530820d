"""Between the machine and its table: a T_Q that is late or loose, a Y that drifts, noise, a shop floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_hardware.drawn_machines.duty import Duty, lag
from sim_hardware.drawn_machines.plant import Response, minutes

Array = NDArray[np.float64]

#: Channels of a duty that a table may have.
CHANNELS = (
    "coolant_degc",
    "coolant_flow_lpm",
    "spindle_rpm",
    "fan_rpm",
    "floor_degc",
    "motor_w",
    "spindle_load_pct",
    "hydraulic_degc",
    "cabinet_degc",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensors:
    """What a machine is measured with.

    Parameters
    ----------
    t_q_noise_k, at_noise_k, y_noise_um : float
        White noise.
    y_quantum_um : float
        Step of Y's converter; 0.01 K is that of temperatures.
    logged : tuple of str
        Channels in the table.
    shop_floor : bool
        Whether there are gaps, outliers, slow noise and a sensor that steps.
    """

    t_q_noise_k: float
    at_noise_k: float
    y_noise_um: float
    y_quantum_um: float
    logged: tuple[str, ...]
    shop_floor: bool

    @classmethod
    def drawn(cls, rng: np.random.Generator, needed: str, *, shop_floor: bool) -> Sensors:
        """Draw the sensors of a machine; `needed` is a channel that is logged in any case, or empty."""
        related = ("coolant_degc", "coolant_flow_lpm") if needed.startswith("coolant") else (needed,)
        logged = tuple(name for name in CHANNELS if name in related or rng.random() < 0.7)
        noise_k = float(rng.uniform(0.01, 0.04))
        return cls(
            t_q_noise_k=noise_k,
            at_noise_k=noise_k * float(rng.uniform(0.7, 1.3)),
            y_noise_um=float(rng.uniform(0.1, 0.5)),
            y_quantum_um=float(rng.choice([0.0, 0.01, 0.1])),
            logged=logged,
            shop_floor=shop_floor,
        )

    def table(
        self, rng: np.random.Generator, response: Response, duty: Duty, *, heat: bool = False, guarded: bool = False
    ) -> dict[str, Array]:
        """Return the columns of a run.

        Parameters
        ----------
        response : Response
            What the sensors see, the time before the recording cut off.
        heat : bool
            Whether a wattmeter reads the heat.
        guarded : bool
            Whether outliers and a long gap are left out even on a shop floor: a service refuses those before its model.
        """
        n = response.y_um.size
        columns: dict[str, Array] = {
            "t_s": 60.0 * np.arange(n, dtype=np.float64),
            "t_q_degc": response.t_q_degc + rng.normal(0.0, self.t_q_noise_k, n),
            "at_degc": response.at_degc + rng.normal(0.0, self.at_noise_k, n),
            "y_um": response.y_um + rng.normal(0.0, self.y_noise_um, n),
        }
        if heat:
            columns["heat_w"] = np.round(response.heat_w, 1)
        for name in self.logged:
            true = minutes(duty.columns[name])[-n:]
            noise = (
                rng.normal(0.0, 0.03, n) if name.endswith("degc") else rng.normal(0.0, 0.002, n) * np.max(np.abs(true))
            )
            columns[name] = true + noise * (true != 0.0)
        if self.shop_floor:
            self._spoil(rng, columns, guarded=guarded)
        for name, values in columns.items():
            quantum = self.y_quantum_um if name == "y_um" else 0.01 if name.endswith("degc") else 0.0
            if quantum:
                columns[name] = np.round(values / quantum) * quantum
        return columns

    def _spoil(self, rng: np.random.Generator, columns: dict[str, Array], *, guarded: bool) -> None:
        """Add what a shop floor adds: slow noise, outliers, missing values, a gap, a sensor that steps."""
        n = columns["t_s"].size
        for name, size in (("y_um", rng.uniform(0.1, 0.3)), ("at_degc", 0.02), ("t_q_degc", 0.01)):
            tau = rng.uniform(15.0, 90.0)
            columns[name] += _slow(rng, n, tau, size)
        steps = [name for name in ("hydraulic_degc", "cabinet_degc") if name in columns]
        if steps:
            columns[str(rng.choice(steps))][int(rng.uniform(0.2, 0.8) * n) :] += rng.choice([-1.0, 1.0]) * rng.uniform(
                0.5, 3.0
            )
        for name in ("t_q_degc", "at_degc", "y_um"):
            wild = rng.random(n) < (0.0 if guarded else 0.001)
            wild[:60] = False
            columns[name][wild] += rng.choice([-1.0, 1.0], int(wild.sum())) * rng.uniform(10.0, 60.0, int(wild.sum()))
            missing = rng.random(n) < 0.004
            missing[:60] = False
            columns[name][missing] = np.nan
        if not guarded and n > 1200 and rng.random() < 0.4:
            first = int(rng.uniform(0.3, 0.7) * n)
            gap = slice(first, first + int(rng.uniform(30.0, 120.0)))
            for name, values in columns.items():
                if name != "t_s":
                    values[gap] = np.nan


def _slow(rng: np.random.Generator, n: int, tau_min: float, std: float) -> Array:
    """Return noise with a time constant, its first value 0."""
    noise = lag(np.concatenate(([0.0], rng.normal(0.0, 1.0, n - 1))), tau_min, 1.0)
    return np.asarray(std * noise / np.std(noise))


def mismeasured_t_q(t_q_degc: Array, at_degc: Array, effect: str, strength: float) -> Array:
    """Return what a late or loose thermocouple reads.

    Parameters
    ----------
    effect : {"lag_t_q", "delay_t_q", "loose_couple"}
        A lag of `strength` min, a delay of `strength` samples, or a contact that loses `strength` of the difference to
        the air and lags by 10 min times that.
    """
    if effect == "lag_t_q":
        return lag(t_q_degc, strength, 1.0)
    if effect == "delay_t_q":
        late = round(strength)
        return np.concatenate((np.full(late, t_q_degc[0]), t_q_degc[: t_q_degc.size - late]))
    return lag(t_q_degc - strength * (t_q_degc - at_degc), 10.0 * strength, 1.0)


def mismeasured_y(rng: np.random.Generator, n: int, effect: str) -> Array:
    """Return an error of Y's measurement of unit standard deviation, shape (n,): a drift, a step or a period."""
    t = np.arange(n, dtype=np.float64)
    if effect == "drift":
        error = t if rng.random() < 0.5 else 1.0 - np.exp(-t / (rng.uniform(0.4, 1.5) * n))
    elif effect == "step":
        error = (t >= rng.uniform(0.25, 0.75) * n).astype(np.float64)
    else:
        error = np.sin(2.0 * np.pi * t / min(rng.uniform(20.0, 180.0), n / 4.0) + rng.uniform(0.0, 6.28))
    error = error - error[0]
    return np.asarray(rng.choice([-1.0, 1.0]) * error / np.std(error))
