"""State of the probes of a compensation: the correction, and the last samples with what was published."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import msgspec

#: Time of a zero by a clock that was set back since then: before every probe.
UNKNOWN_NS = 1


class PastSample(msgspec.Struct, frozen=True, array_like=True):
    """What a probe is compared with: prediction and offset of one sample.

    Parameters
    ----------
    time_ns : int
        End of the sample, ns since 1970 UTC.
    y_um, rate_um_per_min : float
        Deformation by the model alone since the zero, and its growth over the next sample.
    contributions_um : tuple of float
        Share of each path and effect.
    noise_um : float
        Standard deviation that sensor noise and missing samples cause.
    offset_um, offset_rate_um_per_min : float
        As published; NaN until then.
    is_held : bool
        Whether the offset was held.
    behind_ns : int
        How far the middle of its polls is before its end, ns.
    """

    time_ns: int
    y_um: float
    rate_um_per_min: float
    contributions_um: tuple[float, ...]
    noise_um: float
    offset_um: float
    offset_rate_um_per_min: float
    is_held: bool
    behind_ns: int = 0

    @property
    def middle_ns(self) -> int:
        """Time that the prediction belongs to, ns since 1970 UTC."""
        return self.time_ns - self.behind_ns


class KnownProbe(msgspec.Struct, frozen=True, array_like=True):
    """A probe that was compared with the prediction, to recognise a duplicate."""

    time_ns: int
    measured_um: float
    offset_applied_um: float
    feature: str


@dataclass(slots=True)
class ProbingState:
    """State of the probes.

    Parameters
    ----------
    correction : dict
        State of the `ProbeCorrection`.
    samples : list of PastSample
        The last samples, the newest last.
    known : list of KnownProbe
        The last probes that were compared with the prediction.
    features : list of str
        Features that were probed since the zero.
    zero_ns : int
        Time of the last zero, ns since 1970 UTC; `UNKNOWN_NS` if the clock was set back since then, 0 if nothing of it
        is known.
    refused : str
        Code of the last probe if it was refused and another one is wanted for it.
    """

    correction: dict[str, Any]
    samples: list[PastSample] = field(default_factory=list)
    known: list[KnownProbe] = field(default_factory=list)
    features: list[str] = field(default_factory=list)
    zero_ns: int = 0
    refused: str = ""
