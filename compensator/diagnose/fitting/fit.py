"""Several effects fitted together: free parameters searched, amplitudes integrated out."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fitting.descent import least_squares
from compensator.diagnose.fitting.likelihood import Likelihood, factor_of, factored, learned_rest, log_det_of, solution
from compensator.diagnose.fitting.points import Points, SlowRest, raw_columns
from compensator.diagnose.residual.evidence import Evidence
from compensator.model.effects import Effect
from compensator.model.effects.hypothesis import Free, Hypothesis, Place, place_in_words

Start = tuple[Hypothesis, Sequence[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """A hypothesis with values.

    Parameters
    ----------
    hypothesis : Hypothesis
        What acts.
    values : tuple of float
        Its free parameters.
    amplitudes : tuple of float
        Its linear parameters.
    """

    hypothesis: Hypothesis
    values: tuple[float, ...]
    amplitudes: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        """Kind, path and channel in words."""
        return place_in_words(self.hypothesis.place)

    @property
    def effect(self) -> Effect:
        """The effect with its parameters."""
        return self.hypothesis.with_values(self.values, self.amplitudes)

    @property
    def named(self) -> dict[str, float]:
        """Every parameter by name."""
        return self.hypothesis.named(self.values, self.amplitudes)

    @property
    def start(self) -> Start:
        """Where another fit of it begins."""
        return self.hypothesis, self.values


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """Effects fitted together.

    Parameters
    ----------
    terms : tuple of Term
        Effects with their values.
    likelihood : Likelihood
        The data and the rest that they were fitted with.
    log_evidence : float
        Logarithm of the probability of the data, parameters and amplitudes integrated out.
    columns : numpy.ndarray, shape (points, ·)
        Averaged columns of all amplitudes, of size 1.
    fixed : numpy.ndarray, shape (points,)
        What effects without an amplitude add, µm.
    added : numpy.ndarray, shape (points,)
        What all effects add, µm.
    """

    terms: tuple[Term, ...]
    likelihood: Likelihood
    log_evidence: float
    columns: Matrix
    fixed: Vector
    added: Vector

    @property
    def rest(self) -> SlowRest:
        """What no effect explains."""
        return self.likelihood.rest

    @property
    def places(self) -> frozenset[Place]:
        """Kind, path and channel of each effect."""
        return frozenset(term.hypothesis.place for term in self.terms)

    def index_of(self, place: Place) -> int | None:
        """Return which effect has a place; None without one. One that was exchanged stands at the end."""
        return next((i for i, term in enumerate(self.terms) if term.hypothesis.place == place), None)

    @property
    def forms(self) -> frozenset[str]:
        """Place and form of each effect."""
        return frozenset(term.hypothesis.label for term in self.terms)

    @property
    def log_evidence_as_it_is(self) -> float:
        """Logarithm of the probability of the data with the effects as they are, nothing of them integrated out."""
        left = self.likelihood.left_by(self.added)
        return self.likelihood.log_prior - 0.5 * (float(left @ left) + self.likelihood.log_det)

    def projected(self, likelihood: Likelihood) -> tuple[Matrix, Vector]:
        """Return the columns of the amplitudes, and the data without what has none, as a likelihood projects them."""
        return likelihood.projected(self.columns), likelihood.left_by(self.fixed)

    def solved(self, likelihood: Likelihood) -> tuple[Matrix, Matrix, Vector]:
        """Return the projected columns of the amplitudes, what solves data for them, and what all effects leave.

        The amplitudes stay free: they are projected out as far as their prior lets them.
        """
        kept, target = self.projected(likelihood)
        inner = np.asarray(np.linalg.solve(np.eye(kept.shape[1]) + kept.T @ kept, kept.T), dtype=np.float64)
        return kept, inner, target - kept @ (inner @ target)

    def starts(self, without: int | None = None) -> list[Start]:
        """Return where another fit begins, with all terms or all but one."""
        return [term.start for i, term in enumerate(self.terms) if i != without]


def response(evidence: Evidence, term: Term) -> Vector:
    """Return what an effect adds to y on every sample, µm, also on those that are not used."""
    columns = raw_columns(evidence, term.hypothesis, term.values)
    return np.asarray(columns @ np.array(term.amplitudes) if term.amplitudes else columns[:, 0])


def summed(evidence: Evidence, terms: Sequence[Term]) -> Vector:
    """Return what some effects add to y on every sample, µm."""
    return np.asarray(sum((response(evidence, term) for term in terms), np.zeros(evidence.used.size)))


def late_term(fit: Fit) -> Term | None:
    """Return the term of a late T_Q, if there is one."""
    return next((term for term in fit.terms if term.effect.lateness is not None), None)


def has_dead_time(fit: Fit) -> bool:
    """Return whether a late T_Q has a dead time: what the engine leaves of it is no error of the paths."""
    late = late_term(fit)
    return late is not None and late.effect.lateness is not None and late.effect.lateness.delay_min > 0.0


def as_deployed(fit: Fit) -> tuple[tuple[Term, ...], list[Vector], Fit]:
    """Return the terms of a fit as the engine runs them, what each adds to y on every sample, µm, and their fit.

    A late T_Q is found with the future of the record, which the engine does not have. Here it is corrected as the
    engine does, and the other effects are fitted to the corrected signals, which they get there.
    """
    late, points = late_term(fit), fit.likelihood.points
    if late is None:
        return fit.terms, [response(points.evidence, term) for term in fit.terms], fit
    corrected, added = points.evidence.corrected(late.effect)
    starts = [term.start for term in fit.terms if term is not late]
    beside = fit_terms(Likelihood(points.of(corrected), fit.rest), starts)
    others = iter(beside.terms)
    terms = tuple(late if term is late else next(others) for term in fit.terms)
    return terms, [added if term is late else response(corrected, term) for term in terms], beside


@dataclass(frozen=True, slots=True)
class _Part:
    """A hypothesis at some values: averaged columns, their scale (none without amplitudes), and projected ones."""

    values: tuple[float, ...]
    columns: Matrix
    scale: Vector | None
    projected: Matrix


class _Problem:
    """The least squares problem of some hypotheses; keeps the columns of the last values of each.

    Of as many as its slopes need: where one moves by a step, the others are as they were.
    """

    def __init__(self, likelihood: Likelihood, hypotheses: Sequence[Hypothesis]) -> None:
        self.likelihood, self.hypotheses = likelihood, hypotheses
        self.free = [free for hypothesis in hypotheses for free in hypothesis.free]
        self._known: list[list[_Part]] = [[] for _ in hypotheses]

    def parts(self, x: Vector) -> list[_Part]:
        natural = iter([from_search(free, float(v)) for free, v in zip(self.free, x, strict=True)])
        found = []
        for i, hypothesis in enumerate(self.hypotheses):
            values = tuple(itertools.islice(natural, len(hypothesis.free)))
            last = self._known[i]
            part = next((one for one in last if one.values == values), None)
            if part is None:
                part = _part(self.likelihood, hypothesis, values)
            self._known[i] = [part, *(one for one in last if one is not part)][: 1 + len(hypothesis.free)]
            found.append(part)
        return found

    def solve(self, x: Vector) -> tuple[Vector, Vector, Matrix]:
        """Return the residual with the amplitudes' prior, the amplitudes and the factor of their precision."""
        target, columns = self.likelihood.target, [np.zeros((self.likelihood.target.size, 0))]
        for part in self.parts(x):
            if part.scale is None:
                target = target - part.projected[:, 0]
            else:
                columns.append(part.projected)
        table = np.concatenate(columns, axis=1)
        factor = factor_of(np.eye(table.shape[1]) + table.T @ table)
        amplitudes = solution(factor, table.T @ target)
        return np.concatenate([target - table @ amplitudes, -amplitudes]), amplitudes, factor

    def fun(self, x: Vector) -> Vector:
        return self.solve(x)[0]


def _part(likelihood: Likelihood, hypothesis: Hypothesis, values: tuple[float, ...]) -> _Part:
    points, scale = likelihood.points, None
    averaged = points.columns_of(hypothesis, values)
    if hypothesis.amplitudes:
        averaged, scale = points.scaled(averaged, hypothesis.sizes, averaged.shape[1])
    return _Part(values, averaged, scale, likelihood.projected(averaged))


def fit_terms(likelihood: Likelihood, starts: Sequence[Start], *, evaluations: int = 15) -> Fit:
    """Fit effects together.

    Parameters
    ----------
    likelihood : Likelihood
        The data.
    starts : sequence of (Hypothesis, values)
        Effects, and where the search of their free parameters begins.
    evaluations : int
        Most steps of the search.
    """
    problem = _Problem(likelihood, [hypothesis for hypothesis, _ in starts])
    begin = [v for _, values in starts for v in values]
    x = np.array([to_search(free, v) for free, v in zip(problem.free, begin, strict=True)])
    jacobian, ranges = np.zeros((likelihood.target.size, 0)), np.zeros(0)
    if x.size:
        low = np.array([to_search(free, free.low) for free in problem.free])
        high = np.array([to_search(free, free.high) for free in problem.free])
        ranges = high - low
        x, slopes = least_squares(problem.fun, x, low, high, evaluations)
        jacobian = slopes[: likelihood.target.size]
    return _fitted(problem, x, problem.solve(x), jacobian * ranges)


def _fitted(problem: _Problem, x: Vector, solved: tuple[Vector, Vector, Matrix], jacobian: Matrix) -> Fit:
    likelihood, (residual, amplitudes, factor) = problem.likelihood, solved
    parts, amplitudes_left = problem.parts(x), iter(amplitudes.tolist())
    terms, columns, fixed = [], [np.zeros((likelihood.points.count, 0))], np.zeros(likelihood.points.count)
    for hypothesis, part in zip(problem.hypotheses, parts, strict=True):
        own: tuple[float, ...] = ()
        if part.scale is None:
            fixed = fixed + part.columns[:, 0]
        else:
            columns.append(part.columns)
            own = tuple(
                a * s
                for a, s in zip(itertools.islice(amplitudes_left, part.scale.size), part.scale.tolist(), strict=True)
            )
        terms.append(Term(hypothesis=hypothesis, values=part.values, amplitudes=own))
    table = np.concatenate(columns, axis=1)
    # Laplace's approximation: how much of the range of each searched parameter the data leave.
    searched = factored(jacobian.T @ jacobian / (2.0 * math.pi))
    times = sum(len(getattr(h.effect, "times", ())) for h in problem.hypotheses)
    surprise = float(residual @ residual) + likelihood.log_det + log_det_of(factor) + log_det_of(searched)
    return Fit(
        terms=tuple(terms),
        likelihood=likelihood,
        log_evidence=likelihood.log_prior - 0.5 * surprise - times * math.log(likelihood.points.count / 2.0),
        columns=table,
        fixed=fixed,
        added=fixed + table @ amplitudes,
    )


def settled(fit: Fit) -> Fit:
    """Return a fit with the rest that fits its effects best, and errors of form as effects of their size have.

    Heat and ambient temperature move other temperatures, too. What that does to Y was there when the base was
    calibrated: its paths have it already. So beside an effect by a temperature the paths' own error may be as large as
    that part of the effect, where the data speak for it; to foretell other days it always is. Not where the own error
    is not deployed with effects: with few values, exact forms or a dead time of T_Q.
    """
    points = fit.likelihood.points
    sizes, carried = dict[str, float](), list[float]()
    for term in fit.terms:
        _, path, channel = term.hypothesis.place
        if path or channel:
            of = "" if path else channel
            added = response(points.evidence, term)
            sizes[of] = math.hypot(sizes.get(of, 0.0), float(np.std(added[points.evidence.used])))
            if term.hypothesis.acts_by_temperature:
                carried.append(_carried_um(points, added))
    rests = [points.with_forms_of(fit.rest, sizes)]
    carried_um = math.hypot(*carried)
    if carried_um and not (points.is_exact or points.evidence.is_sparse or has_dead_time(fit)):
        more = dataclasses.replace(rests[0], own_um=math.hypot(rests[0].own_um, carried_um))
        rests = [more] if points.foretells else [*rests, more]
    learned = [learned_rest(points, fit.columns, fit.fixed, rest) for rest in rests]
    fits = [fit_terms(Likelihood(points, rest), fit.starts()) for rest in learned]
    return max(fits, key=lambda one: one.log_evidence)


def _carried_um(points: Points, response_um: Vector) -> float:
    """Return how much of what an effect adds responses of the base's paths explain, standard deviation in µm."""
    added = points.averaged(response_um[:, None])
    table = np.concatenate([points.fast, points.slow], axis=1)
    table = table - table.mean(axis=0)
    explained = table @ np.linalg.lstsq(table, added - added.mean(), rcond=None)[0]
    return float(np.std(explained))


def to_search(free: Free, value: float) -> float:
    """Return a free parameter as it is searched."""
    value = min(max(value, free.low), free.high)
    return float(np.log(value)) if free.log else value / (free.high - free.low)


def from_search(free: Free, x: float) -> float:
    """Return a free parameter's own value."""
    return float(np.exp(x)) if free.log else x * (free.high - free.low)
