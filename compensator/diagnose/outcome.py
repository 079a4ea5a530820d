"""Results of a diagnosis: effects, rivals, errors before and after, the extended model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from compensator.arrays import Vector
from compensator.codes import ModelWarning, Remark
from compensator.diagnose.advice import Advice, label
from compensator.diagnose.deciding import PlannedTest
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Term
from compensator.diagnose.hiding import Hiding
from compensator.diagnose.search import Candidate
from compensator.model.effects import Effect
from compensator.model.effects.hypothesis import Place
from compensator.model.effects.seen import Range, Seen
from compensator.model.simulation import Scores, scores
from compensator.model.thermal_model import ThermalModel

Verdict = Literal["adequate", "explained", "partly_explained", "unexplained"]

#: Blocks that are held out, one after another, and how that is described.
FOLDS = 3
HELD_OUT = (
    f"each of {FOLDS} blocks of time predicted after choosing and fitting on the others; zero and initial state also "
    "from the others"
)
HELD_OUT_RECORDINGS = (
    "each of {count} recordings or groups of them predicted after choosing and fitting on the others; its zero is its "
    "own mean"
)
HELD_OUT_VALUES = (
    f"each of {FOLDS} sets of every {FOLDS}rd value predicted after choosing and fitting on the others; what is named "
    "and deployed is decided by the likelihood of all values"
)
REPLACED = " All channels together explain the data better, so the remainder is deployed in its place."
#: Another explanation is a rival while it leaves no more than this many times as much.
RIVAL_TIMES = 1.2
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
        What it adds to y, µm, all runs one after another.
    rivals : tuple of Rival
        What explains it nearly as well.
    replaced : bool
        Whether the remainder is deployed in its place, since it explains the data better.
    """

    term: Term = field(repr=False)
    effect: Effect
    rms_before_um: float
    rms_after_um: float
    signal: Vector = field(repr=False)
    rivals: tuple[Rival, ...] = field(repr=False)
    replaced: bool = False

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
        return self.effect.explanation + (REPLACED if self.replaced else "")

    @property
    def deployable(self) -> bool:
        """Whether the service can run it."""
        return self.effect.deployable and not self.replaced


@dataclass(frozen=True, slots=True, kw_only=True)
class Rival:
    """Another explanation that is nearly as good.

    Parameters
    ----------
    term : Term
        The other explanation.
    rms_after_um : float
        What it leaves, µm rms.
    test : PlannedTest or None
        The test that tells both apart best; None where no test is possible.
    """

    term: Term
    rms_after_um: float
    test: PlannedTest | None

    @property
    def how_to_tell_apart(self) -> str:
        """The test in words."""
        return self.test.sentence if self.test else "No test with what was logged tells them apart."

    @property
    def label(self) -> str:
        """Kind and place in words."""
        return label(self.term)


@dataclass(frozen=True, slots=True, kw_only=True)
class Remainder:
    """What the channels explain and no named effect does: a regularised linear response of several of them.

    Parameters
    ----------
    deployed : bool
        Whether the extended model has it, as an effect of kind `regression`.
    channels : tuple of str
        Channels that respond.
    rms_before_um, rms_after_um : float
        Residual without it and with it on data that took no part, µm.
    """

    deployed: bool
    channels: tuple[str, ...]
    rms_before_um: float
    rms_after_um: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Ceiling:
    """What the best linear use of all logged channels leaves on data that took no part.

    Parameters
    ----------
    rms_um : float
        Its residual, µm.
    explained_pct : float
        How much of what it removes the named effects remove, %.
    """

    rms_um: float
    explained_pct: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A step of the error on held-out data: what is left with an effect and those that remove more.

    Parameters
    ----------
    rms_um : float
        Residual on data that took no part, µm.
    searches : int
        How many of the searches without a block found the effect.
    """

    rms_um: float
    searches: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """What a model lacks.

    Parameters
    ----------
    verdict : Verdict
        In one word.
    effects : tuple of FoundEffect
        In order of the error that they remove.
    held_out : str
        How the errors before and after were measured.
    model : ThermalModel
        The base model with every deployable effect.
    evidence : Evidence
        Residual and signals.
    residual_before, residual_after : numpy.ndarray, shape (n,)
        Of the fit to everything, nuisances projected out, µm; NaN where y is missing.
    held_out_before, held_out_named, held_out_after : numpy.ndarray, shape (n,)
        Before, with the named effects, and with the remainder, too, each block by a search that did not see it.
    steps : tuple of Step
        The error on held-out data with the first effect, the first two, and so on.
    tried : tuple of (str, float)
        Explanations of the largest effect and the rms that each leaves, µm, best first.
    warnings : tuple of Remark
        What to know before relying on it.
    remainder : Remainder, optional
        What the channels explain and no named effect does; None where there is none.
    ceiling : Ceiling, optional
        What all channels could explain; None where no linear use of them leaves less than the base model.
    advice : Advice, optional
        What to measure and to test next; None where the model is adequate.
    could_hide : Hiding, optional
        Where Y was measured now and then: how much could act without being seen.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    held_out: str
    model: ThermalModel
    evidence: Evidence
    residual_before: Vector
    residual_after: Vector
    held_out_before: Vector
    held_out_named: Vector
    held_out_after: Vector
    tried: tuple[tuple[str, float], ...]
    warnings: tuple[Remark, ...]
    steps: tuple[Step, ...] = ()
    remainder: Remainder | None = None
    ceiling: Ceiling | None = None
    advice: Advice | None = None
    could_hide: Hiding | None = None

    @property
    def before(self) -> Scores:
        """Errors of the base model on data that took no part in choosing or fitting."""
        return self._scores(self.held_out_before)

    @property
    def named(self) -> Scores:
        """The same with every named effect."""
        return self._scores(self.held_out_named)

    @property
    def after(self) -> Scores:
        """The same with every effect and the remainder."""
        return self._scores(self.held_out_after)

    @property
    def noise_floor_um(self) -> float:
        """What the sensors' noise alone makes of the residual, µm."""
        return self.evidence.noise.noise_um

    def _scores(self, residual: Vector) -> Scores:
        y = self.evidence.y_um
        return scores(y, y - residual)


def rms_of(values: Vector) -> float:
    """Return the root mean square of the values that are not missing."""
    return float(np.sqrt(np.nanmean(values**2)))


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


def rivals_of(
    term: Term, others: Iterable[Candidate], after_um: float, test: Callable[[Candidate], PlannedTest | None]
) -> tuple[Rival, ...]:
    """Return the best of other explanations, one for each place, that leave nearly as little as an effect.

    Parameters
    ----------
    term : Term
        The effect.
    others : iterable of Candidate
        Other explanations, best first.
    after_um : float
        What the effect leaves, µm rms.
    test : callable
        Returns the test that tells another explanation apart from the effect.
    """
    rivals: dict[Place, Rival] = {}
    for other in others:
        place, rms = other.term.hypothesis.place, other.rms_um
        if place == term.hypothesis.place or place in rivals or rms > RIVAL_TIMES * after_um:
            continue
        rivals[place] = Rival(term=other.term, rms_after_um=rms, test=test(other))
        if len(rivals) == MOST_RIVALS:
            break
    return tuple(rivals.values())


def warnings_of(
    effects: Sequence[FoundEffect], before: Vector, after: Vector, *, deployed: bool, few: bool = False
) -> tuple[Remark, ...]:
    """Return what to know before relying on the effects that were found.

    Parameters
    ----------
    effects : sequence of FoundEffect
        Effects.
    before, after : numpy.ndarray, shape (n,)
        What is left on held-out data without and with them, µm.
    deployed : bool
        Whether the extended model has any.
    few : bool
        Whether Y was measured now and then, so that held-out blocks do not decide what is deployed.
    """
    warnings = []
    rms_before, rms_after = rms_of(before), rms_of(after)
    if effects and rms_after > rms_before:
        numbers = f"({rms_after:.2f} against {rms_before:.2f} µm rms)"
        if deployed or few:
            text = f"The effects are clear in the data as a whole, but do not predict held-out blocks better {numbers}."
            warnings.append(Remark(ModelWarning.NOT_CONFIRMED, text))
        else:
            text = f"On held-out blocks the effects make it worse {numbers}, so the model was left as it is."
            warnings.append(Remark(ModelWarning.MADE_WORSE, text))
    for effect in effects:
        kind, named = effect.place[0], effect.named
        loose = [name for name, std in effect.std.items() if std > abs(named[name]) > 0.0]
        if loose:
            text = f"{kind}: the standard error of {', '.join(loose)} is larger than the value."
            warnings.append(Remark(ModelWarning.HARDLY_DETERMINED, text))
        if effect.rivals:
            names = ", ".join(rival.label for rival in effect.rivals)
            warnings.append(Remark(ModelWarning.NEARLY_AS_GOOD, f"{kind}: {names} would explain it nearly as well."))
    return tuple(warnings)
