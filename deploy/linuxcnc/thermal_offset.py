#!/usr/bin/python3
# SPDX-License-Identifier: GPL-2.0-or-later
"""HAL component: brings the thermal offset to an axis of LinuxCNC.

    loadusr -Wn thermal-offset [THERMAL]PYTHON ./thermal_offset.py --config thermal.toml

A separate small program, because LinuxCNC's `hal` module is under the GPL. Pins, settings and wiring: README.md.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import hal
import linuxcnc
from reconcile import AxisView, Reconciler

from compensator.receiver import Applied, Receiver, ReceiverError, load_settings
from compensator.receiver.settings import read_table
from compensator.receiver.subscriber import monotonic_s

PERIOD_S = 0.01
STATES = ("starting", "following", "holding", "fading")
#: Unit of [TRAJ]LINEAR_UNITS in µm.
UNITS_UM = {"mm": 1000.0, "metric": 1000.0, "in": 25400.0, "inch": 25400.0, "imperial": 25400.0}


@dataclass(frozen=True)
class AxisSettings:
    """`[axis]`: which axis, and how fast a lost offset is restored."""

    letter: str
    unit_um: float
    slew_um_per_s: float
    fade_um_per_min: float


def main() -> int:
    """Run until `halcmd unload`, SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(description="Brings the thermal offset to an axis of LinuxCNC.")
    parser.add_argument("--config", required=True, metavar="FILE", help="TOML with [receiver] and [axis]")
    parser.add_argument("--name", default="thermal-offset", help="name of the component")
    arguments = parser.parse_args()
    ended: list[int] = []
    signals = (signal.SIGTERM, signal.SIGINT)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)  # whoever starts it may have blocked them
    for number in signals:
        signal.signal(number, lambda *_: ended.append(1))
    try:
        settings, tables = load_settings(arguments.config)
        axis_settings = _axis_settings(tables, arguments.config)
        _check_ini(axis_settings)
        component = hal.component(arguments.name)  # pins can be read from here on
    except (ReceiverError, hal.error) as error:
        report(f"{error}")
        return 1
    try:
        axis = Axis(axis_settings)
        receiver = Receiver(settings, applied_um=axis.found_um())
        make_pins(component)
        reconciler = Reconciler(axis.view().counts, axis_settings.slew_um_per_s)
        component["counts"] = reconciler.counts  # before it can be linked
        component.ready()
        with receiver:
            try:
                run(component, receiver, reconciler, axis, lambda: bool(ended))
            finally:
                # Before Zenoh is left: closing that takes a moment in which HAL would miss the component.
                component.exit()
    except (ReceiverError, RuntimeError, hal.error) as error:  # RuntimeError: a pin that is not there
        report(f"{error}")
        component.exit()
        return 1
    return 0


def make_pins(component: Any) -> None:
    """Make the pins; README.md says what each means."""
    for name in ("enable", "fade"):
        component.newpin(name, hal.HAL_BIT, hal.HAL_IN)
    component.newpin("counts", hal.HAL_S32, hal.HAL_OUT)
    for name in ("offset-um", "applied-um", "age-s", "probe-by-s", "probe-std-um"):
        component.newpin(name, hal.HAL_FLOAT, hal.HAL_OUT)
    for name in ("state", "seq"):
        component.newpin(name, hal.HAL_U32, hal.HAL_OUT)
    for name in ("fresh", "arrived", "alive", "ready", "limited", "trouble", "heartbeat", "probe-wanted"):
        component.newpin(name, hal.HAL_BIT, hal.HAL_OUT)


def run(component: Any, receiver: Receiver, reconciler: Reconciler, axis: Axis, ended: Callable[[], bool]) -> None:
    """Loop: poll the receiver, read the axis, set the counts."""
    reported = ""
    while not ended():
        _set_mode(component, receiver, axis.settings.fade_um_per_min)
        applied = receiver.poll()
        view = axis.view()
        component["counts"] = reconciler.step(monotonic_s(), applied.offset_um, view)
        _show(component, receiver, applied, view, reconciler)
        _show_probe(component, receiver)
        # While the axis cannot move its pins show an old offset.
        receiver.record(view.eoffset_um if view.ready else None)
        words = " ".join(filter(None, (reconciler.trouble.replace("axis.L", axis.name), applied.steady_reasons)))
        line = f"{applied.state}{': ' if words else ''}{words}"
        if line != reported:
            reported = line
            report(line)
        time.sleep(PERIOD_S)


def _set_mode(component: Any, receiver: Receiver, fade_um_per_min: float) -> None:
    if component["fade"]:
        receiver.follower.fade(fade_um_per_min)
    elif component["enable"]:
        receiver.follower.follow()
    else:
        receiver.follower.hold()


def _show(component: Any, receiver: Receiver, applied: Applied, view: AxisView, reconciler: Reconciler) -> None:
    there = view.ready and abs(view.eoffset_um - applied.offset_um) <= view.scale_um
    component["offset-um"] = applied.offset_um
    component["applied-um"] = view.eoffset_um if view.ready else 0.0
    component["age-s"] = -1.0 if applied.age_s is None else applied.age_s
    component["state"] = STATES.index(applied.state)
    component["seq"] = (applied.seq or 0) & 0xFFFFFFFF
    component["fresh"] = applied.state == "following"
    component["arrived"] = applied.arrived and there
    component["alive"] = receiver.follower.alive is True
    component["ready"] = view.ready
    component["limited"] = view.limited
    component["trouble"] = bool(reconciler.trouble)
    component["heartbeat"] = not component["heartbeat"]


def _show_probe(component: Any, receiver: Receiver) -> None:
    probe = receiver.probe_wanted
    component["probe-wanted"] = probe is not None and probe.wanted
    by_ns = None if probe is None else probe.by_utc_ns
    component["probe-by-s"] = -1.0 if by_ns is None else max(0.0, (by_ns - time.time_ns()) / 1e9)
    component["probe-std-um"] = -1.0 if probe is None or probe.std_um is None else probe.std_um


class Axis:
    """The pins of LinuxCNC, read by their own names: a missing wire would read 0 without notice.

    Parameters
    ----------
    settings : AxisSettings
        Letter and unit.
    """

    def __init__(self, settings: AxisSettings) -> None:
        self.settings = settings
        self.name = f"axis.{settings.letter}"

    def view(self) -> AxisView:
        """Read the axis."""
        pin, unit = self.name, self.settings.unit_um
        moves = hal.get_value("motion.teleop-mode") or hal.get_value("motion.coord-mode")
        # In joint mode a change is accepted, and moves the axis at its own speed when the mode is left.
        ready = bool(
            hal.get_value("motion.motion-enabled")
            and hal.get_value("motion.is-all-homed")
            and moves
            and hal.get_value(f"{pin}.eoffset-enable")
            and not hal.get_value(f"{pin}.eoffset-clear")
        )
        return AxisView(
            counts=hal.get_value(f"{pin}.eoffset-counts"),
            scale_um=hal.get_value(f"{pin}.eoffset-scale") * unit,
            request_um=hal.get_value(f"{pin}.eoffset-request") * unit,
            eoffset_um=hal.get_value(f"{pin}.eoffset") * unit,
            ready=ready,
            limited=bool(hal.get_value("motion.eoffset-limited")),
        )

    def found_um(self) -> float:
        """Return the offset that the axis has already; 0 while the machine is off, when its pins show an old one."""
        view = self.view()
        return view.request_um if view.ready else 0.0


def _axis_settings(tables: dict[str, Any], source: str) -> AxisSettings:
    table = tables.pop("axis", None)
    if not isinstance(table, dict):
        raise ReceiverError(f"{source}: axis: missing, expected a table [axis]")
    if tables:
        raise ReceiverError(f"{source}: {next(iter(tables))}: unknown table, expected receiver, axis")
    settings = read_table(AxisSettings, table, source=source, name="axis")
    if settings.letter not in tuple("xyzabcuvw"):
        raise ReceiverError(f"{source}: axis.letter = {settings.letter!r}: expected one of x y z a b c u v w")
    if settings.unit_um not in (1000.0, 25400.0):
        raise ReceiverError(f"{source}: axis.unit_um = {settings.unit_um:g}: expected 1000 (mm) or 25400 (inch)")
    if not 0.0 < settings.slew_um_per_s <= 100.0:
        # A change of mode while the offset moves makes it jump by the motion of two servo periods.
        raise ReceiverError(f"{source}: axis.slew_um_per_s = {settings.slew_um_per_s:g}: expected above 0, at most 100")
    if not settings.fade_um_per_min > 0.0:
        raise ReceiverError(f"{source}: axis.fade_um_per_min = {settings.fade_um_per_min:g}: expected above 0")
    return settings


def _check_ini(settings: AxisSettings) -> None:
    """Refuse settings that LinuxCNC accepts silently and that never let it move."""
    path = os.environ.get("INI_FILE_NAME")
    if not path:
        return
    ini = linuxcnc.ini(path)
    section = f"AXIS_{settings.letter.upper()}"
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


def report(text: str) -> None:
    """Write a line to LinuxCNC's terminal."""
    sys.stderr.write(f"thermal-offset: {text}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
