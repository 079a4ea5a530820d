"""LinuxCNC as a test starts it: the shipped configuration with a panel for a display and a sampler on the Y joint."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from tests.receiver.wire import until

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "deploy/linuxcnc"
SAMPLER = """
loadrt sampler depth=8192 cfg=ffffb
addf sampler.0 servo-thread
net y-position => sampler.0.pin.0
net y-eoffset axis.y.eoffset => sampler.0.pin.1
net y-request axis.y.eoffset-request => sampler.0.pin.2
net y-program axis.y.pos-cmd => sampler.0.pin.3
net on motion.motion-enabled => sampler.0.pin.4
net y-clear axis.y.eoffset-clear
"""


#: What is waited for first; on a busy computer LinuxCNC itself hangs now and then while it starts.
STARTS = "LinuxCNC is up"
#: What LinuxCNC reports when the computer is so busy that its motion controller does not take a command in time; the
#: command is lost, or comes later.
STARVED = "USRMOT: ERROR: command timeout"
#: It reports how long its task took where that is too long; beyond this it was starved, too, s.
_TASK, _TASK_S = re.compile(r"task: main loop took (\d+\.\d+) seconds"), 0.5
#: Longest time that the panel takes for an answer, s; a block of a program may take a minute.
ANSWER_S = 120.0


def is_starved(said: str) -> bool:
    """Whether LinuxCNC reports that the computer was too busy for it."""
    return STARVED in said or any(float(took) > _TASK_S for took in _TASK.findall(said))


class Period(NamedTuple):
    """One servo period, µm."""

    motor_um: float
    eoffset_um: float
    request_um: float
    program_um: float
    on: bool


def period(words: list[str]) -> Period:
    """Read what `SAMPLER` writes of a servo period."""
    return Period(*(1000.0 * float(word) for word in words[:4]), on=words[4] == "1")


class Control:
    """A running LinuxCNC."""

    def __init__(self, folder: Path, path: str, read: Callable[[list[str]], Any]) -> None:
        self.folder = folder
        self._read = read
        self._socket = socket.socket(socket.AF_UNIX)
        self._path = path
        self._lines: Any = None
        self._samples = folder / "samples.txt"
        self._sampler: subprocess.Popen[bytes] | None = None

    def connect(self, alive: Callable[[], bool]) -> None:
        def there() -> bool:
            assert alive(), "LinuxCNC ended while starting"
            return Path(self._path).exists()

        until(there, STARTS)
        until(self._try, "the panel answers")
        self._socket.settimeout(ANSWER_S)
        self._lines = self._socket.makefile("rw")

    def _try(self) -> bool:
        try:
            self._socket.connect(self._path)
        except OSError:
            return False
        return True

    def do(self, *words: Any) -> Any:
        self._lines.write(json.dumps(words) + "\n")
        self._lines.flush()
        answer = json.loads(self._lines.readline())
        assert "error" not in answer, (words, answer)
        return answer["ok"]

    def get(self, name: str) -> Any:
        return self.do("get", name)[0]

    def um(self, name: str = "joint.1.motor-pos-cmd") -> float:
        return float(self.get(name)) * 1000.0

    def quit(self) -> None:
        self._lines.write('["quit"]\n')
        self._lines.flush()

    def close(self) -> None:
        """End; the panel ends with its connection."""
        if self._sampler is not None:
            self._sampler.kill()
            self._sampler.wait()
        if self._lines is not None:
            self._lines.close()
        self._socket.close()

    def sample(self) -> None:
        """Write every servo period to a file, from here to the end."""
        with self._samples.open("wb") as file:  # line by line, or the file lags behind by a block
            self._sampler = subprocess.Popen(["stdbuf", "-oL", "halsampler", "-t"], stdout=file)

    def _later(self) -> int:
        """Wait until the file holds what happens now; return where it goes on."""
        size = self._samples.stat().st_size
        until(lambda: self._samples.stat().st_size > size + 2_000, "the sampler runs")
        return self._samples.stat().st_size

    @contextmanager
    def watched(self) -> Iterator[list[Any]]:
        """Every servo period while this lasts; the list is full when it ends."""
        found: list[Any] = []
        begin = self._later()
        yield found
        end = self._later()
        with self._samples.open("rb") as file:
            file.seek(begin)
            lines = file.read(end - begin).decode().splitlines()[1:-1]
        before = None
        for line in lines:
            words = line.split()
            assert words[0].isdigit(), line  # "overrun"
            # Two periods between two lines would look like a jump.
            assert before is None or int(words[0]) == before + 1, f"the sampler lost periods: {before} to {words[0]}"
            before = int(words[0])
            found.append(self._read(words[1:]))


def changed(text: str, changes: dict[str, str]) -> str:
    """Replace what must be there."""
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    return text


def why_not() -> str:
    """Say why LinuxCNC cannot be tested here; empty where it can."""
    if shutil.which("linuxcnc") is None or shutil.which("halsampler") is None:
        return "LinuxCNC is not installed (Debian: apt-get install --no-install-recommends linuxcnc-uspace)"
    probe = "import hal, linuxcnc, sys; sys.exit(sys.version_info < (3, 11))"
    if subprocess.run(["/usr/bin/python3", "-c", probe], capture_output=True, check=False).returncode:
        return "/usr/bin/python3 has no LinuxCNC modules, or is older than 3.11"
    done = subprocess.run([*NAMESPACES, "true"], capture_output=True, text=True, check=False)
    if done.returncode:
        return f"no namespaces of its own, and LinuxCNC is one for a whole computer: {done.stderr.strip()}"
    return ""


#: LinuxCNC is one for a whole computer (shared memory, a lock, port 5005 on all addresses), and a second one ends the
#: first. In namespaces of its own it meets nobody.
NAMESPACES = ("unshare", "--ipc", "--pid", "--mount", "--mount-proc", "--net", "--fork", "--kill-child")


@contextmanager
def linuxcnc(
    folder: Path,
    settings: str,
    *,
    hal: str = "",
    sampler: str = SAMPLER,
    read: Callable[[list[str]], Any] = period,
    **ini: str,
) -> Iterator[tuple[Control, Path]]:
    """Start the shipped configuration with other settings, and with a sampler whose lines `read` understands.

    Yields
    ------
    (Control, pathlib.Path)
        The control, and the file that its messages go to.
    """
    folder.mkdir(mode=0o777, exist_ok=True)
    folder.chmod(0o777)
    for name in (
        "machine.hal",
        "thermal.hal",
        "thermal_axes.hal",
        "thermal_offset.py",
        "thermal_axis.py",
        "reconcile.py",
        "thermal_probe.ngc",
        "thermal_probe.hal",
    ):
        shutil.copy(SHIPPED / name, folder / name)
    text = (SHIPPED / "machine.ini").read_text(encoding="utf-8")
    panel = folder / "panel.py"
    shutil.copy(Path(__file__).with_name("operator_panel.py"), panel)
    text = changed(
        text,
        {
            "DISPLAY = dummy": "DISPLAY = ./panel.py",
            "/opt/thermal/venv/bin/python": "./python",
            "HALFILE = thermal.hal": "HALFILE = thermal.hal\nHALFILE = sampler.hal",
            **ini,
        },
    )
    (folder / "machine.ini").write_text(text, encoding="utf-8")
    (folder / "thermal.toml").write_text(settings, encoding="utf-8")
    (folder / "sampler.hal").write_text(sampler + hal, encoding="utf-8")
    # The system's Python with this environment's zenoh, whose wheel is for every version of Python 3.
    python = folder / "python"
    packages = Path(zenoh.__file__).parents[1]
    python.write_text(f'#!/bin/sh\nPYTHONPATH="{ROOT}:{packages}" exec /usr/bin/python3 "$@"\n', encoding="utf-8")
    for program in (python, panel):
        program.chmod(program.stat().st_mode | stat.S_IXUSR | stat.S_IXGRP | stat.S_IXOTH)
    path = str(folder / "panel.sock")
    environment = {
        **os.environ,
        "HOME": str(folder),
        "RTAPI_UID": "65534",
        "PANEL_SOCKET": path,
        "RTAPI_FIFO_PATH": str(folder / "rtapi_fifo"),
        "TMPDIR": str(folder),
    }
    environment.pop("PYTHONPATH", None)
    log = folder / "linuxcnc.log"
    with log.open("wb") as out:
        process = subprocess.Popen(
            ["linuxcnc", "-r", "machine.ini"],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
        )
        control = Control(folder, path, read)
        try:
            control.connect(lambda: process.poll() is None)
            control.sample()
            yield control, log
            control.quit()
            process.wait(timeout=60)
        except BaseException:
            said = log.read_text(errors="replace")
            sys.stderr.write(f"{STARVED}\n{said[-6000:]}" if is_starved(said) else said[-6000:])
            raise
        finally:
            control.close()
            if process.poll() is None:
                process.terminate()
                process.wait(timeout=60)
