#!/usr/bin/python3
# SPDX-License-Identifier: GPL-2.0-or-later
"""HAL component: brings the thermal offset to one axis of LinuxCNC, or to several.

    loadusr -Wn thermal-offset [THERMAL]PYTHON ./thermal_offset.py --config thermal.toml

A separate small program, because LinuxCNC's `hal` module is under the GPL. Pins, settings and wiring: README.md.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import hal
from thermal_axis import STATES, Axis, Common, One, Output, Pins, one_axis, several_axes

from compensator.receiver import (
    Applied,
    AppliedAxes,
    AxesReceiver,
    AxesSettings,
    ControlState,
    Receiver,
    ReceiverError,
    Settings,
    load_any,
)
from compensator.receiver.client import monotonic_s

PERIOD_S = 0.01


def main() -> int:
    """Run until `halcmd unload`, SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(description="Brings the thermal offset to one axis of LinuxCNC, or to several.")
    parser.add_argument("--config", required=True, metavar="FILE", help="TOML with [receiver] and [axis]")
    parser.add_argument("--name", default="thermal-offset", help="name of the component")
    arguments = parser.parse_args()
    ended: list[int] = []
    signals = (signal.SIGTERM, signal.SIGINT)
    for number in signals:
        signal.signal(number, lambda *_: ended.append(1))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)  # whoever starts it may have blocked them
    try:
        settings, tables = load_any(arguments.config)
        make: Callable[[Any], Machine]
        if isinstance(settings, AxesSettings):
            common, pins = several_axes(settings, tables, arguments.config)
            make = lambda component: Several(component, settings, common, pins)  # noqa: E731
        else:
            one = one_axis(tables, arguments.config)
            make = lambda component: Alone(component, settings, one)  # noqa: E731
        component = hal.component(arguments.name)  # pins can be read from here on
    except (ReceiverError, hal.error) as error:
        report(f"{error}")
        return 1
    try:
        machine = make(component)
        make_pins(component)
        component.ready()
        with machine.receiver:
            try:
                run(component, machine, lambda: bool(ended))
            finally:
                # Before Zenoh is left: closing that takes a moment in which HAL would miss the component.
                component.exit()
    except (ReceiverError, RuntimeError, hal.error) as error:  # RuntimeError: a pin that is not there
        report(f"{error}")
        component.exit()
        return 1
    return 0


class Machine(ABC):
    """A receiver with the axes that it moves."""

    receiver: Receiver | AxesReceiver
    outputs: list[Output]
    fade_um_per_min: float

    @abstractmethod
    def step(self) -> Applied | AppliedAxes:
        """Poll the receiver, and bring its offsets to the axes."""


class Alone(Machine):
    """One axis."""

    def __init__(self, component: Any, settings: Settings, one: One) -> None:
        axis = Axis(one.letter, one.unit_um)
        self.receiver: Receiver = Receiver(settings, applied_um=axis.found_um())
        self.outputs = [Output(component, axis, one.slew_um_per_s)]
        self.fade_um_per_min = one.fade_um_per_min

    def step(self) -> Applied:
        """Poll the receiver, and bring its offset to the axis."""
        applied = self.receiver.poll()
        self.outputs[0].step(monotonic_s(), applied)
        self.receiver.record(self.outputs[0].applied_um)
        return applied


class Several(Machine):
    """Several axes, with the length of the tool and the positions that LinuxCNC shows."""

    def __init__(self, component: Any, settings: AxesSettings, common: Common, pins: Pins) -> None:
        axes = {letter: Axis(letter, common.unit_um) for letter in settings.linear}
        found_um = {letter: axis.found_um() for letter, axis in axes.items()}
        self.receiver: AxesReceiver = AxesReceiver(settings, applied_um=found_um)
        self.outputs = [Output(component, axis, common.slew_um_per_s, f"{letter}.") for letter, axis in axes.items()]
        self.fade_um_per_min = common.fade_um_per_min
        self._letters = list(axes)
        self._unit_mm = common.unit_um / 1000.0
        self._tilts = settings.has_tilt
        self._length_here = settings.tool is not None and settings.tool.length_from == "control"
        self._pins = pins
        places = {"x": pins.x_position, "y": pins.y_position, "z": pins.z_position}
        self._places = {letter: places[letter] for letter, limits in settings.linear.items() if limits.has_slope}
        self._read()  # a pin that is not there ends the start

    def step(self) -> AppliedAxes:
        """Poll the receiver, and bring its offsets to the axes."""
        applied = self.receiver.poll(self._read())
        now_s = monotonic_s()
        for letter, output in zip(self._letters, self.outputs, strict=True):
            output.step(now_s, applied.axes[letter])
        self.receiver.record(
            {letter: output.applied_um for letter, output in zip(self._letters, self.outputs, strict=True)}
        )
        return applied

    def _read(self) -> ControlState:
        """Read LinuxCNC's pins by their own names."""
        return ControlState(
            # LinuxCNC shows 0 while no length is in effect (G49), which is shorter than any tool.
            tool_length_mm=hal.get_value(self._pins.tool_length) * self._unit_mm if self._length_here else None,
            positions_mm={letter: hal.get_value(pin) * self._unit_mm for letter, pin in self._places.items()},
            cutting=bool(hal.get_value(self._pins.spindle_on)) if self._tilts else True,
        )


def make_pins(component: Any) -> None:
    """Make the pins that all axes have in common; README.md says what each means."""
    for name in ("enable", "fade"):
        component.newpin(name, hal.HAL_BIT, hal.HAL_IN)
    for name in ("age-s", "probe-by-s", "probe-std-um"):
        component.newpin(name, hal.HAL_FLOAT, hal.HAL_OUT)
    for name in ("state", "seq"):
        component.newpin(name, hal.HAL_U32, hal.HAL_OUT)
    for name in ("fresh", "arrived", "alive", "ready", "limited", "trouble", "heartbeat", "probe-wanted"):
        component.newpin(name, hal.HAL_BIT, hal.HAL_OUT)


def run(component: Any, machine: Machine, ended: Callable[[], bool]) -> None:
    """Loop: poll the receiver, read the axes, set the counts."""
    reported = ""
    while not ended():
        _set_mode(component, machine)
        applied = machine.step()
        _show(component, machine, applied)
        _show_probe(component, machine)
        words = " ".join(filter(None, (*(output.trouble for output in machine.outputs), applied.steady_reasons)))
        line = f"{applied.state}{': ' if words else ''}{words}"
        if line != reported:
            reported = line
            report(line)
        time.sleep(PERIOD_S)


def _set_mode(component: Any, machine: Machine) -> None:
    follower = machine.receiver.follower
    if component["fade"]:
        follower.fade(machine.fade_um_per_min)
    elif component["enable"]:
        follower.follow()
    else:
        follower.hold()


def _show(component: Any, machine: Machine, applied: Applied | AppliedAxes) -> None:
    outputs = machine.outputs
    component["age-s"] = -1.0 if applied.age_s is None else applied.age_s
    component["state"] = STATES.index(applied.state)
    component["seq"] = (applied.seq or 0) & 0xFFFFFFFF
    component["fresh"] = applied.state == "following"
    component["arrived"] = all(output.arrived for output in outputs)
    component["alive"] = machine.receiver.follower.alive is True
    component["ready"] = all(output.view.ready for output in outputs)
    component["limited"] = any(output.view.limited for output in outputs)
    component["trouble"] = any(output.trouble for output in outputs)
    component["heartbeat"] = not component["heartbeat"]


def _show_probe(component: Any, machine: Machine) -> None:
    probe = machine.receiver.probe_wanted
    component["probe-wanted"] = probe is not None and probe.wanted
    by_ns = None if probe is None else probe.by_utc_ns
    component["probe-by-s"] = -1.0 if by_ns is None else max(0.0, (by_ns - time.time_ns()) / 1e9)
    component["probe-std-um"] = -1.0 if probe is None or probe.std_um is None else probe.std_um


def report(text: str) -> None:
    """Write a line to LinuxCNC's terminal, if it can be written: nothing here may end the loop that moves the axes."""
    if sys.stderr is None:  # closed before the start
        return
    with contextlib.suppress(OSError):  # a terminal that was closed, a pipe without a reader, a full disk
        sys.stderr.write(f"thermal-offset: {text}\n")
        sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
