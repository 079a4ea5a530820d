"""What a machine is made to do: profiles of heat, speed, coolant, fan, air and floor, drawn by a seed.

Each controlled channel follows a profile of its own kind; where channels move together, one of them follows the profile
of the heat for hours at a time. Everything lies on a grid of 15 s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]

STEP_S = 15.0
PER_MIN = int(60.0 / STEP_S)
PER_H = 60 * PER_MIN
PROFILES = ("steps", "programme", "once", "cycles")
#: Levels of a controlled channel, so that a machine changes only between a few states.
LEVELS = 4
CONTROLLED = ("spindle_rpm", "motor_w", "coolant_flow_lpm", "fan_rpm")


@dataclass(frozen=True, slots=True, kw_only=True)
class Habits:
    """What stays the same on every day of a machine.

    Parameters
    ----------
    power_w : float
        Largest heat.
    full : dict of str to float
        Largest value of each controlled channel, in its unit.
    together : dict of str to float
        Share of the time in which a channel follows the heat's profile.
    shifts : bool
        Whether nothing runs at night.
    hall_degc, swing_k, events_k : float
        The hall: mean, daily swing, size of one-time events (doors, heating).
    start_h : float
        Hour of the day at which a run starts.
    """

    power_w: float
    full: dict[str, float]
    together: dict[str, float]
    shifts: bool
    hall_degc: float
    swing_k: float
    events_k: float
    start_h: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Habits:
        """Draw the habits of a machine."""
        full = {
            "spindle_rpm": float(rng.choice([3000.0, 6000.0, 8000.0, 12000.0, 18000.0])),
            "motor_w": float(rng.uniform(200.0, 3000.0)),
            "coolant_flow_lpm": float(rng.uniform(5.0, 40.0)),
            "fan_rpm": float(rng.choice([1500.0, 2800.0, 3000.0])),
        }
        together = {name: float(rng.choice([0.0, 0.0, 0.3, 0.6])) for name in CONTROLLED}
        return cls(
            power_w=float(rng.uniform(60.0, 90.0)),
            full=full,
            together=together,
            shifts=bool(rng.random() < 0.4),
            hall_degc=float(rng.uniform(17.0, 25.0)),
            swing_k=float(rng.uniform(0.3, 3.0)),
            events_k=float(rng.uniform(0.5, 4.0)),
            start_h=float(rng.uniform(5.0, 22.0)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Duty:
    """Inputs of a run.

    Parameters
    ----------
    columns : dict of str to array, shape (n,)
        `power_w`, the controlled channels, `air_degc`, `floor_degc`, `coolant_degc`, channels that act on
        nothing, and `hidden`, which is 0 or 1 and never logged.
    before : int
        Steps before the recording starts: what makes a start that is not at rest.
    profiles : dict of str to str
        Kind of profile of the heat and of each controlled channel.
    """

    columns: dict[str, Array]
    before: int
    profiles: dict[str, str]

    @property
    def n(self) -> int:
        """Number of steps, those before the recording included."""
        return int(self.columns["power_w"].size)

    def share(self, name: str, habits: Habits) -> Array:
        """Return a controlled channel as a share of its largest value."""
        return self.columns[name] / habits.full[name]

    def resting(self) -> Duty:
        """Return one step before the duty: its first air, floor and coolant, nothing running."""
        still = {"power_w", "hidden", *CONTROLLED}
        columns = {name: np.zeros(1) if name in still else values[:1] for name, values in self.columns.items()}
        return Duty(columns=columns, before=0, profiles=self.profiles)


def lag(values: Array, tau_min: float, step_min: float = STEP_S / 60.0) -> Array:
    """Return a signal behind a first-order lag that has settled at the signal's first value.

    Examples
    --------
    >>> lag(np.array([0.0, 1.0, 1.0]), 1e-6).round(3).tolist()
    [0.0, 1.0, 1.0]
    """
    keep = float(np.exp(-step_min / tau_min))
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], values, zi=[keep * values[0]])[0], dtype=np.float64)


def profile(rng: np.random.Generator, n: int, kind: str) -> Array:
    """Return a profile of a kind, in quarters from 0 to 1, shape (n,)."""
    if kind == "once":
        first = int(rng.uniform(0.05, 0.25) * n)
        last = int(rng.uniform(0.5, 0.75) * n)
        out = np.zeros(n)
        out[first:last] = 1.0
        return out
    if kind == "cycles":
        period, out, at = rng.uniform(12.0, 60.0) * PER_MIN, np.empty(n), 0
        while at < n:
            share = 0.0 if rng.random() < 0.2 else rng.uniform(0.2, 0.8)
            end = min(n, at + int(rng.uniform(2.0, 6.0) * PER_H))
            out[at:end] = (np.arange(end - at) % period) < share * period
            at = end
        return out
    low, high = (60.0, 300.0) if kind == "steps" else (8.0, 120.0)
    out, at, last_level = np.empty(n), 0, -1.0
    while at < n:
        level = last_level
        while level == last_level:
            level = float(rng.choice([0, 0, 1, 2, 3, 4])) / LEVELS
        end = min(n, at + max(1, int(rng.uniform(low, high) * PER_MIN)))
        out[at:end] = last_level = level
        at = end
    return out


def draw_duty(rng: np.random.Generator, habits: Habits, hours: float, *, kind: str, use: str = "record") -> Duty:
    """Draw the inputs of a run.

    Parameters
    ----------
    hours : float
        Length of the recording.
    kind : str
        Profile of the heat.
    use : {"record", "calibration", "fresh"}
        A calibration is mostly from rest, in air without events. A fresh run always begins at rest: what a start on a
        warm machine leaves is unknown to any model, and would hide what an effect leaves.
    """
    rests = rng.random() < {"record": 0.5, "calibration": 0.8, "fresh": 1.0}[use]
    before = 0 if rests else int(rng.uniform(1.0, 8.0) * PER_H)
    n = before + round(hours * PER_H)
    hour = habits.start_h + (np.arange(n) - before) / PER_H
    works = (
        ((hour % 24.0) >= 6.0) & ((hour % 24.0) < 22.0) if habits.shifts and hours > 20.0 else np.ones(n, dtype=bool)
    )
    heat = profile(rng, n, kind) * works
    columns, profiles = {"power_w": habits.power_w * heat}, {"power_w": kind}
    for name in CONTROLLED:
        profiles[name] = kind if kind == "once" else str(rng.choice(PROFILES, p=(0.3, 0.4, 0.1, 0.2)))
        own = profile(rng, n, profiles[name])
        block = np.repeat(rng.random(n // (2 * PER_H) + 1) < habits.together[name], 2 * PER_H)[:n]
        columns[name] = habits.full[name] * np.where(block, heat, own) * (works if name != "fan_rpm" else 1.0)
    if not before:  # Half an hour at rest, as a shift begins.
        for name in ("power_w", *CONTROLLED):
            columns[name][: PER_H // 2] = 0.0
    air = _air(rng, habits, n, hour, events=use != "calibration")
    columns["air_degc"] = air
    columns["floor_degc"] = _floor(rng, habits, air)
    columns["coolant_degc"] = _coolant(rng, habits.hall_degc, columns["coolant_flow_lpm"] > 0.0, air)
    columns["hidden"] = _switched(rng, n)
    speed, motor = columns["spindle_rpm"] / habits.full["spindle_rpm"], columns["motor_w"] / habits.full["motor_w"]
    columns["spindle_load_pct"] = 100.0 * lag(0.3 * speed + 0.5 * motor * profile(rng, n, "programme"), 0.5)
    columns["hydraulic_degc"] = (
        habits.hall_degc + lag(12.0 * profile(rng, n, "steps") * works, 45.0) + 0.4 * (air - air[0])
    )
    columns["cabinet_degc"] = air + lag(8.0 * profile(rng, n, "programme"), 20.0) + 2.0 * lag(heat, 25.0)
    return Duty(columns=columns, before=before, profiles=profiles)


def _air(rng: np.random.Generator, habits: Habits, n: int, hour: Array, *, events: bool) -> Array:
    """Return the hall's air: a daily swing, slow noise, doors, heating that is switched once."""
    keep = float(np.exp(-STEP_S / 2400.0))
    air = habits.swing_k * np.sin(2.0 * np.pi * (hour - rng.uniform(6.0, 12.0)) / 24.0)
    air += lfilter([1.0], [1.0, -keep], rng.normal(0.0, 0.15 * np.sqrt(1.0 - keep * keep), n))
    if events:
        doors = np.zeros(n)
        for _ in range(rng.poisson(3.0 * n / (24.0 * PER_H))):
            first = int(rng.integers(0, n))
            doors[first : first + int(rng.uniform(3.0, 20.0) * PER_MIN)] -= rng.uniform(0.3, 1.0) * habits.events_k
        air += lag(doors, 6.0)
        if rng.random() < 0.5:
            heating = np.zeros(n)
            heating[int(rng.uniform(0.2, 0.8) * n) :] = habits.events_k * rng.choice([-1.0, 1.0])
            air += lag(heating, rng.uniform(40.0, 150.0))
    return np.asarray(habits.hall_degc + air, dtype=np.float64)


def _floor(rng: np.random.Generator, habits: Habits, air: Array) -> Array:
    """Return the floor: it follows the hall slowly and has a heating of its own."""
    own = rng.uniform(4.0, 10.0) * profile(rng, air.size, str(rng.choice(["steps", "once"])))
    return habits.hall_degc + 0.4 * lag(air - habits.hall_degc, 600.0) + lag(own, rng.uniform(40.0, 120.0))


def _coolant(rng: np.random.Generator, hall_degc: float, flows: NDArray[np.bool_], air: Array) -> Array:
    """Return the coolant: a chiller's set value that is changed, warmed by work, with its two-point control."""
    target = rng.uniform(-4.0, 4.0) * profile(rng, air.size, str(rng.choice(["steps", "once", "programme"])))
    saw = rng.uniform(0.0, 0.6) * np.abs(((np.arange(air.size) / (rng.uniform(15.0, 60.0) * PER_MIN)) % 2.0) - 1.0)
    warmed = rng.uniform(1.0, 4.0) * lag(flows.astype(np.float64), rng.uniform(20.0, 60.0))
    return np.asarray(hall_degc + lag(target, rng.uniform(8.0, 30.0)) + saw + warmed + 0.2 * (air - hall_degc))


def _switched(rng: np.random.Generator, n: int) -> Array:
    """Return a source that is switched now and then, 0 or 1."""
    out, at, on = np.zeros(n), 0, False
    while at < n:
        end = at + int(rng.uniform(1.5, 7.0) * PER_H)
        out[at:end] = float(on)
        at, on = end, not on
    return out
