"""A systemd of its own in namespaces: PID 1, journal and services, on this PC's files with all changes thrown away."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

#: Packages of the environment that the tests run in, where the box sees them.
PACKAGES = "/var/test-packages"

#: Where the box's own units stand; none of those that set up a PC.
UNITS = "/etc/systemd/box"

# What belongs to the whole PC (/sys, kernel settings) is read only in the box, and of the system's units it knows the
# journal alone, so that nothing in it can set up what is set up already.
_BOOT = """
set -e
mount --make-rprivate /
mount -t tmpfs tmpfs "$BOX"
mkdir -p "$BOX/upper" "$BOX/work" "$BOX/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$BOX/upper,workdir=$BOX/work" "$BOX/root"
cd "$BOX/root"
mount -t proc proc proc
mount -o bind,ro proc/sys proc/sys
mount -t sysfs -o ro sysfs sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs tmpfs run
mount --rbind /dev dev
mkdir -p ".$PACKAGES" old ".$UNITS"
mount --bind "$SITE" ".$PACKAGES"
cp lib/systemd/system/systemd-journald.service lib/systemd/system/systemd-journald*.socket ".$UNITS"
for target in box sysinit basic multi-user; do
    printf '[Unit]\nDefaultDependencies=no\nRequires=systemd-journald.service\n' > ".$UNITS/$target.target"
done
pivot_root . old
umount -l /old
exec env -i container=other PATH="$PATH" SYSTEMD_UNIT_PATH="$UNITS:/etc/systemd/system:/usr/local/lib/systemd/system" \
    /lib/systemd/systemd --unit=box.target --show-status=no --log-target=journal
"""


class NoBoxError(Exception):
    """What is missing here for a systemd of its own."""


class Box:
    """A running systemd. Use it as a context manager.

    Parameters
    ----------
    folder : pathlib.Path
        Empty folder for its mounts and the log of its start.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._group = Path("/sys/fs/cgroup")
        self._process: subprocess.Popen[bytes] | None = None
        self.pid = 0

    @property
    def root(self) -> Path:
        """The box's files, seen from outside."""
        return Path(f"/proc/{self.pid}/root")

    def __enter__(self) -> Box:
        for program in ("unshare", "nsenter", "pivot_root", "systemctl", "journalctl"):
            if shutil.which(program) is None:
                raise NoBoxError(f"{program} is not installed")
        if os.geteuid() != 0:
            raise NoBoxError("only root can start a systemd of its own")
        groups = [path for path in (self._group / "unified", self._group) if (path / "cgroup.procs").exists()]
        if not groups:
            raise NoBoxError("no cgroup2 here")
        self._group = groups[0] / f"compensator-test-{os.getpid()}"
        try:
            self._group.mkdir()
            self._start()
        except (OSError, AssertionError, NoBoxError) as error:
            self.__exit__()
            raise NoBoxError(str(error)) from error
        return self

    def _start(self) -> None:
        mounts = self._folder / "mounts"
        mounts.mkdir()
        import numpy

        site = Path(numpy.__file__).parents[1]
        environment = {
            "BOX": str(mounts),
            "SITE": str(site),
            "PACKAGES": PACKAGES,
            "UNITS": UNITS,
            "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        }
        enter = f"echo $$ > {self._group}/cgroup.procs; exec unshare --pid --mount --net --uts --ipc --cgroup --fork "
        log = self._folder / "boot.log"
        with log.open("wb") as file:
            self._process = subprocess.Popen(
                ["sh", "-c", enter + '--kill-child sh -c "$BOOT"'],
                env=environment | {"BOOT": _BOOT},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
            )
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")

        def booted() -> bool:
            if self._process is None or self._process.poll() is not None:
                raise NoBoxError(f"systemd did not start: {log.read_text()[-500:]}")
            found = children.read_text().split()
            if not found:
                return False
            self.pid = int(found[0])
            return "running" in self.run("systemctl", "is-system-running", check=False)

        wait(booted, 60.0)
        self.run("sh", "-c", "ip link set lo up || true")

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        for _attempt in range(100):  # the kernel takes a moment to empty the groups
            for path in sorted(self._group.rglob("*"), reverse=True):
                if path.is_dir():
                    try_to(path.rmdir)
            if try_to(self._group.rmdir) or not self._group.exists():
                return
            time.sleep(0.05)

    def run(self, *command: str, check: bool = True, environment: Mapping[str, str] | None = None) -> str:
        """Run a command in the box and return what it printed on both streams."""
        enter = ["nsenter", "--target", str(self.pid), "--all"]
        done = subprocess.run(
            [*enter, *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", **(environment or {})},
            check=False,
            timeout=300,
        )
        if check and done.returncode != 0:
            raise AssertionError(f"{' '.join(command)}: exit {done.returncode}\n{done.stdout}")
        return done.stdout

    def show(self, unit: str, name: str) -> str:
        """Return a property of a unit."""
        return self.run("systemctl", "show", "--value", "--property", name, unit).strip()

    def kill(self, unit: str, number: signal.Signals) -> None:
        """Send a signal to a service's main process."""
        self.run("kill", f"-{int(number)}", self.show(unit, "MainPID"))


def try_to(action: Callable[[], object]) -> bool:
    try:
        action()
    except OSError:
        return False
    return True


def wait(done: Callable[[], bool], timeout_s: float = 200.0, explain: Callable[[], str] = str) -> None:
    """Look again and again until it is so."""
    end = time.monotonic() + timeout_s
    while not done():
        assert time.monotonic() < end, f"not within {timeout_s:.0f} s\n{explain()}"
        time.sleep(0.05)


def python_of_the_system() -> str:
    """Return a Python that services can see and that runs the packages of this environment.

    Raises
    ------
    NoBoxError
        Where there is none.
    """
    for path in (os.path.realpath(sys.executable), "/usr/bin/python3"):
        code = "import sys, ensurepip; print(*sys.version_info[:2])"
        if path.split("/")[1] in ("root", "home") or not Path(path).exists():
            continue
        done = subprocess.run([path, "-c", code], capture_output=True, text=True, check=False)
        if done.stdout.split() == [str(part) for part in sys.version_info[:2]]:
            return path
    raise NoBoxError("no Python of this version with venv outside home folders")
