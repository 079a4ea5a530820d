"""A bank of Kalman filters for what a model's deformation lacks: an offset, relative gains, zeros of features.

The filters differ in how fast the offset walks and in whether its level was known before the first value. Their
weights are how well they predicted the values. Only +, −, ·, / and square roots, in a fixed order: the same values
give the same bits on every machine.

Sources: Magill, Optimal adaptive estimation of sampled stochastic processes (1965): the bank; Herbster and Warmuth,
Tracking the best expert (1998): the share of the weights that is spread.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.model.correction.mixture import Mixture, summed, weighted

#: Walks of the offset, µm/√min, and how probable each is before the first value.
WALKS_UM = (0.02, 0.05, 0.12, 0.28, 0.67, 1.6)
WALK_WEIGHTS = tuple(1.0 / math.sqrt(w) / sum(1.0 / math.sqrt(v) for v in WALKS_UM) for w in WALKS_UM)
#: Standard deviation of the offset before the first value, µm: the machine was zeroed, or the level is anything.
LEVELS_UM = (3.0, 1000.0)
#: Standard deviation of the zero of a further feature before its first value, µm.
ZERO_STD_UM = 1000.0
#: Share of the weights of the walks that returns to `WALK_WEIGHTS` at each value, so that a change is found.
FORGETTING = 0.005
#: How often a value is wrong (a chip, another feature), and by about how much, µm.
WRONG_SHARE, WRONG_UM = 0.05, 20.0
#: Degrees of freedom of the t distributions; with 15 their densities need an eighth power only.
FREEDOM = 15

_GROUPS = range(0, len(WALKS_UM) * len(LEVELS_UM), len(WALKS_UM))
#: Number of filters: the walks for one level, then for the next.
SIZE = len(WALKS_UM) * len(LEVELS_UM)


@dataclass(frozen=True, slots=True)
class Observation:
    """A measured value.

    Parameters
    ----------
    h : list of float, length n
        How much of each state it contains.
    value_um, std_um : float
        The value beyond the free run, and its standard deviation, µm.
    age_min : float
        How long ago it was measured, when the offset had not walked as far yet, min.
    """

    h: list[float]
    value_um: float
    std_um: float
    age_min: float = 0.0


@dataclass(frozen=True, slots=True)
class Weighing:
    """How probable a value is, and how probable it makes each filter.

    Parameters
    ----------
    right : float
        Probability that the value is right.
    density : float
        Probability density of the value before it was measured, but for a factor that is common to all banks.
    weights : list of float, length SIZE
        Weights of the filters after it.
    """

    right: float
    density: float
    weights: list[float]


@dataclass(frozen=True, slots=True)
class _Innovations:
    """The innovation of each filter.

    Parameters
    ----------
    value : numpy.ndarray, shape (SIZE,)
        The measured value less the expected one, µm.
    variance : numpy.ndarray, shape (SIZE,)
        Its variance, µm².
    covariance : numpy.ndarray, shape (SIZE, n)
        Covariance of the states with it, P h.
    """

    value: Vector
    variance: Vector
    covariance: Matrix

    def each(self) -> list[tuple[float, float]]:
        """Return value and variance of each filter."""
        return list(zip(self.value.tolist(), self.variance.tolist(), strict=True))


class KalmanBank:
    """Kalman filters with the states offset, gains, zeros.

    Parameters
    ----------
    gain_stds, gain_walks : sequence of float
        Standard deviation of each relative gain before the first value, and its walk, 1/√min.

    Attributes
    ----------
    x : numpy.ndarray, shape (SIZE, n)
        States of each filter: offset, µm; gains, 1; zeros, µm.
    P : numpy.ndarray, shape (SIZE, n, n)
        Their covariance.
    walks : numpy.ndarray, shape (SIZE, n)
        Growth of their variance, 1/min.
    weights, mean_weights : list of float, length SIZE
        Probability of each filter, and the same for the mean, which a refused value must not move.
    """

    def __init__(self, gain_stds: Sequence[float], gain_walks: Sequence[float]) -> None:
        n = 1 + len(gain_stds)
        self.x: Matrix = np.zeros((SIZE, n))
        self.P: Matrix = np.zeros((SIZE, n, n))
        self.P[:, np.arange(1, n), np.arange(1, n)] = np.array(gain_stds) ** 2
        self.P[:, 0, 0] = np.repeat(LEVELS_UM, len(WALKS_UM)) ** 2
        self.walks = np.tile(np.array([0.0, *gain_walks]) ** 2, (SIZE, 1))
        self.walks[:, 0] = np.tile(WALKS_UM, len(LEVELS_UM)) ** 2
        self.weights = [weight / len(LEVELS_UM) for _ in LEVELS_UM for weight in WALK_WEIGHTS]
        self.mean_weights = list(self.weights)

    def add_zero(self) -> None:
        """Add the zero of a further feature."""
        n = self.x.shape[1]
        self.x = np.pad(self.x, ((0, 0), (0, 1)))
        self.P = np.pad(self.P, ((0, 0), (0, 1), (0, 1)))
        self.P[:, n, n] = ZERO_STD_UM**2
        self.walks = np.pad(self.walks, ((0, 0), (0, 1)))

    def advance(self, minutes: float) -> None:
        """Let the states walk for a time, min."""
        states = np.arange(self.x.shape[1])
        self.P[:, states, states] += minutes * self.walks

    # ------------------------------------------------------------------ a value

    def innovation(self, observation: Observation) -> tuple[float, float]:
        """Return the innovation of the whole bank, µm, and its variance, µm²."""
        each = self._innovations(observation).each()
        mean = weighted(self.mean_weights, [value for value, _ in each])
        return mean, weighted(self.weights, [variance + (value - mean) ** 2 for value, variance in each])

    def weigh(self, observation: Observation) -> Weighing:
        """Return how probable a value is, and how probable it makes each filter.

        A wrong value is further off by about `WRONG_UM`. Where it is more probably wrong, the walks that allow it
        gain weight all the same: what moved may be the machine.
        """
        return self._weigh(self._innovations(observation))

    def correct(self, observation: Observation) -> None:
        """Correct every filter by a value, and the weights."""
        innovations = self._innovations(observation)
        self._correct_states(innovations)
        self.weights = self._weigh(innovations).weights
        self.mean_weights = list(self.weights)

    def correct_by_wrong(self, observation: Observation) -> None:
        """Correct as by a value that is known to be wrong: with `WRONG_UM` in its standard deviation."""
        innovations = self._innovations(replace(observation, std_um=math.hypot(observation.std_um, WRONG_UM)))
        self._correct_states(innovations)
        found = [weight * _density(*each) for weight, each in zip(self.weights, innovations.each(), strict=True)]
        total = summed(found)
        if total > 0.0:  # Else it was so far off that no density is left.
            self.weights = [weight / total for weight in found]
        self.mean_weights = list(self.weights)

    def widen(self, jump_um: float, zero: int | None = None) -> None:
        """Admit that the offset may have moved, and that its walk is not known any more.

        Parameters
        ----------
        jump_um : float
            How far, µm.
        zero : int, optional
            The state of a zero that is unknown again.
        """
        self.P[:, 0, 0] += jump_um**2
        if zero is not None:
            self.P[:, zero, zero] += ZERO_STD_UM**2
        self.weights = _spread(self.weights, 1.0)

    def _innovations(self, observation: Observation) -> _Innovations:
        value = np.full(SIZE, observation.value_um)
        covariance = np.zeros_like(self.x)
        for i, weight in enumerate(observation.h):
            value = value - weight * self.x[:, i]
            covariance = covariance + weight * self.P[:, :, i]
        variance = observation.std_um**2 + observation.age_min * self.walks[:, 0]
        for i, weight in enumerate(observation.h):
            variance = variance + weight * covariance[:, i]
        return _Innovations(value, variance, covariance)

    def _weigh(self, innovations: _Innovations) -> Weighing:
        right, wrong, found = 0.0, 0.0, []
        for weight, (innovation, variance) in zip(self.weights, innovations.each(), strict=True):
            as_right = (1.0 - WRONG_SHARE) * _density(innovation, variance)
            as_wrong = WRONG_SHARE * _density(innovation, variance + WRONG_UM**2)
            right += weight * as_right
            wrong += weight * as_wrong
            found.append(weight * (as_right + as_wrong))
        total = right + wrong
        if total == 0.0:  # So far off that no density is left.
            return Weighing(0.0, 0.0, list(self.weights))
        return Weighing(right / total, total, _spread([value / total for value in found], FORGETTING))

    def _correct_states(self, innovations: _Innovations) -> None:
        gain = innovations.covariance / innovations.variance[:, None]
        self.x = self.x + gain * innovations.value[:, None]
        self.P = self.P - gain[:, :, None] * innovations.covariance[:, None, :]
        self.P = 0.5 * (self.P + self.P.transpose(0, 2, 1))

    # ------------------------------------------------------------------ what is known

    def mixture(self, n: int, *, zeroed: bool) -> Mixture:
        """Return what is known of the first `n` states.

        Parameters
        ----------
        n : int
            How many.
        zeroed : bool
            Whether no value has come since the zero: the offset is that of the machine then, which was zeroed, and
            not the level of the values, which may be any.
        """
        mean_weights, weights = self.mean_weights, self.weights
        if zeroed:
            mean_weights, weights = _of_zeroed(mean_weights), _of_zeroed(weights)
        x, p, walks = self.x.tolist(), self.P.tolist(), self.walks.tolist()
        means = [weighted(mean_weights, [row[i] for row in x]) for i in range(n)]
        covariance = [
            [
                weighted(weights, [p[k][i][j] + (x[k][i] - means[i]) * (x[k][j] - means[j]) for k in range(SIZE)])
                for j in range(i + 1)
            ]
            for i in range(n)
        ]
        return Mixture(means, covariance, [weighted(weights, [row[i] for row in walks]) for i in range(n)])

    def weights_of_walks(self) -> list[float]:
        """Return the weights with each walk's as it is, and every level as probable as before the first value."""
        found = []
        for walk in range(len(WALKS_UM)):
            found.append(summed([self.weights[start + walk] for start in _GROUPS]) / len(LEVELS_UM))
        return found * len(LEVELS_UM)

    # ------------------------------------------------------------------ state

    def copy(self) -> KalmanBank:
        """Return a bank in the same state."""
        found = KalmanBank((), ())
        found.x, found.P, found.walks = self.x.copy(), self.P.copy(), self.walks.copy()
        found.weights, found.mean_weights = list(self.weights), list(self.mean_weights)
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the state, for JSON."""
        return {
            "weights": list(self.weights),
            "mean_weights": list(self.mean_weights),
            "states": self.x.tolist(),
            "covariances": self.P.tolist(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from what `to_dict` of a bank with the same states returned.

        Raises
        ------
        ValueError
            If it has other states, or a number is missing.
        """
        weights, mean_weights = ([float(weight) for weight in state[key]] for key in ("weights", "mean_weights"))
        x, p = np.array(state["states"], dtype=float), np.array(state["covariances"], dtype=float)
        if (x.shape, p.shape, len(weights), len(mean_weights)) != (self.x.shape, self.P.shape, SIZE, SIZE):
            raise ValueError(f"{len(weights)} filters with states of shape {x.shape}, expected {self.x.shape}")
        if not (np.isfinite(x).all() and np.isfinite(p).all() and all(map(math.isfinite, weights + mean_weights))):
            raise ValueError("a number is missing or not finite")
        self.x, self.P, self.weights, self.mean_weights = x, p, weights, mean_weights


def _of_zeroed(weights: Sequence[float]) -> list[float]:
    """Return weights of the filters that knew the level, with those of the others added to them."""
    found = [0.0] * SIZE
    for k, weight in enumerate(weights):
        found[k % len(WALKS_UM)] += weight
    return found


def _spread(weights: Sequence[float], share: float) -> list[float]:
    """Return weights of which a share has returned to `WALK_WEIGHTS`; those of the levels are kept."""
    found = []
    for start in _GROUPS:
        group = weights[start : start + len(WALKS_UM)]
        total = summed(group)
        found += [(1.0 - share) * w + share * total * own for w, own in zip(group, WALK_WEIGHTS, strict=True)]
    return found


def _density(innovation: float, variance: float) -> float:
    """Return a t distribution's density but for a factor that is common to all."""
    tail = 1.0 + innovation * innovation / (FREEDOM * variance)
    squared = tail * tail
    fourth = squared * squared
    return 1.0 / (math.sqrt(variance) * fourth * fourth)
