"""Every state, reason, quality, finding and warning has one sentence on what it means and one on what to do."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

import compensator
from compensator.cli import main
from compensator.codes import DOMAINS, WORDS, Code, ModelWarning, Remark

PACKAGE = Path(compensator.__file__).parent


def member(node: ast.AST) -> Code | None:
    """The code that `DOMAIN.MEMBER` names in the sources."""
    if not isinstance(node, ast.Attribute) or not isinstance(node.value, ast.Name):
        return None
    domain = next((domain for domain in DOMAINS if domain.__name__ == node.value.id), None)
    return None if domain is None else domain.__members__.get(node.attr)


def remarks() -> set[str]:
    """Codes of all warnings that the sources make."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Remark":
                code = member(node.args[0])
                assert code is not None, f"{path}: {node.lineno}: a code that is not a member of its domain"
                found.add(str(code))
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
    """Texts in the sources, as far as a colon, and codes that they name, without those of the tables of words."""
    found = set()
    for root in ("compensator", "drivers"):
        for path in (PACKAGE.parent / root).rglob("*.py"):
            if path != PACKAGE / "codes.py":
                tree = ast.parse(path.read_text(encoding="utf-8"))
                found |= {str(code) for node in ast.walk(tree) if (code := member(node)) is not None}
                found |= {
                    node.value.partition(":")[0]
                    for node in ast.walk(tree)
                    if isinstance(node, ast.Constant) and isinstance(node.value, str)
                }
    return found


def test_no_code_is_left_over() -> None:
    assert set(WORDS) - written() == set()


def test_every_code_that_is_shown_has_its_sentences() -> None:
    assert len(remarks()) >= 18
    assert remarks() <= set(WORDS)
    for code, (means, do) in WORDS.items():
        assert means.endswith(".") and do.endswith(".") and means != do, code


@pytest.mark.parametrize(
    "code", sorted(remarks() | {"hold", "silent", "unknown", "torn", "altered", "outside_validity"})
)
def test_explain_says_the_same(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", code, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["means"], said["do"]) == WORDS[code]


def test_no_code_has_two_meanings() -> None:
    assert len(WORDS) == sum(len(domain) for domain in DOMAINS)


def test_a_warning_says_what_to_do() -> None:
    said = Remark(ModelWarning.TWIN_MODES, "Two time constants of the DTF coincide at 20 min.")
    assert said.startswith("Two time") and said.endswith(WORDS["twin_modes"][1]) and said.code == "twin_modes"
