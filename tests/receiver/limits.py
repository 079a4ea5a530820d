"""Limits of an axis that tests of the follower and of the bridge share."""

from __future__ import annotations

import dataclasses

from compensator.receiver import AxisLimits

MAX_UM = 50.0


def plain(rate_um_per_min: float) -> AxisLimits:
    """An axis without a slope."""
    return AxisLimits(offset_max_um=MAX_UM, offset_rate_max_um_per_min=rate_um_per_min)


def sloped(rate_um_per_min: float) -> AxisLimits:
    """Y with a slope over a travel of a metre."""
    return dataclasses.replace(
        plain(rate_um_per_min),
        slope_max_um_per_m=60.0,
        position_min_mm=0.0,
        position_max_mm=1000.0,
        position_speed_max_mm_per_s=500.0,
    )
