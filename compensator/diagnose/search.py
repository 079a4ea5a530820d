"""Which effects does the model lack? Added one after another, everything refitted together, weighed against chance.

An effect is worth its parameters where the residual's sum of squares falls by more than chance would make it fall
with so many hypotheses tried:

    J = N/c · log(Σ e² + A) + Σ_effects [ p log(N/c) + 2 log M ]

with N samples, p parameters, M places tried, A what the base model's own error may leave, and *c* the colour of what is
left in the end: a coloured residual has fewer independent samples than its length says.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from compensator.diagnose.evidence import Evidence
from compensator.diagnose.joint import Joint, Part, columns_of, fit_joint
from compensator.diagnose.switching import switchings
from compensator.model.effects.dynamics import ChangedPaths, changed_paths
from compensator.model.effects.hypothesis import Hypothesis, proposals
from compensator.model.effects.unobserved import Unobserved

Rough = npt.NDArray[np.float32]
Start = tuple[Hypothesis, Sequence[float]]

#: Most effects looked for.
MOST = 4
#: Hypotheses that are fitted after each scan, and where something stands already.
POLISHED, EXCHANGED = 12, 6
#: Parts of an effect that are larger than their sum by this much cancel each other.
CANCELS = 6.0
#: Effects that take this share of what all take explain it; the rest rounds it off.
MOSTLY = 0.7
#: What one effect leaves up to this share of the sum of squares is its form's, where forms are not exact.
FORM_LEAVES = 0.08
#: What a hidden source may leave of what channels leave, where forms are not exact.
HIDDEN_LEAVES = 0.5
#: A residual with less colour than this is noise, and no hidden source is looked for in it.
CLEAN = 1.3


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
        *J*.
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
        self._grids: dict[int, list[tuple[tuple[float, ...], Rough]]] = {}

    def run(self, *, hidden: bool = True) -> Found:
        """Search: what the inputs explain first, then whether a source that no channel shows explains it better.

        Parameters
        ----------
        hidden : bool
            Whether a hidden source is looked for.
        """
        before = fit_joint(self.evidence, [])
        if self.evidence.is_expected:
            return Found(before=before, joint=before, colour=1.0, rivals=(), places=self.places)
        path = self._forward([before])
        beside = self._beside_changed_paths(path[-1])
        last = min([path[-1], *beside], key=lambda joint: self.score(joint, 1.0))
        coloured = hidden and not self.evidence.is_noise(last.cost) and self.evidence.colour(last.residual) > CLEAN
        if self.evidence.setting.rough and any(self._is_one(joint, before) for joint in (*path, *beside)):
            coloured = False
        others = [*beside, *(self._with_hidden(path, last) if coloured else [])]
        last = min([last, *others], key=lambda joint: self.score(joint, 1.0))
        colour = self.evidence.colour(last.residual)
        best = self._thinned(min([*path, *others], key=lambda joint: self.score(joint, colour)), colour)
        best = self._named(best, before)
        rivals = tuple(self._rivals(best, i) for i in range(len(best.parts)))
        return Found(before=before, joint=best, colour=colour, rivals=rivals, places=self.places)

    def _forward(self, path: list[Joint]) -> list[Joint]:
        """Add one effect after another while each is worth it."""
        while len(path) <= MOST:
            last = path[-1]
            if self.evidence.is_noise(last.cost) and self.evidence.colour(last.residual) < CLEAN:
                break
            step = [t for t in self._add(last) if self._is_worth(t.part.hypothesis, last, t.joint)]
            if not step:
                break
            better = self._improved(step[0].joint)
            colour = self._colour(better)
            if self.score(better, colour) >= self.score(last, colour):
                break
            path.append(better)
        return path

    def _is_one(self, joint: Joint, before: Joint) -> bool:
        """Tell whether a single effect explains so much that the rest is its form's."""
        effects = sum(not isinstance(part.hypothesis, ChangedPaths) for part in joint.parts)
        return effects <= 1 and joint.cost < FORM_LEAVES * before.cost

    def _colour(self, joint: Joint) -> float:
        """Return the colour that counts while something may still be missing.

        On a real machine no effect is exactly of any form, and what it leaves is no noise: few independent samples,
        so that the simpler of two wins. Where forms are exact, what is left is the effect that comes next.
        """
        return self.evidence.colour(joint.residual) if self.evidence.setting.rough else 1.0

    def _beside_changed_paths(self, last: Joint) -> list[Joint]:
        """Return what is found beside paths that answer otherwise; nothing where one effect leaves mere noise.

        A real machine that is altered answers otherwise to its heat and to the air, whatever else the alteration
        does: what is looked for beside that is not mistaken for it.
        """
        clean = len(last.parts) < 2 and last.cost < self.evidence.floor
        if clean or not self.evidence.setting.rough:
            return []
        return self._forward([fit_joint(self.evidence, [(changed_paths(self.evidence.setting), ())])])

    def _named(self, joint: Joint, before: Joint) -> Joint:
        """Say of paths that answer otherwise whether that is an effect of its own, and by its simplest name.

        Where other effects explain most without it, it only rounds off what they leave. Where it stands alone and other
        strengths explain most of it, the strength is what is wrong.
        """
        at = [i for i, part in enumerate(joint.parts) if isinstance(part.hypothesis, ChangedPaths)]
        if not at:
            return joint
        others = [(p.hypothesis, p.values) for i, p in enumerate(joint.parts) if i != at[0]]
        rounded = (joint.parts[at[0]].hypothesis, ())
        if not others:
            gains = [(h, ()) for h in self.hypotheses if h.kind == "gain"]
            if not self._explain_most(gains, joint, before):
                return joint
            others = [gain for gain in gains if gain[0].path == "DTF"]
        elif not self._explain_most(others, joint, before):
            return joint
        fitted = fit_joint(self.evidence, [*others, rounded])
        *named, last = fitted.parts
        return dataclasses.replace(fitted, parts=(*named, dataclasses.replace(last, companion=True)))

    def _explain_most(self, some: Sequence[Start], joint: Joint, before: Joint) -> bool:
        """Tell whether some effects alone take most of what all of them take."""
        return before.cost - fit_joint(self.evidence, some).cost > MOSTLY * (before.cost - joint.cost)

    def _with_hidden(self, path: Sequence[Joint], shown: Joint) -> list[Joint]:
        """Return fits with a hidden source beside what was found before it, or instead of it.

        Steps at any time follow much that is none of theirs. On a real machine, where forms are never exact, they must
        leave half of what the best explanation by channels leaves.
        """
        found = []
        for base in path[:3]:
            hidden = switchings(self.evidence, base.residual)
            if hidden is not None:
                starts = [(part.hypothesis, part.values) for part in base.parts]
                found.append(fit_joint(self.evidence, [*starts, hidden]))
        found.sort(key=lambda joint: self.score(joint, 1.0))
        improved = [self._improved(joint) for joint in found[:1]]
        if not self.evidence.setting.rough:
            return improved
        own = self.evidence.count * self.evidence.own_error_um**2
        return [joint for joint in improved if joint.cost + own < HIDDEN_LEAVES * (shown.cost + own)]

    def _is_worth(self, hypothesis: Hypothesis, without: Joint, joint: Joint) -> bool:
        """Tell whether an effect takes enough to be of use, the base model's own error counted as still there."""
        allowance = self.evidence.allowance
        beside = self.evidence.setting.rough and any(not isinstance(p.hypothesis, ChangedPaths) for p in without.parts)
        share = hypothesis.worth_beside if beside else hypothesis.worth
        return joint.cost + allowance < (1.0 - share) * (without.cost + allowance)

    def score(self, joint: Joint, colour: float) -> float:
        """Return *J*."""
        count = self.evidence.count / colour
        penalty = joint.parameters * math.log(max(count, 2.0)) + 2.0 * len(joint.parts) * math.log(self.places)
        return count * math.log(max(joint.cost + self.evidence.allowance, 1e-12)) + penalty

    # ------------------------------------------------------------------ steps

    def _add(self, joint: Joint, without: int | None = None) -> list[Tried]:
        """Return fits with one effect more (in the place of one, if said so), best first."""
        kept = [part for i, part in enumerate(joint.parts) if i != without]
        starts = [(part.hypothesis, part.values) for part in kept]
        base = fit_joint(self.evidence, starts) if without is not None else joint
        taken = {part.hypothesis.place for part in kept}
        candidates = [h for h in self.hypotheses if h.place not in taken]
        most = POLISHED if without is None else EXCHANGED
        ranked = sorted(self._scan(base, candidates), key=lambda item: item[0])[:most]
        found = []
        for _, hypothesis, values in ranked:
            fitted = fit_joint(self.evidence, [*starts, (hypothesis, values)])
            if self._is_plausible(fitted.parts[-1]):
                found.append(Tried(joint=fitted, index=len(starts), score=self.score(fitted, 1.0)))
        if not found:
            return []
        colour = self._colour(min(found, key=lambda item: item.score).joint)
        found = [dataclasses.replace(item, score=self.score(item.joint, colour)) for item in found]
        return sorted(found, key=lambda item: item.score)

    def _scan(self, base: Joint, candidates: Sequence[Hypothesis]) -> list[tuple[float, Hypothesis, tuple[float, ...]]]:
        """Rank hypotheses by what their best grid point would take off the residual."""
        known = [columns_of(self.evidence, part.hypothesis, part.values)[0] for part in base.parts]
        whole = np.concatenate(known, axis=1) if known and sum(k.shape[1] for k in known) else None
        q = None if whole is None else np.linalg.qr(whole)[0].astype(np.float32)
        residual = base.residual.astype(np.float32)
        count, log_count = self.evidence.count, math.log(self.evidence.count)
        ranked = []
        for hypothesis in candidates:
            best: tuple[float, tuple[float, ...]] | None = None
            for values, table in self._grid(hypothesis):
                x = table if q is None else table - q @ (q.T @ table)
                gain = _taken(x, residual)
                if best is None or gain > best[0]:
                    best = (gain, values)
            if best is not None:
                left = max(base.cost - best[0], 1e-3 * base.cost)
                ranked.append((count * math.log(left) + hypothesis.parameters * log_count, hypothesis, best[1]))
        return ranked

    def _grid(self, hypothesis: Hypothesis) -> list[tuple[tuple[float, ...], Rough]]:
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
                # Half the memory, and more digits than a first ranking needs.
                tables.append((values, self.evidence.without_nuisances(table).astype(np.float32)))
            self._grids[key] = tables
        return self._grids[key]

    def _improved(self, joint: Joint) -> Joint:
        """Exchange effects one at a time as long as that helps: what was found first may have stood for two."""
        if len(joint.parts) < 2:
            return joint
        for _ in range(2):
            changed = False
            for i, part in enumerate(joint.parts):
                if isinstance(part.hypothesis, ChangedPaths):
                    continue
                others = (
                    self._hidden_again(joint, i) if isinstance(part.hypothesis, Unobserved) else self._add(joint, i)
                )
                if not others:
                    continue
                colour = self._colour(others[0].joint)
                if self.score(others[0].joint, colour) < self.score(joint, colour) - 1e-6:
                    joint, changed = others[0].joint, True
            if not changed:
                break
        return joint

    def _hidden_again(self, joint: Joint, index: int) -> list[Tried]:
        """Look for the hidden source again, the other effects being what they are now."""
        kept = [(p.hypothesis, p.values) for i, p in enumerate(joint.parts) if i != index]
        hidden = switchings(self.evidence, fit_joint(self.evidence, kept).residual)
        if hidden is None:
            return []
        fitted = fit_joint(self.evidence, [*kept[:index], hidden, *kept[index:]])
        return [Tried(joint=fitted, index=index, score=self.score(fitted, 1.0))]

    def _thinned(self, joint: Joint, colour: float) -> Joint:
        """Leave out every effect that is not worth its parameters."""
        while joint.parts:
            fewer = [
                fit_joint(self.evidence, [(p.hypothesis, p.values) for k, p in enumerate(joint.parts) if k != i])
                for i in range(len(joint.parts))
            ]
            out = min(range(len(fewer)), key=lambda i: self.score(fewer[i], colour))
            small = not self._is_worth(joint.parts[out].hypothesis, fewer[out], joint)
            if self.score(fewer[out], colour) > self.score(joint, colour) and not small:
                return joint
            joint = fewer[out]
        return joint

    def _is_plausible(self, part: Part) -> bool:
        """Refuse an effect whose columns cancel: two lags that stand for a derivative or a ramp are no physics."""
        if len(part.amplitudes) < 2 or part.hypothesis.ridge:
            return True
        table = columns_of(self.evidence, part.hypothesis, part.values)[0] * np.array(part.amplitudes)
        return bool(np.max(np.linalg.norm(table, axis=0)) < CANCELS * np.linalg.norm(table.sum(axis=1)))

    def _rivals(self, joint: Joint, index: int) -> tuple[Tried, ...]:
        """Return what else explains an effect's part, one for each place, best first."""
        if joint.parts[index].companion:
            return ()
        kept = [(p.hypothesis, p.values) for i, p in enumerate(joint.parts) if i != index]
        taken = {part.hypothesis.place for part in joint.parts}
        base = fit_joint(self.evidence, kept)
        ranked = sorted(
            self._scan(base, [h for h in self.hypotheses if h.place not in taken]), key=lambda item: item[0]
        )
        found: dict[tuple[str, str, str], Tried] = {}
        for _, hypothesis, values in ranked:
            if hypothesis.place not in found and len(found) < EXCHANGED:
                fitted = fit_joint(self.evidence, [*kept, (hypothesis, values)], evaluations=10)
                found[hypothesis.place] = Tried(joint=fitted, index=len(kept), score=self.score(fitted, 1.0))
        return tuple(sorted(found.values(), key=lambda item: item.joint.cost))


def _taken(x: Rough, residual: Rough) -> float:
    """Return how much of the residual's sum of squares some columns take."""
    if x.shape[1] == 1:
        size = float(x[:, 0] @ x[:, 0])
        return float((x[:, 0] @ residual) ** 2 / size) if size > 1e-12 else 0.0
    q, r = np.linalg.qr(x)
    good = np.abs(np.diag(r)) > 1e-5 * np.linalg.norm(r, axis=0) + 1e-9
    part = q.T @ residual
    return float(np.sum(part[good] ** 2))
