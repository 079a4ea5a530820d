"""Held-out blocks predicted by a fit to the others: zeros and initial states as those know them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from compensator.arrays import Mask, Vector, rms_of
from compensator.diagnose.fitting.fit import Fit, fit_terms, settled, summed
from compensator.diagnose.fitting.likelihood import Likelihood, RandomColumns
from compensator.diagnose.fitting.points import Points, SlowRest
from compensator.diagnose.fitting.whitening import Whitening
from compensator.diagnose.residual.evidence import Evidence

#: Blocks that are held out, one after another.
FOLDS = 3


class Folds:
    """Parts of some evidence, each without a block that a fit to it foretells.

    Parameters
    ----------
    points : Points
        All of the evidence.
    """

    def __init__(self, points: Points) -> None:
        self._evidence = points.evidence
        self._parts = [(block, points.of(points.evidence.without(block))) for block in points.evidence.blocks(FOLDS)]

    def error_um(self, fit: Fit) -> float:
        """Return what the effects of a fit, fitted without each block, leave of it, µm rms; not chosen anew.

        Infinite where the others do not determine them.
        """
        left = []
        for block, points in self._parts:
            try:
                own = settled(fit_terms(Likelihood(points, fit.rest), fit.starts()))
            except np.linalg.LinAlgError:  # without the block nothing shows how large they are
                return math.inf
            predicted = Nuisances(points, own.rest).beside(summed(points.evidence, own.terms))
            left.append(left_of_block(self._evidence, block, zeros_known(points), predicted))
        return rms_of(np.concatenate(left))


def left_of_block(evidence: Evidence, block: Mask, knows_zero: Sequence[bool], predicted: Vector) -> Vector:
    """Return what a prediction leaves of a block, µm; what is about a zero that it does not know about its own mean."""
    left = np.where(block, evidence.residual - predicted, np.nan)
    for own, is_known in zip(evidence.zeros.T > 0.0, knows_zero, strict=True):
        if (block & own).any() and not is_known:
            left[own] -= np.nanmean(left[own])
    return np.asarray(left[block])


def zeros_known(points: Points) -> tuple[bool, ...]:
    """Return for each zero whether a point shows it; a few samples at the end of a run are none."""
    return tuple(np.any(points.evidence.zeros[points.first] > 0.0, axis=0).tolist())


class Nuisances:
    """Zeros and initial states of all runs as a part of the evidence knows them.

    Parameters
    ----------
    points : Points
        The part.
    rest : SlowRest
        What no effect explains, of all data: how far initial states are from rest, and how many samples count. A part
        that does not see where a run begins says nothing of that.
    """

    def __init__(self, points: Points, rest: SlowRest) -> None:
        self._points, self._whitening = points, Whitening(points, rest)
        self._table = points.zeros_and_starts(rest)
        self._white = self._whitening.of(points.averaged(self._table))

    def beside(self, added: Vector) -> Vector:
        """Return what effects add, with the most probable zeros and initial states beside them, on every sample."""
        target = self._points.residual - self._points.averaged(added[:, None])[:, 0]
        weights = RandomColumns(self._white, self._whitening.of(target[:, None])[:, 0]).mean
        return np.asarray(added + self._table @ weights)
