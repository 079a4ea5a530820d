"""Values of Y measured now and then that do not fit: a chip on the feature, another feature.

A single value is left out if all others, with the best explanation found without it, make it improbable by the noise
that is stated and the rest that is learned. What several values show, one after another, is no chip.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from compensator.arrays import Indices, Mask, Matrix, Vector
from compensator.codes import Remark
from compensator.data.chips import left_out, without
from compensator.data.runs import Run
from compensator.diagnose.fitting.fit import Fit, fit_terms
from compensator.diagnose.fitting.likelihood import Likelihood, dense, learned_rest
from compensator.diagnose.fitting.points import Points, SlowRest
from compensator.diagnose.residual.evidence import LEAST_VALUES, Evidence
from compensator.diagnose.search.findings import Findings, findings_of

#: A value so many deviations away from what the others predict is suspected; one so many away is left out.
SUSPECTED, IMPROBABLE = 3.0, 4.5
#: So many that are as far off as each other may be something that acts for less than the time between two values.
ALIKE = 3
#: Most values that are left out, as a share of all: more of them are something that acts.
MOST_SHARE = 0.1
#: A value that is left out may be anything: so many times the spread of the deformation.
ANYTHING = 100.0


def without_chips(
    found: Findings, evidence_without: Callable[[Sequence[Run]], Evidence]
) -> tuple[Findings, list[Remark]]:
    """Search again without the values that do not fit, and return what that finds with a remark on them.

    Parameters
    ----------
    found : Findings
        What was found with every value.
    evidence_without : callable
        Returns the evidence of runs.
    """
    evidence, points = found.search.evidence, found.search.points
    at = np.flatnonzero(evidence.used)
    most = min(max(1, int(MOST_SHARE * at.size)), at.size - LEAST_VALUES)
    better: Findings | None = found
    while better is not None:
        found, chips = better, np.flatnonzero(~_is_used(better, at)).tolist()
        better = _without_more(found, evidence_without, most - len(chips))
    if not chips:
        return found, []
    missed = _improbable(points, found.selection.fit, chips)[1]
    return found, [left_out(evidence.runs, _by_run(evidence, at[chips]), _alike(missed, _agree_um(points)))]


def _is_used(found: Findings, at: Indices) -> Mask:
    """Return which of some samples take part in what was found."""
    return np.asarray(found.search.evidence.used[at])


def _without_more(found: Findings, evidence_without: Callable[[Sequence[Run]], Evidence], most: int) -> Findings | None:
    """Return what is found without some values that do not fit; None if there are none, or too many."""
    evidence = found.search.evidence
    points, at = found.search.points, np.flatnonzero(evidence.used)
    for fit in _explanations(found):
        suspects = _suspects(fit, most)
        while suspects:
            again = findings_of(evidence_without(without(evidence.runs, _by_run(evidence, at[suspects]))))
            chips, _ = _improbable(points, again.selection.fit, suspects)
            if chips == suspects:
                return again
            suspects = chips
    return None


def _explanations(found: Findings) -> Iterator[Fit]:
    """Yield explanations that chips may have spoilt: a source without a channel takes chips for its times."""
    if any(not term.hypothesis.effect.observed for term in found.selection.fit.terms):
        yield found.search.run(unobserved=False).fit
    yield found.selection.fit
    yield found.selection.before


def _suspects(fit: Fit, most: int) -> list[int]:
    """Return the values that lie far from what all others predict, the worst first; none if there are too many."""
    points, found = fit.likelihood.points, list[int]()
    rest = fit.rest
    while True:
        columns = np.column_stack([fit.columns, _spikes(points, found)])
        away = _deviations(points, _precision(points, rest), columns, fit.fixed)[0]
        away[found] = 0.0
        worst = int(np.argmax(np.abs(away)))
        if abs(away[worst]) < SUSPECTED:
            return sorted(found)
        if len(found) == most:
            return []
        found.append(worst)
        rest = learned_rest(points, np.column_stack([columns, _spikes(points, [worst])]), fit.fixed, rest)


def _improbable(points: Points, fit: Fit, suspects: list[int]) -> tuple[list[int], Vector]:
    """Return which of some values are improbable by a fit without them, and how far all of them are off, µm.

    Those that agree with a suspect beside them are not.
    """
    whole = fit_terms(Likelihood(points, fit.rest), fit.starts(), evaluations=1)
    away, missed, precision = np.zeros(len(suspects)), np.zeros(len(suspects)), _precision(points, fit.rest)
    for k, one in enumerate(suspects):
        others = _spikes(points, [other for other in suspects if other != one])
        deviations, innovations = _deviations(points, precision, np.column_stack([whole.columns, others]), whole.fixed)
        away[k], missed[k] = deviations[one], innovations[one]
    agree = _agree_um(points)
    kept = []
    for k, one in enumerate(suspects):
        beside = [j for j, other in enumerate(suspects) if abs(other - one) == 1]
        if abs(away[k]) > IMPROBABLE and not any(abs(missed[j] - missed[k]) < agree for j in beside):
            kept.append(one)
    return kept, missed


def _agree_um(points: Points) -> float:
    """Return how far two values may be apart that show the same, µm."""
    return IMPROBABLE * math.sqrt(2.0) * points.evidence.probe_um


def _alike(missed: Vector, agree_um: float) -> str:
    """Return a sentence where several values that do not fit are equally far off."""
    if missed.size < ALIKE or np.ptp(missed) > agree_um:
        return ""
    return (
        f" All are off by about {np.mean(missed):+.0f} µm; an effect that lasts less than the time between two values "
        "looks the same."
    )


def _precision(points: Points, rest: SlowRest) -> Matrix:
    """Return the inverse of the values' covariance without effects."""
    table = dense(Likelihood(points, rest))
    return np.asarray(table.T @ table)


def _deviations(points: Points, precision: Matrix, columns: Matrix, fixed: Vector) -> tuple[Vector, Vector]:
    """Return how far each value is from what all others predict: in standard deviations, and in µm."""
    turned = precision @ columns
    inner = np.eye(columns.shape[1]) + columns.T @ turned
    precision = precision - turned @ np.linalg.solve(inner, turned.T)
    by_others, known = precision @ (points.residual - fixed), np.maximum(np.diag(precision), 1e-12)
    return by_others / np.sqrt(known), by_others / known


def _spikes(points: Points, values: Sequence[int]) -> Matrix:
    """Return a column for each of some values that lets it be anything."""
    table = np.zeros((points.count, len(values)))
    table[list(values), range(len(values))] = ANYTHING * points.spread_um
    return table


def _by_run(evidence: Evidence, at: Indices) -> list[Mask]:
    """Return a mask for each run of some samples of all runs, one after another."""
    chips = np.isin(np.arange(evidence.used.size), at)
    return np.split(chips, np.cumsum([run.t_s.size for run in evidence.runs])[:-1])
