"""Runs a diagnosis as a process of its own, which the sampling loop never feels.

The service only waits for it: the process has a low priority and limits of memory, computing time and wall time.
Whatever it does (it hangs, is killed, writes rubbish) is a diagnosis that failed, with a reason. It ends with the
service.
"""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import signal
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from compensator.clock import NS
from compensator.config import Config
from compensator.errors import CompensatorError
from compensator.input_file import MODEL_BYTES, RESULT_BYTES, read_file
from compensator.messages import UNREADABLE
from compensator.service.loop.job import CALIBRATED, JOB, RESULT, Job, Result
from compensator.service.loop.state import Running
from compensator.service.loop.weighing import FAILED, Diagnosed, failed

log = logging.getLogger("compensator")

#: Makes a diagnosis of what is wanted, from a calibrated model.
Diagnose = Callable[[Running, bytes], Awaitable[Diagnosed]]
#: Module that the process runs.
MODULE = "compensator.commands.loop_diagnosis"
#: Diagnoses whose files are kept.
KEPT = 14
#: Waiting for a process that was killed, s.
_KILLED_S = 5.0
_UNFINISHED = ".part"
#: What the process has to say of its errors; of its last bytes the last line is cited, so many characters of it.
ERRORS = "errors.txt"
_TAIL, _CITED = 4096, 200


class DiagnosisProcess:
    """Makes the diagnoses of one machine.

    Parameters
    ----------
    config : Config
        Settings, with `[loop]`.
    recordings : pathlib.Path
        Folder of the recordings.
    folder : pathlib.Path
        Folder for the results, one in it for each diagnosis.
    command : sequence of str, optional
        The process to which the folder of a diagnosis is handed over.
    """

    def __init__(self, config: Config, recordings: Path, folder: Path, *, command: tuple[str, ...] = ()) -> None:
        assert config.loop is not None
        self._config, self._settings = config, config.loop
        self._recordings, self._folder = recordings, folder
        self._command = command or (sys.executable, "-m", MODULE)

    async def __call__(self, wanted: Running, calibrated: bytes) -> Diagnosed:
        """Make a diagnosis; it never raises a `CompensatorError`."""
        stamp = datetime.fromtimestamp(wanted.to_utc_ns / NS, UTC).strftime("%Y-%m-%dT%H%M%SZ")
        work = self._folder / f"{stamp}{_UNFINISHED}"
        try:
            await asyncio.to_thread(self._prepare, work, wanted, calibrated)
            why = await self._run(work)
            found = await asyncio.to_thread(_read, work) if not why else failed(why)
            await asyncio.to_thread(self._finish, work, self._folder / stamp)
        except (CompensatorError, OSError) as error:
            return failed(str(error))
        return found

    def _prepare(self, work: Path, wanted: Running, calibrated: bytes) -> None:
        """Remove what interrupted diagnoses have left, and write the job."""
        for left in self._folder.glob(f"*{_UNFINISHED}"):
            shutil.rmtree(left, ignore_errors=True)
        work.mkdir(parents=True)
        settings, probe = self._settings, self._config.probe
        job = Job(
            recordings=str(self._recordings.absolute()),
            machine=self._config.machine.name,
            from_utc_ns=wanted.from_utc_ns,
            to_utc_ns=wanted.to_utc_ns,
            probe_std_um=probe.std_um if probe is not None else None,
            memory_mb=settings.memory_mb,
            time_limit_min=settings.time_limit_min,
            parent=os.getpid(),
        )
        (work / CALIBRATED).write_bytes(calibrated)
        (work / JOB).write_bytes(msgspec.json.encode(job))

    async def _run(self, work: Path) -> str:
        """Run the process; return why it gave nothing, empty if it ended well."""
        limit_s = 60.0 * self._settings.time_limit_min
        with (work / ERRORS).open("wb") as errors:
            process = await asyncio.create_subprocess_exec(
                *self._command,
                str(work),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=errors,
                start_new_session=True,
            )
        try:
            async with asyncio.timeout(limit_s):
                code = await process.wait()
        except TimeoutError:
            return f"it took longer than loop.time_limit_min = {self._settings.time_limit_min:g}"
        finally:
            await _end(process)
        if code == 0:
            return ""
        said = await asyncio.to_thread(_last_line, work / ERRORS)
        why = f"it was ended by {signal.Signals(-code).name}" if code < 0 else f"it ended with code {code}"
        why += f": {said}" if said else ""
        # The kernel ends what needs too much without a word.
        is_memory = code < 0 or MemoryError.__name__ in said
        return f"{why}; limit of memory: {self._settings.memory_mb:g} MB" if is_memory else why

    def _finish(self, work: Path, done: Path) -> None:
        shutil.rmtree(done, ignore_errors=True)
        work.rename(done)
        # What has a later name was made while the clock was ahead.
        folders = [path for path in self._folder.iterdir() if path.is_dir()]
        for path in sorted(folders, key=lambda path: (path.name <= done.name, path.name))[:-KEPT]:
            shutil.rmtree(path, ignore_errors=True)


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a process with all that it has started."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    if process.returncode is None:
        with suppress(TimeoutError):
            async with asyncio.timeout(_KILLED_S):
                await process.wait()


def _last_line(path: Path) -> str:
    """Return the last line that the process has written, shortened; empty if there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - _TAIL, 0))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return ""
    line = next((line for line in reversed(lines) if line.strip()), "")
    return "".join(filter(str.isprintable, line.strip()))[:_CITED]


def _read(work: Path) -> Diagnosed:
    """Read what the process has written, and trust none of it."""
    try:
        result = msgspec.json.decode(read_file(work / RESULT, RESULT_BYTES), type=Result)
        model = read_file(work / "model.toml", MODEL_BYTES) if result.effects else None
    except (CompensatorError, OSError, *UNREADABLE) as error:
        return failed(f"its result cannot be read: {error}")
    if result.verdict == FAILED:
        return failed(result.needs)
    return Diagnosed(result.verdict, tuple(result.effects), model, result.text, result.needs, result.y_moved_utc_ns)
