"""Measured values of Y that do not fit the others, as by a chip on the probed feature: how they are named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compensator.arrays import Mask, Vector
from compensator.codes import DataRemark, Remark
from compensator.data.runs import Run

#: A value so many deviations away from what the others show is a chip.
CHIP_DEVIATIONS = 5.0
#: Of values that took no part in a fit, so many on each side show where one should be.
_NEIGHBOURS = 2
#: Number of values whose times a remark lists.
_SHOWN = 10


def without(runs: Sequence[Run], chips: Sequence[Mask]) -> list[Run]:
    """Return runs without some of their measured values."""
    return [run.without_y(chip) if chip.any() else run for run, chip in zip(runs, chips, strict=True)]


def left_out(runs: Sequence[Run], chips: Sequence[Mask], more: str = "") -> Remark:
    """Return the remark on values that do not fit: how many of how many, and when.

    Parameters
    ----------
    runs : sequence of Run
        With every measured value.
    chips : sequence of numpy.ndarray of bool
        The values of each run that do not fit.
    more : str
        Another sentence on them.
    """
    name = ", ".join(dict.fromkeys(run.name for run, chip in zip(runs, chips, strict=True) if chip.any()))
    t_s: Vector = np.concatenate([run.t_s[chip] for run, chip in zip(runs, chips, strict=True)])
    of = sum(int(np.isfinite(run.y_um).sum()) for run in runs)
    where = ", ".join(f"{value:.0f}" for value in t_s[:_SHOWN].tolist())
    others = f" and {t_s.size - _SHOWN} more" if t_s.size > _SHOWN else ""
    words = f"{name}: {t_s.size} of {of} measured y_um do not fit the others and were left out"
    return Remark(DataRemark.Y_LEFT_OUT, f"{words}, at t_s = {where}{others} from the start.{more}")


def isolated(residual: Vector, noise_um: float) -> Mask:
    """Return the values that lie far from their neighbours, in the residual of a model that was not fitted to them.

    What the model misses moves several values; a chip moves one.

    Parameters
    ----------
    residual : numpy.ndarray, shape (n,)
        Measured less predicted, µm; NaN where nothing was measured.
    noise_um : float
        Standard deviation of one value, µm.

    Examples
    --------
    >>> isolated(np.array([0.0, 1.0, 20.0, 0.5, 0.0, 9.0, 9.0, 9.0]), 1.0).nonzero()[0]
    array([2])
    """
    known, found = np.flatnonzero(np.isfinite(residual)), np.zeros(residual.size, dtype=bool)
    values = residual[known]
    limit = CHIP_DEVIATIONS * np.sqrt(2.0) * noise_um
    for i in range(values.size):
        sides = [values[max(0, i - _NEIGHBOURS) : i], values[i + 1 : i + 1 + _NEIGHBOURS]]
        apart = values[i] - np.concatenate(sides)
        # All on one side and far: a step has a neighbour that is near.
        found[known[i]] = apart.size > _NEIGHBOURS and bool(np.all(apart > limit) or np.all(apart < -limit))
    return found
