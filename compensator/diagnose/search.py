"""Search for the effects that a model lacks: added one after another, refitted together, compared by a criterion.

An effect is worth its parameters where the residual's sum of squares falls by more than chance would make it fall
with the number of hypotheses tried:

    J = N/c · log(Σ e² + A) + Σ_effects [ p log(N/c) + 2 log M ]

with N samples, p parameters, M places tried, A what the base model's own error may leave, and *c* the variance
inflation of the final residual: N/c is its effective number of samples.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Fit, Start, Term, as_deployed, columns_of, fit_terms, late_term
from compensator.diagnose.noise import lead_noise_um2
from compensator.diagnose.scan import Scan
from compensator.diagnose.switching import switchings
from compensator.model.effects.hypothesis import Hypothesis, proposals

#: Most effects looked for.
MOST = 4
#: Hypotheses that are fitted after each scan: for one effect more, and in the place of one.
POLISHED, EXCHANGED = 12, 6
#: Columns of an effect that are larger than their sum by this much cancel each other.
CANCELS = 6.0
#: Effects that explain this share of what all explain leave the rest to a companion.
MOSTLY = 0.7
#: Where forms are approximate, what one effect leaves up to this share of the sum of squares is due to its form.
FORM_LEAVES = 0.08
#: Where forms are approximate, an unobserved source may leave this share of what channels leave.
UNOBSERVED_LEAVES = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A hypothesis that was fitted during the search.

    Parameters
    ----------
    fit : Fit
        The fit, with the effects found before.
    index : int
        Which of its terms was tried.
    score : float
        *J*.
    """

    fit: Fit
    index: int
    score: float

    @property
    def term(self) -> Term:
        """What was tried."""
        return self.fit.terms[self.index]


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What a search found.

    Parameters
    ----------
    before, fit : Fit
        The fit of nothing, and of the effects found.
    variance_inflation : float
        *c*.
    rivals : tuple of tuple of Candidate
        For each effect, what else was fitted in its place, best first.
    """

    before: Fit
    fit: Fit
    variance_inflation: float = 1.0
    rivals: tuple[tuple[Candidate, ...], ...] = ()


class Search:
    """One search over one body of evidence."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        self.approximate = evidence.context.approximate
        self.scan = Scan(evidence)
        self.places = len({hypothesis.place for hypothesis in self.scan.hypotheses}) + 1

    def run(self, *, unobserved: bool = True) -> Selection:
        """Search what the inputs explain, then whether a source that no channel shows explains it better.

        Parameters
        ----------
        unobserved : bool
            Whether an unobserved source is looked for.
        """
        evidence = self.evidence
        before = fit_terms(evidence, [])
        left = evidence.without_nuisances(evidence.residual)
        if evidence.noise.is_expected(float(left @ left)):
            return Selection(before=before, fit=before)
        path = self._forward([before])
        others = self._beside_background(path[-1])
        last = min([path[-1], *others], key=lambda fit: self.score(fit, 1.0))
        structured = not self._is_noise(last) and not self._is_white(last)
        if unobserved and structured and not self._is_one_effect([*path, *others], before):
            others = [*others, *self._with_unobserved(path, last)]
            last = min([last, *others], key=lambda fit: self.score(fit, 1.0))
        inflation = evidence.variance_inflation(last.residual)
        best = min([*path, *others], key=lambda fit: self.score(fit, inflation))
        best = self._settle_background(self._worth_deployed(self._pruned(best, inflation)), before)
        rivals = tuple(self._rivals(best, i) for i in range(len(best.terms)))
        return Selection(before=before, fit=best, variance_inflation=inflation, rivals=rivals)

    def score(self, fit: Fit, variance_inflation: float) -> float:
        """Return *J*."""
        count = self.evidence.count / variance_inflation
        penalty = fit.parameters * math.log(max(count, 2.0)) + 2.0 * len(fit.terms) * math.log(self.places)
        return count * math.log(max(fit.cost + self.evidence.noise.allowance, 1e-12)) + penalty

    # ------------------------------------------------------------------ order of the search

    def _forward(self, path: list[Fit]) -> list[Fit]:
        """Add one effect after another while each is worth it."""
        while len(path) <= MOST:
            last = path[-1]
            if self._is_noise(last) and self._is_white(last):
                break
            step = [c for c in self._add(last) if self._is_worth(c.term.hypothesis, last, c.fit)]
            if not step:
                break
            better = self._improved(step[0].fit)
            inflation = self._inflation(better)
            if self.score(better, inflation) >= self.score(last, inflation):
                break
            path.append(better)
        return path

    def _is_noise(self, fit: Fit) -> bool:
        return self.evidence.noise.is_noise(without_lead_noise(self.evidence, fit))

    def _is_white(self, fit: Fit) -> bool:
        return self.evidence.noise.is_white(self.evidence.variance_inflation(fit.residual))

    def _is_one_effect(self, fits: Sequence[Fit], before: Fit) -> bool:
        """Return whether one effect explains so much that its form, where forms are approximate, leaves the rest."""
        return self.approximate and any(
            len(_foreground(fit)) <= 1 and fit.cost < FORM_LEAVES * before.cost for fit in fits
        )

    def _inflation(self, fit: Fit) -> float:
        """Return the variance inflation that counts while something may still be missing.

        On a real machine an effect has only approximately any form, and what it leaves is not noise: few effective
        samples, so that the simpler of two wins. Where forms are exact, what is left is the effect that comes next.
        """
        return self.evidence.variance_inflation(fit.residual) if self.approximate else 1.0

    def _beside_background(self, last: Fit) -> list[Fit]:
        """Return what is found beside a background effect; nothing where one effect alone leaves noise.

        Altering a real machine changes its response to heat and ambient temperature, whatever else it does: what is
        found beside that is not mistaken for it.
        """
        done = len(last.terms) < 2 and self.evidence.noise.is_bare_noise(last.cost)
        if done or not self.approximate:
            return []
        starts = [(hypothesis, ()) for hypothesis in proposals(self.evidence.context, background=True)]
        return self._forward([fit_terms(self.evidence, starts)])

    def _settle_background(self, fit: Fit, before: Fit) -> Fit:
        """Decide whether a background effect is an effect of its own, by which name, or is a companion of others.

        Where other effects explain most without it, it only absorbs what they leave. Where it is alone and effects
        of a simpler name explain most of it, it gets their name.
        """
        background = next((term for term in fit.terms if term.hypothesis.effect.background), None)
        if background is None:
            return fit
        others = [term.start for term in _foreground(fit)]
        if not others:
            simpler: list[Start] = [(h, ()) for h in self.scan.hypotheses if h.effect.names_background]
            if not self._explain_most(simpler, fit, before):
                return fit
            others = [start for start in simpler if start[0].place[1] == background.hypothesis.place[1]]
        elif not self._explain_most(others, fit, before):
            return fit
        fitted = fit_terms(self.evidence, [*others, (background.hypothesis, ())])
        *named, last = fitted.terms
        return dataclasses.replace(fitted, terms=(*named, dataclasses.replace(last, companion=True)))

    def _explain_most(self, some: Sequence[Start], fit: Fit, before: Fit) -> bool:
        """Return whether some effects alone explain most of what all explain."""
        return before.cost - fit_terms(self.evidence, some).cost > MOSTLY * (before.cost - fit.cost)

    def _with_unobserved(self, path: Sequence[Fit], observed: Fit) -> list[Fit]:
        """Return fits with an unobserved source beside what was found before it, or instead of it.

        Steps at any time follow much that they do not cause. On a real machine, where forms are approximate, they must
        leave half of what the best explanation by channels leaves.
        """
        found = []
        for base in path[:3]:
            source = switchings(self.evidence, base.residual)
            if source is not None:
                found.append(fit_terms(self.evidence, [*base.starts(), source]))
        found.sort(key=lambda fit: self.score(fit, 1.0))
        improved = [self._improved(fit) for fit in found[:1]]
        if not self.approximate:
            return improved
        own = self.evidence.count * self.evidence.noise.own_error_um**2
        return [fit for fit in improved if fit.cost + own < UNOBSERVED_LEAVES * (observed.cost + own)]

    def _is_worth(self, hypothesis: Hypothesis, without: Fit, fit: Fit) -> bool:
        """Return whether an effect explains enough, the base model's own error counted as still there."""
        allowance, effect = self.evidence.noise.allowance, hypothesis.effect
        share = effect.worth_with_others if self.approximate and _foreground(without) else effect.worth
        return fit.cost + allowance < (1.0 - share) * (without.cost + allowance)

    # ------------------------------------------------------------------ steps

    def _add(self, fit: Fit, without: int | None = None) -> list[Candidate]:
        """Return fits with one effect more, or with one exchanged, best first."""
        kept = [term for i, term in enumerate(fit.terms) if i != without]
        starts = fit.starts(without)
        base = fit_terms(self.evidence, starts) if without is not None else fit
        found = []
        for hypothesis, values in self.scan.ranked(base, kept)[: POLISHED if without is None else EXCHANGED]:
            fitted = fit_terms(self.evidence, [*starts, (hypothesis, values)])
            if self._is_plausible(fitted.terms[-1]):
                found.append(Candidate(fit=fitted, index=len(starts), score=self.score(fitted, 1.0)))
        if not found:
            return []
        inflation = self._inflation(min(found, key=lambda item: item.score).fit)
        found = [dataclasses.replace(item, score=self.score(item.fit, inflation)) for item in found]
        return sorted(found, key=lambda item: item.score)

    def _improved(self, fit: Fit) -> Fit:
        """Exchange effects one at a time as long as that helps: what was found first may have absorbed two."""
        if len(fit.terms) < 2:
            return fit
        for _ in range(2):
            changed = False
            for i, term in enumerate(fit.terms):
                if term.hypothesis.effect.background:
                    continue
                others = self._add(fit, i) if term.hypothesis.effect.observed else self._switchings_again(fit, i)
                if not others:
                    continue
                inflation = self._inflation(others[0].fit)
                if self.score(others[0].fit, inflation) < self.score(fit, inflation) - 1e-6:
                    fit, changed = others[0].fit, True
            if not changed:
                break
        return fit

    def _switchings_again(self, fit: Fit, index: int) -> list[Candidate]:
        """Look for the unobserved source again, with the other effects as they are now."""
        kept = fit.starts(index)
        source = switchings(self.evidence, fit_terms(self.evidence, kept).residual)
        if source is None:
            return []
        fitted = fit_terms(self.evidence, [*kept[:index], source, *kept[index:]])
        return [Candidate(fit=fitted, index=index, score=self.score(fitted, 1.0))]

    def _pruned(self, fit: Fit, inflation: float) -> Fit:
        """Leave out every effect that is not worth its parameters."""
        while fit.terms:
            fewer = [fit_terms(self.evidence, fit.starts(i)) for i in range(len(fit.terms))]
            out = min(range(len(fewer)), key=lambda i: self.score(fewer[i], inflation))
            small = not self._is_worth(fit.terms[out].hypothesis, fewer[out], fit)
            if self.score(fewer[out], inflation) > self.score(fit, inflation) and not small:
                return fit
            fit = fewer[out]
        return fit

    def _worth_deployed(self, fit: Fit) -> Fit:
        """Leave out every effect that is worth nothing once a late T_Q is corrected as the engine does.

        What the correction leaves after a change of the heat is no further effect.
        """
        while (late := late_term(fit)) is not None and len(fit.terms) > 1:
            whole, _ = as_deployed(self.evidence, fit)
            others = [i for i, term in enumerate(fit.terms) if term is not late]
            fewer = {i: fit_terms(self.evidence, fit.starts(i)) for i in others}
            deployed = {i: as_deployed(self.evidence, fewer[i])[0] for i in others}
            out = min(others, key=lambda i: deployed[i].cost)
            if self._is_worth(fit.terms[out].hypothesis, deployed[out], whole):
                break
            fit = fewer[out]
        return fit

    def _is_plausible(self, term: Term) -> bool:
        """Refuse an effect whose columns cancel: two lags that imitate a derivative or a ramp are not physical."""
        if len(term.amplitudes) < 2 or term.hypothesis.effect.ridge:
            return True
        table = columns_of(self.evidence, *term.start)[0] * np.array(term.amplitudes)
        return bool(np.max(np.linalg.norm(table, axis=0)) < CANCELS * np.linalg.norm(table.sum(axis=1)))

    def _rivals(self, fit: Fit, index: int) -> tuple[Candidate, ...]:
        """Return what else explains the part of an effect, one for each place, best first."""
        if fit.terms[index].companion:
            return ()
        kept = fit.starts(index)
        base = fit_terms(self.evidence, kept)
        found: dict[tuple[str, str, str], Candidate] = {}
        for hypothesis, values in self.scan.ranked(base, fit.terms):
            if hypothesis.place not in found and len(found) < EXCHANGED:
                fitted = fit_terms(self.evidence, [*kept, (hypothesis, values)], evaluations=10)
                found[hypothesis.place] = Candidate(fit=fitted, index=len(kept), score=self.score(fitted, 1.0))
        return tuple(sorted(found.values(), key=lambda item: item.fit.cost))


def _foreground(fit: Fit) -> list[Term]:
    """Return the effects that are no background."""
    return [term for term in fit.terms if not term.hypothesis.effect.background]


def without_lead_noise(evidence: Evidence, fit: Fit) -> float:
    """Return what a fit leaves, less the noise that the lead of a late T_Q adds to its column, µm²."""
    late = late_term(fit)
    lateness = late.effect.lateness if late is not None else None
    if lateness is None:
        return fit.cost
    return fit.cost - evidence.count * lead_noise_um2(evidence.model, evidence.runs, lateness.lag_min)
