"""Each module stands in the README of its room; a room without one stands as a folder in the README above it."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = sorted(
    {path.parent for package in ("compensator", "drivers", "sim_hardware") for path in (ROOT / package).rglob("*.py")}
)


def named(readme: Path) -> set[str]:
    """Return what a README names as code: modules without their suffix, folders with a slash at the end."""
    return {word.removesuffix(".py") for word in re.findall(r"`([\w./]+)`", readme.read_text(encoding="utf-8"))}


def missing(room: Path) -> list[str]:
    readme = room / "README.md"
    if readme.exists():
        modules = {path.stem for path in room.glob("*.py") if not path.stem.startswith("__")}
        return [f"{(room / name).relative_to(ROOT)}.py" for name in sorted(modules - named(readme))]
    above = next(folder for folder in room.parents if (folder / "README.md").exists())
    is_named = f"{room.relative_to(above)}/" in named(above / "README.md")
    return [] if is_named else [f"{room.relative_to(ROOT)}/README.md"]


def test_every_module_stands_in_the_readme_of_its_room() -> None:
    assert len(ROOMS) > 30
    assert [name for room in ROOMS for name in missing(room)] == []
