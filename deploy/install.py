#!/usr/bin/env python3
"""Install, upgrade, roll back and remove the thermal error compensation on a machine's PC.

Needs Python 3.11 with venv and nothing else. Every command may be repeated; what is done already is left as it is.

    install.py install --wheels DIR          the newest quill_compensator-*.whl in DIR, dependencies from DIR, offline
    install.py install --wheel FILE          dependencies from the package index that pip is set up for
    install.py machine NAME --config FILE    folder and configuration of a machine, checked, service enabled and started
    install.py back                          the previous version
    install.py uninstall [--purge]           the program; with --purge configuration, recordings and user, too

Each version is in a virtual environment of its own, PREFIX/versions/VERSION-HASH; PREFIX/current and PREFIX/previous
point to two of them. Before anything is switched the new version checks every machine's configuration. A service that
does not become ready with the new version gets the old one back. Configurations and recordings are never touched, and
a unit or rule that was changed here stays: the new one is written next to it as `.new`.

One file, because it runs before the rest of the program is installed.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import importlib.util
import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

DISTRIBUTION = "quill_compensator"
PREFIX = "/opt/compensator"
USER = "compensator"
CONFIGURATIONS, RECORDINGS, LOGS = "/etc/compensator", "/var/lib/compensator", "/var/log/compensator"
#: File of a version's share/compensator → where the system looks for it.
SYSTEM_FILES = {
    "systemd/compensator@.service": "/usr/local/lib/systemd/system/compensator@.service",
    "systemd/compensator-router.service": "/usr/local/lib/systemd/system/compensator-router.service",
    "systemd/compensator.sysusers.conf": "/usr/local/lib/sysusers.d/compensator.conf",
    "systemd/compensator.tmpfiles.conf": "/usr/local/lib/tmpfiles.d/compensator.conf",
    "systemd/70-compensator.rules": "/usr/local/lib/udev/rules.d/70-compensator.rules",
}
JOURNAL_LIMITS = {"systemd/journald.conf": "/etc/systemd/journald.conf.d/compensator.conf"}
COMMAND = "/usr/local/bin/compensator"
#: Largest file that is read, bytes: a wheel, and anything else.
WHEEL_BYTES, FILE_BYTES = 100_000_000, 1_000_000
#: Names of machines, which are names of folders and units.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
UNITS = ("compensator-router.service", "compensator@*.service")


class InstallError(Exception):
    """One line: what could not be done, and what was expected."""


class Installation:
    """The versions below a prefix, and the system's files that belong to them.

    Parameters
    ----------
    prefix : str
        Folder of the versions, as a path on the machine.
    destdir : str
        Folder used instead of `/`; with it nothing of the running system is touched.
    """

    def __init__(self, prefix: str, destdir: str) -> None:
        self._prefix, self._destdir = prefix, destdir
        self.root = self.path(prefix)
        self._manifest = self.root / "manifest.json"

    def path(self, name: str) -> Path:
        """Return where a path of the machine is now, below `destdir`."""
        return Path(self._destdir + name) if self._destdir else Path(name)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Keep a second installer out."""
        self.root.mkdir(parents=True, exist_ok=True)
        with (self.root / ".lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise InstallError(f"{self.root}: another installer is running") from error
            yield

    # ------------------------------------------------------------------ versions

    def link(self, name: str) -> Path | None:
        """Return the version that `current` or `previous` points to."""
        link = self.root / name
        return link.resolve() if link.is_symlink() and link.exists() else None

    def extras(self) -> list[str]:
        """Return the extras of the version in use: an upgrade keeps them."""
        current = self.link("current")
        return read(current / ".complete").decode().split() if current else []

    def build(self, wheel: Path, wheels: Path | None, extras: Sequence[str], *, dependencies: bool) -> Path:
        """Make the virtual environment of a wheel; a complete one stays, an incomplete one is made again."""
        # What else is installed with it: the same program beside newer dependencies is another environment.
        beside = [*extras, *([] if dependencies else ["--no-deps"])]
        beside += sorted(path.name for path in wheels.glob("*.whl")) if wheels else []
        digest = hashlib.sha256(read(wheel, WHEEL_BYTES) + " ".join(beside).encode()).hexdigest()
        version = self.root / "versions" / f"{wheel.name.split('-')[1]}-{digest[:8]}"
        if (version / ".complete").exists():
            report(f"{version.name}: installed already")
            return version
        report(f"{version.name}: installing into {version}")
        shutil.rmtree(version, ignore_errors=True)
        run([sys.executable, "-m", "venv", str(version)])
        pip = [str(version / "bin/python"), "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
        offline = ["--no-index", "--find-links", str(wheels)] if wheels else []
        wanted = f"{wheel}[{','.join(extras)}]" if extras else str(wheel)
        run([*pip, *offline, *([] if dependencies else ["--no-deps"]), wanted])
        for path in (version, version / "share/compensator"):
            if not path.is_dir():
                raise InstallError(f"{wheel}: no {path.relative_to(version)} in it, expected a complete wheel")
        (version / ".complete").write_text(" ".join(extras) + "\n", encoding="utf-8")
        os.sync()
        return version

    def point(self, name: str, version: Path) -> None:
        """Let `current` or `previous` point to a version, atomically."""
        link = self.root / name
        new = self.root / f".{name}.new"
        new.unlink(missing_ok=True)
        new.symlink_to(os.path.relpath(version, self.root))
        new.replace(link)

    def prune(self) -> None:
        """Remove versions that neither `current` nor `previous` points to."""
        keep = {self.link("current"), self.link("previous")}
        for version in sorted((self.root / "versions").iterdir()):
            if version.resolve() not in keep:
                shutil.rmtree(version)
                report(f"{version.name}: removed")

    # ------------------------------------------------------------------ the system's files

    def write_system_files(self, version: Path, *, journal_limits: bool) -> None:
        """Write units, rules and descriptions of folders to their places."""
        share = version / "share/compensator"
        known = self._known()
        here = any(self.path(place).exists() for place in JOURNAL_LIMITS.values())
        files = SYSTEM_FILES | (JOURNAL_LIMITS if journal_limits or here else {})
        for name, place in files.items():
            data = read(share / name).replace(PREFIX.encode(), self._prefix.encode())
            self._write(self.path(place), place, data, known)
        command = self.path(COMMAND)
        if not command.exists() or command.is_symlink():
            command.parent.mkdir(parents=True, exist_ok=True)
            command.unlink(missing_ok=True)
            command.symlink_to(f"{self._prefix}/current/bin/compensator")

    def _write(self, path: Path, place: str, data: bytes, known: dict[str, list[str]]) -> None:
        digest, newer = hashlib.sha256(data).hexdigest(), path.with_name(path.name + ".new")
        found = hashlib.sha256(read(path)).hexdigest() if path.exists() else None
        if found == digest:
            return
        if found is not None and found not in known.get(place, []):
            put(newer, data)
            report(f"{path}: was changed here and stays; the new one is {newer.name}")
            return
        # Recorded before it is written: a power cut in between leaves no file without an owner.
        known[place] = [*known.get(place, []), digest]
        self._manifest.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
        path.parent.mkdir(parents=True, exist_ok=True)
        put(path, data)
        newer.unlink(missing_ok=True)
        report(f"{path}: written")

    def _known(self) -> dict[str, list[str]]:
        try:
            return json.loads(read(self._manifest)) if self._manifest.exists() else {}
        except ValueError as error:
            raise InstallError(f"{self._manifest}: {error}, expected what this program wrote; remove it") from error

    def remove_system_files(self) -> None:
        """Remove the files written; those that were changed here stay."""
        known = self._known()
        for place in (SYSTEM_FILES | JOURNAL_LIMITS).values():
            path = self.path(place)
            path.with_name(path.name + ".new").unlink(missing_ok=True)
            if not path.exists():
                continue
            if hashlib.sha256(read(path)).hexdigest() in known.get(place, []):
                path.unlink()
                report(f"{path}: removed")
            else:
                report(f"{path}: was changed here and stays")
        command = self.path(COMMAND)
        if command.is_symlink():
            command.unlink()

    # ------------------------------------------------------------------ machines

    def machines(self) -> list[Path]:
        """Return the configuration of every machine."""
        return sorted(self.path(CONFIGURATIONS).glob("*/machine.toml"))

    def check(self, version: Path, config: Path) -> None:
        """Let a version check a configuration; nothing is opened."""
        done = subprocess.run(
            [str(version / "bin/compensator"), "check", "--config", str(config)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines() or ["no answer"]
            raise InstallError(f"{version.name} cannot use {config}: {lines[-1]}")
        name = config.parent.name
        table = tomllib.loads(read(config).decode("utf-8-sig"))
        for kind, key in (("recording", "folder"), ("recording", "head"), ("model", "store")):
            given = table.get(kind, {}).get(key)
            if given is None:
                continue
            place = os.path.normpath(Path(CONFIGURATIONS) / name / given)
            if place.startswith(f"{RECORDINGS}/{name}/"):
                continue
            expected = f"{config}: {kind}.{key} = {given!r}, expected a place below {RECORDINGS}/{name}/, the only one"
            if key == "folder" or f"{place}/".startswith((f"{CONFIGURATIONS}/", f"{RECORDINGS}/")):
                raise InstallError(f"{expected} that the service may write to")
            report(f"{expected} that the service may write to unless its unit has ReadWritePaths (systemctl edit)")
        report(f"{config}: valid for {version.name}")

    def activate(self, version: Path, system: System, *, journal_limits: bool = False) -> None:
        """Switch to a version, restart running services, and switch back where one does not become ready.

        Raises
        ------
        InstallError
            If it cannot use a configuration (nothing was switched), or a service did not become ready (the previous
            version is in use again).
        """
        for config in self.machines():
            self.check(version, config)
        before, earlier = self.link("current"), self.link("previous")
        self._switch(version, before, system, journal_limits)
        running = system.running()
        failed = [unit for unit in running if not system.restarted(unit)]
        if failed and before not in (None, version):
            assert before is not None
            self._switch(before, earlier, system, journal_limits)
            if earlier is None:
                (self.root / "previous").unlink(missing_ok=True)
            still = [unit for unit in running if not system.restarted(unit)]
            end = f"; {', '.join(still)} does not start with that one either" if still else ""
            raise InstallError(f"{', '.join(failed)} did not start with {version.name}; back to {before.name}{end}")
        if failed:
            raise InstallError(f"{', '.join(failed)} did not start: journalctl -u {failed[0]} -n 20")
        report(f"{version.name}: in use" + (f", restarted {', '.join(running)}" if running else ""))

    def _switch(self, version: Path, previous: Path | None, system: System, journal_limits: bool) -> None:
        if previous is not None and previous != version:
            self.point("previous", previous)
        self.point("current", version)
        self.write_system_files(version, journal_limits=journal_limits)
        system.reload()


class System:
    """The running system; not touched where files go to another root.

    Parameters
    ----------
    touch : bool
        Whether the running system may be touched.
    """

    def __init__(self, *, touch: bool) -> None:
        self._touch = touch
        self._systemd = touch and Path("/run/systemd/system").is_dir()

    def reload(self) -> None:
        """Let the system read its files again: user, folders, device names, units."""
        if self._touch:
            run(["systemd-sysusers", SYSTEM_FILES["systemd/compensator.sysusers.conf"]])
            run(["systemd-tmpfiles", "--create", SYSTEM_FILES["systemd/compensator.tmpfiles.conf"]])
        if self._systemd:
            run(["systemctl", "daemon-reload"])
        if self._systemd and Path("/run/udev/control").exists():
            run(["udevadm", "control", "--reload"])
            run(["udevadm", "trigger", "--subsystem-match=tty", "--subsystem-match=usb-serial"])

    def forget(self) -> None:
        """Let the system notice that the units are gone."""
        if self._systemd:
            run(["systemctl", "daemon-reload"])

    def running(self) -> list[str]:
        """Return the services that are running or starting."""
        if not self._systemd:
            return []
        done = run(["systemctl", "list-units", "--plain", "--no-legend", "--state=active,activating,failed", *UNITS])
        return [line.split()[0] for line in done.splitlines() if line.strip()]

    def restarted(self, unit: str) -> bool:
        """Restart a service and return whether it became ready."""
        return subprocess.run(["systemctl", "restart", unit], check=False).returncode == 0

    def enable(self, unit: str) -> None:
        """Start a service now and with the PC."""
        if self._systemd:
            run(["systemctl", "enable", "--now", unit])
            report(f"{unit}: runs, and starts with the PC")

    def disable(self) -> None:
        """Stop and disable all services."""
        wanted = Path("/etc/systemd/system/multi-user.target.wants").glob("compensator[@-]*.service")
        units = sorted({*self.running(), *(path.name for path in wanted)}) if self._systemd else []
        if units:
            run(["systemctl", "disable", "--now", *units])
            report(f"{', '.join(units)}: stopped")

    def check_python(self) -> None:
        """Refuse a Python that cannot make the environment, or that the service could not read.

        Raises
        ------
        InstallError
            With what to use instead.
        """
        if importlib.util.find_spec("ensurepip") is None:
            raise InstallError(f"{sys.executable}: no ensurepip, expected the package python3-venv")
        real = Path(sys.executable).resolve()
        if self._touch and real.parts[1] in ("home", "root"):
            raise InstallError(
                f"{real}: services cannot read home folders, expected a Python outside, such as /usr/bin/python3"
            )

    def own(self, path: Path, mode: int) -> None:
        """Give a file to root and the service's group."""
        if self._touch:
            shutil.chown(path, "root", USER)
        path.chmod(mode)

    def remove_user(self) -> None:
        """Remove the service's user."""
        if self._touch:
            subprocess.run(["userdel", USER], check=False, capture_output=True)


# ---------------------------------------------------------------------------- commands


def install(given: argparse.Namespace, installation: Installation, system: System) -> None:
    """Install or upgrade."""
    wheel = given.wheel or newest(given.wheels)
    if not wheel.is_file():
        raise InstallError(f"{wheel}: no such file, expected a wheel of {DISTRIBUTION}")
    system.check_python()
    extras = sorted({*installation.extras(), *given.extra})
    version = installation.build(wheel.resolve(), given.wheels, extras, dependencies=not given.no_deps)
    installation.activate(version, system, journal_limits=given.journal_limits)
    installation.prune()


def newest(wheels: Path | None) -> Path:
    """Return the wheel of the highest version in a folder."""
    found = sorted(wheels.glob(f"{DISTRIBUTION}-*.whl"), key=_version_of) if wheels else []
    if not found:
        raise InstallError(f"{wheels or 'no --wheel and no --wheels'}: no {DISTRIBUTION}-*.whl, expected one")
    return found[-1]


def _version_of(wheel: Path) -> list[int]:
    return [int(part) if part.isdecimal() else 0 for part in wheel.name.split("-")[1].split(".")]


def machine(given: argparse.Namespace, installation: Installation, system: System) -> None:
    """Make the folder of a machine, write its configuration, check it, and start its service."""
    version = installation.link("current")
    if version is None:
        raise InstallError(f"{installation.root}: nothing is installed, expected `install.py install` first")
    if NAME.fullmatch(given.name) is None:
        raise InstallError(f"machine {given.name!r}: expected letters, digits, . _ -, such as vmc-07")
    if given.config is not None and (other := _name_in(given.config)) not in (None, given.name):
        raise InstallError(f"{given.config}: machine.name = {other!r}, expected {given.name!r}")
    folder = installation.path(CONFIGURATIONS) / given.name
    folder.mkdir(parents=True, exist_ok=True)
    system.own(folder, 0o750)
    if given.config is not None:
        _copy(given.config, folder / "machine.toml", system)
    if older := [path.name for path in given.model if not _copy(path, folder / path.name, system)]:
        raise InstallError(
            f"{folder / older[0]}: not the one given: move {older[0]}.new over it, or give the new one another name"
        )
    if not (folder / "machine.toml").exists():
        raise InstallError(f"{folder / 'machine.toml'}: missing, expected --config FILE")
    installation.check(version, folder / "machine.toml")
    system.enable(f"compensator@{given.name}.service")


def _name_in(config: Path) -> object:
    """Return the name of the machine in a configuration; None where `check` will say what is wrong with it."""
    try:
        table = tomllib.loads(read(config).decode("utf-8-sig")).get("machine")
    except ValueError:
        return None
    return table.get("name") if isinstance(table, dict) else None


def _copy(source: Path, target: Path, system: System) -> bool:
    """Copy a file to where there is none; return whether it is there now."""
    data = read(source)
    if target.exists() and read(target) != data:
        newer = target.with_name(target.name + ".new")
        put(newer, data)
        system.own(newer, 0o640)
        report(f"{target}: differs and stays; the new one is {newer.name}")
        return False
    if not target.exists():
        put(target, data)
        report(f"{target}: written")
    system.own(target, 0o640)
    return True


def back(given: argparse.Namespace, installation: Installation, system: System) -> None:
    """Return to the previous version; repeated, it returns from there."""
    previous = installation.link("previous")
    if previous is None:
        raise InstallError(f"{installation.root}: no previous version is kept")
    installation.activate(previous, system)


def uninstall(given: argparse.Namespace, installation: Installation, system: System) -> None:
    """Remove the program; configuration and recordings only with `--purge`."""
    system.disable()
    installation.remove_system_files()
    for name in ("current", "previous", "manifest.json", ".lock"):
        (installation.root / name).unlink(missing_ok=True)
    shutil.rmtree(installation.root / "versions", ignore_errors=True)
    with contextlib.suppress(OSError):
        installation.root.rmdir()
    for name in (CONFIGURATIONS, RECORDINGS, LOGS):
        path = installation.path(name)
        if given.purge:
            shutil.rmtree(path, ignore_errors=True)
        elif path.exists():
            report(f"{path}: stays")
    if given.purge:
        system.remove_user()
        report("configuration, recordings, logs and user: removed")
    system.forget()


def put(path: Path, data: bytes) -> None:
    """Write a file that is never half there: the same command would take it for one that was changed here."""
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def read(path: Path, most: int = FILE_BYTES) -> bytes:
    """Return the bytes of a regular file; a device or a pipe may have no end.

    Raises
    ------
    InstallError
        If it is no regular file, or larger.
    """
    # A pipe would wait for its writer.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise InstallError(f"{path}: not a regular file")
        data = file.read(most + 1)
    if len(data) > most:
        raise InstallError(f"{path}: larger than {most} bytes")
    return data


def report(text: str) -> None:
    """Print what was done."""
    print(text, flush=True)


def run(command: Sequence[str]) -> str:
    """Run a command and return what it printed.

    Raises
    ------
    InstallError
        If it fails; with its last line.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        lines = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
        raise InstallError(f"{' '.join(command)}: {lines[-1]}")
    return done.stdout


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prefix", default=PREFIX, help=f"folder of the program (default {PREFIX})")
    parser.add_argument("--destdir", default="", help="folder used instead of /; the running system is not touched")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    one = commands.add_parser("install", help="install or upgrade")
    one.set_defaults(command=install)
    one.add_argument("--wheel", type=Path, help="the program")
    one.add_argument("--wheels", type=Path, help="folder of wheels: the program and its dependencies; offline")
    one.add_argument(
        "--extra", action="append", default=[], help="sign or tls: both need the package cryptography; kept by upgrades"
    )
    one.add_argument("--no-deps", action="store_true", help="do not install dependencies")
    one.add_argument(
        "--journal-limits", action="store_true", help="limit this PC's journal to 1 GB and a year, on disk"
    )
    one = commands.add_parser("machine", help="configuration and service of a machine")
    one.set_defaults(command=machine)
    one.add_argument("name")
    one.add_argument("--config", type=Path, help="becomes /etc/compensator/NAME/machine.toml, unless there is one")
    one.add_argument("--model", type=Path, action="append", default=[], help="model file to copy next to it")
    commands.add_parser("back", help="return to the previous version").set_defaults(command=back)
    one = commands.add_parser("uninstall", help="remove the program")
    one.set_defaults(command=uninstall)
    one.add_argument("--purge", action="store_true", help="remove configuration, recordings and user, too")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 1 failed."""
    given = _parser().parse_args(argv)
    # A script starts its background jobs with SIGINT ignored, and so would pip be started.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    os.umask(0o022)  # root's own may be narrower, and then the service could not read its program
    installation, system = Installation(given.prefix, given.destdir), System(touch=not given.destdir)
    try:
        if not given.destdir and os.geteuid() != 0:
            raise InstallError("only root can install; expected sudo, or --destdir")
        with installation.alone():
            given.command(given, installation, system)
    except (InstallError, OSError) as error:
        print(f"install.py: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("install.py: interrupted; the same command completes it", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
