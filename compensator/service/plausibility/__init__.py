"""Plausibility of measured values: each channel alone, T_Q against AT, and measured against predicted Y."""

from compensator.service.plausibility.checks import BLOCK_SAMPLES, PlausibilityCheck, PlausibilityState, SensorEvidence
from compensator.service.plausibility.guards import HEATED_W, TEMPERATURES, SensorGuards
from compensator.service.plausibility.jump_state import JumpState
from compensator.service.plausibility.jumps import JumpWatch
from compensator.service.plausibility.one_jump import Judgement

__all__ = [
    "BLOCK_SAMPLES",
    "HEATED_W",
    "TEMPERATURES",
    "Judgement",
    "JumpState",
    "JumpWatch",
    "PlausibilityCheck",
    "PlausibilityState",
    "SensorEvidence",
    "SensorGuards",
]
