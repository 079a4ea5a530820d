"""Several estimates as one, weighted by their probabilities; every sum in the order of its values.

`sum` of newer Pythons compensates the rounding, which gives other bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple


class Mixture(NamedTuple):
    """States that several estimates together know.

    Parameters
    ----------
    mean : list of float, length n
        Mean of each state: µm for an offset, 1 for a relative gain.
    covariance : list of list of float
        Lower triangle of their covariance.
    growth : list of float, length n
        Growth of the variance of each state, 1/min.
    """

    mean: list[float]
    covariance: list[list[float]]
    growth: list[float]

    def std_of(self, h: Sequence[float], minutes: float) -> float:
        """Return the standard deviation of what contains so much of each state, some minutes later."""
        variance = 0.0
        for i, row in enumerate(self.covariance):
            part = 0.0
            for j in range(i):
                part += row[j] * h[j]
            variance += h[i] * (2.0 * part + h[i] * (row[i] + minutes * self.growth[i]))
        return math.sqrt(max(variance, 0.0))

    def growth_of(self, h: Sequence[float]) -> float:
        """Return the growth of its variance, 1/min."""
        result = 0.0
        for growth, weight in zip(self.growth, h, strict=True):
            result += growth * weight * weight
        return result


def mixed(parts: Sequence[Mixture], probabilities: Sequence[float]) -> Mixture:
    """Return several as one; its covariance includes how far their means lie apart."""
    if len(parts) == 1:
        return parts[0]
    states = range(len(parts[0].mean))
    mean = [weighted(probabilities, [part.mean[i] for part in parts]) for i in states]
    covariance = [
        [
            weighted(
                probabilities,
                [part.covariance[i][j] + (part.mean[i] - mean[i]) * (part.mean[j] - mean[j]) for part in parts],
            )
            for j in range(i + 1)
        ]
        for i in states
    ]
    return Mixture(mean, covariance, [weighted(probabilities, [part.growth[i] for part in parts]) for i in states])


def weighted(weights: Sequence[float], values: Sequence[float]) -> float:
    """Return the sum of the products of weights and values."""
    result = 0.0
    for weight, value in zip(weights, values, strict=True):
        result += weight * value
    return result


def summed(values: Sequence[float]) -> float:
    """Return the sum of the values."""
    result = 0.0
    for value in values:
        result += value
    return result
