"""The course of a noisy signal: smooth, with kinks where the data have them.

A residual and the columns that shall explain it are both computed from the same measured temperatures. Their noise
would stand in both, and an effect that cancels noise would seem to explain it. So diagnosis starts from the course of
a temperature and not from its readings.

Source: Kim, Koh, Boyd, Gorinevsky, l1 trend filtering (SIAM Review 2009), solved by reweighted least squares.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from compensator.arrays import Vector

#: Rounds of reweighting; bisections of the penalty.
REWEIGHTINGS, BISECTIONS = 8, 12
#: The readings scatter about their course by this share of the noise: the course follows some of it.
SCATTER = 0.97


def course(values: Vector, noise_std: float) -> Vector:
    """Return the course of a signal.

    Parameters
    ----------
    values : numpy.ndarray, shape (n,)
        Readings at equal intervals, without NaN.
    noise_std : float
        Standard deviation of their white noise.

    Examples
    --------
    >>> ramp = np.maximum(np.arange(200) - 100.0, 0.0)
    >>> noisy = ramp + np.random.default_rng(0).normal(0.0, 1.0, 200)
    >>> bool(np.std(course(noisy, 1.0) - ramp) < 0.4)
    True
    """
    if noise_std <= 0.0 or values.size < 8:
        return values
    low, high = -4.0, 8.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        scatter = np.sqrt(np.mean((values - _penalised(values, noise_std, middle)) ** 2))
        low, high = (middle, high) if scatter < SCATTER * noise_std else (low, middle)
    return _penalised(values, noise_std, low)


def _penalised(values: Vector, noise_std: float, log_penalty: float) -> Vector:
    """Return the minimum of the squared distance plus a penalty on the size of second differences."""
    penalty = float(np.exp(log_penalty))
    smooth = _solved(values, np.full(values.size - 2, penalty))
    for _ in range(REWEIGHTINGS):
        bends = np.abs(np.diff(smooth, 2))
        smooth = _solved(values, penalty * noise_std / (bends + 0.02 * noise_std))
    return smooth


def _solved(values: Vector, weights: Vector) -> Vector:
    """Solve (I + DᵀWD) x = values with D the second differences."""
    bands = np.zeros((3, values.size))
    bands[2] = 1.0
    bands[2, :-2] += weights
    bands[2, 1:-1] += 4.0 * weights
    bands[2, 2:] += weights
    bands[1, 1:-1] -= 2.0 * weights
    bands[1, 2:] -= 2.0 * weights
    bands[0, 2:] += weights
    return np.asarray(solveh_banded(bands, values, check_finite=False))
