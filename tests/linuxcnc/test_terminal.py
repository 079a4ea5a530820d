"""The HAL component's lines for its terminal, without LinuxCNC: whether they can be written moves no axis."""

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


@pytest.mark.parametrize("terminal", [Gone(), None])
def test_a_terminal_that_is_gone_does_not_end_the_loop(monkeypatch: pytest.MonkeyPatch, terminal: Gone | None) -> None:
    for name in ("hal", "linuxcnc"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    for name in MODULES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(str(FOLDER))
    program: Any = importlib.import_module("thermal_offset")
    for name in MODULES:  # with a made-up `hal` they are nobody else's
        monkeypatch.delitem(sys.modules, name)
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
