"""Every state, reason, quality, finding and warning has one sentence on what it means and one on what to do."""

from __future__ import annotations

import ast
import functools
import json
from pathlib import Path
from typing import NamedTuple

import pytest

import compensator
from compensator.cli import main
from compensator.codes import DOMAINS, SUFFIXES, WORDS, Code, ModelWarning, Remark
from compensator.model.model_file import load_model
from compensator.service.plausibility.isolation import FaultIsolation

PACKAGE = Path(compensator.__file__).parent


def member(node: ast.AST) -> Code | None:
    """The code that `DOMAIN.MEMBER` names in the sources."""
    if not isinstance(node, ast.Attribute) or not isinstance(node.value, ast.Name):
        return None
    domain = next((domain for domain in DOMAINS if domain.__name__ == node.value.id), None)
    return None if domain is None else domain.__members__.get(node.attr)


class Source(NamedTuple):
    """Codes, texts as far as a colon, what each remark is made of, lines of warnings without a code."""

    path: Path
    codes: frozenset[Code]
    texts: frozenset[str]
    remarks: tuple[ast.expr, ...]
    unmarked: tuple[int, ...]


@functools.cache
def sources() -> tuple[Source, ...]:
    """The sources, each read once."""
    return tuple(source(path) for root in ("compensator", "drivers") for path in (PACKAGE.parent / root).rglob("*.py"))


def source(path: Path) -> Source:
    """Read a source."""
    codes, texts, remarks, unmarked = set[Code](), set[str](), list[ast.expr](), list[int]()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute):
            if (code := member(node)) is not None:
                codes.add(code)
        elif isinstance(node, ast.Constant):
            if isinstance(node.value, str):
                texts.add(node.value.partition(":")[0])
        elif isinstance(node, ast.Call):
            if getattr(node.func, "id", "") == "Remark":
                remarks.append(node.args[0])
            if getattr(node.func, "attr", "") == "warning":
                last = node.args[-1]
                if not (isinstance(last, ast.Attribute) and last.attr == "marked"):
                    unmarked.append(node.lineno)
    return Source(path, frozenset(codes), frozenset(texts), tuple(remarks), tuple(unmarked))


def remarks() -> set[str]:
    """Codes of all warnings that the sources make."""
    found = set()
    for one in sources():
        if PACKAGE not in one.path.parents:
            continue
        for made in one.remarks:
            if isinstance(made, ast.Name):  # handed over: any code that the module names
                found |= {str(code) for code in one.codes}
                continue
            code = member(made)
            assert code is not None, f"{one.path}: {made.lineno}: a code that is not a member of its domain"
            found.add(str(code))
    return found


def test_every_warning_in_the_log_has_a_code() -> None:
    for one in sources():
        # The receiver stands alone, with codes of its own.
        if PACKAGE in one.path.parents and PACKAGE / "receiver" not in one.path.parents:
            assert not one.unmarked, f"{one.path}: {one.unmarked}"


def written() -> set[str]:
    """Texts in the sources, as far as a colon, and codes that they name, without those of the tables of words."""
    told = [one for one in sources() if one.path != PACKAGE / "codes.py"]
    return {str(code) for one in told for code in one.codes} | {text for one in told for text in one.texts}


def test_no_code_is_left_over() -> None:
    assert set(WORDS) - written() == set()


def test_every_code_that_is_shown_has_its_sentences() -> None:
    assert len(remarks()) >= 18
    assert remarks() <= set(WORDS)
    for code, (means, do) in WORDS.items():
        assert means.endswith(".") and do.endswith(".") and means != do, code


def test_explain_says_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    for code in sorted(remarks() | {"hold", "silent", "unknown", "torn", "altered", "outside_validity"}):
        assert main(["explain", code, "--json"]) == 0, code
        said = json.loads(capsys.readouterr().out)
        assert (said["means"], said["do"]) == WORDS[code], code


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("implausible:foo", "expected implausible, implausible:t_q_degc, implausible:at_degc, implausible:y_um, "),
        ("outside_validity:model", "outside_validity:heat_w"),
        ("channel_missing:", "expected channel_missing, channel_missing:CHANNEL"),
        ("hold:t_q_degc", "unknown suffix 't_q_degc', expected hold"),
    ],
)
def test_a_suffix_that_no_reason_has_is_refused(code: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", code]) == 2
    assert expected in capsys.readouterr().err
    assert main(["explain", "channel_missing:oil_degc"]) == 0, "any channel of a configuration"


def test_every_suspect_can_be_explained() -> None:
    model = load_model("quill")
    suspects = {shape.suspect for shape in FaultIsolation(model, 10, 4, 0.5)._shapes} | {"model"}
    assert suspects == set(SUFFIXES["implausible"])
    for code, suffixes in SUFFIXES.items():
        assert all(main(["explain", f"{code}:{suffix}"]) == 0 for suffix in suffixes)


def test_no_code_has_two_meanings() -> None:
    assert len(WORDS) == sum(len(domain) for domain in DOMAINS)


def test_a_warning_says_what_to_do() -> None:
    said = Remark(ModelWarning.TWIN_MODES, "Two time constants of the DTF coincide at 20 min.")
    assert said.startswith("Two time") and said.endswith(WORDS["twin_modes"][1]) and said.code == "twin_modes"
