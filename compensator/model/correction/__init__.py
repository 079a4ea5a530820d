"""Correction of a model by measured values of Y, as from a touch probe: ../MATHEMATICS.md, section 8.

probe → ProbeCorrection.update
          refused         refused probes that agree are believed
          probation       the most doubtful probe that was taken: right or wrong, one bank for each
            kalman_bank   offset, gains and zeros, by one Kalman filter for each walk of the offset
              mixture     several estimates as one
"""

from compensator.model.correction.probe_correction import BELIEVED, OUTLIER, ProbeCorrection, ProbeVerdict

__all__ = ["BELIEVED", "OUTLIER", "ProbeCorrection", "ProbeVerdict"]
