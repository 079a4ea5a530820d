"""Several effects fitted at once: free parameters searched together, amplitudes projected."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from compensator.arrays import Matrix, Vector
from compensator.diagnose.evidence import Evidence
from compensator.model.effects.hypothesis import Free, Hypothesis


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
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
        Whether it only rounds off what the others leave: it is deployed with them and not named beside them.
    """

    hypothesis: Hypothesis
    values: tuple[float, ...]
    amplitudes: tuple[float, ...] = ()
    companion: bool = False

    @property
    def named(self) -> dict[str, float]:
        """Every parameter by name."""
        return self.hypothesis.named(self.values, self.amplitudes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Joint:
    """Effects fitted together.

    Parameters
    ----------
    parts : tuple of Part
        Effects with their values.
    residual : numpy.ndarray, shape (n,)
        What is left, nuisances taken out; 0 where samples are not used.
    cost : float
        Its sum of squares, µm².
    """

    parts: tuple[Part, ...]
    residual: Vector
    cost: float

    @property
    def parameters(self) -> int:
        """Number of parameters of all effects."""
        return sum(part.hypothesis.parameters for part in self.parts)


def response(evidence: Evidence, part: Part) -> Vector:
    """Return what an effect adds to y on every sample, µm, also on those that are not used."""
    pieces = []
    for wave in evidence.waves:
        total = part.hypothesis.columns(wave, part.values) @ np.array(part.amplitudes)
        fixed = part.hypothesis.fixed(wave, part.values)
        pieces.append(total if fixed is None else total + fixed)
    return np.concatenate(pieces)


def summed(evidence: Evidence, joint: Joint) -> Vector:
    """Return what all effects add to y on every sample, µm."""
    total = np.zeros(evidence.used.size)
    for part in joint.parts:
        total += response(evidence, part)
    return total


def columns_of(evidence: Evidence, hypothesis: Hypothesis, values: Sequence[float]) -> tuple[Matrix, Vector | None]:
    """Return columns and fixed part on the samples used, nuisances taken out."""
    columns = np.concatenate([hypothesis.columns(wave, values) for wave in evidence.waves])
    columns[~evidence.used] = 0.0
    fixed = [hypothesis.fixed(wave, values) for wave in evidence.waves]
    still = None
    if fixed[0] is not None:
        whole = np.concatenate([f for f in fixed if f is not None])
        whole[~evidence.used] = 0.0
        still = evidence.without_nuisances(whole)
    return evidence.without_nuisances(columns), still


class _Problem:
    """The projected problem of some hypotheses; remembers the columns of the last values of each."""

    def __init__(self, evidence: Evidence, hypotheses: Sequence[Hypothesis]) -> None:
        self.evidence, self.hypotheses = evidence, hypotheses
        self.y = evidence.without_nuisances(evidence.residual)
        self.free = [free for hypothesis in hypotheses for free in hypothesis.free]
        self.ridge = np.array([h.ridge for h in hypotheses for _ in h.amplitudes])
        self._known: list[tuple[tuple[float, ...], tuple[Matrix, Vector | None]] | None] = [None] * len(hypotheses)

    def values(self, x: Vector) -> list[tuple[float, ...]]:
        natural = [from_search(free, float(v)) for free, v in zip(self.free, x, strict=True)]
        result, at = [], 0
        for hypothesis in self.hypotheses:
            result.append(tuple(natural[at : at + len(hypothesis.free)]))
            at += len(hypothesis.free)
        return result

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


def fit_joint(
    evidence: Evidence, starts: Sequence[tuple[Hypothesis, Sequence[float]]], *, evaluations: int = 25
) -> Joint:
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
        low, high = (
            np.array([to_search(free, bound) for free, bound in ((f, getattr(f, side)) for f in problem.free)])
            for side in ("low", "high")
        )
        inside = np.clip(x, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
        found = least_squares(
            problem.fun, inside, bounds=(low, high), diff_step=1e-4, xtol=1e-6, ftol=1e-7, max_nfev=evaluations
        )
        x = np.asarray(found.x)
    residual, amplitudes = problem.solve(x)
    residual = np.where(evidence.used, residual, 0.0)
    parts, at = [], 0
    for (hypothesis, _), values in zip(starts, problem.values(x), strict=True):
        width = len(hypothesis.amplitudes)
        parts.append(Part(hypothesis=hypothesis, values=values, amplitudes=tuple(amplitudes[at : at + width].tolist())))
        at += width
    return Joint(parts=tuple(parts), residual=residual, cost=float(residual @ residual))


def standard_errors(evidence: Evidence, joint: Joint, colour: float) -> list[dict[str, float]]:
    """Return the standard error of everything that each effect is named by, the residual's colour counted in."""
    natural = np.array([v for part in joint.parts for v in (*part.values, *part.amplitudes)])
    if natural.size == 0:
        return []
    ridge = np.array([r for part in joint.parts for r in _ridges(part)])

    def moved(values: Vector) -> list[Part]:
        result, at = [], 0
        for part in joint.parts:
            n, m = len(part.values), len(part.amplitudes)
            own = values[at : at + n + m].tolist()
            result.append(dataclasses.replace(part, values=tuple(own[:n]), amplitudes=tuple(own[n:])))
            at += n + m
        return result

    def predicted(values: Vector) -> Vector:
        total = np.zeros(evidence.used.size)
        for part in moved(values):
            total += response(evidence, part)
        total[~evidence.used] = 0.0
        return evidence.without_nuisances(total)

    def named(values: Vector) -> Vector:
        return np.array([v for part in moved(values) for v in part.named.values()])

    steps = 1e-3 * np.abs(natural) + 1e-9
    jacobian = _slopes(predicted, natural, steps)
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, vt = np.linalg.svd(np.concatenate([jacobian / scale, np.diag(np.sqrt(ridge))]), full_matrices=False)
    inverse = vt.T / np.maximum(s, 1e-7 * s[0]) / scale[:, None]
    sigma2 = joint.cost / max(evidence.count - natural.size, 1) * colour
    spread = _slopes(named, natural, steps) @ inverse
    errors = np.sqrt(np.maximum(np.einsum("ij,ij->i", spread, spread) * sigma2, 0.0)).tolist()
    result, at = [], 0
    for part in joint.parts:
        names = list(part.named)
        result.append(dict(zip(names, errors[at : at + len(names)], strict=True)))
        at += len(names)
    return result


def _ridges(part: Part) -> list[float]:
    return [*(0.0 for _ in part.values), *(part.hypothesis.ridge for _ in part.amplitudes)]


def _slopes(function: Callable[[Vector], Vector], at: Vector, steps: Vector) -> Matrix:
    """Return the derivatives of a function by each of its arguments, shape (values, arguments)."""
    columns = []
    for i, step in enumerate(steps.tolist()):
        above, below = at.copy(), at.copy()
        above[i] += step
        below[i] -= step
        columns.append((function(above) - function(below)) / (2.0 * step))
    return np.stack(columns, axis=1)
