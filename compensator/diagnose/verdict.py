"""The verdict on a base model from the data that were searched."""

from __future__ import annotations

import dataclasses

import numpy as np

from compensator.arrays import Vector, rms_of
from compensator.diagnose.ceiling import Ceiling
from compensator.diagnose.deployment import Deployment, is_adequate
from compensator.diagnose.noise import VERDICT_TIMES
from compensator.diagnose.outcome import Verdict
from compensator.model.late_observer import late_variance_um2
from compensator.model.thermal_model import ThermalModel


def judged(
    chosen: Deployment, extended: ThermalModel, ceiling: Ceiling | None, *, is_off: bool
) -> tuple[Verdict, bool]:
    """Return the verdict in one word, and whether nothing is left to look for.

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
    is_off : bool
        Whether the base is far off, and its paths were kept because nothing came of others.
    """
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
