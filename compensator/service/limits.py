"""Limits of the offset: largest value and largest rate, each limiting action with a reason."""

from __future__ import annotations

import math
from dataclasses import dataclass

from compensator.config import Limits


@dataclass(frozen=True, slots=True)
class Limited:
    """An offset within its limits.

    Parameters
    ----------
    offset_um, rate_um_per_min : float
        What may be published.
    reasons : tuple of str
        Limiting actions that were taken.
    """

    offset_um: float
    rate_um_per_min: float
    reasons: tuple[str, ...]


class OffsetLimiter:
    """Keeps the offset inside its limits; it moves, it never jumps.

    Parameters
    ----------
    limits : Limits
        Largest value, µm, and rate, µm/min.
    period_min : float
        Length of a sample, min.
    """

    def __init__(self, limits: Limits, period_min: float) -> None:
        self._max_um = limits.offset_max_um
        self._rate_max = limits.offset_rate_max_um_per_min
        self._period_min = period_min
        #: What was published last, µm; a control that never got an offset applies none.
        self.offset_um = 0.0

    def follow(self, target_um: float, target_rate_um_per_min: float) -> Limited:
        """Move towards a target.

        Parameters
        ----------
        target_um : float
            Where the offset should be, µm.
        target_rate_um_per_min : float
            How the target will go on, µm/min.

        Returns
        -------
        Limited
            The next offset, and the rate at which the one after it is expected.
        """
        reasons = []
        wanted = target_um
        if abs(wanted) > self._max_um:
            wanted = math.copysign(self._max_um, wanted)
            reasons.append("offset_limited")
        step_max = self._rate_max * self._period_min
        # No more than one sample's worth, however long ago the last one was published.
        if abs(wanted - self.offset_um) > step_max:
            wanted = self.offset_um + math.copysign(step_max, wanted - self.offset_um)
            reasons.append("rate_limited")
        self.offset_um = wanted
        return Limited(
            wanted, self._rate_towards(target_um + target_rate_um_per_min * self._period_min), tuple(reasons)
        )

    def hold(self) -> Limited:
        """Stay where it is."""
        return Limited(self.offset_um, 0.0, ())

    def _rate_towards(self, next_target_um: float) -> float:
        ahead = max(-self._max_um, min(self._max_um, next_target_um))
        rate = (ahead - self.offset_um) / self._period_min
        return max(-self._rate_max, min(self._rate_max, rate))
