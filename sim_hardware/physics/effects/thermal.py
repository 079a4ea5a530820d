"""Undeclared effects that are heat: sources, sinks, films, gaps and masses that the calibration never saw."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import ClassVar

from sim_hardware.physics.design import QuillDesign
from sim_hardware.physics.effects.base import Array, Places, UndeclaredEffect
from sim_hardware.physics.plant import MAX_FAN_RPM, MAX_SPINDLE_RPM, Inputs


def _spread(heat_w: Array, nodes: tuple[int, ...] | list[int], watts: float) -> None:
    """Share heat evenly between nodes."""
    for node in nodes:
        heat_w[node] += watts / len(nodes)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoolantJacket(UndeclaredEffect):
    """Coolant flows through a jacket and pulls a place towards its own temperature.

    Parameters
    ----------
    w_per_k : float
        Conductance from the coolant to the place, W/K.
    place : str
        ``"jacket"`` (of the housing), ``"quill"`` (all of it), ``"front"`` (of the column) …
    """

    kind: ClassVar[str] = "input"
    channel: ClassVar[str | None] = "coolant_degc"
    thermal: ClassVar[bool] = True
    w_per_k: float
    place: str = "jacket"

    def add_heat(self, heat_w: Array, t_s: float, inputs: Inputs, degc: Array, places: Places) -> None:
        """Add the coolant's heat, W."""
        nodes = places[self.place]
        for node in nodes:
            heat_w[node] += self.w_per_k / len(nodes) * (inputs.coolant_degc - degc[node])


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingFriction(UndeclaredEffect):
    """The spindle's bearing heats the nose, far from T_Q.

    Parameters
    ----------
    full_speed_w : float
        Heat at 8000 rpm, W.
    exponent : float
        1: of a preloaded bearing; 2: of viscous grease.
    """

    kind: ClassVar[str] = "input"
    channel: ClassVar[str | None] = "spindle_rpm"
    thermal: ClassVar[bool] = True
    full_speed_w: float
    exponent: float = 2.0

    def add_heat(self, heat_w: Array, t_s: float, inputs: Inputs, degc: Array, places: Places) -> None:
        """Add the friction's heat, W."""
        share = abs(inputs.spindle_rpm) / MAX_SPINDLE_RPM
        _spread(heat_w, list(places["nose"]), self.full_speed_w * share**self.exponent)


@dataclass(frozen=True, slots=True, kw_only=True)
class FanMotor(UndeclaredEffect):
    """The fan's motor heats the wall that it is mounted on.

    Parameters
    ----------
    full_speed_w : float
        Heat at 3000 rpm, W; it grows with the square of the speed.
    place : str
        ``"front"`` or ``"rear"`` wall of the column.
    """

    kind: ClassVar[str] = "input"
    channel: ClassVar[str | None] = "fan_rpm"
    thermal: ClassVar[bool] = True
    full_speed_w: float
    place: str = "front"

    def add_heat(self, heat_w: Array, t_s: float, inputs: Inputs, degc: Array, places: Places) -> None:
        """Add the motor's heat, W."""
        _spread(heat_w, list(places[self.place]), self.full_speed_w * (abs(inputs.fan_rpm) / MAX_FAN_RPM) ** 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class FanOnFilm(UndeclaredEffect):
    """A fan moves the air: the forced coefficient of every surface grows with its speed.

    Parameters
    ----------
    full_speed_factor : float
        Factor on the forced coefficient at 3000 rpm, at least 1. Between, by the 0.8th power of the speed, as
        in turbulent flow along a plate.
    """

    kind: ClassVar[str] = "scheduled"
    path: ClassVar[str] = "DTF"
    channel: ClassVar[str | None] = "fan_rpm"
    thermal: ClassVar[bool] = True
    full_speed_factor: float

    def forced_factor(self, inputs: Inputs) -> float:
        """Return the factor on the forced film coefficient."""
        share = abs(inputs.fan_rpm) / MAX_FAN_RPM
        return 1.0 + (self.full_speed_factor - 1.0) * float(share**0.8)


@dataclass(frozen=True, slots=True, kw_only=True)
class WetGuide(UndeclaredEffect):
    """Flowing coolant wets the gap between quill and headstock and bridges it: the heat leaves by another path.

    Parameters
    ----------
    w_per_k : float
        Further conductance of the whole gap while coolant flows, W/K.
    threshold_lpm : float
        Flow above which the gap is wet, l/min.
    """

    kind: ClassVar[str] = "scheduled"
    path: ClassVar[str] = "DTF"
    channel: ClassVar[str | None] = "coolant_flow_lpm"
    thermal: ClassVar[bool] = True
    w_per_k: float
    threshold_lpm: float = 0.5

    def add_heat(self, heat_w: Array, t_s: float, inputs: Inputs, degc: Array, places: Places) -> None:
        """Move heat from the guided nodes to the housing, W."""
        if inputs.coolant_flow_lpm <= self.threshold_lpm:
            return
        nodes, (housing,) = places["guided"], places["housing"]
        for node in nodes:
            crossing_w = self.w_per_k / len(nodes) * (degc[node] - degc[housing])
            heat_w[node] -= crossing_w
            heat_w[housing] += crossing_w


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondMass(UndeclaredEffect):
    """A further mass on the housing warms slowly and moves the tool: a mode that the model lacks.

    Parameters
    ----------
    j_per_k : float
        Its heat capacity, J/K.
    w_per_k : float
        Its contact to the housing, W/K.
    lever_m : float
        Length of steel that moves the tool centre point as much; positive towards +Y.
    """

    kind: ClassVar[str] = "dynamics"
    path: ClassVar[str] = "DTF"
    thermal: ClassVar[bool] = True
    j_per_k: float
    w_per_k: float
    lever_m: float

    def alter(self, design: QuillDesign) -> QuillDesign:
        """Return the design with the mass."""
        return replace(
            design, second_j_per_k=self.j_per_k, second_link_w_per_k=self.w_per_k, second_lever_m=self.lever_m
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenSource(UndeclaredEffect):
    """Something heats a place by a schedule of its own, and no channel shows it.

    Parameters
    ----------
    heat_w : float
        Heat while it is on, W.
    switch_s : tuple of float
        Times at which it is switched on, off, on …, s.
    place : str
        Where it sits: ``"nose"``, ``"housing"``, ``"front"``, ``"rear"``, ``"base"``.
    """

    kind: ClassVar[str] = "unobserved"
    thermal: ClassVar[bool] = True
    heat_w: float
    switch_s: tuple[float, ...]
    place: str = "housing"

    def add_heat(self, heat_w: Array, t_s: float, inputs: Inputs, degc: Array, places: Places) -> None:
        """Add the source's heat, W."""
        if bisect_right(self.switch_s, t_s) % 2 == 1:
            _spread(heat_w, list(places[self.place]), self.heat_w)
