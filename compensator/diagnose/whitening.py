"""The Kalman filter of the slow rest, an Ornstein–Uhlenbeck process, in white noise."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dtbtrs

from compensator.arrays import Matrix, Vector
from compensator.diagnose.points import Points, Rest

#: Stretches of so few points are whitened in a loop.
FEW = 12
#: So many columns are whitened with all of them at once.
MANY = 400


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
        phis = points.decays(rest.tau_min)
        stationary, starts = (rest.slow_um / rest.noise_um) ** 2, set(points.starts.tolist())
        predicted, p = np.empty(points.count), stationary
        for begin, end, noise in points.stretches:
            if begin in starts:
                p = stationary
            predicted[begin:end], p = _predicted_variances(p, end - begin, noise, float(phis[begin]), stationary)
        variances = predicted + points.relative_variance
        # What a point says of the next one, and what is left of what was known before; nothing from run to run.
        phis[points.starts[1:] - 1] = 0.0
        gains = predicted / variances
        self._into = (phis * gains)[:-1, None]
        self._bands = np.ones((2, points.count))
        self._bands[1] = -phis * (1.0 - gains)
        self._scale = 1.0 / (np.sqrt(variances) * rest.noise_um)[:, None]
        self.log_det = float(np.log(variances).sum()) + 2.0 * points.count * math.log(rest.noise_um)

    def of(self, table: Matrix) -> Matrix:
        """Return columns as the filter leaves them."""
        if not table.shape[1]:
            return np.zeros(table.shape)  # LAPACK must not be called with nothing
        if table.shape[1] > MANY:
            return self._row_by_row(table)
        # LAPACK goes along columns.
        table = np.asfortranarray(table)
        driven = np.empty(table.shape, order="F")
        driven[0] = 0.0
        np.multiply(table[:-1], self._into, out=driven[1:])
        predicted, _ = dtbtrs(self._bands, driven, uplo="L", diag="U", overwrite_b=1)
        np.subtract(table, predicted, out=predicted)
        predicted *= self._scale
        return np.asarray(predicted)

    def _row_by_row(self, table: Matrix) -> Matrix:
        """Return the same, with all columns at once from one point to the next."""
        white, predicted, kept = np.empty(table.shape), np.zeros(table.shape[1]), -self._bands[1]
        for i, (into, left) in enumerate(zip([*self._into[:, 0].tolist(), 0.0], kept.tolist(), strict=True)):
            np.subtract(table[i], predicted, out=white[i])
            predicted *= left
            predicted += into * table[i]
        white *= self._scale
        return white


def _predicted_variances(first: float, count: int, noise: float, phi: float, stationary: float) -> tuple[Vector, float]:
    """Return the variances of a slow rest before each of some points with equal noise, and after them.

    What the Kalman filter makes of a variance is a linear fraction of it, so that many points need no loop.
    """
    if count <= FEW:
        values = []
        for _ in range(count):
            values.append(first)
            first = stationary + phi * phi * (first * noise / (first + noise) - stationary)
        return np.array(values), first
    n = np.arange(count + 1, dtype=np.float64)
    course: Vector
    driven = stationary * (1.0 - phi * phi)
    half = 0.5 * (noise * (1.0 - phi * phi) - driven)
    root = math.sqrt(half * half + driven * noise)
    # The larger of both fixed points, without cancellation, and the other, which is negative.
    settled = driven * noise / (half + root) if half > 0.0 else root - half
    other = settled - 2.0 * root
    odds = np.power(phi * noise / (settled + noise), 2.0 * n) * (first - settled) / (first - other)
    course = (settled - other * odds) / (1.0 - odds)
    return course[:-1], float(course[-1])
