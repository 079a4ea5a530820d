"""The pieces of a working day: random levels, shop air with doors, coolant with its thermostat."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim_hardware.physics.plant import REST_DEGC

Array = NDArray[np.float64]

GRID_S = 10.0
DAY_S = 86_400.0


def levels(random: np.random.Generator, n: int, choices: Array, minutes: tuple[float, float]) -> Array:
    """Return levels that are constant for random times within `minutes`; consecutive levels differ."""
    out = np.empty(n)
    at, last = 0, -1.0
    while at < n:
        value = last
        while value == last:
            value = float(random.choice(choices))
        length = max(1, round(random.uniform(*minutes) * 60.0 / GRID_S))
        out[at : at + length] = last = value
        at += length
    return out


def shop_air(random: np.random.Generator, n: int, doors_per_day: float, swing_k: float = 1.0) -> Array:
    """Return the air's temperature in °C: ±`swing_k` a day, slow noise of 0.15 K, doors that let cold air in.

    It starts at 20 °C, the temperature at which the machine is at rest.
    """
    t_s = np.arange(n) * GRID_S
    air = swing_k * np.sin(2.0 * np.pi * t_s / DAY_S) * random.choice([-1.0, 1.0])
    # Noise with a time constant of 40 min, started at zero.
    keep = float(np.exp(-GRID_S / 2400.0))
    air += lfilter([1.0], [1.0, -keep], random.normal(0.0, 0.15 * np.sqrt(1.0 - keep * keep), n))
    dip = np.zeros(n)
    for _ in range(random.poisson(doors_per_day * n * GRID_S / DAY_S)):
        first = int(random.integers(0, n))
        dip[first : first + int(random.uniform(120.0, 900.0) / GRID_S)] -= random.uniform(0.5, 2.0)
    mix = float(np.exp(-GRID_S / 300.0))
    air += lfilter([1.0 - mix], [1.0, -mix], dip)
    return np.asarray(REST_DEGC + air - air[0], dtype=np.float64)


def flow_while(random: np.random.Generator, turning: NDArray[np.bool_]) -> Array:
    """Return the coolant's flow in l/min: while the spindle turns, but some jobs run dry."""
    starts = np.cumsum(np.diff(turning.astype(int), prepend=0) == 1)
    wet = random.random(int(starts[-1]) + 1) < 0.65
    return np.where(turning & wet[starts], 12.0, 0.0)


def coolant(random: np.random.Generator, air_degc: Array, flow_lpm: Array) -> Array:
    """Return the coolant's °C under a two-point thermostat, warmed by the air and by cutting."""
    upper, lower = REST_DEGC + random.uniform(0.5, 2.0), REST_DEGC - random.uniform(1.0, 3.0)
    cutting_k_per_s = random.uniform(1.0, 3.0) / 1200.0
    chilling_k_per_s = random.uniform(4.0, 8.0) / 1200.0
    out = np.empty(len(air_degc))
    value, chilling = REST_DEGC, False
    for i, (air, flow) in enumerate(zip(air_degc.tolist(), flow_lpm.tolist(), strict=True)):
        chilling = value > lower if chilling else value > upper
        rate = (air - value) / 5400.0 + (cutting_k_per_s if flow > 0.0 else 0.0)
        value += GRID_S * (rate - (chilling_k_per_s if chilling else 0.0))
        out[i] = value
    return out


def cabinet(random: np.random.Generator, air_degc: Array) -> Array:
    """Return a cabinet's °C, which follows the air and its own load, and has no effect."""
    load_k = levels(random, len(air_degc), np.array([3.0, 6.0, 9.0]), (30.0, 240.0))
    keep = float(np.exp(-GRID_S / 1800.0))
    start = [keep * float(load_k[0])]
    return np.asarray(air_degc + lfilter([1.0 - keep], [1.0, -keep], load_k, zi=start)[0], dtype=np.float64)
