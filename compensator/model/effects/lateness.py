"""By how much T_Q is late: what an effect asks of the observer."""

from __future__ import annotations

import math
from dataclasses import dataclass

from compensator.model.transfer_function import SampledTransferFunction

#: A dead time that is as near to whole samples is one of them: 0.3333333333 min are 4 samples of 5 s.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Lateness:
    """Lag and dead time of T_Q, and how the drive moves that is estimated from it.

    The later T_Q is, the more depends on what the drive is expected to do: it says how much of a change of T_Q is
    believed, and how the drive goes on where T_Q does not show it yet.

    Parameters
    ----------
    lag_min, delay_min : float
        Time constant of a first-order lag, and dead time, min.
    of_ambient : bool
        Whether the ambient's change reaches T_Q as late as the heat does: the sensor is late, and not the heat's way.
    walk_times : float
        The drive changes in one sample by this many times what the estimator says.
    behind_min : float
        In a direct model, T_Q − AT is behind what changes so by this first-order lag, min: it goes on after a change.
    """

    lag_min: float
    delay_min: float
    of_ambient: bool
    walk_times: float = 1.0
    behind_min: float = 0.0

    def samples(self, period_s: float) -> int:
        """Return the whole samples of the dead time."""
        return self._split(period_s)[0]

    def _split(self, period_s: float) -> tuple[int, float]:
        """Return the dead time in whole samples, and what they leave of it, in samples."""
        samples = self.delay_min * 60.0 / period_s
        if abs(samples - round(samples)) < _ROUNDING:
            return round(samples), 0.0
        whole = math.floor(samples)
        return whole, samples - whole

    def behind(self, period_s: float) -> SampledTransferFunction | None:
        """Return the lag of T_Q − AT behind what changes, if it has one."""
        return _lag(self.behind_min * 60.0 / period_s, period_s) if self.behind_min > 0.0 else None

    def within_a_sample(self, period_s: float, *, invertible: bool) -> SampledTransferFunction:
        """Return the lag, and what whole samples leave of the dead time.

        The lag is that of the backward difference, whose inverse is a lead that does not ring (Tustin's has a zero at
        z = −1). A part of a sample is a straight line between two of them, whose inverse may ring, or as a lag.

        Parameters
        ----------
        period_s : float
            Sample period, s.
        invertible : bool
            Whether it will be inverted.
        """
        part = self._split(period_s)[1]
        function = _lag(self.lag_min * 60.0 / period_s, period_s)
        if part == 0.0:
            return function
        if invertible:
            return function.times(_lag(part, period_s))
        return function.times(SampledTransferFunction(b=(1.0 - part, part), a=(1.0,), period_s=period_s))


def _lag(samples: float, period_s: float) -> SampledTransferFunction:
    pole = samples / (samples + 1.0)
    a = (1.0, -pole) if pole > 0.0 else (1.0,)
    return SampledTransferFunction(b=(1.0 - pole,), a=a, period_s=period_s)
