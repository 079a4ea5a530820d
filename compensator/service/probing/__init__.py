"""Probes: read, checked against what was published at their time, and compared with the prediction."""

from compensator.service.probing.probing import Corrected, Probing, ProbingHandover
from compensator.service.probing.received import UNKNOWN_UM, ReceivedProbe, read_probe
from compensator.service.probing.state import ProbingState
from compensator.service.probing.wanted import Wanted

__all__ = [
    "UNKNOWN_UM",
    "Corrected",
    "Probing",
    "ProbingHandover",
    "ProbingState",
    "ReceivedProbe",
    "Wanted",
    "read_probe",
]
