"""An effect that one axis shows is looked for on the others; what one probe alone shows is first suspected in it.

Time constants and inputs are the machine's: on another axis the effect has the form that was found, and only its size
is open. What no other axis shows may come from the probe itself: its mount, its zero, its scale.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Vector
from compensator.axes import label_of
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.choice.outcome import Diagnosis
from compensator.diagnose.fitting.fit import Fit, Start, Term, fit_terms, response, settled
from compensator.diagnose.fitting.likelihood import Likelihood, rest_without_effects
from compensator.diagnose.fitting.points import Points
from compensator.diagnose.fitting.standard_errors import deviations
from compensator.diagnose.residual.evidence import Evidence
from compensator.model.effects.hypothesis import Place

#: An axis shows an effect if it moves it by at least so many standard errors.
SEEN = 4.0
#: An axis does not show an effect if it moves it surely, by two standard errors, less than this share of the largest.
LITTLE = 0.5
#: Kinds that no channel and no path shows, by what is said of them.
_UNCAUSED = {"drift": "a drift", "step": "a step", "periodic": "an oscillation", "unobserved": "an unobserved source"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """What an effect moves on one axis.

    Parameters
    ----------
    axis : str
        The axis.
    moves_um : float
        How far it moves the axis in the record, peak to peak, µm; negative against its channel or, where it has none,
        against the axis that it moves most.
    std_um : float
        Its standard error, µm.
    named : bool
        Whether the diagnosis of the axis names the effect.
    """

    axis: str
    moves_um: float
    std_um: float
    named: bool

    @property
    def is_seen(self) -> bool:
        """Whether the axis shows the effect."""
        return self.named or abs(self.moves_um) > SEEN * self.std_um


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineEffect:
    """An effect on all axes of a machine.

    Parameters
    ----------
    place : Place
        Kind, path and channel.
    shares : tuple of Share
        What it moves, the axis that it moves most first.
    partner : str
        Another probe of the direction of the only axis that shows it; empty if there is none.
    """

    place: Place
    shares: tuple[Share, ...]
    partner: str = ""

    @property
    def seen(self) -> tuple[Share, ...]:
        """The axes that show it."""
        return tuple(share for share in self.shares if share.is_seen)

    @property
    def still(self) -> tuple[Share, ...]:
        """The axes that it moves little at most; of the others the data do not say it."""
        largest = max(abs(share.moves_um) for share in self.seen) if self.seen else 0.0
        others = (share for share in self.shares if not share.is_seen)
        return tuple(share for share in others if abs(share.moves_um) + 2.0 * share.std_um < LITTLE * largest)

    @property
    def suspect(self) -> str:
        """The axis whose probe is suspected first: the only one that shows the effect, if the others surely do not."""
        alone = len(self.seen) == 1 and len(self.still) == len(self.shares) - 1 > 0
        return self.seen[0].axis if alone else ""

    @property
    def sentence(self) -> str:
        """Where it acts and how far, and what is suspected first."""
        kind, path, channel = self.place
        cause = _UNCAUSED.get(kind, f"{channel or path} ({kind}{f', {path}' if path and channel else ''})")
        moved = ", ".join(f"{label_of(one.axis)} by {_size(one.moves_um)}" for one in self.seen)
        others = [one for one in self.shares if not one.is_seen]
        words = {share.axis: "not" for share in self.still}
        still = ", ".join(
            f"{label_of(one.axis)} {words.get(one.axis, 'perhaps')} ({abs(one.moves_um):.1f} ± {one.std_um:.1f})"
            for one in others
        )
        cause = cause if channel or path else f"{cause[0].upper()}{cause[1:]}"
        sentence = f"{cause} moves {moved} µm{f', {still}' if still else ''}."
        if not self.suspect:
            return sentence
        beside = f" {label_of(self.partner)}, of the same direction, does not." if self.partner else ""
        probe = label_of(self.suspect)
        check = f"Check the probe of {probe} first: its mount, zero, scale and cable."
        return f"{sentence} Only {probe} shows it.{beside} {check}"


def missing_places(diagnoses: Mapping[str, Diagnosis]) -> dict[str, frozenset[Place]]:
    """Return the effects that each axis shows and does not name, because only another axis told of them."""
    found: dict[str, frozenset[Place]] = {}
    for axis, diagnosis in diagnoses.items():
        own = {effect.place for effect in diagnosis.effects}
        places = {
            effect.place
            for other, theirs in diagnoses.items()
            for effect in theirs.effects
            if other != axis and effect.place not in own and _share(axis, diagnosis, effect).is_seen
        }
        if places:
            found[axis] = frozenset(places)
    return found


def across(diagnoses: Mapping[str, Diagnosis], partners: Mapping[str, str] | None = None) -> tuple[MachineEffect, ...]:
    """Return every effect with what it moves on each axis.

    Parameters
    ----------
    diagnoses : mapping of str to Diagnosis
        Diagnosis of each axis.
    partners : mapping of str to str, optional
        The other probe of the same direction, where there is one.
    """
    places = dict.fromkeys(effect.place for one in diagnoses.values() for effect in one.effects)
    found = []
    for place in places:
        own = {axis: effect for axis, one in diagnoses.items() for effect in one.effects if effect.place == place}
        largest = max(own.values(), key=lambda effect: float(np.std(effect.signal)))
        shares = [_share(axis, one, own.get(axis, largest), largest) for axis, one in diagnoses.items()]
        shares.sort(key=lambda share: (not share.is_seen, -abs(share.moves_um)))
        effect = MachineEffect(place=place, shares=tuple(shares))
        found.append(dataclasses.replace(effect, partner=(partners or {}).get(effect.suspect, "")))
    return tuple(sorted(found, key=lambda effect: -abs(effect.shares[0].moves_um)))


def _share(axis: str, diagnosis: Diagnosis, effect: FoundEffect, reference: FoundEffect | None = None) -> Share:
    """Fit the size of an effect, in the form that was found, on an axis beside the effects that it has by itself."""
    named = any(one.place == effect.place for one in diagnosis.effects)
    evidence = diagnosis.evidence
    if effect.path and ("DTF" if effect.path == "TTF" else effect.path) not in evidence.context.paths:
        # A model without the path does not say how it would act here: perhaps as far as on the other axis.
        return Share(axis=axis, moves_um=0.0, std_um=float(np.ptp((reference or effect).signal)), named=named)
    points = Points(evidence)
    others = [one.term.start for one in diagnosis.effects if one.place != effect.place]
    fit = _fitted(points, [*others, _in_its_form(effect.term)])
    term, error = fit.terms[-1], deviations(fit)[-1][1]
    added = response(evidence, term)[evidence.used]
    unit = response(evidence, effect.term)[evidence.used]
    span, spread = float(np.ptp(added)), float(np.std(added))
    shape = span / spread if spread > 0.0 else float(np.ptp(unit)) / max(float(np.std(unit)), 1e-12)
    towards = _cause(evidence, reference or effect)[evidence.used]
    sign = -1.0 if _covariance(added, towards) < 0.0 else 1.0
    return Share(axis=axis, moves_um=sign * span, std_um=shape * error, named=named)


def _fitted(points: Points, starts: list[Start]) -> Fit:
    return settled(fit_terms(Likelihood(points, rest_without_effects(points)), starts, evaluations=4))


def _in_its_form(term: Term) -> Start:
    """Return the effect with its searched parameters as found: only its size is open; without a size, as found."""
    hypothesis = term.hypothesis
    if not hypothesis.amplitudes:
        return hypothesis, term.values
    return dataclasses.replace(hypothesis, effect=hypothesis.with_values(term.values), free=()), ()


def _cause(evidence: Evidence, effect: FoundEffect) -> Vector:
    """Return what the direction of an effect is counted from: its channel, or else what it adds to its first axis."""
    if effect.channel is not None:
        return np.concatenate([record.channels[effect.channel] for record in evidence.signals])
    return response(evidence, effect.term)


def _covariance(first: Vector, second: Vector) -> float:
    return float(np.mean((first - first.mean()) * (second - second.mean())))


def _size(moves_um: float) -> str:
    return f"{moves_um:.1f}".replace("-", "−")
