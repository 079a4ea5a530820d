"""The offset at a real control: LinuxCNC without a screen, from the panel to the Y joint."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.linuxcnc.control import NAMESPACES, ROOT, STARTS, STARVED, is_starved, why_not
from tests.linuxcnc.several import waited

#: What the component says where the position has changed by more between two of its turns than the axis can move.
TABLE_JUMPED = "[position_jumped]"
REASON = why_not()
pytestmark = [pytest.mark.skipif(bool(REASON), reason=REASON), pytest.mark.timeout(860)]


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder with a short path that LinuxCNC's other user may enter."""
    folder = Path(tempfile.mkdtemp(prefix="lcnc-"))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


def run_scenario(name: str, place: Path) -> subprocess.CompletedProcess[str]:
    """Run a scenario, and again where LinuxCNC itself could not keep up with the computer; return the last run."""
    for attempt in ("first", "second", "third"):
        folder = place / attempt
        folder.mkdir()
        folder.chmod(0o755)
        command = [*NAMESPACES, sys.executable, "-m", "tests.linuxcnc.scenario", name, str(folder)]
        try:
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280, check=False)
        except subprocess.TimeoutExpired as error:
            said = (error.stderr or b"").decode(errors="replace")
            done = subprocess.CompletedProcess(command, 1, "", f"{said}\nnot done after {error.timeout:.0f} s")
        # A table that jumped moved while the component had no turn.
        if done.returncode == 0 or not any(sign in done.stderr for sign in (f": {STARTS}", STARVED, TABLE_JUMPED)):
            break
    return done


@pytest.mark.parametrize("name", ["scripted", "axes", "service", "service_axes", "probing", "refused"])
def test_at_the_control(name: str, place: Path) -> None:
    done = run_scenario(name, place)
    assert done.returncode == 0 and done.stdout.endswith("done\n"), done.stdout + done.stderr


@pytest.mark.parametrize(
    ("said", "runs"),
    [
        ([STARVED, ""], 2),
        ([TABLE_JUMPED, ""], 2),
        ([f"AssertionError: {STARTS}", STARVED, STARVED], 3),
        (["AssertionError: a jump"], 1),
    ],
)
def test_only_a_starved_control_is_asked_again(
    place: Path, monkeypatch: pytest.MonkeyPatch, said: list[str], runs: int
) -> None:
    answers = iter(said)

    def answer(*_: object, **__: object) -> subprocess.CompletedProcess[str]:
        words = next(answers)
        return subprocess.CompletedProcess([], bool(words), stdout="" if words else "done\n", stderr=words)

    monkeypatch.setattr(subprocess, "run", answer)
    done = run_scenario("scripted", place)
    assert len(list(place.iterdir())) == runs
    assert done.stderr == said[-1]


def test_a_control_is_starved_where_its_own_task_says_so() -> None:
    assert is_starved(f"...\n{STARVED}\n") and is_starved("task: main loop took 0.977323 seconds")
    assert not is_starved("task: main loop took 0.110232 seconds")


def test_a_component_that_had_its_turn_has_not_waited() -> None:
    turns = [float(i // 20) for i in range(400)]
    stands = [*turns, *[turns[-1]] * 700, *[turns[-1] + 1.0 + i for i in range(50)]]
    assert waited(turns)[-1] == 0
    assert waited(stands)[399 + 650] == 650 + 19 and waited(stands)[-1] == 700 + 19
