"""Detection limits: the size that something would need for few values of Y to show it.

Few values with noise fit any model that is not far off. A residual that is noise says only that nothing larger than
this acts. An effect with the column *w*, whitened and without nuisances, is named where

    ½ a² ‖w‖² = cost + ½ log(1 + ‖w‖² spread²)

on average; the size *a* below is that which is named in about 19 of 20 records like this one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.search import Selection
from compensator.model.effects.blocks import Lag

#: What is named in 19 of 20 records is this many standard deviations larger than what is named on average.
SURE = 1.645
#: A model is adequate only where nothing could hide that moves Y by more than this share of its whole movement.
MATTERS = 0.1
#: Effects that are listed as undecided.
UNDECIDED = 3
#: Lag of a source that no channel shows, min, and the share of the record in which it acts.
LAG_MIN, ACTS_SHARE = 60.0, 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionLimit:
    """How large something could be that acts without being seen.

    Parameters
    ----------
    kind, path : str
        As an effect is named: `gain` of a path, `drift`, `step`, `unobserved`.
    size_um : float
        Peak to peak of what it would add to y over the record, µm.
    """

    kind: str
    path: str
    size_um: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionLimits:
    """How much could act without being seen in a record of few values.

    Parameters
    ----------
    what : tuple of DetectionLimit
        The largest first.
    matters_um : float
        What must not hide if the model shall be called adequate, peak to peak, µm.
    values : int
        Number of measured values.
    every_min : float
        Median time between two of them, min: what comes and goes within it does not show.
    undecided : tuple of str
        Effects that may act, which the values do not decide.
    """

    what: tuple[DetectionLimit, ...]
    matters_um: float
    values: int
    every_min: float
    undecided: tuple[str, ...] = ()

    @property
    def is_too_much(self) -> bool:
        """Whether something that matters could hide."""
        return self.what[0].size_um > self.matters_um

    @property
    def values_needed(self) -> int:
        """About how many values like these would show what matters."""
        return math.ceil(self.values * (self.what[0].size_um / self.matters_um) ** 2)


def detection_limits(selection: Selection, cost: float) -> DetectionLimits:
    """Return how much could hide beside what was found.

    Parameters
    ----------
    selection : Selection
        Effects and rest that were found.
    cost : float
        What an effect must add to the logarithm of the evidence.
    """
    fit = selection.fit
    likelihood, points = fit.likelihood, fit.likelihood.points
    kept, inner, _ = fit.solved(likelihood)
    found, named = [], {(kind, where) for kind, where, _ in fit.places}
    for kind, path, course in _courses(points.evidence):
        if (kind, path) in named:
            continue
        unit = course / max(float(np.ptp(course)), 1e-9)
        white = likelihood.projected(points.averaged(unit[:, None]))[:, 0]
        square = float(white @ white - (white @ kept) @ (inner @ white))
        least = math.sqrt(2.0 * cost + math.log1p(square * points.spread_um**2)) + SURE
        found.append(DetectionLimit(kind=kind, path=path, size_um=least / math.sqrt(max(square, 1e-9))))
    measured, undecided = points.evidence.y_um, selection.undecided[:UNDECIDED]
    return DetectionLimits(
        what=tuple(sorted(found, key=lambda one: -one.size_um)),
        matters_um=MATTERS * float(np.nanmax(measured) - np.nanmin(measured)),
        values=points.count,
        every_min=points.period_min,
        undecided=tuple(dict.fromkeys(other.terms[-1].label for other in undecided)),
    )


def _courses(evidence: Evidence) -> Iterator[tuple[str, str, Vector]]:
    """Yield what might act: kind, path, and its course on every sample of all records."""
    records = evidence.signals
    for path in evidence.context.paths:
        course = np.concatenate([record.share(path) for record in records])
        if np.ptp(course) > 0.0:
            yield "gain", path, course
    minutes = np.concatenate([record.begins_min + record.minutes for record in records])
    yield "drift", "", minutes
    period_min = evidence.context.period_min
    longest = max(records, key=lambda record: record.size)
    begin, middle = sum(r.size for r in records[: longest.number]), longest.size // 2
    step = np.zeros(minutes.size)
    step[begin + middle : begin + longest.size] = 1.0
    yield "step", "", step
    acts = np.zeros(longest.size)
    acts[round((0.5 - ACTS_SHARE / 2.0) * longest.size) : round((0.5 + ACTS_SHARE / 2.0) * longest.size)] = 1.0
    source = np.zeros(minutes.size)
    source[begin : begin + longest.size] = Lag(LAG_MIN, period_min).filter(acts)
    yield "unobserved", "", source
