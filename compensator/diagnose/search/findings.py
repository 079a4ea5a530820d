"""What is found in some evidence: named effects as the engine runs them, and a remainder of all channels."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Vector, rms_of
from compensator.diagnose.fitting.fit import (
    Fit,
    Term,
    as_deployed,
    fit_terms,
    has_dead_time,
    late_term,
    response,
    settled,
)
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.background import Background, Regressed
from compensator.diagnose.search.criterion import MARGIN, MOSTLY
from compensator.diagnose.search.foresight import Foresight, foreseeing
from compensator.diagnose.search.own_error import foretelling, own_error, own_error_alone
from compensator.diagnose.search.scan import Grid
from compensator.diagnose.search.search import Search, Selection

#: The remainder is worth deploying where it adds this much to the logarithm of the evidence, and this share of noise
#: and own error; where nothing is known of the paths, so are named effects in place of all channels.
WORTH, LEAST = 2.0 * MARGIN, 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Effects and remainder.

    Parameters
    ----------
    search : Search
        The search, with its data.
    selection : Selection
        What it found.
    fit : Fit
        Its effects as they are deployed.
    terms : tuple of Term
        Effects as the engine runs them.
    responses : tuple of numpy.ndarray, shape (n,)
        What each adds to y on every sample, µm.
    remainder : Regressed or None
        What the channels explain beyond them, where that is worth deploying; elsewhere the own error beside them.
    is_own_error : bool
        Whether the remainder is the base's own error: with which the effects were fitted; or alone, where it explains
        most of what the base leaves, with a name for it in whose place it stands, or without.
    confirmed : float
        Share of the remainder that is deployed.
    deploys_names : bool
        Whether the named effects are deployed. Where all channels together, or an own error, explain the data clearly
        better without them, their names say what resembles it most, and the remainder is deployed in their place.
    channels : Regressed
        What all channels together explain without any named effect.
    paths : numpy.ndarray, shape (n,)
        What the base's paths alone would explain, where nothing was known of them; 0 elsewhere, µm.
    refitted : Regressed or None
        The base's paths fitted together with the named effects, where nothing was known of them.
    foresight : Foresight or None
        How the drive moves, where a late T_Q was found.
    left_in : Term or None
        A late T_Q that is named and not corrected; it adds nothing to y in `responses`.
    """

    search: Search
    selection: Selection
    fit: Fit
    terms: tuple[Term, ...]
    responses: tuple[Vector, ...]
    remainder: Regressed | None
    is_own_error: bool
    deploys_names: bool
    channels: Regressed
    paths: Vector
    refitted: Regressed | None
    foresight: Foresight | None = None
    confirmed: float = 1.0
    left_in: Term | None = None

    @property
    def named(self) -> Vector:
        """What the named effects add, µm; with the paths, where nothing was known of them."""
        return np.asarray(sum(self.responses, self.own_paths))

    @property
    def own_paths(self) -> Vector:
        """What the base's paths add, fitted together with the named effects; 0 where they are kept, µm."""
        return self.refitted.added if self.refitted else np.zeros(self.ceiling.size)

    @property
    def ceiling(self) -> Vector:
        """What all channels together explain without any named effect, µm."""
        return self.channels.added

    @property
    def left_in_um(self) -> Vector:
        """What a late T_Q that is left in would add, µm; 0 without one."""
        if self.left_in is None:
            return np.zeros(self.ceiling.size)
        return response(self.search.evidence, self.left_in)

    @property
    def leaves_noise(self) -> bool:
        """Whether the base model leaves no more than noise, with zero and initial state fitted."""
        return self.search.criterion.leaves_noise(self.selection.before)

    @property
    def is_hidden(self) -> bool:
        """Whether all that is named is a source that no channel shows."""
        return bool(self.terms) and not any(term.effect.observed for term in self.terms)

    @property
    def is_of_measurement(self) -> bool:
        """Whether all that is named depends on time alone, and is an error of the measurement."""
        return bool(self.terms) and all(one.effect.of_measurement for one in self.terms)

    @property
    def corrects_late_t_q(self) -> bool:
        """Whether a late T_Q is named and not left in."""
        return self.left_in is None and late_term(self.selection.fit) is not None

    @property
    def is_own_error_alone(self) -> bool:
        """Whether the own error is deployed without effects beside it."""
        return self.is_own_error and not (self.terms and self.deploys_names)

    @property
    def whole(self) -> Vector:
        """What effects and remainder add, µm."""
        if self.remainder is None:
            return self.named
        return np.asarray(sum(self.responses if self.deploys_names else (), self.remainder.added))

    def without_names(self) -> Findings:
        """Return the findings of a search that named nothing, without a remainder."""
        selection = dataclasses.replace(self.selection, fit=self.selection.before)
        return dataclasses.replace(
            self,
            selection=selection,
            fit=selection.fit,
            terms=(),
            responses=(),
            remainder=None,
            is_own_error=False,
            deploys_names=True,
        )

    @property
    def rest_um(self) -> float:
        """Standard deviation of what they leave to an unknown slow cause and to the form of the effects, µm."""
        rest, regressed = self.selection.fit.rest, self.remainder or self.refitted
        if regressed is not None:
            return regressed.rest.slow_um
        return float(np.hypot(rest.slow_um, rest.own_um))


def findings_of(
    evidence: Evidence,
    *,
    unobserved: bool = True,
    grid: Grid | None = None,
    foresight: Foresight | None = None,
    leaves_late: bool | None = None,
) -> Findings:
    """Search in some evidence.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals; nothing but the samples used takes part.
    unobserved : bool
        Whether an unobserved source is looked for.
    grid : Grid, optional
        That of a search over all data, where something is held out.
    foresight : Foresight, optional
        How the drive moves, by a search over all data that found a late T_Q.
    leaves_late : bool, optional
        Whether a late T_Q beside other effects is left in, by a search over all data; by default it is decided.
    """
    search = Search(evidence, grid)
    found = _findings_of(search, unobserved=unobserved, foresight=foresight, leaves_late=leaves_late)
    if evidence.is_sparse or all(term.effect.observed for term in found.terms):
        return found
    base_um, own_um = in_free_run(found)
    if own_um <= base_um and not _is_surpassed(found):
        return found
    known = found.foresight or foresight
    shown = _findings_of(search, unobserved=False, foresight=known, leaves_late=leaves_late)
    rms = search.criterion.rms
    nothing, hidden, left = (rms(terms) ** 2 for terms in ((), found.fit.terms, shown.fit.terms))
    if left < hidden:
        return shown
    # The effects make up for the source. Channels that explain most of it alone take their place.
    is_better = own_um > base_um and in_free_run(shown)[1] < own_um
    return shown if is_better and nothing - left > MOSTLY * (nothing - hidden) else found


def _is_surpassed(found: Findings) -> bool:
    """Return whether something known, in the place of a source that no channel shows, leaves less than it does.

    A source has a time and a size of its own for every switching, and leaves to the own error of the paths what it
    does not explain; by the evidence it may win over their change.
    """
    search, fit = found.search, found.selection.fit
    rms = search.criterion.rms
    with_it = rms(fit.terms)
    return any(
        rms(rival.fit.terms) < with_it
        for i, term in enumerate(fit.terms)
        if not term.effect.observed
        for rival in search.rivals(fit, i)
    )


def by_channels(found: Findings, *, names_are_useless: bool) -> Findings | None:
    """Return findings with all channels in the place of names that gain nothing in free run, or of none.

    Names may be right, and the engine can do nothing with them: what a late T_Q hides may be most of the effect, and a
    source that no channel shows may warm a part with a sensor. And what has no name may be as small as the model's own
    error, and come again all the same. None where a name that a channel shows gains something, where a remainder is for
    what has no name, and where all channels are worse. The evidence for a late T_Q knows the future of the record: what
    its correction gains in time, other channels may gain before.

    Parameters
    ----------
    found : Findings
        Names, and what all channels explain.
    names_are_useless : bool
        Whether nothing is deployed by them anyhow: they are refused, or a source that no channel shows.
    """
    evidence = found.search.evidence
    if not found.terms:
        stays = found.remainder is not None
    elif names_are_useless or found.corrects_late_t_q:
        stays = False
    else:
        known = found.selection.before.log_evidence_as_it_is
        stays = _is_no_worse(found) or not _is_worth_deploying(found.channels, known, evidence)
    if evidence.is_sparse or stays:
        return None
    instead = dataclasses.replace(
        found, remainder=found.channels, is_own_error=False, deploys_names=not found.terms, confirmed=1.0, left_in=None
    )
    return instead if _is_no_worse(instead) else None


def _is_no_worse(found: Findings) -> bool:
    """Return whether what would be deployed leaves no more in free run than the base model."""
    base_um, own_um = in_free_run(found)
    return own_um <= base_um


def _findings_of(
    search: Search, *, unobserved: bool, foresight: Foresight | None, leaves_late: bool | None
) -> Findings:
    """Search once, and choose what is deployed beside the named effects or in their place."""
    selection = search.run(unobserved=unobserved)
    before, points, evidence = selection.before, search.points, search.evidence
    nothing = np.zeros(points.count)
    background = Background(evidence)
    channels = background.fitted(points, nothing, before.rest)
    is_of_paths = (
        not selection.fit.terms
        and search.criterion.is_of_paths(before)
        and not _is_worth_deploying(channels, before.log_evidence_as_it_is, evidence)
    )
    if is_of_paths:
        selection = search.of_paths(before) or selection
    fit, foresight = foreseeing(selection.fit, foresight)
    paths = Background(evidence, channels=False) if evidence.free_paths else None
    alone = paths.fitted(points, nothing, before.rest) if paths else None
    refitted = paths.fitted(points, fit.added, fit.rest) if paths and fit is not before else alone
    terms, responses, corrected = as_deployed(fit)
    named = Findings(
        search=search,
        selection=selection,
        fit=fit,
        terms=terms,
        responses=tuple(responses),
        remainder=None,
        is_own_error=False,
        deploys_names=True,
        channels=channels,
        paths=alone.added if alone else np.zeros(evidence.used.size),
        refitted=refitted,
        foresight=foresight,
    )
    if is_of_paths:
        own = own_error_alone(before)
        return dataclasses.replace(named, remainder=own, is_own_error=True, deploys_names=not terms)
    late = late_term(fit)
    if late is None:
        remainder, deploys_names = _remainder(search, fit, background, refitted, channels)
    else:
        remainder, deploys_names = _beside_late(corrected), True
    found = dataclasses.replace(named, remainder=remainder, deploys_names=deploys_names)
    if remainder is None and _has_own_error(fit):
        found = _with_own_error(named)
    return found if late is None else _corrected_or_left_in(found, named, late, leaves_late)


def _with_own_error(named: Findings) -> Findings:
    """Return named effects with the base's own error beside them, fitted anew to foretell together."""
    fit = foretelling(named.fit)
    terms, responses, corrected = as_deployed(fit)
    return dataclasses.replace(
        named, fit=fit, terms=terms, responses=tuple(responses), remainder=own_error(corrected), is_own_error=True
    )


def _corrected_or_left_in(found: Findings, named: Findings, late: Term, leaves_late: bool | None) -> Findings:
    """Leave a late T_Q in where the correction in real time gains nothing beside other effects.

    Parameters
    ----------
    found, named : Findings
        With the late T_Q corrected: all that is deployed, and the named effects alone.
    late : Term
        The late T_Q among these.
    leaves_late : bool or None
        As in `findings_of`.
    """
    evidence = found.search.evidence
    others = [term for term in named.fit.terms if term is not late]
    # A late T_Q alone is judged with everything that is deployed (`deployment.py`).
    has_others = any(term.effect.deployable for term in others)
    if not has_others or evidence.is_sparse or evidence.free_paths or leaves_late is False:
        return found
    as_it_is = fit_terms(named.fit.likelihood, [term.start for term in others])
    if leaves_late is None:
        # By the named effects alone: an own error takes in a lag, and goes elsewhere on another day.
        leaves_late = in_free_run(_left_in(named, late, as_it_is))[1] <= in_free_run(named)[1]
    return _late_left_in(named, late, as_it_is) if leaves_late else found


def _late_left_in(named: Findings, late: Term, others: Fit) -> Findings:
    """Return findings whose late T_Q is named and not corrected, beside others that are fitted to T_Q as it is."""
    fit = settled(others)
    if not _has_own_error(fit):
        return _left_in(named, late, fit)
    fit = foretelling(fit)
    return _left_in(dataclasses.replace(named, remainder=own_error(fit), is_own_error=True), late, fit)


def _left_in(found: Findings, late: Term, fit: Fit) -> Findings:
    """Return findings with the effects of a fit, and a late T_Q that adds nothing."""
    evidence, beside = found.search.evidence, iter(fit.terms)
    terms = tuple(late if term.effect.lateness is not None else next(beside) for term in found.terms)
    nothing = np.zeros(evidence.used.size)
    return dataclasses.replace(
        found,
        fit=fit,
        terms=terms,
        responses=tuple(nothing if term is late else response(evidence, term) for term in terms),
        left_in=late,
    )


def in_free_run(found: Findings) -> tuple[float, float]:
    """Return what the base model leaves of the data in free run, and with what would be deployed, µm rms.

    Without a source that no channel shows, and with nothing unknown but the zero of each run, as in service; where a
    warm start was estimated (`with_initial_state`), with an initial state. What depends on time alone is an error of
    the measurement and counts neither way.
    """
    evidence = found.search.evidence
    hidden, of_time = not_deployed(found)
    at_rest = all(signals.initial_um is None for signals in evidence.signals)

    def left_um(added: Vector) -> float:
        return rms_of(evidence.left(added + of_time, at_rest=at_rest)[evidence.used])

    return left_um(by_base(evidence)), left_um(found.whole - hidden - of_time)


def not_deployed(found: Findings) -> tuple[Vector, Vector]:
    """Return what no channel shows, and what depends on time alone, of the named effects, µm."""
    hidden, of_time = (np.zeros(found.search.evidence.used.size) for _ in range(2))
    # A remainder in the place of effects is for all of it.
    effects = zip(found.terms, found.responses, strict=True) if found.deploys_names else ()
    for term, added in effects:
        if not term.effect.observed:
            hidden += added
        elif not term.effect.deployable:
            of_time += added
    return hidden, of_time


def by_base(evidence: Evidence) -> Vector:
    """Return what the base's paths as they are make of the residual, µm: all of y where they are free, else nothing."""
    if not evidence.free_paths:
        return np.zeros(evidence.used.size)
    return np.concatenate([signals.y_dtf_um + signals.y_tdtf_um for signals in evidence.signals])


def _has_own_error(fit: Fit) -> bool:
    """Return whether the own error is deployed beside effects: these can be, and neither paths nor forms are exact."""
    points, deployable = fit.likelihood.points, any(term.effect.deployable for term in fit.terms)
    return deployable and not has_dead_time(fit) and not points.is_exact and not points.evidence.is_sparse


def _remainder(
    search: Search, fit: Fit, background: Background, refitted: Regressed | None, channels: Regressed
) -> tuple[Regressed | None, bool]:
    """Choose what is deployed beside named effects by the evidence, and whether they are deployed themselves.

    Parameters
    ----------
    search : Search
        What named effects cost.
    fit : Fit
        The named effects.
    background : Background
        All channels and the base's paths.
    refitted : Regressed or None
        The base's paths fitted together with them, where nothing was known of those.
    channels : Regressed
        All channels without the named effects.
    """
    points, evidence = fit.likelihood.points, fit.likelihood.points.evidence
    beside = background.fitted(points, fit.added, fit.rest) if fit.terms else channels
    known = refitted.log_evidence if refitted else fit.log_evidence_as_it_is
    # A name costs something, its deployment does not. But where nothing is known of the paths, names carry the whole
    # deformation into states that were not seen.
    charge = search.criterion.charge(fit) + WORTH if evidence.free_paths else 0.0
    if fit.terms and channels.log_evidence > max(known, beside.log_evidence) - charge:
        return channels, False
    return beside if _is_worth_deploying(beside, known, evidence) else None, True


def _beside_late(corrected: Fit) -> Regressed | None:
    """Return what all channels explain where a late T_Q is corrected as the engine does, if that is worth deploying.

    What a dead time hides from T_Q another channel may show at once. The correction stays: others get its signals.

    Parameters
    ----------
    corrected : Fit
        The other effects, of the corrected signals (`as_deployed`).
    """
    if not corrected.likelihood.points.evidence.context.channels:
        return None
    alone = settled(corrected)
    points = alone.likelihood.points
    beside = Background(points.evidence, recent=True).fitted(points, alone.added, alone.rest)
    return beside if _is_worth_deploying(beside, alone.log_evidence_as_it_is, points.evidence) else None


def _is_worth_deploying(beside: Regressed, known: float, evidence: Evidence) -> bool:
    """Return whether a remainder adds enough to the logarithm of the evidence, `known` without it, and to y."""
    size = float(np.std(beside.added[evidence.used]))
    least = LEAST * np.hypot(evidence.noise.noise_um, evidence.noise.own_error_um)
    return beside.log_evidence > known + WORTH and size > least
