"""Makes the reference that newer versions are held against: run with version 0.1.0 only.

    git checkout 37d41dd && python -m tests.reference.make

It writes `tests/reference/v0_1_0`: small recordings of the real service on simulated time, tables, models, and what
the commands of version 0.1.0 gave on them. Run twice it writes the same bytes twice. It checks
`compensator.__version__ == "0.1.0"` and does nothing with any other version.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import compensator
from tests.reference import kept

VERSION = "0.1.0"


def main() -> int:
    """Make the reference anew and return the exit code."""
    if compensator.__version__ != VERSION:
        sys.stderr.write(f"version {compensator.__version__}, the reference is made with {VERSION} only\n")
        return 1
    shutil.rmtree(kept.KEPT, ignore_errors=True)
    with tempfile.TemporaryDirectory() as scratch:
        expected = _make(Path(scratch))
    text = json.dumps(expected, indent=1, ensure_ascii=False, sort_keys=True)
    (kept.KEPT / "expected.json").write_text(text + "\n", encoding="utf-8")
    return 0


def _make(scratch: Path) -> dict[str, Any]:
    from tests.reference import models, scenes, tables

    for folder in ("models", "tables", "recordings", "identify", "diagnose", "keys"):
        (kept.KEPT / folder).mkdir(parents=True)
    for name, data in models.MODELS.items():
        (kept.KEPT / "models" / name).write_bytes(data)
    for name, write in tables.TABLES.items():
        write(kept.KEPT / "tables" / name)
    keys = {"machine": 7, "other": 8}
    for name, number in keys.items():
        (kept.KEPT / "keys" / f"{name}.pub.pem").write_bytes(scenes.public_key(number))
    recordings = {name: _scene(name) for name in scenes.SCENES}
    keyed = {"machine": ("signed", "machine"), "other": ("signed", "other"), "unsigned": ("plain", "machine")}
    return {
        "version": VERSION,
        "recordings": recordings,
        "keys": {name: _with_key(*pair) for name, pair in keyed.items()},
        "tampered": {name: _tampered(name, scratch) for name, _, _ in kept.TAMPERED},
        "export": {scene: kept.exported(scene, scratch / "e.csv") for scene in kept.EXPORTS},
        "identify": {name: _identified(name, scratch) for name in kept.IDENTIFIED},
        "diagnose": {name: _diagnosed(name, scratch) for name in kept.DIAGNOSED},
        "simulate": {name: kept.simulated(name, scratch / "s.csv") for name in kept.SIMULATED},
        "compare": {name: kept.compared(name, scratch / "c.csv") for name in kept.COMPARED},
    }


def _scene(name: str) -> dict[str, Any]:
    from tests.reference import scenes

    folder = kept.KEPT / "recordings" / name
    published = scenes.make(name, folder)
    said = kept.said(folder)
    # What a torn file has lost was published all the same.
    assert said.offsets == [data for data in published if data in set(said.offsets)], name
    about = (scenes.SCENES[name].__doc__ or "").strip()
    audit = kept.replay(folder)
    assert audit["exit"] == 0, (name, audit)
    return {"about": about, "published": len(published), "said": said.as_json(), "replay": audit}


def _with_key(scene: str, key: str) -> dict[str, Any]:
    public = kept.KEPT / "keys" / f"{key}.pub.pem"
    return {"scene": scene, "key": key, "replay": kept.replay(kept.KEPT / "recordings" / scene, "--public-key", public)}


def _tampered(name: str, scratch: Path) -> dict[str, Any]:
    with kept.tampered(name, scratch) as folder:
        audit = kept.replay(folder)
    assert audit["exit"] in (2, 3), (name, audit)
    return audit


def _identified(name: str, scratch: Path) -> dict[str, Any]:
    out = scratch / name / "model.toml"
    code, result = kept.identified(name, out)
    assert code == 0, name
    shutil.copyfile(out, kept.KEPT / "identify" / f"{name}.toml")
    return {"exit": code, "result": result}


def _diagnosed(name: str, scratch: Path) -> dict[str, Any]:
    out = scratch / f"diagnose-{name}"
    code, result = kept.diagnosed(name, out)
    assert code == 0, name
    shutil.copyfile(out / "model.toml", kept.KEPT / "diagnose" / f"{name}.toml")
    shutil.copyfile(out / "diagnosis.json", kept.KEPT / "diagnose" / f"{name}.json")
    return {"exit": code, "result": result}


if __name__ == "__main__":
    sys.exit(main())
