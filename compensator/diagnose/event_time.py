"""How well values measured now and then know the time of a step: no better than the time between two of them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.fit import Fit, fit_terms

#: The parameter that is a time.
AT = "at_min"


def with_time_errors(fit: Fit, errors: list[dict[str, float]]) -> list[dict[str, float]]:
    """Return standard errors with those of times as few values know them.

    Between two values the time of a step changes nothing, so a slope says nothing of it: every interval is tried.
    """
    return [{**error, AT: _time_error(fit, i, error[AT])} if AT in error else error for i, error in enumerate(errors)]


def words_of(std: Mapping[str, float], every_min: float) -> str:
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
