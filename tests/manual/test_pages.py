"""The manual says what the code does: figures, kinds of effects, files named in tables, links, examples."""

from __future__ import annotations

import doctest
import importlib
import re
from pathlib import Path
from typing import Any

import pytest

from compensator.identify.settings import Settings
from compensator.model.effects import kinds
from compensator.model.effects.hypothesis import Hypothesis
from compensator.model.effects.unobserved import Unobserved
from compensator.model.model_file import load_model

TOP = Path(__file__).resolve().parents[2]
MODEL, IDENTIFY, DIAGNOSE = (TOP / f"compensator/{room}/MATHEMATICS.md" for room in ("model", "identify", "diagnose"))
EFFECTS = TOP / "compensator/model/effects"
#: `module.NAME` = value, as the pages on the mathematics quote what the code has.
QUOTED = re.compile(r"`(\w+)\.(\w+)` = (-?[\d.]+(?:e-?\d+)?)")
CLASSES = {"Settings": Settings(), "Hypothesis": Hypothesis, "Unobserved": Unobserved}


def constant(room: str, holder: str, name: str) -> Any:
    if holder in CLASSES:
        return getattr(CLASSES[holder], name)
    for place in (f"compensator.{room}.{holder}", f"compensator.{room}.effects.{holder}", f"compensator.{holder}"):
        try:
            return getattr(importlib.import_module(place), name)
        except ModuleNotFoundError:
            continue
    raise AssertionError(f"no module {holder}")


@pytest.mark.parametrize(("page", "least"), [(MODEL, 6), (IDENTIFY, 9), (DIAGNOSE, 19)], ids=lambda p: str(p)[-30:])
def test_quoted_constants_are_those_of_the_code(page: Path, least: int) -> None:
    quoted = QUOTED.findall(page.read_text(encoding="utf-8"))
    assert len(quoted) >= least
    for holder, name, value in quoted:
        assert float(value.rstrip(".")) == constant(page.parent.name, holder, name), f"{page}: {holder}.{name}"


def test_examples_on_the_page_run() -> None:
    done = doctest.testfile(str(MODEL), module_relative=False)
    assert done.attempted >= 4
    assert done.failed == 0


def test_every_kind_of_effect_has_its_section_and_no_other_has() -> None:
    headings = re.findall(r"^### `(\w+)`$", MODEL.read_text(encoding="utf-8"), flags=re.MULTILINE)
    of_package = [c for c in descendants(Hypothesis) if (EFFECTS / f"{c.__module__.rpartition('.')[2]}.py").exists()]
    every = {c.kind for c in of_package} | set(kinds())
    assert sorted(headings) == sorted(every)


def descendants(cls: type[Hypothesis]) -> set[type[Hypothesis]]:
    kinds()  # imports every module of the package
    return set(cls.__subclasses__()).union(*(descendants(sub) for sub in cls.__subclasses__()))


def test_the_table_of_the_published_model_is_the_models() -> None:
    text = MODEL.read_text(encoding="utf-8")
    quill = load_model("quill")
    for name, path in (("DTF", quill.dtf), ("TDTF", quill.tdtf), ("TTF", quill.ttf)):
        row = next(
            line for line in text.splitlines() if re.match(rf"\| {name} \| [\d.]+ µm|\| {name} \| [\d.]+ K/W", line)
        )
        gain, taus, zeros = (cell.strip() for cell in row.split("|")[2:5])
        assert path is not None
        assert float(gain.split()[0]) == pytest.approx(path.in_s().dc_gain, rel=1e-4)
        if not taus.startswith("as"):
            assert [float(t) for t in taus.split(", ")] == pytest.approx(path.in_s().time_constants_min(), rel=1e-3)
        found = sorted({round(z.real, 3) for z in path.in_s().zeros_per_min()})
        printed = sorted({round(float(z.split()[0].replace("−", "-")), 3) for z in zeros.split(", ")})
        assert printed == pytest.approx(found, abs=1.5e-3)
