"""Refused probes that agree with each other: what several of them show was not a chip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from compensator.model.correction.mixture import Mixture

#: So many refused probes that agree are believed; two before a first probe was taken.
AGREEING = 3
#: Refused probes that lie further apart than this do not support each other, min.
AGREEING_WITHIN_MIN = 720.0
#: Refused probes agree within this many standard deviations of their difference.
AGREEMENT = 3.0


@dataclass(frozen=True, slots=True)
class ComparedProbe:
    """A probe after it was compared with the prediction.

    Parameters
    ----------
    minutes : float
        When, min.
    deviation_um : float
        Measured deformation less that of the free run, µm.
    innovation_um : float
        The same less the corrected prediction, µm.
    std_um : float
        Standard deviation of the measured value, µm.
    contributions_um : tuple of float
        Share of each path and effect in the deformation, µm.
    feature : str
        What was probed.
    """

    minutes: float
    deviation_um: float
    innovation_um: float
    std_um: float
    contributions_um: tuple[float, ...]
    feature: str

    @classmethod
    def from_dict(cls, state: Mapping[str, Any]) -> ComparedProbe:
        """Return what `dataclasses.asdict` made into a dict."""
        return cls(**{**state, "contributions_um": tuple(map(float, state["contributions_um"]))})


def agreeing(refused: Sequence[ComparedProbe], probe: ComparedProbe, known: Mixture) -> list[ComparedProbe]:
    """Return the refused probes that agree with another one, within their noise and what may have changed since.

    Parameters
    ----------
    refused : sequence of ComparedProbe
        Earlier ones.
    probe : ComparedProbe
        The newest.
    known : Mixture
        Offset and gains: how fast the one walks, how uncertain the others are.
    """
    found = []
    for other in refused:
        apart = probe.minutes - other.minutes
        variance = probe.std_um**2 + other.std_um**2 + apart * known.growth[0]
        shares = zip(probe.contributions_um, other.contributions_um, strict=True)
        for i, (now, then) in enumerate(shares, start=1):
            variance += known.covariance[i][i] * (now - then) ** 2
        differ = probe.innovation_um - other.innovation_um
        if apart <= AGREEING_WITHIN_MIN and differ**2 <= AGREEMENT**2 * variance:
            found.append(other)
    return found
