"""The page on adding a driver, followed as it stands: its family, its simulated device, its tests."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from drivers import catalog

PAGE = Path(__file__).resolve().parents[3] / "drivers/ADDING.md"
BLOCKS = dict(re.findall(r"```python\n# ([\w/]+\.py)\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL))


def imported(name: str, path: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = ModuleType(name)
    monkeypatch.setitem(sys.modules, name, module)
    exec(compile(BLOCKS[path], f"{PAGE}: {path}", "exec"), module.__dict__)
    return module


def followed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[..., Any]]:
    """Do what the page says, and return its tests."""
    family = imported("drivers.families.acme", "drivers/families/acme.py", monkeypatch)
    monkeypatch.setattr(catalog, "MODELS", {**catalog.MODELS, **family.MODELS})
    imported("sim_hardware.wire.acme", "sim_hardware/wire/acme.py", monkeypatch)
    tests = imported("test_acme", "tests/drivers/fleet/test_acme.py", monkeypatch)
    return {name: value for name, value in vars(tests).items() if name.startswith("test_")}


@pytest.mark.parametrize(
    "name", re.findall(r"^async def (test_\w+)", BLOCKS["tests/drivers/fleet/test_acme.py"], flags=re.MULTILINE)
)
async def test_what_the_page_makes_passes_its_tests(
    name: str, rig: Any, slave: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    test = followed(monkeypatch)[name]
    given = {"rig": rig, "slave": slave}
    await test(**{key: given[key] for key in inspect.signature(test).parameters})


def test_every_model_stands_in_the_table() -> None:
    table = (PAGE.parent / "README.md").read_text(encoding="utf-8")
    assert [model for model in catalog.MODELS if f"`{model}`" not in table] == []
