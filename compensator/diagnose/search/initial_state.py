"""The initial state of the base model, as the measured deformation shows it, for what is not linear in the paths.

The likelihood integrates it out as what adds to y. An effect that counts from where the machine is at rest needs it
once more: a path that is still warm inside acts in it, too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from compensator.diagnose.fitting.fit import Fit, fit_terms
from compensator.diagnose.fitting.likelihood import Likelihood
from compensator.diagnose.fitting.points import Points
from compensator.diagnose.residual.base_run import WARM_SHARE
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.criterion import MARGIN
from compensator.diagnose.search.findings import Findings


def as_begun(found: Findings, findings_of: Callable[[Evidence], Findings]) -> Findings:
    """Search once more with the initial state that the named effects need, where they explain more with it.

    Parameters
    ----------
    found : Findings
        What was found without it.
    findings_of : callable
        The search.
    """
    fit, score = found.selection.fit, found.search.criterion.score
    evidence = with_initial_state(fit)
    if evidence is None or score(fit_terms(Likelihood(Points(evidence), fit.rest), fit.starts())) < score(fit) + MARGIN:
        return found
    again = findings_of(evidence)
    return again if score(again.selection.fit) > score(fit) else found


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
