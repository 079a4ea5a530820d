"""The page on adding a control, followed as it stands: its adapter passes its tests."""

from __future__ import annotations

import re
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

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


def test_a_terminal_that_is_gone_does_not_end_its_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    says = iter(["one", "two"])

    def step(*_: Any) -> str:
        said = next(says, "")
        if not said:
            raise KeyboardInterrupt
        return said

    def gone(*_: Any, **__: Any) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(sys, "argv", ["acme_control.py", "receiver.toml", "127.0.0.1", "1"])
    made: dict[str, Any] = {"__name__": "acme_control"}
    exec(compile(BLOCKS[ADAPTER], f"{PAGE}: {ADAPTER}", "exec"), made)
    made |= {"step": step, "print": gone, "socket": MagicMock(), "time": MagicMock(), "load_settings": lambda _: (0, 0)}
    made |= {"AcmeControl": lambda _: SimpleNamespace(applied_um=0.0), "Receiver": lambda *_, **__: nullcontext()}
    with pytest.raises(KeyboardInterrupt):
        made["main"]()
    assert next(says, None) is None
