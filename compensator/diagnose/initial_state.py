"""The initial state of the base model, as the measured deformation shows it, for what is not linear in the paths.

The likelihood integrates it out as what adds to y. An effect that counts from where the machine is at rest needs it
once more: a path that is still warm inside acts in it, too.
"""

from __future__ import annotations

import numpy as np

from compensator.arrays import Vector
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
    evidence = fit.likelihood.points.evidence
    if not any(term.effect.counts_from_rest and term.effect.path == "DTF" for term in fit.terms):
        return None
    initial_um = _initial_um(fit)
    return evidence.with_initial_state(initial_um) if _matters(initial_um, evidence) else None


def begin_warm(fit: Fit) -> list[bool]:
    """Return for each run whether T_Q says that it may begin warm, and the data beside the effects that it does.

    Parameters
    ----------
    fit : Fit
        Effects.
    """
    evidence = fit.likelihood.points.evidence
    parts = np.split(_initial_um(fit), np.cumsum([record.size for record in evidence.signals])[:-1])
    return [
        record.may_begin_warm and _matters(part, evidence) for record, part in zip(evidence.signals, parts, strict=True)
    ]


def _initial_um(fit: Fit) -> Vector:
    """Return what the most probable initial state adds on every sample, µm."""
    points = fit.likelihood.points
    weights = fit.likelihood.weights(fit.added)[points.zeros.shape[1] :][: points.starts_of_modes.shape[1]]
    return np.asarray(points.evidence.nuisances[:, ~points.is_zero] @ (fit.rest.start_um * weights))


def _matters(initial_um: Vector, evidence: Evidence) -> bool:
    return bool(np.max(np.abs(initial_um)) > WARM_SHARE * evidence.context.sizes_um["DTF"])
