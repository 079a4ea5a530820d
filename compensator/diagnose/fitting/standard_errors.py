"""Standard errors of everything that effects are named by; of the time of a step, as few values know it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fitting.fit import Fit, Term, fit_terms, response, summed
from compensator.diagnose.fitting.likelihood import Likelihood

#: The parameter that is a time.
AT = "at_min"
#: Directions of less than this share of the variance of y in the record are not stated.
UNSTATED = 0.001


def standard_errors(fit: Fit) -> list[dict[str, float]]:
    """Return the standard error of everything that each effect is named by.

    Where the calibration states no error of the base's paths, none is counted.
    """
    if not fit.terms:
        return []
    points = fit.likelihood.points
    exact = Likelihood(points, fit.rest.without_own_error()) if points.is_exact else fit.likelihood

    def named(values: Vector) -> Vector:
        return np.array([v for term in _moved(fit.terms, values) for v in term.named.values()])

    spread = _slopes(named, _values(fit.terms)) @ _root(exact, _added_slopes(fit))
    errors = iter(np.sqrt(np.maximum(np.einsum("ij,ij->i", spread, spread), 0.0)).tolist())
    return [dict(zip(term.named, errors, strict=False)) for term in fit.terms]


def deviations(fit: Fit) -> list[tuple[float, float]]:
    """Return what each effect moves, and how well that is known whatever the others do, standard deviations, µm.

    Two effects may be known together and not apart: then each has an error of its own that the other makes up for, in
    this record and not on another day.
    """
    points, slopes, found, first = fit.likelihood.points, _added_slopes(fit), [], 0
    root = _root(fit.likelihood, slopes)
    for term in fit.terms:
        own = slice(first, first + len(term.values) + len(term.amplitudes))
        moves = points.averaged(response(points.evidence, term)[:, None])
        spread = slopes[:, own] @ root[own]
        found.append((float(np.std(moves)), float(np.sqrt(np.sum(np.var(spread, axis=0))))))
        first = own.stop
    return found


def std_factors(fit: Fit, terms: Sequence[Term], *, beside_own_error: bool) -> list[tuple[tuple[float, ...], ...]]:
    """Return the rows of `Effect.std_factor` of each effect: how all of them may differ together.

    The directions are those that move y most in this record, so that few rows say nearly all.

    Parameters
    ----------
    fit : Fit
        What the data say of all parameters.
    terms : sequence of Term
        Its effects as the engine runs them, where that refitted them.
    beside_own_error : bool
        Whether the own error is deployed beside them and states what is open of it. What one of them has too much the
        other lacks, so that both are known together: what is open of effects is then that beside an own error as it is.
    """
    if not terms:
        return []
    points, spread = fit.likelihood.points, fit.likelihood.points.evidence.spread_um
    likelihood = Likelihood(points, fit.rest.without_own_error()) if beside_own_error else fit.likelihood
    slopes = _added_slopes(fit)
    free = [one for term in fit.terms for one in (*term.hypothesis.free, *[None] * len(term.amplitudes))]
    # What the data leave wholly open is known as well as before them.
    moves = np.std(slopes, axis=0)
    prior = [
        spread / move if one is None else (one.high - one.low) * math.sqrt(1.0 / 12.0)
        for one, move in zip(free, np.maximum(moves, 1e-9 * spread).tolist(), strict=True)
    ]
    root = _root(likelihood, slopes, np.array(prior))
    _, sizes, directions = np.linalg.svd(slopes @ root, full_matrices=False)
    count = int(np.searchsorted(np.cumsum(sizes**2), (1.0 - UNSTATED) * float(sizes @ sizes))) + 1
    deployed = _values(terms)
    rows: list[list[tuple[float, ...]]] = [[] for _ in terms]
    for step in (root @ directions[:count].T).T:
        inside = [
            v if one is None else min(max(v, one.low), one.high)
            for one, v in zip(free, (deployed + step).tolist(), strict=True)
        ]
        for found, term, moved in zip(rows, terms, _moved(terms, np.array(inside)), strict=True):
            found.append(tuple(b - a for a, b in zip(term.effect.parameters, moved.effect.parameters, strict=True)))
    return [tuple(found) for found in rows]


def _added_slopes(fit: Fit) -> Matrix:
    """Return by how much all effects together move each point with each parameter, shape (points, parameters)."""
    points = fit.likelihood.points

    def added(values: Vector) -> Vector:
        return points.averaged(summed(points.evidence, _moved(fit.terms, values))[:, None])[:, 0]

    return _slopes(added, _values(fit.terms))


def _root(likelihood: Likelihood, slopes: Matrix, prior: Vector | None = None) -> Matrix:
    """Return a root of the covariance of all parameters: searched ones and amplitudes of each effect in turn.

    With the standard deviation that each had before the data, where it is given.
    """
    jacobian = likelihood.projected(slopes)
    if prior is not None:
        jacobian = np.concatenate([jacobian, np.diag(1.0 / prior)])
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    # Where no parameter moves a point, all are open: a time between two values.
    return np.asarray(vt.T / np.maximum(s, 1e-7 * max(s[0], 1.0)) / scale[:, None])


def _values(terms: Sequence[Term]) -> Vector:
    return np.array([v for term in terms for v in (*term.values, *term.amplitudes)])


def _moved(terms: Sequence[Term], values: Vector) -> list[Term]:
    """Return terms with other values of all parameters."""
    one = iter(values.tolist())
    return [
        dataclasses.replace(
            term,
            values=tuple(itertools.islice(one, len(term.values))),
            amplitudes=tuple(itertools.islice(one, len(term.amplitudes))),
        )
        for term in terms
    ]


def _slopes(function: Callable[[Vector], Vector], at: Vector) -> Matrix:
    """Return the derivatives of a function by each of its arguments, shape (values, arguments)."""
    columns = []
    for i, step in enumerate((1e-3 * np.abs(at) + 1e-9).tolist()):
        above, below = at.copy(), at.copy()
        above[i] += step
        below[i] -= step
        columns.append((function(above) - function(below)) / (2.0 * step))
    return np.stack(columns, axis=1)


def with_time_errors(fit: Fit, errors: list[dict[str, float]]) -> list[dict[str, float]]:
    """Return standard errors with those of times as few values know them.

    Between two values the time of a step changes nothing, so a slope says nothing of it: every interval is tried.
    """
    return [{**error, AT: _time_error(fit, i, error[AT])} if AT in error else error for i, error in enumerate(errors)]


def time_words(std: Mapping[str, float], every_min: float) -> str:
    """Return the sentence on the time of an effect; empty where it has none."""
    if AT not in std:
        return ""
    return f" Its time is known to ± {std[AT]:.0f} min: values lie {every_min:g} min apart."


def _time_error(fit: Fit, index: int, by_slope: float) -> float:
    """Return the standard error of the time of one term, min."""
    points = fit.likelihood.points
    begins, ends = _intervals(fit)
    free = [one.name for one in fit.terms[index].hypothesis.free]
    if AT not in free or not begins.size:
        return by_slope
    middles, fits = 0.5 * (begins + ends), []
    for at in middles.tolist():
        starts = fit.starts()
        hypothesis, values = starts[index]
        starts[index] = hypothesis, tuple(at if name == AT else v for name, v in zip(free, values, strict=True))
        fits.append(fit_terms(fit.likelihood, starts, evaluations=1).log_evidence)
    weights = np.exp(np.array(fits) - max(fits)) * (ends - begins)
    weights /= weights.sum()
    mean = float(weights @ middles)
    variance = float(weights @ ((middles - mean) ** 2 + (ends - begins) ** 2 / 12.0))
    return math.sqrt(max(variance, points.period_min**2 / 12.0))


def _intervals(fit: Fit) -> tuple[Vector, Vector]:
    """Return begin and end of every interval between two values of a run, min after the start of the first run."""
    evidence, begins, ends = fit.likelihood.points.evidence, [], []
    for record, run in zip(evidence.signals, evidence.samples_of_runs(), strict=True):
        minutes = (record.begins_min + record.minutes)[evidence.used[run]]
        begins.append(minutes[:-1])
        ends.append(minutes[1:])
    return np.concatenate(begins), np.concatenate(ends)
