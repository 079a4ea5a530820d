"""Undeclared effects after the heat: lengths, joints, mounts, and a late thermocouple."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import ClassVar

from sim_hardware.physics.design import QuillDesign
from sim_hardware.physics.effects.base import Action, UndeclaredEffect


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongStrength(UndeclaredEffect):
    """The quill expands more or less than during the calibration.

    Parameters
    ----------
    factor : float
        On the quill's coefficient of expansion, 1.
    """

    kind: ClassVar[str] = "gain"
    path: ClassVar[str] = "DTF"
    thermal: ClassVar[bool] = True
    factor: float

    def alter(self, design: QuillDesign) -> QuillDesign:
        """Return the design with the other expansion."""
        return replace(design, growth_factor=design.growth_factor * self.factor)


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeDependent(UndeclaredEffect):
    r"""A stop yields as the quill pushes: the strength depends on the size, :math:`g (1 + b g)`.

    Parameters
    ----------
    per_100_um : float
        Change of strength for every 100 µm of growth, 1.
    """

    kind: ClassVar[str] = "nonlinear"
    path: ClassVar[str] = "DTF"
    per_100_um: float

    def growth_um(self, growth_um: float) -> float:
        """Return the part of the quill's growth that arrives at its nose, µm."""
        return growth_um * (1.0 + self.per_100_um * growth_um / 100.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class StickSlip(UndeclaredEffect):
    """A joint with play: the nose follows the growth only once the play is taken up.

    Parameters
    ----------
    play_um : float
        Whole width of the play, µm; the joint starts in its middle.
    """

    kind: ClassVar[str] = "hysteresis"
    path: ClassVar[str] = "DTF"
    play_um: float

    def begin(self) -> Action:
        """Return the joint in the middle of its play."""
        return _Play(self.play_um / 2.0)


class _Play(Action):
    """The play operator, with its position as state."""

    def __init__(self, half_um: float) -> None:
        self._half_um = half_um
        self._at_um = 0.0

    def growth_um(self, growth_um: float) -> float:
        self._at_um = min(max(self._at_um, growth_um - self._half_um), growth_um + self._half_um)
        return self._at_um


@dataclass(frozen=True, slots=True, kw_only=True)
class LateSensor(UndeclaredEffect):
    """Heat reaches the thermocouple T_Q late, through a bracket or a pad.

    Parameters
    ----------
    delay_s : float
        Dead time, s.
    lag_s : float
        Time constant of the thermocouple in its pad, s.
    """

    kind: ClassVar[str] = "delay"
    path: ClassVar[str] = "TTF"
    delay_s: float
    lag_s: float = 0.0

    def begin(self) -> Action:
        """Return the pad in its initial state."""
        return _LatePad(self.delay_s, self.lag_s)


class _LatePad(Action):
    """State of the late thermocouple: delayed temperatures, and its own temperature."""

    def __init__(self, delay_s: float, lag_s: float) -> None:
        self._delay_s, self._lag_s = delay_s, lag_s
        self._way: deque[tuple[float, float]] = deque()
        self._last_s = math.nan
        self._couple = math.nan

    def t_q_degc(self, t_s: float, t_q_degc: float) -> float:
        way = self._way
        way.append((t_s, t_q_degc))
        due_s = t_s - self._delay_s
        while len(way) > 1 and way[1][0] <= due_s:
            way.popleft()
        arrived = way[0][1]
        if len(way) > 1 and way[0][0] <= due_s:
            (t0, v0), (t1, v1) = way[0], way[1]
            arrived = v0 + (v1 - v0) * (due_s - t0) / (t1 - t0)
        if math.isnan(self._couple) or self._lag_s <= 0.0:
            self._couple = arrived
        else:
            keep = math.exp(-(t_s - self._last_s) / self._lag_s)
            self._couple = arrived + keep * (self._couple - arrived)
        self._last_s = t_s
        return self._couple


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeDrift(UndeclaredEffect):
    """The probe's mount creeps: a ramp on the measured displacement, no error of the machine.

    Parameters
    ----------
    um_per_h : float
        Speed, µm/h.
    """

    kind: ClassVar[str] = "drift"
    um_per_h: float

    def probe_um(self, t_s: float, y_um: float) -> float:
        """Return the displacement added at the probe, µm."""
        return y_um + self.um_per_h * t_s / 3600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MountSlip(UndeclaredEffect):
    """Something was knocked: the displacement jumps at a time and stays.

    Parameters
    ----------
    at_s : float
        When, s.
    jump_um : float
        How far, µm.
    """

    kind: ClassVar[str] = "step"
    at_s: float
    jump_um: float

    def probe_um(self, t_s: float, y_um: float) -> float:
        """Return the displacement added at the probe, µm."""
        return y_um + (self.jump_um if t_s >= self.at_s else 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle(UndeclaredEffect):
    """A period that no channel shows: an air conditioner, central lubrication.

    Parameters
    ----------
    amplitude_um : float
        Half of the swing, µm.
    period_s : float
        Period, s.
    phase_rad : float
        Of the sine at the start, rad.
    """

    kind: ClassVar[str] = "periodic"
    amplitude_um: float
    period_s: float
    phase_rad: float = 0.0

    def probe_um(self, t_s: float, y_um: float) -> float:
        """Return the displacement added at the probe, µm."""
        return y_um + self.amplitude_um * math.sin(2.0 * math.pi * t_s / self.period_s + self.phase_rad)
