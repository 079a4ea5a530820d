"""The Kalman filter of the slow rest, an Ornstein–Uhlenbeck process, in white noise."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dtbtrs

from compensator.arrays import Matrix, Vector
from compensator.diagnose.points import Points, Rest

#: Stretches of so few points are whitened in a loop.
FEW = 12


class Whitening:
    """The Kalman filter of the slow rest with noise: turns both into white noise of size 1.

    Parameters
    ----------
    points : Points
        Which points are used, and where runs begin.
    rest : Rest
        Noise, and size and time constant of the slow rest.
    """

    def __init__(self, points: Points, rest: Rest) -> None:
        self._used = points.used
        phis = points.decays(rest.tau_min)
        stationary = (rest.slow_um / rest.noise_um) ** 2
        predicted, p = np.empty(points.used.size), stationary
        for begin, end, noise in points.stretches:
            if begin in points.begins:
                p = stationary
            predicted[begin:end], p = _predicted_variances(p, end - begin, noise, float(phis[begin]), stationary)
        variances = predicted + points.relative_variance
        gains = predicted / variances
        self._into = phis * gains
        self._into[points.starts[1:] - 1] = 0.0
        self._bands = np.ones((2, points.used.size))
        self._bands[1] = -phis * (1.0 - gains)
        self._bands[1, points.starts[1:] - 1] = 0.0
        self._scale = 1.0 / (np.sqrt(variances[points.used]) * rest.noise_um)
        self.log_det = float(np.log(variances[points.used]).sum()) + 2.0 * points.count * math.log(rest.noise_um)

    def of(self, table: Matrix) -> Matrix:
        """Return columns as the filter leaves them, on the points used."""
        if not table.shape[1]:
            return np.zeros((self._scale.size, 0))  # LAPACK must not be called with nothing
        driven = np.zeros(table.shape, order="F")
        driven[1:] = self._into[:-1, None] * table[:-1]
        predicted, _ = dtbtrs(self._bands, driven, uplo="L", diag="U", overwrite_b=1)
        return np.asarray((table - predicted)[self._used] * self._scale[:, None])


def _predicted_variances(first: float, count: int, noise: float, phi: float, stationary: float) -> tuple[Vector, float]:
    """Return the variances of a slow rest before each of some points with equal noise, and after them.

    What the Kalman filter makes of a variance is a linear fraction of it, so that many points need no loop.
    """
    if count <= FEW:
        values = []
        for _ in range(count):
            values.append(first)
            left = first if noise == math.inf else first * noise / (first + noise)
            first = stationary + phi * phi * (left - stationary)
        return np.array(values), first
    n = np.arange(count + 1, dtype=np.float64)
    course: Vector
    if noise == math.inf:
        course = stationary + np.power(phi, 2.0 * n) * (first - stationary)
        return course[:-1], float(course[-1])
    driven = stationary * (1.0 - phi * phi)
    half = 0.5 * (noise * (1.0 - phi * phi) - driven)
    root = math.sqrt(half * half + driven * noise)
    # The larger of both fixed points, without cancellation, and the other, which is negative.
    settled = driven * noise / (half + root) if half > 0.0 else root - half
    other = settled - 2.0 * root
    odds = np.power(phi * noise / (settled + noise), 2.0 * n) * (first - settled) / (first - other)
    course = (settled - other * odds) / (1.0 - odds)
    return course[:-1], float(course[-1])
