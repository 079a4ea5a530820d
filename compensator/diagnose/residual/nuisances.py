"""What every record has and no effect causes: its zeros, and the base's state as it begins or after a hole."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from compensator.arrays import Indices, Mask, Matrix
from compensator.model.effects.hypothesis import Context
from compensator.model.effects.signals import RecordSignals

#: An initial state moves y by no more than about this many times its spread, with the weight of one sample.
STATE_PRIOR = 1e-3
#: After so many holes, the longest ones, the state is free; it costs time.
MOST_HOLES = 8
#: Fastest decay of an initial state, samples, and the largest ratio of neighbouring decays.
FASTEST, DECAY_RATIO = 2.0, 3.5


def zeros_of(numbers: Indices) -> Matrix:
    """Return a column for each zero that Y of a record counts from, 1 where it does; see `Run.zero_numbers`."""
    return np.asarray(numbers[:, None] == np.unique(numbers), dtype=np.float64)


def decays_of(record: RecordSignals, context: Context, holes: Sequence[tuple[int, int]] = ()) -> Matrix:
    """Return decays from the fastest that can be seen to the base's slowest mode, each of size 1.

    Those of the initial state, and of what the unknown heat in each hole leaves after it; see `Run.holes`.
    """
    fastest = FASTEST * record.period_min
    slowest = max([3.0 * fastest, *(t for values in context.taus_min.values() for t in values)])
    taus = np.geomspace(fastest, slowest, 1 + math.ceil(math.log(slowest / fastest, DECAY_RATIO))).tolist()
    followed = [hole for hole in holes if hole[1] < record.size]
    longest = sorted(followed, key=lambda hole: hole[1] - hole[0])[-MOST_HOLES:]
    since = [record.minutes - record.minutes[begin] for begin in (0, *sorted(end for _, end in longest))]
    return np.column_stack([np.where(t >= 0.0, np.exp(-np.maximum(t, 0.0) / tau), 0.0) for t in since for tau in taus])


def basis_of(nuisances: Matrix, used: Mask) -> Matrix:
    """Return orthonormal columns that the nuisances span on the samples used."""
    u, s, _ = np.linalg.svd(np.where(used[:, None], nuisances, 0.0), full_matrices=False)
    return u[:, s > STATE_PRIOR * s[0]]


def freedom_of(used: Mask, basis: Matrix) -> int:
    """Return the number of values less what the nuisances may absorb, at least 1."""
    return max(int(used.sum()) - int(basis.shape[1]), 1)
