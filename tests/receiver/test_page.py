"""The page on adding a control, followed as it stands: its adapter passes its tests."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

PAGE = Path(__file__).resolve().parents[2] / "deploy/receiver/README.md"
BLOCKS = dict(re.findall(r"```python\n# ([\w/]+\.py)\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL))
ADAPTER, TESTS = "deploy/receiver/acme_control.py", "tests/receiver/test_acme_control.py"


@pytest.mark.parametrize("name", re.findall(r"^def (test_\w+)", BLOCKS[TESTS], flags=re.MULTILINE))
def test_what_the_page_makes_passes_its_tests(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / ADAPTER
    path.parent.mkdir(parents=True)
    path.write_text(BLOCKS[ADAPTER], encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    made: dict[str, Any] = {"__name__": "test_acme_control"}
    exec(compile(BLOCKS[TESTS], f"{PAGE}: {TESTS}", "exec"), made)
    made[name]()
