"""The page on adding a kind of effect, followed as it stands: a new file and nothing else."""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from compensator.model.effects import base, effect_from, hypothesis, kinds
from compensator.model.engine import Engine
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model

PAGE = Path(__file__).resolve().parents[2] / "compensator/model/effects/README.md"
BLOCKS = dict(re.findall(r"```python\n# ([\w/]+\.py)\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL))


@pytest.fixture
def stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the page's file, and take everything back afterwards."""
    kinds()
    monkeypatch.setattr(base, "_FORMS", list(base._FORMS))
    monkeypatch.setattr(hypothesis, "_PROPOSERS", list(hypothesis._PROPOSERS))
    imported("compensator.model.effects.stop", "compensator/model/effects/stop.py", monkeypatch)


def imported(name: str, path: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = ModuleType(name)
    monkeypatch.setitem(sys.modules, name, module)
    exec(compile(BLOCKS[path], f"{PAGE}: {path}", "exec"), module.__dict__)
    return module


@pytest.mark.usefixtures("stop")
def test_the_pages_test_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    imported("test_stop", "tests/diagnose/test_stop.py", monkeypatch).test_a_stop_is_found_and_explained()


@pytest.mark.usefixtures("stop")
def test_it_runs_from_a_model_file() -> None:
    table = effect_from("stop", {"path": "DTF", "limit_um": 5.0})
    model = parse_model(dump_model(dataclasses.replace(load_model("quill"), effects=(table,))).encode(), source="stop")
    engine = Engine(model)
    engine.set_reference(20.0, 20.0)
    estimates = engine.run(20.0 + np.minimum(np.arange(60) * 0.2, 6.0), np.full(60, 20.0))
    assert max(e.y_dtf_um for e in estimates) > 10.0
    assert max(e.y_dtf_um + e.y_effects_um[0] for e in estimates) == pytest.approx(5.0)
