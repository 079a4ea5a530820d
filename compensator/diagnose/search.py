"""Which effects does the model lack? Added one after another, everything refitted together, weighed against chance.

An effect is worth its parameters where the residual's sum of squares falls by more than chance would make it fall
with so many hypotheses tried:

    J = N/c · log(Σ e²) + Σ_effects [ p log(N/c) + 2 log M ]

with N samples, p parameters, M places tried, and *c* the colour of what is left in the end: a coloured residual has
fewer independent samples than its length says.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from compensator.diagnose.evidence import Evidence
from compensator.diagnose.joint import Joint, Part, columns_of, fit_joint
from compensator.diagnose.switching import switchings
from compensator.model.effects.hypothesis import Hypothesis, proposals

Vector = npt.NDArray[np.float64]
Matrix = npt.NDArray[np.float64]

#: Most effects looked for.
MOST = 4
#: Hypotheses that are fitted after each scan.
POLISHED = 14
#: Least share of the sum of squares that an effect must take: less is of no use to anybody.
WORTH = 0.02

Told = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """A hypothesis that was fitted at some point of the search.

    Parameters
    ----------
    joint : Joint
        The fit, with the effects found before.
    index : int
        Which of its parts was tried.
    score : float
        *J*, white.
    """

    joint: Joint
    index: int
    score: float

    @property
    def part(self) -> Part:
        """What was tried."""
        return self.joint.parts[self.index]


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """What a search found.

    Parameters
    ----------
    before, joint : Joint
        The fit of nothing, and of the effects found.
    colour : float
        *c*.
    rivals : tuple of tuple of Tried
        For each effect, what else was fitted in its place, best first.
    places : int
        *M*.
    """

    before: Joint
    joint: Joint
    colour: float
    rivals: tuple[tuple[Tried, ...], ...]
    places: int


class Search:
    """One search over one body of evidence."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        self.hypotheses = proposals(evidence.setting)
        self.places = len({hypothesis.place for hypothesis in self.hypotheses}) + 1
        self._grids: dict[int, list[tuple[tuple[float, ...], Matrix]]] = {}

    def run(self) -> Found:
        """Search."""
        before = fit_joint(self.evidence, [])
        path = [before]
        tried: list[list[Tried]] = []
        while len(path) <= MOST:
            step = self._add(path[-1])
            if not step or step[0].joint.cost > (1.0 - WORTH) * path[-1].cost:
                break
            better = self._improved(step[0].joint)
            if self.score(better, 1.0) >= self.score(path[-1], 1.0):
                break
            path.append(better)
            tried.append(step)
        colour = self.evidence.colour(path[-1].residual)
        best = min(path, key=lambda joint: self.score(joint, colour))
        best = self._thinned(best, colour)
        rivals = tuple(self._rivals(best, i) for i in range(len(best.parts)))
        return Found(before=before, joint=best, colour=colour, rivals=rivals, places=self.places)

    def score(self, joint: Joint, colour: float) -> float:
        """Return *J*."""
        count = self.evidence.count / colour
        penalty = joint.parameters * math.log(max(count, 2.0)) + 2.0 * len(joint.parts) * math.log(self.places)
        return count * math.log(max(joint.cost, 1e-12)) + penalty

    # ------------------------------------------------------------------ steps

    def _add(self, joint: Joint, without: int | None = None) -> list[Tried]:
        """Return fits with one effect more (in the place of one, if said so), best first."""
        kept = [part for i, part in enumerate(joint.parts) if i != without]
        starts = [(part.hypothesis, part.values) for part in kept]
        base = fit_joint(self.evidence, starts) if without is not None else joint
        taken = {part.hypothesis.place for part in kept}
        candidates = [h for h in self.hypotheses if h.place not in taken]
        ranked = sorted(self._scan(base, candidates), key=lambda item: item[0])[:POLISHED]
        found = []
        for _, hypothesis, values in [*ranked, *self._switched(base, taken)]:
            fitted = fit_joint(self.evidence, [*starts, (hypothesis, values)])
            found.append(Tried(joint=fitted, index=len(starts), score=self.score(fitted, 1.0)))
        return sorted(found, key=lambda item: item.score)

    def _switched(
        self, base: Joint, taken: set[tuple[str, str, str]]
    ) -> list[tuple[float, Hypothesis, tuple[float, ...]]]:
        if ("unobserved", "", "") in taken:
            return []
        hypothesis = switchings(self.evidence, base.residual)
        return [] if hypothesis is None else [(0.0, hypothesis[0], hypothesis[1])]

    def _scan(self, base: Joint, candidates: Sequence[Hypothesis]) -> list[tuple[float, Hypothesis, tuple[float, ...]]]:
        """Rank hypotheses by what their best grid point would take off the residual."""
        known = [columns_of(self.evidence, part.hypothesis, part.values)[0] for part in base.parts]
        q = np.linalg.qr(np.concatenate(known, axis=1))[0] if known and sum(k.shape[1] for k in known) else None
        count, log_count = self.evidence.count, math.log(self.evidence.count)
        ranked = []
        for hypothesis in candidates:
            best: tuple[float, tuple[float, ...]] | None = None
            for values, table in self._grid(hypothesis):
                x = table if q is None else table - q @ (q.T @ table)
                gain = _taken(x, base.residual)
                if best is None or gain > best[0]:
                    best = (gain, values)
            if best is not None:
                left = max(base.cost - best[0], 1e-3 * base.cost)
                ranked.append((count * math.log(left) + hypothesis.parameters * log_count, hypothesis, best[1]))
        return ranked

    def _grid(self, hypothesis: Hypothesis) -> list[tuple[tuple[float, ...], Matrix]]:
        key = id(hypothesis)
        if key not in self._grids:
            points: list[tuple[float, ...]] = [()]
            for free in hypothesis.free:
                points = [(*point, value) for point in points for value in free.grid]
            if len(hypothesis.free) == 2 and hypothesis.free[0].name.startswith("tau_1"):
                points = [p for p in points if p[0] < p[1]]
            tables = []
            for values in points:
                table = np.concatenate([hypothesis.trial(wave, values) for wave in self.evidence.waves])
                table[~self.evidence.used] = 0.0
                tables.append((values, self.evidence.without_nuisances(table)))
            self._grids[key] = tables
        return self._grids[key]

    def _improved(self, joint: Joint) -> Joint:
        """Exchange effects one at a time as long as that helps: what was found first may have stood for two."""
        if len(joint.parts) < 2:
            return joint
        for _ in range(2):
            changed = False
            for i in range(len(joint.parts)):
                others = self._add(joint, without=i)
                if others and others[0].score < self.score(joint, 1.0) - 1e-6:
                    joint, changed = others[0].joint, True
            if not changed:
                break
        return joint

    def _thinned(self, joint: Joint, colour: float) -> Joint:
        """Leave out every effect that is not worth its parameters."""
        while joint.parts:
            fewer = [
                fit_joint(self.evidence, [(p.hypothesis, p.values) for k, p in enumerate(joint.parts) if k != i])
                for i in range(len(joint.parts))
            ]
            best = min(fewer, key=lambda j: self.score(j, colour))
            small = joint.cost > (1.0 - WORTH) * best.cost
            if self.score(best, colour) > self.score(joint, colour) and not small:
                return joint
            joint = best
        return joint

    def _rivals(self, joint: Joint, index: int) -> tuple[Tried, ...]:
        return tuple(self._add(joint, without=index))


def _taken(x: Matrix, residual: Vector) -> float:
    """Return how much of the residual's sum of squares some columns take."""
    if x.shape[1] == 1:
        size = float(x[:, 0] @ x[:, 0])
        return float((x[:, 0] @ residual) ** 2 / size) if size > 1e-12 else 0.0
    q, r = np.linalg.qr(x)
    good = np.abs(np.diag(r)) > 1e-9
    part = q.T @ residual
    return float(np.sum(part[good] ** 2))
