"""The offset at a real control: LinuxCNC without a screen, from the panel to the Y joint."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.linuxcnc.control import NAMESPACES, ROOT, STARTS, why_not

REASON = why_not()
pytestmark = [pytest.mark.skipif(bool(REASON), reason=REASON), pytest.mark.timeout(580)]


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder with a short path that LinuxCNC's other user may enter."""
    folder = Path(tempfile.mkdtemp(prefix="lcnc-"))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@pytest.mark.parametrize("name", ["scripted", "service", "probing", "refused"])
def test_at_the_control(name: str, place: Path) -> None:
    for attempt in ("first", "second"):
        folder = place / attempt
        folder.mkdir()
        folder.chmod(0o755)
        done = subprocess.run(
            [*NAMESPACES, sys.executable, "-m", "tests.linuxcnc.scenario", name, str(folder)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
        )
        if f": {STARTS}" not in done.stderr:
            break
    assert done.returncode == 0 and done.stdout.endswith("done\n"), done.stdout + done.stderr
