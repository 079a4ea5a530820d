"""Since when a model has erred otherwise than before: where an effect has probably begun or ended.

The residual's block means are split in two, each part with a mean and a variance of its own. The split that is most
likely is the one sought; neighbouring blocks resemble each other, so its gain over no split chooses what is looked at
and decides nothing.
"""

from __future__ import annotations

import numpy as np

from compensator.arrays import Vector

#: Length of a block, min, and the fewest of them on each side.
BLOCK_MIN, FEWEST_BLOCKS = 30.0, 8
#: A split must be better by so much log-likelihood.
CHANGED = 5.0
#: A model was right before if its error varied by less than this part of what it has varied by since.
QUIET = 0.5


def changed_at(t_s: Vector, residual_um: Vector, floor_um: float, *, from_quiet: bool = False) -> float | None:
    """Return when a residual has changed, s; None if it has not.

    Parameters
    ----------
    t_s, residual_um : numpy.ndarray, shape (n,)
        Time, and residual, µm; NaN where it is unknown.
    floor_um : float
        A standard deviation that does not matter, µm.
    from_quiet : bool
        Whether the model must have been right before (`QUIET`).

    Examples
    --------
    >>> minutes = np.arange(2000.0)
    >>> changed_at(60.0 * minutes, np.where(minutes < 1200, 0.1, 5.0) * np.sin(minutes / 50.0), 0.1) / 60.0
    1200.0
    """
    known = np.isfinite(residual_um)
    numbers, blocks = np.unique(t_s[known] // (60.0 * BLOCK_MIN), return_inverse=True)
    means = np.bincount(blocks, residual_um[known]) / np.maximum(np.bincount(blocks), 1)
    n = means.size
    splits = range(FEWEST_BLOCKS, n - FEWEST_BLOCKS + 1)
    if not splits:
        return None

    def cost(part: Vector) -> float:
        return 0.5 * part.size * float(np.log(np.var(part) + floor_um**2))

    gains = [
        cost(means) - cost(means[:split]) - cost(means[split:])
        if not from_quiet or np.std(means[:split]) <= QUIET * np.std(means[split:])
        else 0.0
        for split in splits
    ]
    best = int(np.argmax(gains))
    return float(numbers[splits[best]]) * 60.0 * BLOCK_MIN if gains[best] >= CHANGED else None
