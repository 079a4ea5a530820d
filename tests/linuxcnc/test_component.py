"""The HAL component without LinuxCNC: its lines for a terminal, and the offset that it shows."""

from __future__ import annotations

import importlib
import io
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from compensator.receiver import Applied

FOLDER = Path(__file__).resolve().parents[2] / "deploy/linuxcnc"
MODULES = ("thermal_offset", "thermal_axis", "reconcile")


class Gone(io.StringIO):
    """A terminal that was closed."""

    def write(self, text: str) -> int:
        raise OSError(5, "Input/output error")


def imported(name: str, monkeypatch: pytest.MonkeyPatch, **hal: Any) -> Any:
    """Return a module of the component with a made-up `hal`."""
    for made_up in ("hal", "linuxcnc"):
        monkeypatch.setitem(sys.modules, made_up, ModuleType(made_up))
    vars(sys.modules["hal"]).update(hal)
    for module in MODULES:
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.syspath_prepend(str(FOLDER))
    found = importlib.import_module(name)
    for module in MODULES:  # with a made-up `hal` they are nobody else's
        monkeypatch.delitem(sys.modules, module, raising=False)
    return found


class Pins(dict[str, Any]):
    """The component."""

    def newpin(self, name: str, *_: object) -> None:
        self[name] = None


@pytest.mark.parametrize(
    ("changed", "value", "acts"),
    [
        ("motion.teleop-mode", True, True),
        ("motion.teleop-mode", False, True),  # joint mode
        ("axis.y.eoffset-enable", False, True),
        ("motion.motion-enabled", False, False),
        ("motion.is-all-homed", False, False),
        ("axis.y.eoffset-clear", True, False),
    ],
)
def test_what_acts_is_shown(monkeypatch: pytest.MonkeyPatch, changed: str, value: bool, acts: bool) -> None:
    there = {"motion.teleop-mode": True, "motion.motion-enabled": True, "motion.is-all-homed": True}
    offset = {"counts": -5000, "scale": 1e-5, "request": -0.05, "enable": True, "clear": False}
    shown: dict[str, Any] = {f"axis.y.eoffset-{name}": one for name, one in offset.items()}
    shown |= {**there, "axis.y.eoffset": -0.05, "motion.coord-mode": False, "motion.eoffset-limited": False}
    shown[changed] = value
    kinds = {"HAL_S32": 0, "HAL_FLOAT": 0, "HAL_OUT": 0}
    program = imported("thermal_axis", monkeypatch, get_value=shown.__getitem__, **kinds)
    pins, axis = Pins(), program.Axis("y", 1000.0)
    output = program.Output(pins, axis, 10.0)
    output.step(0.0, SimpleNamespace(offset_um=-50.0, arrived=True))
    assert pins["applied-um"] == axis.found_um() == (-50.0 if acts else 0.0)
    assert output.view.ready == (changed == "motion.teleop-mode" and value)


@pytest.mark.parametrize("terminal", [Gone(), None])
def test_a_terminal_that_is_gone_does_not_end_the_loop(monkeypatch: pytest.MonkeyPatch, terminal: Gone | None) -> None:
    program = imported("thermal_offset", monkeypatch)
    monkeypatch.setattr(sys, "stderr", terminal)

    steps: list[int] = []

    def step() -> Applied:
        steps.append(1)
        state = ("starting", "following")[len(steps) % 2]
        return Applied(offset_um=0.0, state=state, reasons=(), arrived=True, age_s=None, seq=None, service_state=None)

    follower = SimpleNamespace(alive=True, hold=lambda: None)
    receiver = SimpleNamespace(follower=follower, probe_wanted=None)
    machine = SimpleNamespace(step=step, outputs=[], receiver=receiver)
    program.run({"fade": False, "enable": False, "heartbeat": False}, machine, lambda: len(steps) == 3)
    assert len(steps) == 3
