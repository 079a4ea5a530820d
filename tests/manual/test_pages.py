"""The manual says what the code does: figures, kinds of effects, files named in tables, links, examples."""

from __future__ import annotations

import ast
import doctest
import importlib
import re
import shlex
import typing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from compensator.cli import _parser
from compensator.config import Config
from compensator.identify.settings import Settings
from compensator.model.effects.base import Effect, forms
from compensator.model.model_file import load_model

TOP = Path(__file__).resolve().parents[2]
MODEL, IDENTIFY, DIAGNOSE = (TOP / f"compensator/{room}/MATHEMATICS.md" for room in ("model", "identify", "diagnose"))
EFFECTS, LOOP = TOP / "compensator/model/effects", TOP / "compensator/service/loop"
#: `module.NAME` = value, as the pages on the mathematics quote what the code has.
QUOTED = re.compile(r"`(\w+)\.(\w+)` = (-?[\d.]+(?:e-?\d+)?)")
#: A row of the table of settings: `module.NAME` or `Class.name`, and its value or values.
SETTING = re.compile(r"^\| `(\w+\.\w+)` \| (-?[\d.e-]+(?:, -?[\d.e-]+)*) \|", flags=re.MULTILINE)
#: Settings that are only shown; the page names them without a value.
SHOWN = {"summary.SHOWN", "advice_words.SAID", "remainder_words._NAMED"}
#: Numbers of the loop that decide nothing.
NO_SETTINGS = {"state.STATE_SCHEMA", "process._KILLED_S", "process._TAIL", "process._CITED"}


def constant(room: str, holder: str, name: str) -> Any:
    if holder == "Settings":
        return getattr(Settings(), name)
    for place in (room, f"{room}.effects", f"{room}.correction", "data", "recording", ""):
        try:
            return getattr(importlib.import_module(".".join(filter(None, ("compensator", place, holder)))), name)
        except ModuleNotFoundError:
            continue
    raise AssertionError(f"no module {holder}")


@pytest.mark.parametrize(("page", "least"), [(MODEL, 6), (IDENTIFY, 9)], ids=lambda p: str(p)[-30:])
def test_quoted_constants_are_those_of_the_code(page: Path, least: int) -> None:
    quoted = QUOTED.findall(page.read_text(encoding="utf-8"))
    assert len(quoted) >= least
    for holder, name, value in quoted:
        assert float(value.rstrip(".")) == constant(page.parent.name, holder, name), f"{page}: {holder}.{name}"


def settings_of(folder: Path) -> dict[str, Any]:
    """Everything that is assigned at the top of the modules of a folder, and of those below it."""
    found: dict[str, Any] = {}
    for file in sorted(folder.rglob("[!_]*.py")):
        module = importlib.import_module(".".join(file.relative_to(TOP).with_suffix("").parts))
        assigned = [node for node in ast.parse(file.read_text("utf-8")).body if isinstance(node, ast.Assign)]
        targets = [name for node in assigned for target in node.targets for name in ast.walk(target)]
        found |= {f"{file.stem}.{t.id}": getattr(module, t.id) for t in targets if isinstance(t, ast.Name)}
    return found


def settings_of_diagnosis() -> dict[str, tuple[float, ...]]:
    """Every number or short row of numbers at the top of a module of diagnose, and what effects must be worth."""
    found = settings_of(DIAGNOSE.parent)
    for form in {base for effect in forms() for base in effect.__mro__ if issubclass(base, Effect)}:
        asked = ("worth", "worth_with_others", "removes_alone")
        found |= {f"{form.__name__}.{k}": v for k, v in vars(form).items() if k in asked}
    rows = {
        name: tuple(np.atleast_1d(v)) for name, v in found.items() if isinstance(v, int | float | tuple | np.ndarray)
    }
    return {
        name: tuple(map(float, row))
        for name, row in rows.items()
        if len(row) < 100 and all(isinstance(v, int | float | np.number) for v in row)
    }


def test_the_settings_of_the_diagnosis_are_in_its_table_and_no_others() -> None:
    text = DIAGNOSE.read_text(encoding="utf-8")
    rows = SETTING.findall(text)
    listed = {name: tuple(map(float, values.split(", "))) for name, values in rows}
    assert len(rows) == len(listed), "a setting stands twice"
    settings = settings_of_diagnosis()
    assert all(f"`{name}`" in text for name in SHOWN)
    in_effects = {name for name in listed if (EFFECTS / f"{name.partition('.')[0]}.py").exists()}
    assert set(listed) - in_effects == set(settings) - SHOWN
    for name, values in listed.items():
        known = constant("model.effects", *name.split(".")) if name in in_effects else settings[name]
        assert values == pytest.approx(known if isinstance(known, tuple) else (known,), rel=5e-3), name


def test_the_settings_of_the_loop_are_in_its_table_and_no_others() -> None:
    rows = SETTING.findall((LOOP / "README.md").read_text(encoding="utf-8"))
    found = {name: value for name, value in settings_of(LOOP).items() if isinstance(value, int | float)}
    assert {name: float(value) for name, value in rows} == {k: v for k, v in found.items() if k not in NO_SETTINGS}


def test_examples_on_the_page_run() -> None:
    done = doctest.testfile(str(MODEL), module_relative=False)
    assert done.attempted >= 4
    assert done.failed == 0


def test_every_kind_of_effect_has_its_section_and_no_other_has() -> None:
    headings = re.findall(r"^### `(\w+)`$", MODEL.read_text(encoding="utf-8"), flags=re.MULTILINE)
    of_package = [f for f in forms() if (EFFECTS / f"{f.__module__.rpartition('.')[2]}.py").exists()]
    assert sorted(headings) == sorted({form.kind for form in of_package})


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


# ---------------------------------------------------------------------------- every folder's page

ROOMS = ("compensator", "drivers", "sim_hardware", "tests", "deploy")
PAGES = sorted(
    page
    for page in [TOP / "README.md", *(p for room in ROOMS for p in (TOP / room).rglob("*.md"))]
    if not {".venv", "node_modules"} & set(page.parts)
)
CODE = re.compile(r"```.*?```", flags=re.DOTALL)
#: A cell that names files: nothing but names in backticks.
NAMES = re.compile(r"^(?:`[\w./@-]+`(?:, )?)+$")


def test_every_folder_of_python_has_a_page_or_a_row_in_one() -> None:
    """Below the rooms of the compensator a row in a table of a folder above it is enough."""
    folders = {p.parent for room in ROOMS for p in (TOP / room).rglob("*.py") if "node_modules" not in p.parts}
    listed = {page.parent / name for page in PAGES for name in named_files(page.read_text(encoding="utf-8"))}
    rooms = {f for f in folders if f == TOP / "compensator" or f.parent == TOP / "compensator"}
    without = [f.relative_to(TOP) for f in sorted(folders - (listed - rooms)) if not (f / "README.md").exists()]
    assert [str(f) for f in without] == []


def named_files(text: str) -> list[str]:
    """Names of files and folders in the first column of tables whose head says that this is what stands there."""
    found: list[str] = []
    listing = False
    for line in CODE.sub("", text).splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] if line.startswith("|") else []
        if not cells:
            listing = False
        elif cells[0] in ("file", "module", "folder", "where"):
            listing = True
        elif listing and NAMES.match(cells[0]):
            found += re.findall(r"`([^`]+)`", cells[0])
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(TOP)))
def test_files_in_tables_and_links_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    gone = [
        name
        for name in named_files(text)
        if not name.startswith("/") and not any((page.parent / way).exists() for way in (name, f"{name}.py"))
    ]
    for target in re.findall(r"\]\(([^)\s]+)\)", CODE.sub("", text)):
        where, _, part = target.partition("#")
        if "://" in target:
            continue
        if where and not (page.parent / where).exists():
            gone.append(target)
        elif part:
            aim = (page.parent / where if where else page).read_text(encoding="utf-8")
            if part not in {anchor(heading) for heading in re.findall(r"^#+ (.*)$", aim, flags=re.MULTILINE)}:
                gone.append(target)
    assert gone == []


def anchor(heading: str) -> str:
    """Return what GitHub makes of a heading in a link."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def test_the_reader_of_tables_sees_what_is_there_and_what_is_not() -> None:
    text = "| file | what |\n| --- | --- |\n| `a.py`, `b` | x |\n\n| key | what |\n| --- | --- |\n| `c.py` | x |\n"
    assert named_files(text) == ["a.py", "b"]
    assert len(named_files((TOP / "compensator/README.md").read_text(encoding="utf-8"))) > 10


def test_commands_of_the_top_page_parse() -> None:
    blocks = "".join(CODE.findall((TOP / "README.md").read_text(encoding="utf-8")))
    lines = re.findall(r"^\$ compensator (.*)$", blocks, flags=re.MULTILINE)
    assert len(lines) >= 6
    for line in lines:
        _parser().parse_args(shlex.split(line, comments=True))


# ---------------------------------------------------------------------------- the configuration


def test_every_table_and_key_of_the_configuration_is_on_its_page() -> None:
    rows = re.findall(
        r"^\| `\[+([\w.]+)\]+`(.*)$", (TOP / "deploy/CONFIGURATION.md").read_text("utf-8"), flags=re.MULTILINE
    )
    text = (TOP / "deploy/CONFIGURATION.md").read_text("utf-8")
    for field in msgspec.structs.fields(Config):
        if field.name in ("line", "device"):  # what the drivers say of them stands on their page
            assert f"`[[{field.name}]]`" in text
            continue
        table = table_of(field.type)
        (cells,) = [cells for name, cells in rows if name == field.name]
        named = set(re.findall(r"`(\w+)`", cells))
        nested = {f.name: table_of(f.type) for f in msgspec.structs.fields(table) if is_table(f.type)}
        keys = {f.name for f in msgspec.structs.fields(table)} - set(nested)
        assert keys <= named, f"[{field.name}]: {sorted(keys - named)}"
        for name, inner in nested.items():
            assert f"[{field.name}.{name}]" in text
            for key in (f.name for f in msgspec.structs.fields(inner)):
                assert f"`{key}`" in text, f"[{field.name}.{name}]: {key}"


def is_table(kind: Any) -> bool:
    return bool(tables_in(kind))


def table_of(kind: Any) -> type[msgspec.Struct]:
    """The struct that a field holds, alone, in a list, or where it may be left out."""
    return tables_in(kind)[0]


def tables_in(kind: Any) -> list[type[msgspec.Struct]]:
    own = [kind] if isinstance(kind, type) and issubclass(kind, msgspec.Struct) else []
    return own + [table for part in typing.get_args(kind) for table in tables_in(part)]
