"""Fixtures of the tests of what goes onto the machine."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.shared_folder import made_once

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel."""
    return next(made_once(tmp_path_factory, "wheel", _build).glob("quill_compensator-*.whl"))


def _build(folder: Path) -> None:
    """Build the wheel from a copy, so that nothing is left behind in the sources."""
    import shutil

    source = folder / "source"
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(".*", "tests", "*.egg-info", "build", "demo-out*"))
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        str(source),
        "--no-deps",
        "--no-build-isolation",
        "--quiet",
        "--disable-pip-version-check",
        "--wheel-dir",
        str(folder),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
