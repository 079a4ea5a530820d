"""The initial state of the base model, as the measured deformation shows it, for what is not linear in the paths.

The likelihood integrates it out as what adds to y. An effect that counts from where the machine is at rest needs it
once more: a path that is still warm inside acts in it, too.
"""

from __future__ import annotations

import numpy as np

from compensator.diagnose.base_run import WARM_SHARE
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Fit


def with_initial_state(fit: Fit) -> Evidence | None:
    """Return the evidence of a fit with the most probable initial state; None where none of its effects needs it.

    Parameters
    ----------
    fit : Fit
        Effects.
    """
    points, rest = fit.likelihood.points, fit.rest
    evidence = points.evidence
    if not any(term.effect.counts_from_rest and term.effect.path == "DTF" for term in fit.terms):
        return None
    weights = fit.likelihood.weights(fit.added)[points.zeros.shape[1] :][: points.starts_of_modes.shape[1]]
    initial_um = evidence.decays @ (rest.start_um * weights)
    if np.max(np.abs(initial_um)) <= WARM_SHARE * evidence.context.sizes_um["DTF"]:
        return None
    return evidence.with_initial_state(initial_um)
