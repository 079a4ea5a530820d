"""The verdict on a base model: by the data that were searched, and after the runs that took no part."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compensator.arrays import Vector, rms_of
from compensator.diagnose.advice.ceiling import Ceiling
from compensator.diagnose.choice.deployment import Deployment, is_adequate
from compensator.diagnose.choice.outcome import Verdict
from compensator.diagnose.residual.noise import VERDICT_TIMES
from compensator.diagnose.search.detection_limit import DetectionLimits
from compensator.model.late_observer import late_variance_um2
from compensator.model.thermal_model import ThermalModel

#: Names of the models in `free_run` of a result, and what the data were to them.
BASE, EXTENDED = "base model", "extended model"
SEARCHED, HELD_OUT = "searched", "held out"
#: A run that took no part confirms effects if the extended model leaves no more than this share of the base model's
#: mean square about the mean there: more is gone than stays.
CONFIRMS = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """The verdict on a base model by the data that were searched.

    Parameters
    ----------
    verdict : Verdict
        In one word.
    nothing_left : bool
        Whether nothing is left to look for in the residual.
    hides : bool
        Whether the base is adequate but for what could act without being seen.
    """

    verdict: Verdict
    nothing_left: bool
    hides: bool


def judged(
    chosen: Deployment,
    extended: ThermalModel,
    ceiling: Ceiling | None,
    could_hide: DetectionLimits | None,
    *,
    is_off: bool,
) -> Judged:
    """Return the verdict by the data that were searched; `verdict_of` asks the runs that took no part.

    "Explained" is said of the named effects alone; what the remainder corrects beside them is not looked for, but has
    no name. What the engine cannot know of a late T_Q counts as noise.

    Parameters
    ----------
    chosen : Deployment
        What was found, and what of it is deployed.
    extended : ThermalModel
        The model with it.
    ceiling : Ceiling or None
        What all channels could explain.
    could_hide : DetectionLimits or None
        Where Y was measured now and then: how much could act without being seen.
    is_off : bool
        Whether the base is far off, and its paths were kept because nothing came of others.
    """
    verdict, nothing_left = _of_what_was_found(chosen, extended, ceiling, is_off=is_off)
    # Without an effect the verdict says of few values whether they are noise; that something could hide comes on top.
    hides = verdict == "adequate" and could_hide is not None and (could_hide.is_too_much or could_hide.undecided != ())
    if hides or chosen.reverses_path:
        verdict = "unexplained"
    return Judged(verdict=verdict, nothing_left=nothing_left or hides, hides=hides)


def _of_what_was_found(
    chosen: Deployment, extended: ThermalModel, ceiling: Ceiling | None, *, is_off: bool
) -> tuple[Verdict, bool]:
    """Return the verdict in one word, and whether nothing is left to look for; parameters as in `judged`."""
    found, effects, held_out = chosen.found, chosen.effects, chosen.held_out
    evidence = found.search.evidence
    observed = [term.hypothesis.effect.observed for term in found.terms]
    unknown_um2 = late_variance_um2(extended)
    noise = dataclasses.replace(evidence.noise, noise_um=float(np.hypot(evidence.noise.noise_um, unknown_um2**0.5)))

    def leaves_noise(added: Vector) -> bool:
        left = evidence.left(added)[evidence.used]
        return noise.is_explained(float(left @ left))

    is_noise = leaves_noise(found.whole + found.left_in_um)
    if not observed:
        if is_adequate(found, held_out) and not is_off:
            return "adequate", False
        # Noise in the fit, and more on held-out blocks: in the residual is nothing to look for.
        return "unexplained", found.remainder is None and not evidence.free_paths and found.leaves_noise
    if not any(observed):
        return "unexplained", False

    most_um2 = rms_of(held_out.nothing) ** 2
    if evidence.is_sparse:
        # What few values were fitted by must hold on those that it was not fitted to.
        most_um2 = min(most_um2, VERDICT_TIMES**2 * (noise.noise_um**2 + noise.allowance / noise.count))

    def holds(values: Vector) -> bool:
        return rms_of(values) ** 2 < most_um2

    nothing_left = (
        is_noise and holds(held_out.whole) and all(observed) and found.deploys_names and chosen.worse_um is None
    )
    by_names = (
        leaves_noise(found.named + found.left_in_um) and holds(held_out.named) and all(e.is_determined for e in effects)
    )
    is_missed = ceiling is not None and ceiling.is_missed(rms_of(held_out.nothing))
    return ("explained" if nothing_left and by_names and not is_missed else "partly_explained"), nothing_left


def verdict_of(verdict: str, free_run: Sequence[Mapping[str, Any]], noise_um: float) -> str:
    """Return a verdict in one word after the runs that took no part: what they do not confirm is not `explained`."""
    return "partly_explained" if verdict == "explained" and not is_confirmed(free_run, noise_um) else verdict


def is_contradicted(found: Mapping[str, Any]) -> bool:
    """Whether the extended model is worse than the base model on data that took no part in the search.

    Parameters
    ----------
    found : mapping
        Content of `diagnosis.json`.
    """
    return any(
        EXTENDED in one and one[EXTENDED]["rms_um"] > one[BASE]["rms_um"] for one in _fresh(found.get("free_run", []))
    )


def is_confirmed(free_run: Sequence[Mapping[str, Any]], noise_um: float) -> bool:
    """Whether what was deployed helps on every run that took no part; true where none says anything.

    A run on which the base model leaves noise says nothing, nor does one on which both models are the same.

    Parameters
    ----------
    free_run : sequence of mapping
        As in `diagnosis.json`.
    noise_um : float
        What the sensors' noise makes of the residual, µm.
    """
    for one in _fresh(free_run):
        base, own = one[BASE]["rms_about_mean_um"], one.get(EXTENDED, one[BASE])["rms_about_mean_um"]
        is_noise = max(base, own) <= VERDICT_TIMES * noise_um
        if own != base and not is_noise and own**2 > CONFIRMS * base**2:
            return False
    return True


def _fresh(free_run: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [one["scores"] for one in free_run if one["role"] == HELD_OUT]
