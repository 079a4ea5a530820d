"""Whether measured values can be true: each channel alone, T_Q against AT, and measured against predicted Y."""

from compensator.service.plausibility.checks import BLOCK_SAMPLES, Evidence, PlausibilityCheck, PlausibilityState
from compensator.service.plausibility.guards import HEATED_W, SensorGuards

__all__ = ["BLOCK_SAMPLES", "HEATED_W", "Evidence", "PlausibilityCheck", "PlausibilityState", "SensorGuards"]
