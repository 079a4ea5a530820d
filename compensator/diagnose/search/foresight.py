"""How the drive moves that the engine estimates from a late T_Q: set so that what it knows in time is right.

A late T_Q is found with the future of the record; the engine knows the past only and has to expect how the drive goes
on. What it expects by default is what the calibration's run did, and of T_Q − AT of a direct model that it stays where
it is. The later T_Q is, the more depends on it. So it is set anew: the engine's share of the drive in y is to be as
near as possible to the one that is known with the future, and as near as the engine states. No value of Y takes part.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from compensator.arrays import Vector
from compensator.diagnose.fitting.fit import Fit, late_term
from compensator.diagnose.residual.evidence import Evidence
from compensator.model.effects import Effect
from compensator.model.late_observer import observe, steady_variance_um2

#: How many times the drive moves as it did in the calibration, and the lag that T_Q − AT of a direct model may be
#: behind what moves so, min: where the search begins, and its bounds.
WALK_TIMES, WALK_BOUNDS = 1.0, (0.1, 10.0)
BEHIND_MIN, BEHIND_BOUNDS_MIN = 8.0, (1.0, 60.0)
#: Most trials of the search.
TRIALS = 24
#: What is expected by default stays unless the log of the probability of a sample grows by this: 3 % of an error.
GAINS = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class Foresight:
    """How the drive moves, as a late T_Q has it (`Lateness`).

    Parameters
    ----------
    walk_times, behind_min : float
        As there.
    """

    walk_times: float = 1.0
    behind_min: float = 0.0


def foreseeing(fit: Fit, known: Foresight | None) -> tuple[Fit, Foresight | None]:
    """Return a fit whose late T_Q says how the drive moves, if there is one, and how.

    Parameters
    ----------
    fit : Fit
        What was found.
    known : Foresight or None
        That of all data, where something is held out: no value of Y takes part in it.
    """
    late, evidence = late_term(fit), fit.likelihood.points.evidence
    if late is None or evidence.model.estimator.method != "kalman":
        return fit, None
    foresight = known or _best(evidence, late.effect)
    changes = dataclasses.asdict(foresight)
    effect = dataclasses.replace(late.hypothesis.effect, **changes)
    term = dataclasses.replace(late, hypothesis=dataclasses.replace(late.hypothesis, effect=effect))
    return dataclasses.replace(fit, terms=tuple(term if one is late else one for one in fit.terms)), foresight


def _best(evidence: Evidence, late: Effect) -> Foresight:
    """Return how the drive moves with which the engine is right; as in the calibration where that is as good."""
    surprise, is_direct = _surprise_of(evidence, late), evidence.model.ttf is None

    def foresight(x: Vector) -> Foresight:
        walk, *behind = np.exp(x).tolist()
        return Foresight(walk_times=walk, behind_min=behind[0] if behind else 0.0)

    begin = np.log([WALK_TIMES, *([BEHIND_MIN] if is_direct else [])])
    bounds = np.log([WALK_BOUNDS, *([BEHIND_BOUNDS_MIN] if is_direct else [])])
    found = minimize(
        lambda x: surprise(foresight(x)),
        begin,
        method="Nelder-Mead",
        bounds=bounds.tolist(),
        options={
            "initial_simplex": np.vstack([begin, begin + np.eye(begin.size)]),
            "maxfev": TRIALS,
            "xatol": 0.1,
            "fatol": 0.01,
        },
    )
    return foresight(found.x) if found.fun < surprise(Foresight()) - GAINS else Foresight()


def _surprise_of(evidence: Evidence, late: Effect) -> Callable[[Foresight], float]:
    """Return what gives the surprise by a sample of the share of the drive in y, from how the drive moves.

    That is less the logarithm of the probability of what is known with the future, given what the engine states. An
    error below the noise of Y does not matter.
    """
    lateness = late.lateness
    assert lateness is not None
    # The record's end holds: what comes later is not known.
    unknown = 1 + lateness.samples(evidence.model.period_s)
    known = [own.y_dtf_um + late.columns(own, ())[:, 0] for own in evidence.signals]

    def surprise(foresight: Foresight) -> float:
        effects = (*evidence.model.effects, dataclasses.replace(late, **dataclasses.asdict(foresight)))
        model, left = dataclasses.replace(evidence.model, effects=effects), []
        for run, share in zip(evidence.runs, known, strict=True):
            t_q_degc, at_degc = run.reference
            seen = observe(model, run.t_q_degc - t_q_degc, run.at_degc - at_degc)
            error = (seen.y_dtf_um - share)[: max(share.size - unknown, 1)]
            left.append(error - np.mean(error))
        least_um2 = evidence.probe_um**2
        variance_um2 = steady_variance_um2(model) + least_um2
        return 0.5 * float((np.var(np.concatenate(left)) + least_um2) / variance_um2 + math.log(variance_um2))

    return surprise
