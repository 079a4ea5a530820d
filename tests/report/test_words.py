"""Every state, reason, quality, finding and warning has one sentence on what it means and one on what to do."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import get_args

import pytest

import compensator
from compensator.audit.findings import End, Kind
from compensator.cli import main
from compensator.messages import State
from compensator.reasons import WORDS, Caution

PACKAGE = Path(compensator.__file__).parent


def cautions() -> set[str]:
    """Codes of all warnings that the sources make."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Caution":
                assert isinstance(node.args[0], ast.Constant), f"{path}: {node.lineno}: a code that is not written out"
                found.add(node.args[0].value)
    return found


def test_every_warning_in_the_log_has_a_code() -> None:
    for path in sorted(PACKAGE.rglob("*.py")):
        if PACKAGE / "receiver" in path.parents:  # stands alone, with codes of its own
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "warning":
                last = node.args[-1]
                assert isinstance(last, ast.Attribute) and last.attr == "marked", f"{path}: {node.lineno}"


def written() -> set[str]:
    """Texts in the sources, as far as a colon, without those of the table of words itself."""
    found = set()
    for root in ("compensator", "drivers"):
        for path in (PACKAGE.parent / root).rglob("*.py"):
            if path != PACKAGE / "reasons.py":
                tree = ast.parse(path.read_text(encoding="utf-8"))
                found |= {
                    node.value.partition(":")[0]
                    for node in ast.walk(tree)
                    if isinstance(node, ast.Constant) and isinstance(node.value, str)
                }
    return found


def test_no_code_is_left_over() -> None:
    assert set(WORDS) - written() == set()


def test_every_code_that_is_shown_has_its_sentences() -> None:
    assert len(cautions()) >= 18
    assert cautions() | set(get_args(State)) | set(Kind) | set(End) <= set(WORDS)
    for code, (means, do) in WORDS.items():
        assert means.endswith(".") and do.endswith(".") and means != do, code


@pytest.mark.parametrize(
    "code", sorted(cautions() | {"hold", "silent", "unknown", "torn", "altered", "outside_validity"})
)
def test_explain_says_the_same(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", code, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["means"], said["do"]) == WORDS[code]


def test_a_warning_says_what_to_do() -> None:
    said = Caution("twin_modes", "Two time constants of the DTF coincide at 20 min.")
    assert said.startswith("Two time") and said.endswith(WORDS["twin_modes"][1]) and said.code == "twin_modes"
    with pytest.raises(KeyError):
        Caution("no such code", "Something.")
