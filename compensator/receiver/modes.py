"""What followers of one axis and of several have in common: the modes, and whether a message may be followed."""

from __future__ import annotations

import math
from typing import Any, Generic, Literal

from .errors import ReceiverError
from .gate import Gate, Held, M
from .reasons import Reason
from .values import finite, shown

#: Part of `valid_for_s` for which the published rate is followed: the rate holds until the next sample, and a message
#: is valid for two to three samples.
RATE_PART = 0.5
#: Closer than this the offset counts as arrived, µm.
ARRIVED_UM = 0.01

FollowerState = Literal["starting", "following", "holding", "fading"]


def moved(applied_um: float, target_um: float, step_um: float, most_um: float) -> float:
    """Return a value after one step towards its target, never beyond the limit.

    Parameters
    ----------
    applied_um, target_um : float
        Where it is and where it goes, µm.
    step_um : float
        Longest step, µm.
    most_um : float
        Largest value, µm.
    """
    distance_um = target_um - applied_um
    if abs(distance_um) <= step_um:
        return target_um
    return max(-most_um, min(most_um, applied_um + math.copysign(step_um, distance_um)))


class Modes(Generic[M]):
    """Modes of a follower.

    Parameters
    ----------
    gate : Gate
        Accepts or drops the messages.

    Attributes
    ----------
    alive : bool or None
        Whether the service's liveliness token is present; None if unknown.
    """

    def __init__(self, gate: Gate[M]) -> None:
        self.alive: bool | None = None
        self._gate = gate
        self._mode: Literal["follow", "hold", "fade"] = "follow"
        self._fade_rate_um_per_min = 0.0
        self._advanced_s: float | None = None

    @property
    def machine(self) -> str:
        """Return the machine whose offset is followed."""
        return self._gate.machine

    @property
    def last_sequence(self) -> int:
        """Return the highest number used so far; −1 if unknown."""
        return self._gate.last_sequence

    @property
    def dropped(self) -> dict[str, int]:
        """Return how many messages were dropped, by code."""
        return self._gate.dropped

    @property
    def step_max_s(self) -> float:
        """Return the longest time between two calls that counts for the movement, s."""
        return self._gate.limits.step_max_s

    def follow(self) -> None:
        """Follow the machine, again after `hold` or `fade`."""
        self._mode = "follow"

    def hold(self) -> None:
        """Freeze the offset at its present value."""
        self._mode = "hold"

    def fade(self, rate_um_per_min: float) -> None:
        """Move the offset to zero, at this rate but never faster than the limit.

        Raises
        ------
        ReceiverError
            Where the rate is not above 0.
        """
        rate = finite(rate_um_per_min)
        if rate is None or rate <= 0.0:
            raise ReceiverError(f"fade rate = {shown(rate_um_per_min)} µm/min: expected a number above 0")
        self._mode, self._fade_rate_um_per_min = "fade", rate

    def snapshot(self) -> dict[str, Any]:
        """Return what must survive a restart."""
        return {"machine": self.machine, "last_sequence": self.last_sequence}

    def _step_s(self, now_s: float) -> float:
        """Return the time since the previous call that counts for the movement, s."""
        elapsed_s = 0.0 if self._advanced_s is None else now_s - self._advanced_s
        self._advanced_s = now_s
        return min(max(elapsed_s, 0.0), self.step_max_s)

    def _state(self, now_s: float) -> tuple[FollowerState, Held[M] | None, list[Reason]]:
        """Return the state, the message to follow (None unless it is followed), and the reasons so far."""
        reasons = self._gate.reasons
        if self.alive is False:
            reasons.append(Reason("service_gone"))
        if self._mode == "fade":
            return "fading", None, reasons
        if self._mode == "hold":
            return "holding", None, [Reason("held_here"), *reasons]
        held = self._gate.held
        if held is None:
            return "starting", None, [Reason("no_message"), *reasons]
        age_s = now_s - held.measured_s
        if age_s > held.valid_s:
            return "holding", None, [Reason("expired", f"{age_s:.0f} s old, valid for {held.valid_s:g} s"), *reasons]
        return "following", held, reasons


def followed_s(now_s: float, held: Held[M]) -> float:
    """Return for how long the published rate has been followed, s."""
    return max(0.0, min(now_s - held.measured_s, RATE_PART * held.valid_s))
