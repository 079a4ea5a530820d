"""A record with a test after it: the expected change of the logarithm of the evidence by the test.

Both explanations, as fitted to the record, predict the test. What they leave unknown (their parameters, the error of
the base's paths, zero and initial state, slow rest, noise) has the distribution that the record leaves it. With the
difference *d* of the predictions and the covariance *S* of the second one, the first, if it is true, gains

    E[Δ log p] ≈ ½ dᵀ S⁻¹ d

on average. Either may be true, so the smaller one of both directions counts.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.linalg import block_diag

from compensator.arrays import Indices, Matrix, Vector
from compensator.diagnose.advice.trials import Trial
from compensator.diagnose.fitting.fit import Fit, Term
from compensator.diagnose.fitting.points import Points, SlowRest, raw_columns
from compensator.diagnose.fitting.whitening import Whitening
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.residual.nuisances import decays_of

#: Durations of a test that are looked at, with the rest before it, h.
HOURS = (1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 16.0, 24.0)
#: Step of a searched parameter, as a share of its value.
STEP = 1e-2
#: What happened once does not come again by itself in a test.
ONCE = ("jump", "settling")


class RecordWithTest:
    """A record with a test after it.

    Parameters
    ----------
    evidence : Evidence
        The record.
    trial : Trial
        The test.
    every_min : float
        Time between two values of Y in the test, min; 0: every sample.
    """

    def __init__(self, evidence: Evidence, trial: Trial, every_min: float) -> None:
        n, period_min = trial.signals.size, evidence.context.period_min
        samples = max(1, round(every_min / period_min)) if every_min else 1
        #: Whole samples, as the probes of the test are.
        self.every_min = samples * period_min if every_min else 0.0
        measured = (np.arange(n) + 1) % samples == 0
        self.evidence = dataclasses.replace(
            evidence,
            signals=(*evidence.signals, trial.signals),
            residual=np.concatenate([evidence.residual, np.zeros(n)]),
            used=np.concatenate([evidence.used, measured]),
            zeros=np.asarray(block_diag(evidence.zeros, np.ones((n, 1)))),
            decays=np.asarray(block_diag(evidence.decays, decays_of(trial.signals, evidence.context))),
            noise=dataclasses.replace(evidence.noise, count=evidence.count + int(measured.sum())),
        )
        self.points = Points(self.evidence)
        # A test that is shorter than the time between two probes has no point.
        self.before = int(np.searchsorted(self.points.first, evidence.used.size))
        self.ends = values_within(np.array(HOURS), self.every_min or self.points.period_min)
        self._known: dict[int, tuple[Fit, Vector, Matrix, Matrix]] = {}

    def change(self, first: Fit, second: Fit) -> Vector:
        """Return the expected change of the logarithm of the evidence after each of the durations."""
        views = [self._prediction(fit, first.rest) for fit in (first, second)]
        d = views[0][0] - views[1][0]
        both = [expected_change(d, table, precision, self.ends) for _, table, precision in views]
        return np.minimum(*both)

    def change_by(self, fit: Fit, course: Vector) -> Vector:
        """Return the same for what a source adds to the test, beside a fit without it."""
        begin = self.evidence.used.size - course.size
        added = self.points.averaged(np.concatenate([np.zeros(begin), course])[:, None])
        d = Whitening(self.points, fit.rest).of(added)[self.before :, 0]
        _, table, precision = self._prediction(fit, fit.rest)
        return expected_change(d, table, precision, self.ends)

    def _prediction(self, fit: Fit, rest: SlowRest) -> tuple[Vector, Matrix, Matrix]:
        """Return the mean of the test, columns of what stays unknown in it, and their precision after the record."""
        known = self._known.get(id(fit))
        if known is None or known[0] is not fit:
            added, slopes = self._response(fit)
            table = np.column_stack([self.points.residual - added, added, self.points.random(rest), slopes])
            white = Whitening(self.points, rest).of(table)
            seen, test = white[: self.before], white[self.before :]
            precision = np.eye(white.shape[1] - 2) + seen[:, 2:].T @ seen[:, 2:]
            mean = test[:, 1] + test[:, 2:] @ np.linalg.solve(precision, seen[:, 2:].T @ seen[:, 0])
            known = self._known[id(fit)] = (fit, mean, test[:, 2:], precision)
        return known[1:]

    def _response(self, fit: Fit) -> tuple[Vector, Matrix]:
        """Return what a fit adds to record and test, and its slopes by every parameter, averaged to points."""
        total, columns = np.zeros(self.evidence.used.size), [np.zeros((self.evidence.used.size, 0))]
        for term in fit.terms:
            added, slopes = self._slopes(term)
            if term.hypothesis.form in ONCE:
                begin = sum(record.size for record in self.evidence.signals[:-1])
                added[begin:], slopes[begin:] = 0.0, 0.0
            total = total + added
            columns.append(slopes)
        table = self.points.averaged(np.column_stack([total, *columns]))
        return table[:, 0], table[:, 1:]

    def _slopes(self, term: Term) -> tuple[Vector, Matrix]:
        """Return the response of a term, and its change by each of its parameters within what is usual before data."""

        def response(values: tuple[float, ...]) -> tuple[Vector, Matrix]:
            table = raw_columns(self.evidence, term.hypothesis, values)
            added = table @ np.array(term.amplitudes) if term.amplitudes else table[:, 0]
            return np.array(added), table

        added, table = response(term.values)
        columns = []
        if term.amplitudes:
            spread = np.maximum(np.std(table, axis=0), 1e-12)
            columns.append(table * (self.points.spread_um / spread))
        for i, value in enumerate(term.values):
            step = STEP * max(abs(value), 1e-6)
            moved = tuple(v + step if i == k else v for k, v in enumerate(term.values))
            columns.append(((response(moved)[0] - added) / STEP)[:, None])
        return added, np.concatenate(columns, axis=1) if columns else np.zeros((added.size, 0))


def values_within(hours: Vector, every_min: float) -> Indices:
    """Return how many values of Y are measured by the end of tests, the first one as the first interval ends.

    Parameters
    ----------
    hours : numpy.ndarray, shape (durations,)
        Durations of the tests, h.
    every_min : float
        Time between two values, min.

    Examples
    --------
    >>> values_within(np.array([0.9, 1.5, 2.0, 4.0]), 60.0)
    array([0, 1, 2, 4])
    """
    # 0.7 h are 42 min, whatever rounding makes of it.
    return np.asarray(np.floor(hours * 60.0 / every_min + 1e-9), dtype=np.intp)


def expected_change(d: Vector, table: Matrix, precision: Matrix, ends: Indices) -> Vector:
    """Return ½ dᵀ S⁻¹ d with S = 1 + T P⁻¹ Tᵀ, over the first points of a test.

    Parameters
    ----------
    d : numpy.ndarray, shape (points,)
        Difference of the predictions, whitened.
    table : numpy.ndarray, shape (points, k)
        T: whitened columns of what stays unknown in the test.
    precision : numpy.ndarray, shape (k, k)
        P: its precision after the record.
    ends : numpy.ndarray of int, shape (durations,)
        How many points each duration has.
    """
    found = []
    for end in ends.tolist():
        some, part = table[:end], d[:end]
        moment = some.T @ part
        found.append(0.5 * float(part @ part - moment @ np.linalg.solve(precision + some.T @ some, moment)))
    return np.array(found)
