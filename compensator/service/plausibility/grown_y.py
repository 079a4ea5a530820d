"""Deformation by measured Y, as a jump is compared with it."""

from __future__ import annotations

from typing import NamedTuple


class GrownY(NamedTuple):
    """Deformation since the zero by measured Y, µm; NaN where it is not known.

    Parameters
    ----------
    by_level : float
        By how Y stood to the prediction before the jump: a model that is wrong by some µm says nothing of the sensor.
    by_zero : float
        By Y at the zero: what was wrong before the jump counts, too.
    level_std_um, zero_std_um : float
        Their standard deviations, the noise of Y included, µm: at the zero Y was one value.
    """

    by_level: float
    by_zero: float
    level_std_um: float
    zero_std_um: float
