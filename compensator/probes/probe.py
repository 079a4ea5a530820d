"""One measured value of a touch probe, and where it goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

#: Largest value that any source passes on, µm; the service's own limits are narrower.
LARGEST_UM = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """A measured value, as in the command `thermal/command/probe`.

    Parameters
    ----------
    time_utc_ns : int
        When it was measured, ns since 1970 UTC.
    measured_um : float
        Displacement that the offset has left, µm; see `Convention`.
    offset_applied_um : float
        Offset that the control had applied then, µm.
    feature, tool : str
        Names of the feature and of the probe; empty if not known.
    std_um : float or None
        Standard deviation of the value, µm; None: that of the service's configuration.
    stopped_s : float or None
        How long the spindle had been standing, s; None if not known.
    """

    time_utc_ns: int
    measured_um: float
    offset_applied_um: float
    feature: str = ""
    tool: str = ""
    std_um: float | None = None
    stopped_s: float | None = None

    @property
    def text(self) -> str:
        """Return it in a few words."""
        feature = f" at {self.feature}" if self.feature else ""
        return f"{self.measured_um:+.2f} µm{feature}, offset {self.offset_applied_um:+.2f} µm"


@dataclass(frozen=True, slots=True, kw_only=True)
class Convention:
    """How a control's reading of a feature becomes `measured_um`.

    With the offset o in effect, the tool's tip is at its commanded place plus o plus the deformation y. A value of
    the contract is y + o, so that the deformation is `measured_um` − `offset_applied_um`. A probe in the spindle that
    touches a fixed feature stops where tip and feature meet, at the commanded place −(y + o): its reading falls where
    the offset rises, `sign` = −1. Where the control's display includes the offset, the reading is −y, and does not
    change with the offset at all.

    Parameters
    ----------
    sign : int
        1 or −1: direction of the reading's change if the tip is displaced towards +Y.
    includes_offset : bool
        Whether the control's position contains the offset.

    Examples
    --------
    The tip is displaced by y = +10 µm, the offset is −8 µm, so the probe finds the feature at −2 µm:

    >>> Convention(sign=-1).measured_um(-2.0, -8.0)
    2.0
    >>> Convention(sign=-1, includes_offset=True).measured_um(-10.0, -8.0)
    2.0
    """

    sign: int
    includes_offset: bool = False

    def measured_um(self, reading_um: float, offset_um: float) -> float:
        """Return the value of the contract, µm.

        Parameters
        ----------
        reading_um : float
            Where the control found the feature minus where it belongs, µm.
        offset_um : float
            Offset that acted, µm.
        """
        return self.sign * reading_um + (offset_um if self.includes_offset else 0.0)


class Reply(NamedTuple):
    """The service's answer to a probe: whether it passed the first checks, in words, and the code of a refusal."""

    ok: bool
    text: str
    code: str = ""


class NotSent(Exception):
    """No answer: the service was not reached, or did not answer. The same probe may be sent again."""


class ProbeSink(Protocol):
    """Where probes go."""

    def send(self, probe: Probe) -> Reply:
        """Send a probe and wait for the answer.

        Raises
        ------
        NotSent
            If there was none.
        """
