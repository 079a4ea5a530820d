"""Correction of a model by measured values of Y, as from a touch probe."""

from compensator.model.correction.probe_correction import BELIEVED, OUTLIER, ProbeCorrection, ProbeVerdict

__all__ = ["BELIEVED", "OUTLIER", "ProbeCorrection", "ProbeVerdict"]
