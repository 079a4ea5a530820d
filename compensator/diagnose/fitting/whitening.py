"""The Kalman filter of the slow rest, an Ornstein–Uhlenbeck process, in white noise."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dtbtrs

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fitting.points import Points, SlowRest

#: A variance goes over so many alike points in one step.
ALIKE = 8
#: So many columns are whitened with all of them at once.
MANY = 400


class Whitening:
    """The Kalman filter of the slow rest with noise: turns both into white noise of size 1.

    Parameters
    ----------
    points : Points
        Which points are used, and where runs begin.
    rest : SlowRest
        Noise, and size and time constant of the slow rest.
    """

    def __init__(self, points: Points, rest: SlowRest) -> None:
        stationary = (rest.slow_um / rest.noise_um) ** 2
        # What is left of a slow process from each point to the next; nothing from run to run.
        phis = points.decays(rest.tau_min)
        phis[points.starts[1:] - 1] = 0.0
        predicted, p = np.empty(points.count), stationary
        for first, end in points.alike:
            noise, kept = float(points.relative_variance[first]), float(phis[first]) ** 2
            if end - first > ALIKE:
                predicted[first:end] = _settling(p, stationary, noise, kept, end - first)
                first, p = end - 1, float(predicted[end - 1])  # noqa: PLW2901
            for i in range(first, end):
                predicted[i] = p
                p = stationary + kept * (p * noise / (p + noise) - stationary)
        variances = predicted + points.relative_variance
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


def _settling(begin: float, stationary: float, noise: float, kept: float, count: int) -> Vector:
    """Return the variance predicted at each of some points with one noise and one time to the next.

    From point to point it is p → stationary + kept (p noise / (p + noise) − stationary), with two fixed points; how far
    it is from the one, divided by how far from the other, falls by one factor each time.
    """
    new = stationary * (1.0 - kept)
    half = 0.5 * (new - (1.0 - kept) * noise)
    root = math.hypot(half, math.sqrt(new * noise))
    # Neither is a difference of two that are nearly the same.
    high = half + root if half >= 0.0 else new * noise / (root - half)
    low = -new * noise / high if half >= 0.0 else half - root
    log_factor = math.log((low + noise) / (high + noise)) if low + noise > 0.0 else -math.inf
    ratio = (begin - high) / (begin - low)
    # 1 − ratio left is `apart`.
    left = np.exp(log_factor * np.arange(count)) if math.isfinite(log_factor) else np.eye(1, count)[0]
    apart = (2.0 * root) / (begin - low) - ratio * (left - 1.0)
    return np.asarray(high + 2.0 * root * ratio * left / apart)
