# SPDX-License-Identifier: GPL-2.0-or-later
"""One axis of LinuxCNC and its settings, for `thermal_offset.py`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import hal
import linuxcnc
from reconcile import AxisView, Reconciler

from compensator.receiver import Applied, AxesSettings, ReceiverError
from compensator.receiver.settings import read_table

STATES = ("starting", "following", "holding", "fading")
#: Unit of [TRAJ]LINEAR_UNITS in µm.
UNITS_UM = {"mm": 1000.0, "metric": 1000.0, "in": 25400.0, "inch": 25400.0, "imperial": 25400.0}


@dataclass(frozen=True, kw_only=True)
class Common:
    """`[axis]` for several axes: what is the same for all of them."""

    unit_um: float
    slew_um_per_s: float
    fade_um_per_min: float


@dataclass(frozen=True, kw_only=True)
class One(Common):
    """`[axis]` for one axis: which one, and how fast a lost offset is restored."""

    letter: str


@dataclass(frozen=True, kw_only=True)
class Pins:
    """`[pins]`: where LinuxCNC shows what tilt and slope need, in its unit and in machine coordinates."""

    x_position: str = "axis.x.pos-cmd"
    y_position: str = "axis.y.pos-cmd"
    z_position: str = "axis.z.pos-cmd"
    tool_length: str = "motion.tooloffset.z"
    spindle_on: str = "spindle.0.on"


def one_axis(tables: dict[str, Any], source: str) -> One:
    """Check the tables beside `[receiver]` of one axis."""
    settings = read_table(One, _axis_table(tables, source), source=source, name="axis")
    if tables:
        raise ReceiverError(f"{source}: {next(iter(tables))}: unknown table, expected receiver, axis")
    if settings.letter not in tuple("xyzabcuvw"):
        raise ReceiverError(f"{source}: axis.letter = {settings.letter!r}: expected one of x y z a b c u v w")
    _check(settings, [settings.letter], source)
    return settings


def several_axes(settings: AxesSettings, tables: dict[str, Any], source: str) -> tuple[Common, Pins]:
    """Check the tables beside `[receiver]`, `[axis.x]` and `[tool]` of several axes."""
    common = read_table(Common, _axis_table(tables, source), source=source, name="axis")
    named = tables.pop("pins", {})
    if not isinstance(named, dict):
        raise ReceiverError(f"{source}: pins = {named!r:.60}: expected a table [pins]")
    pins = read_table(Pins, named, source=source, name="pins")
    if tables:
        raise ReceiverError(f"{source}: {next(iter(tables))}: unknown table, expected receiver, axis, tool, pins")
    for axis, limits in settings.linear.items():
        fastest = limits.slope_max_um_per_m * limits.position_speed_max_mm_per_s / 1000.0
        if fastest > common.slew_um_per_s:
            raise ReceiverError(
                f"{source}: axis.slew_um_per_s = {common.slew_um_per_s:g}: expected at least {fastest:g}, which the "
                f"slope of {axis} asks for at its fastest motion"
            )
    _check(common, list(settings.linear), source)
    return common, pins


def _axis_table(tables: dict[str, Any], source: str) -> dict[str, Any]:
    table = tables.pop("axis", None)
    if not isinstance(table, dict):
        raise ReceiverError(f"{source}: axis: missing, expected a table [axis]")
    return table


def _check(settings: Common, letters: list[str], source: str) -> None:
    if settings.unit_um not in (1000.0, 25400.0):
        raise ReceiverError(f"{source}: axis.unit_um = {settings.unit_um:g}: expected 1000 (mm) or 25400 (inch)")
    if not 0.0 < settings.slew_um_per_s <= 100.0:
        # A change of mode while the offset moves makes it jump by the motion of two servo periods.
        raise ReceiverError(f"{source}: axis.slew_um_per_s = {settings.slew_um_per_s:g}: expected above 0, at most 100")
    if not settings.fade_um_per_min > 0.0:
        raise ReceiverError(f"{source}: axis.fade_um_per_min = {settings.fade_um_per_min:g}: expected above 0")
    for letter in letters:
        _check_ini(settings, letter)


def _check_ini(settings: Common, letter: str) -> None:
    """Refuse settings that LinuxCNC accepts silently and that never let it move."""
    path = os.environ.get("INI_FILE_NAME")
    if not path:
        return
    ini = linuxcnc.ini(path)
    section = f"AXIS_{letter.upper()}"
    text = ini.find(section, "OFFSET_AV_RATIO") or "0"
    try:
        ratio = float(text)
    except ValueError:
        ratio = float("nan")
    if not 0.0 < ratio <= 0.9:
        raise ReceiverError(f"{path}: [{section}]OFFSET_AV_RATIO = {text}: expected above 0, at most 0.9, such as 0.01")
    units = (ini.find("TRAJ", "LINEAR_UNITS") or "").lower()
    if UNITS_UM.get(units, settings.unit_um) != settings.unit_um:
        raise ReceiverError(
            f"{path}: [TRAJ]LINEAR_UNITS = {units}: axis.unit_um = {settings.unit_um:g} is another unit"
        )


class Axis:
    """The pins of LinuxCNC, read by their own names: a missing wire would read 0 without notice.

    Parameters
    ----------
    letter : str
        Of the axis.
    unit_um : float
        LinuxCNC's unit of length, µm.
    """

    def __init__(self, letter: str, unit_um: float) -> None:
        self.name = f"axis.{letter}"
        self._unit_um = unit_um

    def view(self) -> AxisView:
        """Read the axis."""
        pin, unit = self.name, self._unit_um
        moves = hal.get_value("motion.teleop-mode") or hal.get_value("motion.coord-mode")
        acts = bool(
            hal.get_value("motion.motion-enabled")
            and hal.get_value("motion.is-all-homed")
            and not hal.get_value(f"{pin}.eoffset-clear")
        )
        return AxisView(
            counts=hal.get_value(f"{pin}.eoffset-counts"),
            scale_um=hal.get_value(f"{pin}.eoffset-scale") * unit,
            request_um=hal.get_value(f"{pin}.eoffset-request") * unit,
            eoffset_um=hal.get_value(f"{pin}.eoffset") * unit,
            acts=acts,
            # In joint mode a change is accepted, and moves the axis at its own speed when the mode is left.
            ready=bool(acts and moves and hal.get_value(f"{pin}.eoffset-enable")),
            limited=bool(hal.get_value("motion.eoffset-limited")),
        )

    def found_um(self) -> float:
        """Return the offset that the axis has already."""
        view = self.view()
        return view.request_um if view.acts else 0.0


class Output:
    """Brings the offset to an axis, and shows it.

    Parameters
    ----------
    component : hal.component
        Gets the pins.
    axis : Axis
        The axis.
    slew_um_per_s : float
        How fast an offset that LinuxCNC has lost is restored.
    prefix : str
        Of the pins; empty where there is one axis alone.
    """

    def __init__(self, component: Any, axis: Axis, slew_um_per_s: float, prefix: str = "") -> None:
        self._component, self._axis, self._prefix = component, axis, prefix
        self._reconciler = Reconciler(axis.view().counts, slew_um_per_s)
        self.view = axis.view()
        self.arrived = False
        component.newpin(f"{prefix}counts", hal.HAL_S32, hal.HAL_OUT)
        for name in ("offset-um", "applied-um"):
            component.newpin(prefix + name, hal.HAL_FLOAT, hal.HAL_OUT)
        if prefix:
            component.newpin(f"{prefix}state", hal.HAL_U32, hal.HAL_OUT)
            for name in ("arrived", "trouble"):
                component.newpin(prefix + name, hal.HAL_BIT, hal.HAL_OUT)
        component[f"{prefix}counts"] = self._reconciler.counts  # before it can be linked

    @property
    def trouble(self) -> str:
        """Return why the offset does not reach the axis, in words; empty where it does."""
        return self._reconciler.trouble.replace("axis.L", self._axis.name)

    def step(self, now_s: float, applied: Applied) -> None:
        """Read the axis, set the counts, and show both."""
        self.view = view = self._axis.view()
        component, prefix = self._component, self._prefix
        component[f"{prefix}counts"] = self._reconciler.step(now_s, applied.offset_um, view)
        there = view.ready and abs(view.eoffset_um - applied.offset_um) <= view.scale_um
        self.arrived = applied.arrived and there
        component[f"{prefix}offset-um"] = applied.offset_um
        component[f"{prefix}applied-um"] = view.eoffset_um if view.acts else 0.0
        if prefix:
            component[f"{prefix}state"] = STATES.index(applied.state)
            component[f"{prefix}arrived"] = self.arrived
            component[f"{prefix}trouble"] = bool(self.trouble)

    @property
    def applied_um(self) -> float | None:
        """Return what the axis has; None while it cannot move, when its pins show an old offset."""
        return self.view.eoffset_um if self.view.ready else None
