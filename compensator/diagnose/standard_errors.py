"""Standard errors of everything that effects are named by; of the time of a step, as few values know it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fit import Fit, Term, fit_terms, summed
from compensator.diagnose.likelihood import Likelihood

#: The parameter that is a time.
AT = "at_min"


def standard_errors(fit: Fit) -> list[dict[str, float]]:
    """Return the standard error of everything that each effect is named by.

    Where the calibration states no error of the base's paths, none is counted.
    """
    natural = np.array([v for term in fit.terms for v in (*term.values, *term.amplitudes)])
    if natural.size == 0:
        return []
    points, rest = fit.likelihood.points, fit.rest
    likelihood = Likelihood(points, rest.without_own_error()) if points.is_exact else fit.likelihood

    def moved(values: Vector) -> list[Term]:
        one = iter(values.tolist())
        return [
            dataclasses.replace(
                term,
                values=tuple(itertools.islice(one, len(term.values))),
                amplitudes=tuple(itertools.islice(one, len(term.amplitudes))),
            )
            for term in fit.terms
        ]

    def predicted(values: Vector) -> Vector:
        total = summed(likelihood.points.evidence, moved(values))
        return likelihood.projected(likelihood.points.averaged(total[:, None]))[:, 0]

    def named(values: Vector) -> Vector:
        return np.array([v for term in moved(values) for v in term.named.values()])

    steps = 1e-3 * np.abs(natural) + 1e-9
    jacobian = _slopes(predicted, natural, steps)
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    inverse = vt.T / np.maximum(s, 1e-7 * s[0]) / scale[:, None]
    spread = _slopes(named, natural, steps) @ inverse
    errors = iter(np.sqrt(np.maximum(np.einsum("ij,ij->i", spread, spread), 0.0)).tolist())
    return [dict(zip(term.named, errors, strict=False)) for term in fit.terms]


def _slopes(function: Callable[[Vector], Vector], at: Vector, steps: Vector) -> Matrix:
    """Return the derivatives of a function by each of its arguments, shape (values, arguments)."""
    columns = []
    for i, step in enumerate(steps.tolist()):
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
