"""Standard errors of everything that effects are named by; of the time of a step, as few values know it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fit import Fit, Term, fit_terms, response, summed
from compensator.diagnose.likelihood import Likelihood

#: The parameter that is a time.
AT = "at_min"


def standard_errors(fit: Fit) -> list[dict[str, float]]:
    """Return the standard error of everything that each effect is named by.

    Where the calibration states no error of the base's paths, none is counted.
    """
    if not fit.terms:
        return []
    points = fit.likelihood.points
    exact = Likelihood(points, fit.rest.without_own_error()) if points.is_exact else fit.likelihood

    def named(values: Vector) -> Vector:
        return np.array([v for term in _moved(fit, values) for v in term.named.values()])

    spread = _slopes(named, _values(fit)) @ _root(fit, exact)
    errors = iter(np.sqrt(np.maximum(np.einsum("ij,ij->i", spread, spread), 0.0)).tolist())
    return [dict(zip(term.named, errors, strict=False)) for term in fit.terms]


def deviations(fit: Fit) -> list[tuple[float, float]]:
    """Return what each effect moves, and how well that is known whatever the others do, standard deviations, µm.

    Two effects may be known together and not apart: then each has an error of its own that the other makes up for, in
    this record and not on another day.
    """
    points, found = fit.likelihood.points, []
    root = _root(fit, fit.likelihood)
    for i in range(len(fit.terms)):

        def added(values: Vector, i: int = i) -> Vector:
            columns = response(points.evidence, _moved(fit, values)[i])
            return points.averaged(columns[:, None])[:, 0]

        spread = _slopes(added, _values(fit)) @ root
        found.append((float(np.std(added(_values(fit)))), float(np.sqrt(np.sum(np.var(spread, axis=0))))))
    return found


def _root(fit: Fit, likelihood: Likelihood) -> Matrix:
    """Return a root of the covariance of all parameters: searched ones and amplitudes of each effect in turn."""

    def predicted(values: Vector) -> Vector:
        total = summed(likelihood.points.evidence, _moved(fit, values))
        return likelihood.projected(likelihood.points.averaged(total[:, None]))[:, 0]

    jacobian = _slopes(predicted, _values(fit))
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    return np.asarray(vt.T / np.maximum(s, 1e-7 * s[0]) / scale[:, None])


def _values(fit: Fit) -> Vector:
    return np.array([v for term in fit.terms for v in (*term.values, *term.amplitudes)])


def _moved(fit: Fit, values: Vector) -> list[Term]:
    """Return the terms of a fit with other values of all parameters."""
    one = iter(values.tolist())
    return [
        dataclasses.replace(
            term,
            values=tuple(itertools.islice(one, len(term.values))),
            amplitudes=tuple(itertools.islice(one, len(term.amplitudes))),
        )
        for term in fit.terms
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
    evidence, begins, ends, first = fit.likelihood.points.evidence, [], [], 0
    for record in evidence.signals:
        minutes = (record.begins_min + record.minutes)[evidence.used[first : first + record.size]]
        begins.append(minutes[:-1])
        ends.append(minutes[1:])
        first += record.size
    return np.concatenate(begins), np.concatenate(ends)
