"""Signs of a jump of T_Q or AT in one sample, and the events that say so."""

from __future__ import annotations

from collections.abc import Mapping

from compensator.arrays import NAN
from compensator.events import EventKind, Implausibility, Note
from compensator.model.engine import Engine
from compensator.model.thermal_model import ThermalModel
from compensator.service.plausibility.guards import TEMPERATURES

#: A value counts as expected within this number of standard deviations.
NEAR = 4.0
#: Heat beyond its range of validity by this part of the range cannot explain a jump of T_Q within the permitted rate.
_BEYOND = 0.2
#: Standard deviations of the innovation that such a jump exceeds in any case.
_JUMP = 6.0

#: Since when, and why, a channel is unconfirmed.
UNSEEN, RESTED, AIR = "after samples without it", "now that it is at rest", "and T_Q does not follow"
BESIDE, LEFT, AS_USED, FITS = (
    "while another channel is in question",
    "after most of its jump is gone",
    "as it did before that jump",
    "too little for measured Y or probes to tell",
)

#: What follows from the jumps of exchanged channels.
EXCHANGED = "to what the other one read: exchanged plugs, wires or addresses; neither is used until they are back"

NAMES = {"t_q_degc": "T_Q", "at_degc": "AT"}


class JumpSigns:
    """Finds channels that differ from what an engine expects, by `least_k` K at least."""

    def __init__(self, model: ThermalModel, least_k: float) -> None:
        self._model = model
        self.least_k = least_k

    def unexpected(self, engine: Engine, offered: Mapping[str, float], seen_again: list[str]) -> list[str]:
        """Return the channels that, seen again, differ from what the engine expects."""
        if not seen_again:
            return []
        with_at, without = engine.forecast(offered["at_degc"]), engine.forecast(NAN)
        # As for a jump that is watched: T_Q follows AT if AT is right, and not if it is wrong. In a direct model T_Q
        # goes its own way, as far as its deviation says.
        least_k = [
            max(self.least_k, _JUMP * expected.t_q_std_k if self._model.ttf is None else 0.0)
            for expected in (with_at, without)
        ]
        found = {
            "t_q_degc": all(
                abs(offered["t_q_degc"] - expected.t_q_k) > least
                for expected, least in zip((with_at, without), least_k, strict=True)
            ),
            "at_degc": abs(offered["at_degc"] - without.at_k) > self.least_k,
        }
        return [name for name in TEMPERATURES if name in seen_again and found[name]]

    def watchable(self, engine: Engine, offered: Mapping[str, float]) -> list[str]:
        """Return the channels that differ from what the engine expects by more than its deviation explains."""
        at_degc, t_q_degc, least_k = offered["at_degc"], offered["t_q_degc"], self.least_k
        # T_Q follows AT if AT is right, and not if it is wrong: only what neither explains is a jump of T_Q.
        with_at, without = engine.forecast(at_degc), engine.forecast(NAN)
        found = []
        if abs(at_degc - without.at_k) > max(least_k, _JUMP * without.at_std_k):
            found.append("at_degc")
        jumps = [t_q_degc - expected.t_q_k for expected in (with_at, without)]
        limits = [max(least_k, _JUMP * expected.t_q_std_k) for expected in (with_at, without)]
        if all(
            abs(k) > most and not is_heat(self._model, engine.drive_for(k))
            for k, most in zip(jumps, limits, strict=True)
        ):
            found.append("t_q_degc")
        return found


def is_heat(model: ThermalModel, heat_w: float) -> bool:
    """Return whether there can be so much heat; a short burst of it looks like a jump for many minutes."""
    if "heat_w" not in model.validity:
        return True
    low, high = model.validity["heat_w"]
    beyond = _BEYOND * (high - low)
    return low - beyond <= heat_w <= high + beyond


def jump_note(name: str, shift_k: float, then: str = "and is not used until its new value is confirmed") -> Note:
    """Return the event that a channel has jumped."""
    return Note(
        EventKind.PLAUSIBILITY,
        f"{NAMES[name]} has jumped by {shift_k:+.2f} K against what was expected, {then}",
        {"code": Implausibility.JUMPED, "channel": name, "shift_k": shift_k},
    )


def accepted_note(name: str, size_k: float, how: str, code: Implausibility = Implausibility.ACCEPTED) -> Note:
    """Return the event that a channel is used again."""
    return Note(
        EventKind.PLAUSIBILITY,
        f"{NAMES[name]} {how}",
        {"code": code, "channel": name, "shift_k": size_k},
    )


def unconfirmed_note(name: str, shift_k: float, when: str) -> Note:
    """Return the event that a channel may have jumped, and that nobody saw whether it has."""
    return Note(
        EventKind.PLAUSIBILITY,
        f"{NAMES[name]} reads {shift_k:+.2f} K other than expected {when}; it is used, but nothing confirms that the "
        "sensor has kept its zero",
        {"code": Implausibility.UNCONFIRMED, "channel": name, "shift_k": shift_k},
    )
