"""How strongly measured Y speaks for one of two models: a regression of the changes of its residual.

With the residual r of the present model and the difference g of the two predictions,

    Δr = a + β Δg + u

β = 0: measured Y moves as the present model predicts; β = 1: as the other one. The mean squares of the two residuals
differ by the sum of g² (1 − 2 β), so the other model is the better one from β = ½ on.

Two measures of it, each as a number of standard deviations:

- `deviations`: (β − ½) / σ(β), against a model that is neither better nor worse;
- `likelihood`: √(2 log L), with L the likelihood of β = 1 over that of β = 0. If the present model is right, L has the
  expectation 1 however long and often one looks, so L ever exceeds e⁸, four deviations, in at most one of 3,000
  comparisons (Ville). A candidate that is right shows as much on a quarter of the values: its β is compared with 0, and
  not with ½. One that is as wrong as the present model may show it by chance, which the first measure tells.

Changes, not values: a sensor that was moved, or that creeps, shifts the values for hours, but it is one large change,
which is given little weight (Huber), or the constant a.

σ(β) counts effective values: consecutive products u Δg that resemble each other, with correlation ρ, count for
(1 − ρ) / (1 + ρ) each. The scale of u comes from the same n values, so the quotient is Student's t with n − 2 degrees
of freedom; it is stated as the normal deviation of the same probability: few values show less than they seem to. L is
the ratio of two densities of that distribution.

Source: Huber, Robust Statistics (1981), section 7; Bartlett (1946) for the effective number; Wallace, Ann. Math.
Statist. 30 (1959) for Student's t; Ville (1939), and Shafer, J. R. Statist. Soc. A 184 (2021), for betting on a model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Mask, Vector

#: A smaller change of a residual is no error of a machine tool, µm.
FLOOR_UM = 0.1
#: Deviations from which on a change counts less.
_HUBER = 2.0
_ITERATIONS = 20
#: Largest correlation that is assumed: so few values do not show a larger one.
_MOST_CORRELATED = 0.9
#: Normal standard deviation for a median of absolute values of 1.
_MEDIAN_TO_STD = 1.4826


@dataclass(frozen=True, slots=True)
class Evidence:
    """How strongly measured Y speaks for the other model.

    Parameters
    ----------
    deviations : float
        By how many standard deviations the other model is better; negative if the present one is.
    effective : float
        Number of independent values.
    ratio : float
        Root mean square of the changes of the other model's residual over that of the present one's, by the weights.
    likelihood : float
        √(2 log L) of the likelihood ratio L of the other model and the present one; negative if the present one is
        more likely.
    """

    deviations: float
    effective: float
    ratio: float = 1.0
    likelihood: float = 0.0


def evidence(residual_um: Vector, difference_um: Vector) -> Evidence:
    """Weigh two models by changes of Y.

    Parameters
    ----------
    residual_um : numpy.ndarray, shape (n,)
        Changes of measured − predicted by the present model, µm.
    difference_um : numpy.ndarray, shape (n,)
        Changes of the residual of the present model less that of the other one, µm.

    Returns
    -------
    Evidence
        Zero deviations where the models do not differ, or with fewer than three values.

    Examples
    --------
    >>> moves = np.array([1.0, -2.0, 3.0, -1.0, 2.0, -3.0, 1.0, -1.0])
    >>> evidence(moves, moves).deviations > 4.0, evidence(0.0 * moves, moves).deviations < -4.0
    (True, True)
    """
    n = residual_um.size
    weights = np.ones(n)
    if n < 3:
        return Evidence(0.0, float(n))
    for _ in range(_ITERATIONS):
        total = weights.sum()
        moves = difference_um - (difference_um * weights).sum() / total
        square = float(np.sum(weights * moves**2))
        if not square > 0.0:
            return Evidence(0.0, float(n))
        beta = float(np.sum(weights * moves * residual_um)) / square
        left = residual_um - beta * moves
        left = left - (left * weights).sum() / total
        sizes = np.abs(left)
        ordered = np.sort(sizes)
        median = 0.5 * float(ordered[(n - 1) // 2] + ordered[n // 2])
        scale = max(_MEDIAN_TO_STD * median, FLOOR_UM)
        before, weights = weights, np.minimum(1.0, _HUBER * scale / np.maximum(sizes, scale))
        if np.array_equal(before, weights):
            break  # what follows would be the same
    clipped = weights * left
    variance = max(float(np.sum(clipped**2)) / (n - 2), FLOOR_UM**2)
    effective = n * _independent(clipped * moves)
    own, other = (
        float(np.sum(weights * part**2)) + n * FLOOR_UM**2 for part in (residual_um, residual_um - difference_um)
    )
    std = math.sqrt(variance / square * n / effective)
    deviations, likelihood = _normal((beta - 0.5) / std, n - 2), _likelihood(beta, std, n - 2)
    return Evidence(deviations, effective, math.sqrt(other / own), likelihood)


def _normal(t: float, freedom: int) -> float:
    """Return the normal deviation with the probability of a value of Student's t, within 0.1 from 3 degrees on.

    Examples
    --------
    >>> round(_normal(5.0, 7), 2), round(_normal(-5.0, 10_000), 2)
    (3.15, -5.0)
    """
    size = math.sqrt(freedom * math.log1p(t * t / freedom)) * (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0)
    return math.copysign(size, t)


def _likelihood(beta: float, std: float, freedom: int) -> float:
    """Return √(2 log L) for the likelihoods of 1 and 0 at an estimate with Student's t.

    Examples
    --------
    >>> [round(_likelihood(*found), 2) for found in ((1.0, 0.25, 10_000), (0.5, 0.01, 8), (1.0, 0.25, 8))]
    [4.0, 0.0, 3.14]
    """
    against, with_it = (math.log1p((beta - value) ** 2 / (std**2 * freedom)) for value in (0.0, 1.0))
    doubled = (freedom + 1.0) * (against - with_it)
    return math.copysign(math.sqrt(abs(doubled)), doubled)


def _independent(products: Vector) -> float:
    """Return which part of the products counts as independent."""
    total = float(np.sum(products**2))
    correlation = float(np.sum(products[1:] * products[:-1])) / total if total > 0.0 else 0.0
    correlation = min(max(correlation, 0.0), _MOST_CORRELATED)
    return (1.0 - correlation) / (1.0 + correlation)


def followed(y_um: Vector, residual_um: Vector, difference_um: Vector, *, parts: int, deviations: float) -> Mask:
    """Return which changes are from a part in which measured Y follows one of the models.

    A dead sensor shows noise about a constant: against both models, no model is the better one.

    Parameters
    ----------
    y_um, residual_um, difference_um : numpy.ndarray, shape (n,)
        Changes of measured Y, and as in `evidence`, µm.
    parts : int
        Number of parts of equal size.
    deviations : float
        By how many standard deviations no model must be better than both.
    """
    found = np.zeros(y_um.size, dtype=bool)
    for part in np.array_split(np.arange(y_um.size), max(parts, 1)):
        y, residual = y_um[part], residual_um[part]
        predictions = (y - residual, y - residual + difference_um[part])
        found[part] = any(evidence(y, predicted).deviations > -deviations for predicted in predictions)
    return found
