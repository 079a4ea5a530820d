"""Data of a machine with several axes, from transfer functions that stand here."""

import numpy as np
from scipy.signal import lfilter

MINUTES = 1800
#: Gains, µm/K, by time constants, min, of the paths of each axis; Y and Z have the same time constants, X has its own.
DRIVE = {"x": {8.0: 2.0}, "y": {30.0: 3.0, 150.0: 2.0}, "z": {30.0: 9.0, 150.0: -2.0}}
AMBIENT = {"x": {8.0: 0.8}, "y": {30.0: 0.5, 150.0: 1.0}, "z": {30.0: -1.0, 150.0: 3.0}}


def lag(values, tau_min):
    """A first-order lag with Tustin's pole at one minute."""
    pole = (2.0 * tau_min - 1.0) / (2.0 * tau_min + 1.0)
    return lfilter([1.0 - pole], [1.0, -pole], values)


def machine(seed=1, *, noise_um=0.3, axes=("x", "y", "z")):
    """A table of one run."""
    rng = np.random.default_rng(seed)
    heat = np.repeat(rng.permutation([0.0, 60.0, 20.0, 90.0, 0.0, 40.0, 75.0, 10.0, 50.0]), MINUTES // 9)
    heat[:60] = 0.0
    difference = 0.15 * lag(heat, 25.0)
    ambient = 1.5 * np.sin(2 * np.pi * np.arange(MINUTES) / 1100.0) + 0.8 * np.sin(
        2 * np.pi * np.arange(MINUTES) / 310.0
    )
    table = {
        "t_s": np.arange(MINUTES) * 60.0,
        "t_q_degc": 22.0 + difference + ambient + rng.normal(0.0, 0.005, MINUTES),
        "at_degc": 22.0 + ambient + rng.normal(0.0, 0.005, MINUTES),
    }
    for i, axis in enumerate(DRIVE):
        if axis not in axes:
            continue
        y = sum(gain * lag(difference, tau) for tau, gain in DRIVE[axis].items())
        y = y + sum(gain * lag(ambient, tau) for tau, gain in AMBIENT[axis].items())
        table[f"{axis}_um"] = y + np.random.default_rng([seed, i]).normal(0.0, noise_um, MINUTES)
    return table
