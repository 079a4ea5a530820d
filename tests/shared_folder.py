"""What is made once for all processes of a test run."""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that the first process to ask for it has filled; the others wait for it.

    Parameters
    ----------
    factory : pytest.TempPathFactory
        Knows the temporary folder of this process, within that of the run.
    name : str
        Name of the folder.
    make : callable
        Fills the folder it is given.
    """
    root = factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    folder, done = root / name, root / f"{name}.done"
    with (root / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


def search_once(patch: pytest.MonkeyPatch, factory: pytest.TempPathFactory) -> None:
    """Search once in a test run for what the same model lacks in data that are equal to the bit."""
    from compensator.api import diagnosis

    find = diagnosis.find_effects

    def once(model: Any, runs: Any, options: Any, **report: Any) -> Any:
        def search(folder: Path) -> None:
            found = find(model, runs, options, **report)
            (folder / "found").write_bytes(pickle.dumps((found, found.model is model)))

        asked = hashlib.sha256(pickle.dumps((model, runs, sorted(options.expected)))).hexdigest()
        answer = made_once(factory, f"searched-{asked}", search) / "found"
        found, is_same = pickle.loads(answer.read_bytes())
        return dataclasses.replace(found, model=model) if is_same else found

    patch.setattr(diagnosis, "find_effects", once)
