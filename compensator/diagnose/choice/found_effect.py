"""An effect that was found, as it is reported: its parameters, what it adds, its explanation and its rivals."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.axes import FIRST
from compensator.diagnose.advice.deciding import PlannedTest
from compensator.diagnose.fitting.fit import Term
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.search import Alternative
from compensator.model.effects import Effect
from compensator.model.effects.base import filters
from compensator.model.effects.delay import CORRECTED
from compensator.model.effects.hypothesis import Place
from compensator.model.effects.input import NEEDS_CHANNEL
from compensator.model.effects.regression import Regression
from compensator.model.effects.seen import Range, Seen

#: Said of an effect in whose place the remainder is deployed.
REPLACED = " A regularised response does better than the names, so the remainder is deployed in its place."
#: The same of a source that no channel shows.
MADE_UP_FOR = " All channels together make up for it: the remainder is deployed in its place, and explains nothing."
#: Said of a late T_Q that is left in.
LEFT_IN = " A correction in real time would make more errors on this record than it removes, so T_Q is used as it is."
#: Said of an effect of a kind that a model can have, where nothing of what was found is deployed.
REFUSED = " Not deployed: {why}."
#: Another explanation is a rival while it leaves no more than this many times as much, and while the logarithm of the
#: evidence is smaller by no more than this: four times what decides, since forms are known approximately only.
RIVAL_TIMES, RIVAL_EVIDENCE = 1.2, 20.0
#: Most rivals of an effect.
MOST_RIVALS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundEffect:
    """An effect that the model lacks; what `diagnosis.json` says of it also by `effect["kind"]`.

    Parameters
    ----------
    term : Term
        Hypothesis and values.
    effect : Effect
        What the extended model gets, with standard errors and explanation.
    rms_before_um, rms_after_um : float
        Residual without it and with it, the others in place, µm.
    signal : numpy.ndarray, shape (n,)
        What it adds to y, µm, all runs one after another; of a late T_Q that is left in what it would add.
    rivals : tuple of Rival
        What explains it nearly as well.
    replaced : bool
        Whether the remainder is deployed in its place, since it explains the data better.
    left_in : bool
        Whether it is a late T_Q whose correction is not deployed, since the model is better without it.
    axis : str
        The axis that it moves.
    refused : str
        Why nothing of what was found is deployed, in words; empty where something is.
    """

    term: Term = field(repr=False)
    effect: Effect
    rms_before_um: float
    rms_after_um: float
    signal: Vector = field(repr=False)
    rivals: tuple[Rival, ...] = field(repr=False)
    replaced: bool = False
    left_in: bool = False
    refused: str = ""
    axis: str = FIRST

    def __getitem__(self, key: str) -> Any:
        return getattr(self, key)

    @property
    def place(self) -> Place:
        """Kind, path and channel."""
        return self.term.hypothesis.place

    @property
    def kind(self) -> str:
        """What it is."""
        return self.place[0]

    @property
    def path(self) -> str | None:
        """Path that it acts on."""
        return self.place[1] or None

    @property
    def channel(self) -> str | None:
        """Channel that it acts by."""
        return self.place[2] or None

    @property
    def channels(self) -> tuple[str, ...]:
        """Every channel that it acts by, that of its place first."""
        return tuple(dict.fromkeys((self.channel, *self.effect.channels))) if self.channel else ()

    @property
    def form(self) -> str:
        """Which variant of its kind."""
        return self.term.hypothesis.form

    @property
    def named(self) -> dict[str, float]:
        """Every parameter by name."""
        return self.term.named

    @property
    def std(self) -> Mapping[str, float]:
        """Standard error of each parameter."""
        return self.effect.std

    @property
    def parameters(self) -> dict[str, dict[str, float]]:
        """`value` and standard error `std` of each parameter."""
        return {name: {"value": value, "std": self.std[name]} for name, value in self.named.items()}

    @property
    def explanation(self) -> str:
        """For an engineer."""
        words = self.effect.explanation
        if self.left_in:
            words = words.replace(CORRECTED, LEFT_IN)
        if self.replaced:
            return words.replace(NEEDS_CHANNEL, "") + (REPLACED if self.effect.observed else MADE_UP_FOR)
        if self.is_refused:
            return words.replace(NEEDS_CHANNEL, "").replace(CORRECTED, "") + REFUSED.format(why=self.refused)
        return words

    @property
    def removed(self) -> Vector:
        """What of its signal the named effects explain in the residual, µm: nothing where it is left in."""
        return np.zeros(self.signal.size) if self.left_in else self.signal

    @property
    def deployable(self) -> bool:
        """Whether the extended model has it: the service can run its kind, and nothing speaks against it."""
        return self.effect.deployable and not self.replaced and not self.left_in and not self.refused

    @property
    def is_refused(self) -> bool:
        """Whether the extended model would have it, if anything of what was found were deployed."""
        return bool(self.refused) and dataclasses.replace(self, refused="").deployable

    @property
    def is_determined(self) -> bool:
        """Whether its size is known: one of its sizes, or where it has none of its parameters, exceeds its error.

        Lags near each other share one response: their sum is a size, too. A response of any form is known by its
        course; its gain at rest may be open all the same.
        """
        if self.effect.has_any_form:
            return True
        searched = {free.name for free in self.term.hypothesis.free}
        sized = [name for name in self.named if name not in searched] or list(self.named)
        return not sized or any(abs(self.named[name]) >= self.std[name] for name in sized)

    @property
    def hardly_determined(self) -> list[str]:
        """Its parameters that are smaller than their standard errors."""
        return [name for name, std in self.std.items() if std > abs(self.named[name]) > 0.0]

    @property
    def reverses_path(self) -> bool:
        """Whether a path with it would act the other way round: Y is reversed, or the model is of another machine."""
        return self.kind == "gain" and self.named["change"] < -1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Rival:
    """Another explanation that is nearly as good.

    Parameters
    ----------
    term : Term
        The other explanation.
    rms_after_um, rms_chosen_um : float
        What it and the effect leave, µm rms, both as `Criterion.compared` has it.
    log_evidence : float
        By how much the data are more probable with it than with the effect, after the cost of the names.
    test : PlannedTest or None
        The test that tells both apart best; None where no test is possible.
    """

    term: Term
    rms_after_um: float
    rms_chosen_um: float
    log_evidence: float
    test: PlannedTest | None

    @property
    def how_to_tell_apart(self) -> str:
        """The test in words."""
        return self.test.sentence if self.test else "No test with what was logged tells them apart."

    @property
    def label(self) -> str:
        """Kind and place in words."""
        return self.term.label


def described(term: Term, std: Mapping[str, float], signal: Vector, evidence: Evidence) -> Effect:
    """Return the effect of a term with its standard errors and, from what was seen of it, an explanation.

    Parameters
    ----------
    term : Term
        Hypothesis and values.
    std : mapping of str to float
        Standard error of each parameter.
    signal : numpy.ndarray, shape (n,)
        What it adds to y, µm.
    evidence : Evidence
        Samples used, channels and paths.
    """
    effect = dataclasses.replace(term.effect, std=std)
    return dataclasses.replace(effect, explanation=effect.explain(seen_of(effect, signal, evidence)))


def seen_of(effect: Effect, signal: Vector, evidence: Evidence) -> Seen:
    """Return the ranges of an effect, of the channel that it acts by and of the path that it acts on."""
    records, used = evidence.signals, signal[evidence.used]
    return Seen(
        rms_um=float(np.std(used)),
        added_um=Range(float(np.min(used)), float(np.max(used))),
        channel=Range.of([record.channels[effect.channel] for record in records]) if effect.channel else None,
        path_um=Range.of([record.share(effect.path) for record in records]) if effect.path else None,
    )


def no_further_than_seen(remainder: Regression, evidence: Evidence) -> Regression:
    """Return a remainder that goes no further to either side than the whole range in which the data showed it.

    It explains nothing, so nothing says that it holds where the machine does what the data did not show.
    """
    blocks = remainder.blocks(evidence.context.period_min)
    # Also where Y was not measured: with probes that is most of the record.
    added = np.concatenate([remainder.law(record, filters(blocks)) for record in evidence.signals])
    most_um = float(max(np.nanmax(added), 0.0) - min(np.nanmin(added), 0.0))
    return dataclasses.replace(remainder, most_um=most_um)


def rivals_of(
    term: Term,
    others: Iterable[Alternative],
    chosen: tuple[float, float],
    test: Callable[[Alternative], PlannedTest | None],
) -> tuple[Rival, ...]:
    """Return the best of other explanations, one for each place, that leave nearly as little as an effect.

    Parameters
    ----------
    term : Term
        The effect.
    others : iterable of Alternative
        Other explanations, best first.
    chosen : (float, float)
        What the effect leaves, µm rms, as it is known of the others, and its score.
    test : callable
        Returns the test that tells another explanation apart from the effect.
    """
    rivals: dict[Place, Rival] = {}
    after_um, score = chosen
    for other in others:
        place, rms = other.term.hypothesis.place, other.rms_um
        if place == term.hypothesis.place or place in rivals:
            continue
        if rms > RIVAL_TIMES * after_um or other.score < score - RIVAL_EVIDENCE:
            continue
        rivals[place] = Rival(
            term=other.term,
            rms_after_um=rms,
            rms_chosen_um=after_um,
            log_evidence=other.score - score,
            test=test(other),
        )
        if len(rivals) == MOST_RIVALS:
            break
    return tuple(rivals.values())
