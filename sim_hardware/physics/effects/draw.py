"""Draw an effect by a seed, and keep it secret until asked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim_hardware.physics.design import QuillDesign
from sim_hardware.physics.effects.base import Action, UndeclaredEffect
from sim_hardware.physics.effects.mechanical import (
    Cycle,
    LateSensor,
    MountSlip,
    ProbeDrift,
    SizeDependent,
    StickSlip,
    WrongStrength,
)
from sim_hardware.physics.effects.thermal import (
    BearingFriction,
    CoolantJacket,
    FanOnFilm,
    HiddenSource,
    SecondMass,
    WetGuide,
)

HOUR_S = 3600.0


class SealedEffect(UndeclaredEffect):
    """An effect whose kind is secret until :meth:`reveal`.

    Parameters
    ----------
    effect : UndeclaredEffect
        What is inside.
    """

    def __init__(self, effect: UndeclaredEffect) -> None:
        self.__effect = effect

    def __repr__(self) -> str:
        return "SealedEffect(…)"

    def alter(self, design: QuillDesign) -> QuillDesign:
        """Return the design with the permanent changes of the effect."""
        return self.__effect.alter(design)

    def begin(self) -> Action:
        """Return the acting effect."""
        return self.__effect.begin()

    def reveal(self) -> UndeclaredEffect:
        """Return the effect."""
        return self.__effect

    def describe(self) -> dict[str, object]:
        """Refuse: a sealed effect does not describe itself.

        Raises
        ------
        TypeError
            Always.
        """
        raise TypeError("sealed: call reveal() first")


class _Draw:
    """One draw: random generator, size in µm and length of the record in h."""

    def __init__(self, random: np.random.Generator, size_um: float, hours: float) -> None:
        self.random = random
        self.size_um = size_um * float(random.uniform(0.75, 1.3))
        self.hours = hours
        self.sign = float(random.choice([-1.0, 1.0]))

    def jacket(self) -> UndeclaredEffect:
        place = str(self.random.choice(["jacket", "quill", "front"]))
        um_per_w_per_k = {"jacket": 0.46, "quill": 2.1, "front": 0.6}[place]
        return CoolantJacket(w_per_k=self.size_um / um_per_w_per_k, place=place)

    def bearing(self) -> UndeclaredEffect:
        exponent = float(self.random.choice([1.0, 2.0]))
        return BearingFriction(full_speed_w=self.size_um / 0.83, exponent=exponent)

    def fan(self) -> UndeclaredEffect:
        return FanOnFilm(full_speed_factor=1.0 + self.size_um / 7.0)

    def guide(self) -> UndeclaredEffect:
        return WetGuide(w_per_k=self.size_um / 1.3)

    def second(self) -> UndeclaredEffect:
        j_per_k, w_per_k = self.random.uniform(20e3, 60e3), self.random.uniform(2.0, 6.0)
        return SecondMass(j_per_k=j_per_k, w_per_k=w_per_k, lever_m=self.sign * self.size_um / 9.5)

    def strength(self) -> UndeclaredEffect:
        return WrongStrength(factor=1.0 + self.sign * self.size_um / 43.0)

    def nonlinear(self) -> UndeclaredEffect:
        return SizeDependent(per_100_um=self.sign * self.size_um / 68.0)

    def play(self) -> UndeclaredEffect:
        return StickSlip(play_um=self.size_um / 0.47)

    def late_sensor(self) -> UndeclaredEffect:
        late_s = min(max(60.0 * self.size_um, 20.0), 900.0)
        share = self.random.uniform(0.3, 1.0)
        return LateSensor(delay_s=late_s * share, lag_s=late_s * (1.0 - share))

    def drift(self) -> UndeclaredEffect:
        return ProbeDrift(um_per_h=self.sign * self.size_um * 12.0**0.5 / self.hours)

    def slip(self) -> UndeclaredEffect:
        at_s = HOUR_S * self.hours * self.random.uniform(0.25, 0.75)
        return MountSlip(at_s=at_s, jump_um=self.sign * 2.0 * self.size_um)

    def cycle(self) -> UndeclaredEffect:
        period_s, phase = self.random.uniform(900.0, 7200.0), self.random.uniform(0.0, 6.28)
        return Cycle(amplitude_um=self.size_um * 2.0**0.5, period_s=period_s, phase_rad=phase)

    def unobserved(self) -> UndeclaredEffect:
        place = str(self.random.choice(["nose", "housing", "front"]))
        um_per_w = {"nose": 1.3, "housing": 0.2, "front": 0.42}[place]
        switch_s, t_s = [], 0.0
        while t_s < self.hours * HOUR_S:
            t_s += HOUR_S * self.random.uniform(1.0, 4.0)
            switch_s.append(t_s)
        return HiddenSource(heat_w=self.size_um / um_per_w, switch_s=tuple(switch_s), place=place)


_DRAWS: tuple[Callable[[_Draw], UndeclaredEffect], ...] = (
    _Draw.jacket,
    _Draw.bearing,
    _Draw.fan,
    _Draw.guide,
    _Draw.second,
    _Draw.strength,
    _Draw.nonlinear,
    _Draw.play,
    _Draw.late_sensor,
    _Draw.drift,
    _Draw.slip,
    _Draw.cycle,
    _Draw.unobserved,
)


def draw_effect(seed: int, size: float = 5.0, hours: float = 24.0) -> SealedEffect:
    """Draw an effect for a :class:`QuillMachine`, its kind unknown to the caller.

    Parameters
    ----------
    seed : int
        Same seed, same effect; seeds that differ by a multiple of 13 give the same kind with other
        parameters.
    size : float
        About how much the effect moves y on a working day, µm standard deviation (within a factor of 2 or
        so). A late sensor does not move y: there it is the error of a model that believes T_Q.
    hours : float
        Length of the record that the effect shall show in.

    Raises
    ------
    ValueError
        If `size` or `hours` is not positive.

    Examples
    --------
    >>> draw_effect(3)
    SealedEffect(…)
    >>> draw_effect(3).reveal() == draw_effect(3).reveal()
    True
    """
    if not size > 0.0 or not hours > 0.0:
        raise ValueError(f"size {size} µm, hours {hours}: must be positive")
    # Mixed so that neighbouring seeds do not draw neighbouring kinds.
    kind = _DRAWS[(seed * 5 + 2) % len(_DRAWS)]
    return SealedEffect(kind(_Draw(np.random.default_rng([abs(seed), 13]), size, hours)))
