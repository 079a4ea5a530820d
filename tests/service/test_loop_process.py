"""The process of a diagnosis: whatever it does, the service gets a reason, and nothing is left behind."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.service.loop.process import KEPT, DiagnosisProcess
from compensator.service.loop.state import Running
from compensator.service.loop.weighing import Diagnosed
from tests.service.looping import extended, settings
from tests.service.test_restart import QUILL

WANTED = Running(from_utc_ns=0, to_utc_ns=1_767_592_800_000_000_000, why="planned")


def process(folder: Path, script: str, **changes: Any) -> DiagnosisProcess:
    """A diagnosis whose process runs a script; `folder` in it is that of the job."""
    config = settings()
    assert config.loop is not None
    config = msgspec.structs.replace(config, loop=msgspec.structs.replace(config.loop, **changes))
    head = "import os, sys, time, json, pathlib; folder = pathlib.Path(sys.argv[1])\n"
    command = (sys.executable, "-c", head + textwrap.dedent(script))
    return DiagnosisProcess(config, folder / "rec", folder / "diagnoses", command=command)


async def made(folder: Path, script: str, **changes: Any) -> Diagnosed:
    return await process(folder, script, **changes)(WANTED, QUILL)


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    return state != "Z"


async def gone(pid: int) -> bool:
    """Wait until a process has ended."""
    for _ in range(500):
        if not is_running(pid):
            return True
        await asyncio.sleep(0.01)
    return False


async def test_what_it_finds_comes_with_the_model_and_the_page_stays(tmp_path: Path) -> None:
    result = {"verdict": "explained", "effects": ["input:coolant_degc"], "text": "found", "needs": ""}
    script = f"""
        (folder / "model.toml").write_bytes({extended()!r})
        (folder / "result.json").write_text(json.dumps({result!r}))
    """
    found = await made(tmp_path, script)
    assert found == Diagnosed("explained", ("input:coolant_degc",), extended(), "found", "")
    folders = list((tmp_path / "diagnoses").iterdir())
    assert [folder.name for folder in folders] == ["2026-01-05T060000Z"]
    assert (folders[0] / "calibrated.toml").read_bytes() == QUILL


@pytest.mark.parametrize("year", [2025, 2027])
async def test_the_newest_diagnoses_are_kept_whatever_the_clock_was(tmp_path: Path, year: int) -> None:
    for day in range(1, KEPT + 1):
        (tmp_path / "diagnoses" / f"{year}-01-{day:02d}T020000Z").mkdir(parents=True)
    await made(tmp_path, "pass")
    kept = sorted(path.name for path in (tmp_path / "diagnoses").iterdir())
    assert len(kept) == KEPT and "2026-01-05T060000Z" in kept and f"{year}-01-01T020000Z" not in kept


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("pass", "cannot be read"),
        ("(folder / 'result.json').write_text('{')", "cannot be read"),
        ("(folder / 'result.json').write_text('{\"verdict\": 5}')", "cannot be read"),
        (
            "(folder / 'result.json').write_text(json.dumps({'verdict': 'explained', 'effects': ['input:a']}))",
            "cannot be read",
        ),
        ("(folder / 'result.json').write_bytes(b' ' * 11_000_000)", "larger than"),
        ("raise SystemExit(3)", "ended with code 3"),
        (
            "raise ZeroDivisionError('a defect' + 500 * '.')",
            f"ended with code 1: ZeroDivisionError: a defect{171 * '.'}",
        ),
        ("sys.stderr.write('line\\n\\x1b[2Jhung\\n\\n'); raise SystemExit(3)", "ended with code 3: [2Jhung"),
        ("os.kill(os.getpid(), 9)", "ended by SIGKILL; limit of memory: 1500 MB"),
        ("(folder / 'result.json').write_bytes(bytes(range(128, 256)))", "cannot be read"),
    ],
)
async def test_a_process_that_gives_nothing_is_a_diagnosis_that_failed(tmp_path: Path, script: str, why: str) -> None:
    found = await made(tmp_path, script)
    assert found.verdict == "failed" and found.model is None and why in found.needs, found
    assert ("limit of memory" in found.needs) is ("SIGKILL" in why)
    assert len(found.needs) < 300


async def test_one_that_hangs_is_ended_with_everything_that_it_has_started(tmp_path: Path) -> None:
    script = """
        import subprocess
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        (folder.parent / "pids").write_text(f"{os.getpid()} {child.pid}")
        time.sleep(600)
    """
    began = time.monotonic()
    # A process of the lowest priority needs seconds to begin on a busy computer.
    found = await made(tmp_path, script, time_limit_min=0.2)
    assert found.verdict == "failed" and "loop.time_limit_min" in found.needs
    assert time.monotonic() - began < 120.0
    for pid in map(int, (tmp_path / "diagnoses" / "pids").read_text(encoding="utf-8").split()):
        assert await gone(pid)


LIMITED = """
    from compensator.commands.loop_diagnosis import _limit
    from compensator.service.loop.job import read_job
    _limit(read_job(folder / "job.json"))
"""


async def test_one_that_eats_memory_fails_and_has_a_low_priority(tmp_path: Path) -> None:
    script = (
        LIMITED
        + """
    (folder.parent / "nice").write_text(f"{os.nice(0)} {os.sched_getscheduler(0) == os.SCHED_BATCH}")
    everything = bytearray(2_000_000_000)
    """
    )
    found = await made(tmp_path, script, memory_mb=400.0)
    assert found.verdict == "failed" and "ended with code 1: MemoryError; limit of memory: 400 MB" in found.needs
    niceness, is_batch = (tmp_path / "diagnoses" / "nice").read_text(encoding="utf-8").split()
    assert int(niceness) >= 10 and is_batch == "True"


async def test_it_ends_with_the_service_that_stops(tmp_path: Path) -> None:
    script = """
        (folder.parent / "pid").write_text(str(os.getpid()))
        time.sleep(600)
    """
    task = asyncio.create_task(made(tmp_path, script))
    path = tmp_path / "diagnoses" / "pid"
    while not (path.exists() and path.read_text(encoding="utf-8")):
        await asyncio.sleep(0.01)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert await gone(int(path.read_text(encoding="utf-8")))
    # The next one removes what it has left.
    assert list((tmp_path / "diagnoses").glob("*.part"))
    await made(tmp_path, "pass")
    assert not list((tmp_path / "diagnoses").glob("*.part"))


async def test_it_ends_with_a_service_that_is_killed(tmp_path: Path) -> None:
    inner = (
        LIMITED
        + """
    (folder.parent / "pid").write_text(str(os.getpid()))
    time.sleep(600)
    """
    )
    outer = f"""
import asyncio, pathlib
from tests.service.test_loop_process import made
asyncio.run(made(pathlib.Path({str(tmp_path)!r}), {inner!r}))
"""
    service = subprocess.Popen([sys.executable, "-c", outer], cwd=Path(__file__).parents[2])
    path = tmp_path / "diagnoses" / "pid"
    while not (path.exists() and path.read_text(encoding="utf-8")):
        assert service.poll() is None
        await asyncio.sleep(0.05)
    service.send_signal(signal.SIGKILL)
    service.wait()
    assert await gone(int(path.read_text(encoding="utf-8")))
