"""An effect that begins and ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim_hardware.physics.effects.base import Action, Array, Places, UndeclaredEffect, overriding
from sim_hardware.physics.plant import Inputs

#: Hooks that do not say when they are called.
_WITHOUT_TIME = ("forced_factor", "growth_um")


@dataclass(frozen=True, slots=True, kw_only=True)
class During(UndeclaredEffect):
    """An effect that acts for a time only.

    Parameters
    ----------
    effect : UndeclaredEffect
        The effect: one that adds heat, or acts at the probe or the thermocouple.
    from_s, to_s : float
        When it begins and ends, s.

    Raises
    ------
    ValueError
        For an effect that changes the design, the film or the joint.
    """

    effect: UndeclaredEffect
    from_s: float
    to_s: float = math.inf

    def __post_init__(self) -> None:
        inner = self.effect.reveal()
        changed = [name for name in _WITHOUT_TIME if overriding([inner.begin()], name)]
        if type(inner).alter is not UndeclaredEffect.alter:
            changed.append("alter")
        if changed:
            raise ValueError(f"{inner!r} changes {changed[0]}, which has no beginning and no end")

    @property
    def thermal(self) -> bool:  # type: ignore[override]
        """Whether it needs a machine of masses."""
        return self.effect.reveal().thermal

    def begin(self) -> Action:
        """Return the acting effect."""
        return _During(self.effect.begin(), self.from_s, self.to_s)

    def describe(self) -> dict[str, object]:
        """Return kind, path, channel and parameters of the effect, and when it acts."""
        return {**self.effect.describe(), "from_s": self.from_s, "to_s": self.to_s}


class _During(Action):
    """Passes the hooks on while the effect acts."""

    def __init__(self, acting: Action, from_s: float, to_s: float) -> None:
        self._acting, self._from_s, self._to_s = acting, from_s, to_s

    def _acts(self, t_s: float) -> bool:
        return self._from_s <= t_s < self._to_s

    def add_heat(self, heat_w: Array, t_s: float, inputs: Inputs, degc: Array, places: Places) -> None:
        if self._acts(t_s):
            self._acting.add_heat(heat_w, t_s, inputs, degc, places)

    def probe_um(self, t_s: float, y_um: float) -> float:
        return self._acting.probe_um(t_s, y_um) if self._acts(t_s) else y_um

    def t_q_degc(self, t_s: float, t_q_degc: float) -> float:
        # Called once a step, in order: a lag that acts later starts from what it is given first.
        return self._acting.t_q_degc(t_s, t_q_degc) if self._acts(t_s) else t_q_degc
