"""Search for the effects that a model lacks: proposed by scans, compared by the evidence.

A rest that may be large hides slow effects from a scan, a small one shows them and is fooled by what is missing. So
effects are proposed with both, and compared with the rest that fits each best.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from compensator.diagnose.fitting.fit import Fit, Start, Term, fit_terms, settled
from compensator.diagnose.fitting.likelihood import Likelihood, rest_without_effects
from compensator.diagnose.fitting.points import Points, SlowRest
from compensator.diagnose.fitting.prediction import Folds
from compensator.diagnose.fitting.standard_errors import deviations
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.criterion import MOSTLY, Criterion
from compensator.diagnose.search.scan import Grid, Scan
from compensator.diagnose.search.switching import switchings
from compensator.model.effects.hypothesis import Hypothesis, Place, proposals

T = TypeVar("T")

#: Most effects looked for.
MOST = 4
#: Few values do not decide whether an effect acts that is not worth its price and adds as much as this.
DOUBT = 4.5
#: Hypotheses that are fitted after each scan, and for how many of those the rest is learned.
FITTED, JUDGED = 6, 4
#: Shortest period that averaged points show for what it is, points.
ALIAS_FREE = 3.0
#: Effects are proposed beside a small slow rest, too, if that of the fit is larger by the first factor, and beside one
#: between them if it is larger by the second.
SMALLER = (1.5, 6.0)
#: Where the base leaves no more than it may by its own error, an input must add so much more to the evidence.
EXPECTED = 8.0
#: Explanations are about as likely if they differ by so little, and one foretells clearly better than another if it
#: leaves so much of its error on held-out blocks.
NEARLY, FORETELLS = 2.0, 0.8
#: Kinds of what may change in a path that stays linear.
OF_PATHS = ("dynamics", "gain", "delay")


@dataclass(frozen=True, slots=True, kw_only=True)
class Alternative:
    """A hypothesis that was fitted in the place of an effect.

    Parameters
    ----------
    term : Term
        What was tried.
    fit : Fit
        The fit, with the other effects.
    rms_um : float
        What it leaves, µm, as `Criterion.compared` has it.
    score : float
        Its criterion of selection.
    """

    term: Term
    fit: Fit
    rms_um: float
    score: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What a search found.

    Parameters
    ----------
    before, fit : Fit
        The fit of nothing, and of the effects found.
    undecided : tuple of Fit
        Where few values do not decide: effects that may act, best first.
    """

    before: Fit
    fit: Fit
    undecided: tuple[Fit, ...] = ()


class Search:
    """One search over one body of evidence.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals.
    grid : Grid, optional
        That of a search over all data, where something is held out.
    """

    def __init__(self, evidence: Evidence, grid: Grid | None = None) -> None:
        context = evidence.context
        self.evidence, self.points = evidence, Points(evidence)
        self.hypotheses = proposals(context)
        if evidence.free_paths:
            # The paths are estimated with everything else; nothing can be said of how they differ from a base.
            self.hypotheses = [hypothesis for hypothesis in self.hypotheses if hypothesis.effect.kind == "input"]
        elif context.approximate:
            self.hypotheses += proposals(context, background=True)
        self.hypotheses = [_above(hypothesis, ALIAS_FREE * self.points.period_min) for hypothesis in self.hypotheses]
        self._scan = Scan(self.points, self.hypotheses, grid)
        self.criterion = Criterion(evidence, self.hypotheses)
        # One step after another asks for the same.
        self._known_proposed: dict[Hashable, list[Fit]] = {}
        self._known_settled: dict[Hashable, Fit] = {}
        self._known_rivals: dict[Hashable, tuple[Alternative, ...]] = {}

    @property
    def grid(self) -> Grid:
        """What a search without some of the data need not compute again."""
        return self._scan.grid

    def run(self, *, unobserved: bool = True) -> Selection:
        """Search what the inputs explain, and a source that no channel shows.

        Parameters
        ----------
        unobserved : bool
            Whether an unobserved source is looked for.
        """
        unobserved = unobserved and not self.evidence.free_paths
        before = fit_terms(Likelihood(self.points, rest_without_effects(self.points)), [])
        self.criterion.something_acts = self.evidence.is_sparse and not self.criterion.leaves_noise(before)
        expected = self.criterion.is_expected(before)
        unobserved = unobserved and not expected
        # What may come by itself on another day is an error of the paths. What another channel adds is none.
        paths = frozenset(one.place for one in self.hypotheses if expected and one.effect.kind != "input")
        grown, undecided = self._grown(before, unobserved=unobserved, apart_from=paths)
        best = self._pruned(grown)
        if grown.terms and not best.terms:
            # What was too small to name must not keep out what is not.
            grown, undecided = self._grown(before, unobserved=unobserved, apart_from=paths | grown.places)
            best = self._pruned(grown)
        # What was left out as too small must not come back in the place of what it was too small beside.
        small = paths | (grown.places - best.places)
        best = self._with_simpler_name(self._exchanged(best, keep_last=False, apart_from=small))
        best = self._foretelling(best, apart_from=small)
        if hidden := self._hidden(undecided, best):
            best = hidden
        return Selection(before=before, fit=best, undecided=() if best.terms else undecided)

    def _grown(self, best: Fit, *, unobserved: bool, apart_from: frozenset[Place]) -> tuple[Fit, tuple[Fit, ...]]:
        """Add one effect after another while each is worth its cost; return what few values do not decide, too.

        Parameters
        ----------
        best : Fit
            Where to begin.
        unobserved : bool
            Whether an unobserved source is looked for.
        apart_from : frozenset of Place
            Effects that are not looked for.
        """
        while len(best.terms) < MOST:
            expected = self.criterion.is_expected(best)
            if expected and best.terms:
                break
            proposed = self._proposed(best, unobserved=unobserved, apart_from=apart_from)
            # A source with many switchings looks poor until the rest is settled with it.
            late = [fit for fit in proposed[JUDGED:] if not fit.terms[-1].hypothesis.effect.observed]
            candidates = [self._settled(fit) for fit in (*proposed[:JUDGED], *late)]
            better = max(candidates, key=self.criterion.score, default=best)
            if self.criterion.score(better) <= self.criterion.score(best) + expected * EXPECTED:
                return best, self._undecided(candidates, best)
            best = self._exchanged(better, apart_from=apart_from)
        return best, ()

    def _hidden(self, undecided: Sequence[Fit], best: Fit) -> Fit | None:
        """Return a source that no channel shows, if few values show that something acts and nothing else comes nearer.

        The slow rest is such a source, too, only without times: it must not keep the one with times from its name.
        """
        if best.terms or not self.criterion.something_acts:
            return None
        first = next((fit for fit in undecided if self.criterion.leaves_noise(fit)), None)
        return first if first and first.terms[-1].hypothesis.effect.kind == "unobserved" else None

    def _undecided(self, candidates: Sequence[Fit], best: Fit) -> tuple[Fit, ...]:
        """Return the effects that may act, best first, where few values do not decide it."""
        if not self.evidence.is_sparse:
            return ()
        least = -math.inf if self.criterion.something_acts else best.log_evidence + DOUBT
        return tuple(sorted((f for f in candidates if f.log_evidence > least), key=self.criterion.score, reverse=True))

    def of_paths(self, nothing: Fit) -> Selection | None:
        """Return a change of the paths that explains most of what the base leaves, in the place of a large own error.

        Such an error is learned from the data and takes any form of timing: it must not keep a change of the paths from
        its name. Beside one of the usual size that change shows.

        Parameters
        ----------
        nothing : Fit
            The fit of nothing, of which the own error explains most (`Criterion.is_of_paths`).
        """
        usual = dataclasses.replace(nothing.rest, fast_um=self.points.typical_rest().fast_um)
        beside_usual = fit_terms(Likelihood(self.points, usual), [])
        before_um2 = self.criterion.rms(()) ** 2
        named = [
            fit
            for fit in self._proposed(beside_usual, unobserved=False)
            if (effect := fit.terms[0].hypothesis.effect).kind in OF_PATHS
            and effect.lateness is None
            and before_um2 - self.criterion.rms(fit.terms) ** 2 > MOSTLY * before_um2
        ]
        if not named:
            return None
        # What can absorb any change of the paths is the own error once more.
        best = min(named, key=lambda fit: (fit.terms[0].hypothesis.effect.background, -self.criterion.score(fit)))
        return Selection(before=nothing, fit=best)

    def rivals(self, fit: Fit, index: int) -> tuple[Alternative, ...]:
        """Return what else explains the part of an effect, one for each place, best first."""
        return _once(self._known_rivals, (_values(fit), index), lambda: self._rivals(fit, index))

    def _rivals(self, fit: Fit, index: int) -> tuple[Alternative, ...]:
        kept = fit.starts(index)
        base = fit_terms(fit.likelihood, kept, evaluations=1)
        found: dict[Place, Alternative] = {}
        for hypothesis, values in self._scan.ranked(fit.likelihood, base, self.criterion.cost_of):
            if hypothesis.place not in found and hypothesis.place not in fit.places and len(found) < FITTED:
                other = fit_terms(fit.likelihood, [*kept, (hypothesis, values)], evaluations=6)
                found[hypothesis.place] = Alternative(
                    term=other.terms[-1],
                    fit=other,
                    rms_um=self.criterion.compared(other),
                    score=self.criterion.score(other),
                )
        return tuple(sorted(found.values(), key=lambda item: item.rms_um))

    # ------------------------------------------------------------------ steps

    def _views(self, fit: Fit) -> list[SlowRest]:
        """Return the rests with which effects are proposed: as it is, small, and between."""
        small = min(fit.rest.slow_um, max(self.evidence.probe_um, self.points.own_um))
        views = [fit.rest]
        if fit.rest.slow_um > SMALLER[0] * small:
            views.append(dataclasses.replace(fit.rest, slow_um=small))
        if fit.rest.slow_um > SMALLER[1] * small:
            views.append(dataclasses.replace(fit.rest, slow_um=math.sqrt(fit.rest.slow_um * small)))
        return views

    def _settled(self, fit: Fit) -> Fit:
        return _once(self._known_settled, _values(fit), lambda: settled(fit))

    def _proposed(self, fit: Fit, *, unobserved: bool, apart_from: frozenset[Place] = frozenset()) -> list[Fit]:
        """Return fits with one effect more, each with the view that suits it, best first."""
        asked = _values(fit), fit.log_evidence if unobserved else None, apart_from - fit.places
        fitted = partial(self._fitted, fit, unobserved=unobserved, apart_from=apart_from)
        return _once(self._known_proposed, asked, fitted)

    def _fitted(self, fit: Fit, *, unobserved: bool, apart_from: frozenset[Place]) -> list[Fit]:
        views = self._views(fit)
        likelihoods = [Likelihood(self.points, rest) for rest in views]
        found: list[Fit] = []
        seen = set()
        for rest, likelihood in zip(views, likelihoods, strict=True):
            all_ranked = self._scan.ranked(likelihood, fit, self.criterion.cost_of)
            ranked: Iterable[Start] = [start for start in all_ranked if start[0].place not in apart_from][:FITTED]
            if unobserved and rest is views[-1] and all(t.hypothesis.effect.observed for t in fit.terms):
                ranked = itertools.chain(ranked, self._sources(rest, fit, found))
            for start in ranked:
                if id(start[0]) in seen or start[0].place in apart_from:
                    continue
                seen.add(id(start[0]))
                if start[0].effect.jumps:
                    if self._starts_anywhere(fit):
                        continue
                    start = self._at_best_sample(likelihood, fit, start)  # noqa: PLW2901
                added = fit_terms(likelihood, [*fit.starts(), start], evaluations=8)
                if not self.criterion.is_plausible(added.terms):
                    continue
                others = [
                    fit_terms(other, added.starts(), evaluations=1) for other in likelihoods if other is not likelihood
                ]
                found.append(max([added, *others], key=self.criterion.score))
        return sorted(found, key=self.criterion.score, reverse=True)

    def _at_best_sample(self, likelihood: Likelihood, fit: Fit, start: Start) -> Start:
        """Return a jump at the sample near its point of the grid that suits it best.

        What it leaves is no smooth function of its time: beside a large one a search ends where it begins.
        """
        hypothesis, (at_min, *_) = start
        free, period_min = hypothesis.free[0], self.evidence.context.period_min
        apart = max(round(float(np.max(np.diff(free.grid), initial=0.0)) / period_min), 0)
        near = [at_min + i * period_min for i in range(-apart, apart + 1)]
        fits = [
            fit_terms(likelihood, [*fit.starts(), (hypothesis, (at,))], evaluations=1)
            for at in near
            if free.low <= at <= free.high
        ]
        return max(fits, key=lambda one: one.log_evidence).terms[-1].start

    def _exchanged(self, fit: Fit, *, keep_last: bool = True, apart_from: frozenset[Place]) -> Fit:
        """Exchange effects, or their forms, one at a time where it helps: what was found first may have absorbed two.

        Parameters
        ----------
        fit : Fit
            Effects.
        keep_last : bool
            Whether the last one is not tried, which was chosen beside the others.
        apart_from : frozenset of Place
            Effects that are not looked for.
        """
        for place in [term.hypothesis.place for term in fit.terms[: len(fit.terms) - keep_last]]:
            i = fit.index_of(place)
            if i is None:
                continue
            others = fit_terms(fit.likelihood, fit.starts(i), evaluations=1)
            proposed = self._proposed(others, unobserved=False, apart_from=apart_from)
            forms = [one for one in proposed if one.places == fit.places and one.forms != fit.forms]
            for candidate in (*forms[:1], *[one for one in proposed[:2] if one.places != fit.places]):
                better = self._settled(candidate)
                fit = better if self.criterion.score(better) > self.criterion.score(fit) else fit
        return fit

    def _pruned(self, fit: Fit) -> Fit:
        """Leave out every effect that is not worth its cost, too small to name, or not known apart from the others."""
        while fit.terms:
            fewer = [self._settled(fit_terms(fit.likelihood, fit.starts(i))) for i in range(len(fit.terms))]
            best = max(range(len(fewer)), key=lambda i: self.criterion.score(fewer[i]))
            small = [i for i, term in enumerate(fit.terms) if not self.criterion.is_worth_naming(term, fewer[i], fit)]
            if not small and not self.evidence.free_paths:
                small = [i for i, (size, std) in enumerate(deviations(fit)) if std > size]
            if self.criterion.score(fewer[best]) <= self.criterion.score(fit):
                if not small:
                    return fit
                best = max(small, key=lambda i: self.criterion.score(fewer[i]))
            fit = fewer[best]
        return fit

    def _sources(self, rest: SlowRest, fit: Fit, found: Sequence[Fit]) -> Iterator[Start]:
        """Yield a source that no channel shows, where it may compete with the effects found.

        It begins when `found` has the effects of the scan: a source that cannot win is not refined.
        """
        best = max((other.log_evidence for other in found), default=fit.log_evidence)
        if source := switchings(rest, fit, best - fit.log_evidence):
            yield source

    def _starts_anywhere(self, fit: Fit) -> bool:
        """Return whether an initial state of an effect is unknown: until its first reversal it looks like a jump."""
        return self.evidence.context.approximate and any(t.hypothesis.effect.starts_anywhere for t in fit.terms)

    def _with_simpler_name(self, fit: Fit) -> Fit:
        """Name what can absorb any change of the paths by a simple effect that explains most of it."""
        for i, term in enumerate(fit.terms):
            if term.hypothesis.effect.background or (
                self.evidence.context.approximate and term.hypothesis.effect.kind == "dynamics"
            ):
                without = self.criterion.rms(fit_terms(fit.likelihood, fit.starts(i), evaluations=1).terms) ** 2
                all_of_it = without - self.criterion.rms(fit.terms) ** 2
                for hypothesis in self.hypotheses:
                    if hypothesis.effect.names_background and hypothesis.place not in fit.places:
                        starts = [*fit.starts(i)[:i], (hypothesis, ()), *fit.starts(i)[i:]]
                        simple = self._settled(fit_terms(fit.likelihood, starts))
                        if without - self.criterion.rms(simple.terms) ** 2 > MOSTLY * all_of_it:
                            return simple
        return fit

    def _foretelling(self, fit: Fit, *, apart_from: frozenset[Place]) -> Fit:
        """Exchange an effect, or its form, for one that is as likely, or nearly, and foretells clearly better.

        There the evidence does not choose; a form of many lags is as likely as one lag then, and elsewhere it runs
        free. What is more likely is kept: a block that is held out may have the one event that shows it.
        """
        if self.evidence.is_sparse or self.evidence.free_paths or self.points.is_exact:
            return fit
        folds = Folds(self.points)
        for place in [term.hypothesis.place for term in fit.terms]:
            i = fit.index_of(place)
            if i is None or not (effect := fit.terms[i].effect).observed:
                continue
            others = fit_terms(fit.likelihood, fit.starts(i), evaluations=1)
            proposed = self._proposed(others, unobserved=False, apart_from=apart_from)
            least = self.criterion.score(fit) - NEARLY
            # A form of any lags does not take the place of one with a law: it may resemble that.
            others_settled = [
                self._settled(one)
                for one in proposed[:FITTED]
                if one.forms != fit.forms and (effect.has_any_form or not one.terms[-1].effect.has_any_form)
            ]
            near = [one for one in others_settled if self.criterion.score(one) > least]
            if near:
                errors = [folds.error_um(one) for one in near]
                best = int(np.argmin(errors))
                if errors[best] < FORETELLS * folds.error_um(fit):
                    fit = near[best]
        return fit


def _once(known: dict[Hashable, T], asked: Hashable, found: Callable[[], T]) -> T:
    """Return the answer to a question, found when it is asked for the first time."""
    if asked not in known:
        known[asked] = found()
    return known[asked]


def _values(fit: Fit) -> Hashable:
    """Return what a fit is made of: the values of its effects, and the rest."""
    return tuple((term.hypothesis, term.values) for term in fit.terms), fit.rest


def _above(hypothesis: Hypothesis, shortest_min: float) -> Hypothesis:
    """Return a hypothesis without periods that averaged points would show as others."""
    free = tuple(
        dataclasses.replace(f, low=max(f.low, shortest_min), grid=tuple(g for g in f.grid if g > shortest_min))
        if f.name == "period_min"
        else f
        for f in hypothesis.free
    )
    return dataclasses.replace(hypothesis, free=free)
