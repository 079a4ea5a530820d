"""The result of a diagnosis: verdict, effects, errors before and after, the extended model, warnings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from compensator.arrays import Vector
from compensator.codes import Remark
from compensator.diagnose.advice.advice import Advice
from compensator.diagnose.advice.ceiling import Ceiling
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.detection_limit import DetectionLimits
from compensator.model.effects.hypothesis import EQUAL, Place
from compensator.model.simulation import Scores, scores
from compensator.model.thermal_model import ThermalModel

Verdict = Literal["adequate", "explained", "partly_explained", "unexplained"]


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
    instead : bool
        Whether it stands in place of the named effects.
    belongs : bool
        Whether it is the base's own error: beside named effects, in their place, or alone.
    confirmed : float
        Share of it that is deployed: of an own error as much as held-out blocks confirm.
    """

    deployed: bool
    channels: tuple[str, ...]
    rms_before_um: float
    rms_after_um: float
    instead: bool = False
    belongs: bool = False
    confirmed: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused:
    """What was found and is not deployed: nothing was added to the model.

    Parameters
    ----------
    why : str
        In words.
    held_out : numpy.ndarray, shape (n,)
        What it would leave, each block by a search that did not see it, µm.
    """

    why: str
    held_out: Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A step of the error on held-out data: what is left with an effect and those that remove more.

    Parameters
    ----------
    place : Place
        Kind, path and channel of the effect.
    rms_um : float
        Residual on data that took no part, µm.
    searches : int
        How many of the searches without a block found the effect.
    """

    place: Place
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
        The base model with every deployable effect; the base itself where nothing was added.
    evidence : Evidence
        Residual and signals.
    residual_before, residual_after : numpy.ndarray, shape (n,)
        Of the fit to everything, nuisances projected out, µm; NaN where y is missing.
    paths_um, remainder_um : numpy.ndarray, shape (n,)
        What the extension adds to the base model beside the effects, in the fit to all data, µm: by paths that were
        fitted anew, and by the remainder (where it stands in place of the effects: less what these and the paths would
        add); 0 where there are none.
    named_rms_um : float
        Residual of the fit with the named effects and without a remainder, µm.
    held_out_before, held_out_named, held_out_after : numpy.ndarray, shape (n,)
        Before, with the named effects, and after, each block by a search that did not see it. After: with every effect
        that the model has or that no model can have, and the remainder; as before where what was found is refused.
    steps : tuple of Step
        The error on held-out data with the first effect, the first two, and so on (`stepped`).
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
    could_hide : DetectionLimits, optional
        Where Y was measured now and then: how much could act without being seen.
    since_h : float
        From when on measured Y was searched, h after the start of the data: an effect began then (`onset`).
    refused : Refused, optional
        What a model could have of what was found, where none of it is deployed.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    held_out: str
    model: ThermalModel
    evidence: Evidence
    residual_before: Vector
    residual_after: Vector
    paths_um: Vector
    remainder_um: Vector
    named_rms_um: float
    held_out_before: Vector
    held_out_named: Vector
    held_out_after: Vector
    tried: tuple[tuple[str, float], ...]
    warnings: tuple[Remark, ...]
    steps: tuple[Step, ...] = ()
    remainder: Remainder | None = None
    ceiling: Ceiling | None = None
    advice: Advice | None = None
    could_hide: DetectionLimits | None = None
    since_h: float = 0.0
    refused: Refused | None = None

    @property
    def shows_nothing(self) -> bool:
        """Whether the base leaves noise where it is fitted to; held-out blocks may still speak against it."""
        nothing_left = self.advice is None or self.advice.unexplained is None
        nothing_found = not self.effects and self.remainder is None and self.could_hide is None
        return self.verdict == "adequate" or (nothing_found and nothing_left)

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
        """The same with the extended model, and with what no model can have (`held_out`)."""
        return self._scores(self.held_out_after)

    @property
    def held_out_found(self) -> Vector:
        """What is left on held-out data with everything that was found, deployed or not, µm."""
        return self.held_out_after if self.refused is None else self.refused.held_out

    @property
    def found(self) -> Scores:
        """The same in figures."""
        return self._scores(self.held_out_found)

    @property
    def noise_floor_um(self) -> float:
        """What the sensors' noise alone makes of the residual, µm."""
        return self.evidence.noise.noise_um

    @property
    def counts_from_rest(self) -> bool:
        """Whether an effect counts from where T_Q is AT, because the data begin warm."""
        return self.evidence.at_rest == EQUAL or any(effect.term.hypothesis.rest == EQUAL for effect in self.effects)

    @property
    def stepped(self) -> tuple[tuple[FoundEffect, Step], ...]:
        """The effects with their `steps`: a late T_Q that was left in has none."""
        steps = {step.place: step for step in self.steps}
        return tuple((effect, steps[effect.place]) for effect in self.effects if effect.place in steps)

    def series(self) -> dict[str, Vector]:
        """Return the curves as columns of shape (n,), one row for each sample, so that anybody can plot them again.

        NaN where Y is missing or not searched. `run` counts from 1, `t_s` is the time in it. `residual_…` are of the
        fit to all data, `held_out_…` of searches that did not see the sample, `effect_1_um` is what the first effect
        adds to Y (0 where it is left in), `remainder_um` what the remainder adds to all of them and `paths_um` what
        paths do that were fitted anew (where there are any). Then come the channels of the effects.
        """
        evidence = self.evidence
        sizes = [run.t_s.size for run in evidence.runs]
        columns = {
            "run": np.repeat(np.arange(1.0, len(sizes) + 1.0), sizes),
            "t_s": np.concatenate([run.t_s for run in evidence.runs]),
            "y_um": evidence.y_um,
            "residual_before_um": self.residual_before,
            "residual_after_um": self.residual_after,
            "held_out_before_um": self.held_out_before,
            "held_out_named_um": self.held_out_named,
            "held_out_after_um": self.held_out_after,
            "t_q_degc": np.concatenate([run.t_q_degc for run in evidence.runs]),
            "at_degc": np.concatenate([run.at_degc for run in evidence.runs]),
        }
        for i, effect in enumerate(self.effects, start=1):
            columns[f"effect_{i}_um"] = effect.removed
        beside = {"remainder_um": self.remainder_um, "paths_um": self.paths_um}
        columns |= {name: values for name, values in beside.items() if values.any()}
        for name in dict.fromkeys(channel for effect in self.effects for channel in effect.channels):
            if all(name in run.channels for run in evidence.runs):
                columns[name] = np.concatenate([run.channels[name] for run in evidence.runs])
        return columns

    def _scores(self, residual: Vector) -> Scores:
        y = self.evidence.y_um
        return scores(y, y - residual)
