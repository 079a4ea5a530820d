"""Several effects fitted together: free parameters searched, amplitudes projected."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from compensator.arrays import Matrix, Vector
from compensator.diagnose.evidence import Evidence
from compensator.model.effects import Effect
from compensator.model.effects.hypothesis import Free, Hypothesis

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
    companion : bool
        Whether it only absorbs what the other terms leave: it is deployed with them and not named beside them.
    """

    hypothesis: Hypothesis
    values: tuple[float, ...]
    amplitudes: tuple[float, ...] = ()
    companion: bool = False

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
    residual : numpy.ndarray, shape (n,)
        What is left, nuisances projected out; 0 where samples are not used.
    cost : float
        Its sum of squares, µm².
    """

    terms: tuple[Term, ...]
    residual: Vector
    cost: float

    @property
    def parameters(self) -> int:
        """Number of parameters of all effects."""
        return sum(term.hypothesis.parameters for term in self.terms)

    def starts(self, without: int | None = None) -> list[Start]:
        """Return where another fit begins, with all terms or all but one."""
        return [term.start for i, term in enumerate(self.terms) if i != without]


def response(evidence: Evidence, term: Term) -> Vector:
    """Return what an effect adds to y on every sample, µm, also on those that are not used."""
    columns = np.concatenate([term.hypothesis.columns(record, term.values) for record in evidence.signals])
    return np.asarray(columns @ np.array(term.amplitudes) if term.amplitudes else columns[:, 0])


def summed(evidence: Evidence, terms: Sequence[Term]) -> Vector:
    """Return what some effects add to y on every sample, µm."""
    return np.asarray(sum((response(evidence, term) for term in terms), np.zeros(evidence.used.size)))


def late_term(fit: Fit) -> Term | None:
    """Return the term of a late T_Q, if there is one."""
    return next((term for term in fit.terms if term.effect.lateness is not None), None)


def as_deployed(evidence: Evidence, fit: Fit) -> tuple[Fit, list[Vector]]:
    """Return a fit as the engine runs it, and what each of its effects adds to y on every sample, µm.

    A late T_Q is found with the future of the record, which the engine does not have. Here it is corrected as the
    engine does, and the other effects are fitted to the corrected signals, which they get there.
    """
    late = late_term(fit)
    if late is None:
        return fit, [response(evidence, term) for term in fit.terms]
    corrected, added = evidence.corrected(late.effect)
    others = fit_terms(corrected, [term.start for term in fit.terms if term is not late])
    rest = iter(others.terms)
    terms = [late if term is late else dataclasses.replace(next(rest), companion=term.companion) for term in fit.terms]
    responses = [added if term is late else response(corrected, term) for term in terms]
    return dataclasses.replace(others, terms=tuple(terms)), responses


def columns_of(evidence: Evidence, hypothesis: Hypothesis, values: Sequence[float]) -> tuple[Matrix, Vector | None]:
    """Return columns and fixed part on the samples used, nuisances projected out."""
    columns = np.concatenate([hypothesis.columns(record, values) for record in evidence.signals])
    columns[~evidence.used] = 0.0
    if hypothesis.amplitudes:
        return evidence.without_nuisances(columns), None
    return columns[:, :0], evidence.without_nuisances(columns[:, 0])


class _Problem:
    """The projected problem of some hypotheses; keeps the columns of the last values of each."""

    def __init__(self, evidence: Evidence, hypotheses: Sequence[Hypothesis]) -> None:
        self.evidence, self.hypotheses = evidence, hypotheses
        self.y = evidence.without_nuisances(evidence.residual)
        self.free = [free for hypothesis in hypotheses for free in hypothesis.free]
        self.ridge = np.array([h.effect.ridge for h in hypotheses for _ in h.amplitudes])
        self._known: list[tuple[tuple[float, ...], tuple[Matrix, Vector | None]] | None] = [None] * len(hypotheses)

    def values(self, x: Vector) -> list[tuple[float, ...]]:
        natural = iter([from_search(free, float(v)) for free, v in zip(self.free, x, strict=True)])
        return [tuple(itertools.islice(natural, len(hypothesis.free))) for hypothesis in self.hypotheses]

    def solve(self, x: Vector) -> tuple[Vector, Vector]:
        """Return residual and amplitudes."""
        target, columns = self.y, []
        for i, values in enumerate(self.values(x)):
            kept = self._known[i]
            if kept is None or kept[0] != values:
                kept = (values, columns_of(self.evidence, self.hypotheses[i], values))
                self._known[i] = kept
            table, fixed = kept[1]
            columns.append(table)
            if fixed is not None:
                target = target - fixed
        whole = np.concatenate(columns, axis=1) if columns else np.zeros((self.y.size, 0))
        if whole.shape[1] == 0:
            return target, np.zeros(0)
        scale = np.linalg.norm(whole, axis=0)
        scale[scale == 0.0] = 1.0
        table, aim = whole / scale, target
        if self.ridge.any():
            table = np.concatenate([table, np.diag(np.sqrt(self.ridge))])
            aim = np.concatenate([target, np.zeros(self.ridge.size)])
        amplitudes = np.linalg.lstsq(table, aim, rcond=1e-9)[0] / scale
        return target - whole @ amplitudes, amplitudes

    def fun(self, x: Vector) -> Vector:
        return self.solve(x)[0][self.evidence.used]


def to_search(free: Free, value: float) -> float:
    """Return a free parameter as it is searched."""
    value = min(max(value, free.low), free.high)
    return float(np.log(value)) if free.log else value / (free.high - free.low)


def from_search(free: Free, x: float) -> float:
    """Return a free parameter's own value."""
    return float(np.exp(x)) if free.log else x * (free.high - free.low)


def fit_terms(evidence: Evidence, starts: Sequence[Start], *, evaluations: int = 25) -> Fit:
    """Fit effects together.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals.
    starts : sequence of (Hypothesis, values)
        Effects, and where the search of their free parameters begins.
    evaluations : int
        Most steps of the search.
    """
    problem = _Problem(evidence, [hypothesis for hypothesis, _ in starts])
    begin = [v for _, values in starts for v in values]
    x = np.array([to_search(free, v) for free, v in zip(problem.free, begin, strict=True)])
    if x.size:
        low = np.array([to_search(free, free.low) for free in problem.free])
        high = np.array([to_search(free, free.high) for free in problem.free])
        inside = np.clip(x, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
        found = least_squares(
            problem.fun, inside, bounds=(low, high), diff_step=1e-4, xtol=1e-6, ftol=1e-7, max_nfev=evaluations
        )
        x = np.asarray(found.x)
    residual, amplitudes = problem.solve(x)
    residual = np.where(evidence.used, residual, 0.0)
    rest = iter(amplitudes.tolist())
    terms = [
        Term(hypothesis=hypothesis, values=values, amplitudes=tuple(itertools.islice(rest, len(hypothesis.amplitudes))))
        for hypothesis, values in zip(problem.hypotheses, problem.values(x), strict=True)
    ]
    return Fit(terms=tuple(terms), residual=residual, cost=float(residual @ residual))


def standard_errors(evidence: Evidence, fit: Fit, variance_inflation: float) -> list[dict[str, float]]:
    """Return the standard error of everything that each effect is named by, for the effective number of samples."""
    natural = np.array([v for term in fit.terms for v in (*term.values, *term.amplitudes)])
    if natural.size == 0:
        return []
    ridge = np.array([r for term in fit.terms for r in _ridges(term)])

    def moved(values: Vector) -> list[Term]:
        rest = iter(values.tolist())
        return [
            dataclasses.replace(
                term,
                values=tuple(itertools.islice(rest, len(term.values))),
                amplitudes=tuple(itertools.islice(rest, len(term.amplitudes))),
            )
            for term in fit.terms
        ]

    def predicted(values: Vector) -> Vector:
        total = summed(evidence, moved(values))
        total[~evidence.used] = 0.0
        return evidence.without_nuisances(total)

    def named(values: Vector) -> Vector:
        return np.array([v for term in moved(values) for v in term.named.values()])

    steps = 1e-3 * np.abs(natural) + 1e-9
    jacobian = _slopes(predicted, natural, steps)
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, vt = np.linalg.svd(np.concatenate([jacobian / scale, np.diag(np.sqrt(ridge))]), full_matrices=False)
    inverse = vt.T / np.maximum(s, 1e-7 * s[0]) / scale[:, None]
    sigma2 = fit.cost / max(evidence.count - natural.size, 1) * variance_inflation
    spread = _slopes(named, natural, steps) @ inverse
    errors = iter(np.sqrt(np.maximum(np.einsum("ij,ij->i", spread, spread) * sigma2, 0.0)).tolist())
    return [dict(zip(term.named, errors, strict=False)) for term in fit.terms]


def _ridges(term: Term) -> list[float]:
    return [*(0.0 for _ in term.values), *(term.hypothesis.effect.ridge for _ in term.amplitudes)]


def _slopes(function: Callable[[Vector], Vector], at: Vector, steps: Vector) -> Matrix:
    """Return the derivatives of a function by each of its arguments, shape (values, arguments)."""
    columns = []
    for i, step in enumerate(steps.tolist()):
        above, below = at.copy(), at.copy()
        above[i] += step
        below[i] -= step
        columns.append((function(above) - function(below)) / (2.0 * step))
    return np.stack(columns, axis=1)
