"""The criterion of selection: the evidence of an explanation, less what naming its effects costs.

    J = log p(residual | effects) − Σ_effects [ log(M + 1) + log f + margin ]

with M places tried and f forms of a place. A source that no channel shows is charged more beside an approximate base,
what another axis shows the margin alone. The evidence counts everything else: parameters and amplitudes cost what
the data leave of their ranges, and what no effect explains is a slow rest and noise of learned size.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.fitting.fit import Fit, Term, response, summed
from compensator.diagnose.fitting.points import raw_columns
from compensator.diagnose.residual.evidence import Evidence
from compensator.model.effects.hypothesis import Hypothesis

#: What an effect must add to the logarithm of the evidence, beyond the number of places tried.
MARGIN = 4.0
#: What a source that no channel shows must add beyond that where the base has an error of its own, whose form it takes.
UNSEEN = 15.0
#: A simpler effect gives its name where it explains this share of what a background effect or a large own error
#: explains, and so do channels in place of a source that no channel shows and that makes up for the effects beside it.
MOSTLY = 0.7
#: Columns of an effect that are larger than their sum by this much cancel each other.
CANCELS = 6.0
#: Effects make up for each other where one is larger than all together by this much.
MAKES_UP = 2.0


class Criterion:
    """Compares fits, and says which effects are worth naming.

    Parameters
    ----------
    evidence : Evidence
        The data.
    hypotheses : sequence of Hypothesis
        Everything that is tried.

    Attributes
    ----------
    something_acts : bool
        Whether few values are left with more than their stated noise where nothing is assumed to act.
    """

    def __init__(self, evidence: Evidence, hypotheses: Sequence[Hypothesis]) -> None:
        self._evidence = evidence
        self._forms = Counter(hypothesis.place for hypothesis in hypotheses)
        self.something_acts = False

    def score(self, fit: Fit) -> float:
        """Return *J*."""
        return fit.log_evidence - self.charge(fit)

    def charge(self, fit: Fit) -> float:
        """Return what the effects of a fit are charged.

        Where few values are left with more than their stated noise, something acts, and effects that leave no more than
        that are not charged for being there: one of them is, or a slow cause that has no name.
        """
        waived = self.something_acts and bool(fit.terms) and self.leaves_noise(fit)
        return self.cost(fit) - waived * self.price

    def cost(self, fit: Fit) -> float:
        """Return what the effects of a fit must add to the evidence."""
        return sum(self.cost_of(term.hypothesis) for term in fit.terms)

    def left(self, terms: Sequence[Term]) -> Vector:
        """Return what effects leave on every sample, nuisances projected out, µm; 0 where samples are not used."""
        left = self._evidence.residual - summed(self._evidence, terms)
        return self._evidence.without_nuisances(np.where(self._evidence.used, left, 0.0))

    def rms(self, terms: Sequence[Term]) -> float:
        """Return the rms of what effects leave, µm."""
        return float(np.sqrt(np.sum(self.left(terms) ** 2) / self._evidence.count))

    def compared(self, fit: Fit) -> float:
        """Return the rms of what a fit leaves beside what its choice granted, µm: what rivals are compared by.

        Where effects are fitted beside an error of the base's own paths and of their form, or beside paths that are
        free, that is taken off. It is known on the points only.
        """
        likelihood = fit.likelihood
        points = likelihood.points
        if points.is_exact and not self._evidence.free_paths:
            return self.rms(fit.terms)
        left = points.residual - fit.added - points.random(fit.rest) @ likelihood.weights(fit.added)
        return float(np.sqrt(np.mean(left**2)))

    def is_of_paths(self, nothing: Fit) -> bool:
        """Return whether an own error of the base's paths explains most of what the base leaves: more than noise.

        Parameters
        ----------
        nothing : Fit
            The fit of nothing, where the paths are approximate and not free.
        """
        points, likelihood = nothing.likelihood.points, nothing.likelihood
        if points.is_exact or self._evidence.is_sparse or self.leaves_noise(nothing):
            return False
        table, weights = points.random(nothing.rest), likelihood.weights(nothing.added)
        first = points.zeros.shape[1] + points.starts_of_modes.shape[1]
        before = points.residual - table[:, :first] @ weights[:first]
        left = before - table[:, first:] @ weights[first:]
        return bool(np.mean(left**2) < (1.0 - MOSTLY) * np.mean(before**2))

    @property
    def price(self) -> float:
        """What a usual effect must add to the logarithm of the evidence."""
        return MARGIN + math.log(len(self._forms) + 1)

    def cost_of(self, hypothesis: Hypothesis) -> float:
        """Return what an effect must add to the evidence."""
        if hypothesis.place in self._evidence.expected:
            return MARGIN
        unseen = UNSEEN if self._evidence.context.approximate and not hypothesis.effect.observed else 0.0
        return unseen + MARGIN + math.log(len(self._forms) + 1) + math.log(max(self._forms[hypothesis.place], 1))

    def leaves_noise(self, fit: Fit) -> bool:
        """Return whether what a fit leaves may be noise alone."""
        return self._evidence.noise.is_explained(self.rms(fit.terms) ** 2 * self._evidence.count)

    def is_expected(self, fit: Fit) -> bool:
        """Return whether what is left may come by itself on another day, where the calibration states its error.

        An effect that another axis shows is looked for all the same.
        """
        noise = self._evidence.noise
        return (
            self._evidence.expected <= fit.places
            and noise.own_error_um > 0.0
            and not self._evidence.is_sparse
            and noise.is_expected(self.rms(fit.terms) ** 2 * self._evidence.count)
        )

    def is_worth_naming(self, term: Term, without: Fit, fit: Fit) -> bool:
        """Return whether an effect is large enough beside what is left without it and the base model's own error."""
        if self._evidence.free_paths:
            # What is left without it is the whole deformation: only the evidence says what it is worth.
            return True
        effect, approximate = term.hypothesis.effect, self._evidence.context.approximate
        others, without_um2 = len(fit.terms) > 1, self.rms(without.terms) ** 2
        removed_um2 = without_um2 - self.rms(fit.terms) ** 2
        if term.hypothesis.acts_by_temperature:
            # The base has the part of it that heat and ambient make: that alone makes more of the error, not less.
            removed_um2 = max(removed_um2, self.compared(without) ** 2 - self.compared(fit) ** 2)
        if approximate and not others and removed_um2 < effect.removes_alone * without_um2:
            return False
        share = effect.worth_with_others if approximate and others else effect.worth
        size = float(np.sum(self._added(term) ** 2))
        return size > share * (without_um2 * self._evidence.count + self._evidence.noise.allowance)

    def is_plausible(self, terms: Sequence[Term]) -> bool:
        """Refuse effects of which the columns of the last cancel, or that make up for each other.

        Two lags that imitate a derivative or a ramp are not physical. Two large effects that leave little together here
        leave much on another day, and keep what acts from being found.
        """
        return not self._cancels(terms[-1]) and (len(terms) < 2 or not self._make_up(terms))

    def _cancels(self, term: Term) -> bool:
        if len(term.amplitudes) < 2 or term.hypothesis.effect.has_any_form:
            return False
        table = raw_columns(self._evidence, term.hypothesis, term.values) * np.array(term.amplitudes)
        table = table[self._evidence.used]
        table = table - table.mean(axis=0)
        return bool(np.max(np.linalg.norm(table, axis=0)) >= CANCELS * np.linalg.norm(table.sum(axis=1)))

    def _make_up(self, terms: Sequence[Term]) -> bool:
        each = [self._added(term) for term in terms]
        return bool(max(map(np.linalg.norm, each)) > MAKES_UP * np.linalg.norm(sum(each)))

    def _added(self, term: Term) -> Vector:
        """Return what an effect adds on every sample, nuisances projected out, µm; 0 where samples are not used."""
        added = np.where(self._evidence.used, response(self._evidence, term), 0.0)
        return self._evidence.without_nuisances(added)
