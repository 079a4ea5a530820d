"""The wheel holds everything; the installer upgrades, goes back and removes without losing what is not its own."""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import resource
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.deploy.conftest import ROOT

PACKAGES = ("compensator", "drivers", "sim_hardware")
UNIT = "usr/local/lib/systemd/system/compensator@.service"


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("install", ROOT / "deploy/install.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


install = load()


# ---------------------------------------------------------------------------- the wheel


def test_the_wheel_holds_all_that_is_used_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
    here = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith(".")
    }
    data = f"{'-'.join(wheel.name.split('-')[:2])}.data/data/share/compensator/"
    shipped = {name.removeprefix(data) for name in names if name.startswith(data)}
    inside = {name for name in names if not name.startswith(data) and ".dist-info/" not in name}
    assert inside == here
    for folder in ("systemd", "zenoh", "receiver"):
        there = {path.name for path in (ROOT / "deploy" / folder).iterdir() if path.is_file()}
        assert {f"{folder}/{name}" for name in there} == {name for name in shipped if name.startswith(f"{folder}/")}
    assert {"install.py", "README.md", "OPERATING.md", "machine.example.toml"} <= shipped
    assert not [name for name in shipped if "__pycache__" in name or name.endswith(".pyc")]
    # What the installer puts into the system comes out of the wheel.
    assert set(install.SYSTEM_FILES | install.JOURNAL_LIMITS) <= shipped


# ---------------------------------------------------------------------------- the installer, below another root


class Pretended:
    """A system that is told in a test which services run and which of them do not start."""

    def __init__(self) -> None:
        self.units: list[str] = []
        self.broken: set[str] = set()
        self.version = lambda: ""
        self.log: list[str] = []

    def reload(self) -> None:
        self.log.append(f"reload {self.version()}")

    forget = disable = remove_user = check_python = lambda self: None

    def running(self) -> list[str]:
        return self.units

    def restarted(self, unit: str) -> bool:
        self.log.append(f"restart {unit} with {self.version()}")
        return self.version() not in self.broken

    def enable(self, unit: str) -> None:
        self.units.append(unit)

    def own(self, path: Path, mode: int) -> None:
        path.chmod(mode)


class Pc:
    """A PC's files below a folder, and versions whose program is a few lines of shell."""

    def __init__(self, folder: Path, prefix: str = "/opt/compensator") -> None:
        self.folder = folder / "pc"
        self.installation = install.Installation(prefix, str(self.folder))
        self.system = Pretended()
        self.system.version = lambda: getattr(self.installation.link("current"), "name", "none")

    def __truediv__(self, name: str) -> Path:
        return self.folder / name

    def version(self, name: str, *, unit: str = "", refuses: str = "") -> Path:
        """Make a version as `build` would; its `check` refuses configurations with a word in them."""
        version: Path = self.installation.root / "versions" / name
        (version / "bin").mkdir(parents=True)
        program = version / "bin/compensator"
        program.write_text(
            f'#!/bin/sh\nif [ -n "{refuses}" ] && grep -q "{refuses}" "$3"; then\n  echo "no {refuses}" >&2\n'
            "  exit 2\nfi\n"
        )
        program.chmod(0o755)
        (version / ".complete").touch()
        share = version / "share/compensator/systemd"
        share.mkdir(parents=True)
        for path in (ROOT / "deploy/systemd").iterdir():
            (share / path.name).write_bytes(path.read_bytes())
        if unit:
            (share / "compensator@.service").write_text(unit)
        return version

    def activate(self, version: Path, **options: Any) -> None:
        self.installation.activate(version, self.system, **options)

    def machine(self, text: str, folder: str = "/var/lib/compensator/vmc-07/recordings", name: str = "vmc-07") -> Path:
        source = self.folder / "given.toml"
        source.write_text(f'{text}\n[recording]\nfolder = "{folder}"\n')
        given = argparse.Namespace(name=name, config=source, model=[])
        install.machine(given, self.installation, self.system)
        return self.folder / "etc/compensator" / name / "machine.toml"

    def uninstall(self, *, purge: bool) -> None:
        install.uninstall(argparse.Namespace(purge=purge), self.installation, self.system)


@pytest.fixture
def pc(tmp_path: Path) -> Pc:
    return Pc(tmp_path)


def test_twice_is_as_once(pc: Pc) -> None:
    version = pc.version("1.0-aaaa")
    pc.activate(version)
    first = {path: path.read_bytes() for path in pc.folder.rglob("*") if path.is_file()}
    pc.activate(version)
    assert {path: path.read_bytes() for path in pc.folder.rglob("*") if path.is_file()} == first
    assert pc.installation.link("current") == version and pc.installation.link("previous") is None
    assert str((pc / "usr/local/bin/compensator").readlink()) == "/opt/compensator/current/bin/compensator"
    assert not (pc / "etc/systemd/journald.conf.d").exists()  # the PC's own journal only where it is asked for


def test_an_upgrade_keeps_the_version_before_and_back_returns_to_it(pc: Pc) -> None:
    old, new = pc.version("1.0-aaaa", unit="[Unit]\n# 1\n"), pc.version("1.1-bbbb", unit="[Unit]\n# 1.1\n")
    older = pc.version("0.9-0000")
    for version in (older, old, new):
        pc.activate(version)
    pc.installation.prune()
    assert pc.installation.link("current") == new and pc.installation.link("previous") == old and not older.exists()
    assert (pc / UNIT).read_text().endswith("# 1.1\n")
    install.back(argparse.Namespace(), pc.installation, pc.system)
    assert pc.installation.link("current") == old and pc.installation.link("previous") == new
    assert (pc / UNIT).read_text().endswith("# 1\n")


def test_an_upgrade_brings_the_extras_along(pc: Pc, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[str] = []

    def pretended(command: list[str]) -> str:
        if command[1:3] == ["-m", "venv"]:
            (Path(command[3]) / "share/compensator").mkdir(parents=True)
        else:
            asked.append(command[-1])
        return ""

    monkeypatch.setattr(install, "run", pretended)
    wheel = tmp_path / "quill_compensator-1.2.3-py3-none-any.whl"
    wheel.write_bytes(b"one")
    version = pc.installation.build(wheel, None, ["sign", "tls"], dependencies=True)
    assert asked == [f"{wheel}[sign,tls]"] and version.name.startswith("1.2.3-")
    pc.installation.point("current", version)
    assert pc.installation.extras() == ["sign", "tls"]
    assert pc.installation.build(wheel, None, ["sign", "tls"], dependencies=True) == version and len(asked) == 1
    # Another set is another environment.
    (wheels := tmp_path / "wheels").mkdir()
    made = [version, pc.installation.build(wheel, None, [], dependencies=True)]
    made.append(pc.installation.build(wheel, None, [], dependencies=False))
    for name in ("numpy-1.0-py3-none-any.whl", "numpy-1.1-py3-none-any.whl"):
        (wheels / name).touch()
        made += [pc.installation.build(wheel, wheels, [], dependencies=True) for _ in range(2)]
    assert len({*made}) == 5 and len(asked) == 5


def test_half_a_version_is_made_anew(pc: Pc, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    wheel = tmp_path / "quill_compensator-1.2.3-py3-none-any.whl"
    wheel.write_bytes(b"one")
    made: list[str] = []

    def broken(command: list[str]) -> str:
        if command[1:3] != ["-m", "venv"]:
            raise install.InstallError("no space left on device")
        made.append(command[3])
        (Path(command[3]) / "share/compensator").mkdir(parents=True)
        return ""

    monkeypatch.setattr(install, "run", broken)
    for _ in range(2):
        with pytest.raises(install.InstallError, match="no space left"):
            pc.installation.build(wheel, None, [], dependencies=True)
    assert len(made) == 2 and pc.installation.link("current") is None


def test_a_changed_unit_stays_and_the_new_one_lies_beside_it(pc: Pc, capsys: pytest.CaptureFixture[str]) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    (pc / UNIT).write_text("[Unit]\n# mine\n")
    pc.activate(pc.version("1.1-bbbb", unit="[Unit]\n# 1.1\n"))
    assert (pc / UNIT).read_text().endswith("# mine\n")
    assert (pc / (UNIT + ".new")).read_text().endswith("# 1.1\n")
    assert "was changed here and stays" in capsys.readouterr().out
    pc.uninstall(purge=False)
    assert (pc / UNIT).exists()


def test_nothing_is_switched_where_a_configuration_is_not_good_for_the_new_version(pc: Pc) -> None:
    old = pc.version("1.0-aaaa")
    pc.activate(pc.version("0.9-0000"))
    pc.activate(old)
    pc.machine("# an old key")
    pc.system.log.clear()
    with pytest.raises(install.InstallError, match=r"1\.1-bbbb cannot use .*machine\.toml: no old key"):
        pc.activate(pc.version("1.1-bbbb", unit="[Unit]\n", refuses="old key"))
    assert pc.installation.link("current") == old and pc.system.log == []
    assert (pc / UNIT).read_bytes() == (ROOT / "deploy/systemd/compensator@.service").read_bytes()


def test_a_service_that_does_not_start_gets_the_old_version_back(pc: Pc) -> None:
    old = pc.version("1.0-aaaa", unit="[Unit]\n# 1\n")
    pc.activate(old)
    pc.machine("")
    pc.system.broken = {"1.1-bbbb"}
    with pytest.raises(install.InstallError, match=r"did not start with 1\.1-bbbb; back to 1\.0-aaaa$"):
        pc.activate(pc.version("1.1-bbbb", unit="[Unit]\n# 1.1\n"))
    assert pc.system.log[-1] == "restart compensator@vmc-07.service with 1.0-aaaa"
    assert pc.installation.link("current") == old and (pc / UNIT).read_text().endswith("# 1\n")
    assert pc.installation.link("previous") is None  # the one that failed is none to go back to


def test_a_configuration_is_never_overwritten(pc: Pc) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    config = pc.machine("# first")
    assert config.stat().st_mode & 0o777 == 0o640 and config.parent.stat().st_mode & 0o777 == 0o750
    before = config.read_bytes()
    pc.machine("# second")
    assert config.read_bytes() == before
    assert b"# second" in config.with_name("machine.toml.new").read_bytes()


def test_another_model_of_the_same_name_is_a_failure_that_says_what_to_do(pc: Pc, tmp_path: Path) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    folder = pc.machine("").parent
    given = argparse.Namespace(name="vmc-07", config=None, model=[tmp_path / "a.toml", tmp_path / "b.toml"])
    for path in given.model:
        path.write_text("first\n")
    for _ in range(2):  # the same again is as once
        install.machine(given, pc.installation, pc.system)
    pc.system.units.clear()
    given.model[0].write_text("second\n")
    with pytest.raises(install.InstallError, match=r"vmc-07/a\.toml: not the one given: move a\.toml\.new over it"):
        install.machine(given, pc.installation, pc.system)
    assert pc.system.units == [] and (folder / "a.toml").read_text() == "first\n"
    (folder / "a.toml.new").replace(folder / "a.toml")
    install.machine(given, pc.installation, pc.system)
    assert (folder / "a.toml").read_text() == "second\n" and len(pc.system.units) == 1


@pytest.mark.parametrize(
    "folder", ["recordings", "/data", "/var/lib/compensator/other/recordings", "/var/lib/compensator/vmc-07/../other"]
)
def test_a_recording_that_the_service_could_not_write_is_refused(pc: Pc, folder: str) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    with pytest.raises(install.InstallError, match="expected a place below /var/lib/compensator/vmc-07/"):
        pc.machine("", folder)
    assert pc.system.units == []


def test_a_write_that_was_cut_off_is_made_good_by_the_same_command(pc: Pc) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    text = "# a line of a configuration\n" * 200
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    source = pc.folder / "given.toml"
    source.write_text(text + 'recording.folder = "/var/lib/compensator/vmc-07/recordings"\n')
    given = argparse.Namespace(name="vmc-07", config=source, model=[])
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            install.machine(given, pc.installation, pc.system)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    install.machine(given, pc.installation, pc.system)
    assert (pc / "etc/compensator/vmc-07/machine.toml").read_bytes() == source.read_bytes()


def test_the_configuration_of_another_machine_is_refused_and_not_copied(pc: Pc) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    with pytest.raises(install.InstallError, match=r"given\.toml: machine\.name = 'vmc-08', expected 'vmc-07'"):
        pc.machine('[machine]\nname = "vmc-08"')
    assert not (pc / "etc").exists() and pc.system.units == []
    pc.machine('[machine]\nname = "vmc-07"')
    assert pc.system.units == ["compensator@vmc-07.service"]


@pytest.mark.parametrize(
    ("table", "refused"),
    [
        ('[model]\nstore = "models"', "model.store = 'models', expected a place below /var/lib/compensator/vmc-07/"),
        ('[model]\nstore = "/var/lib/compensator/vmc-07/models"', None),
        ('recording.head = "vmc-07.head.json"', "recording.head = 'vmc-07.head.json', expected a place"),
        ('recording.head = "/var/lib/compensator/vmc-07/vmc-07.head.json"', None),
        ('recording.head = "/srv/heads/vmc-07.head.json"', None),
        *(
            (f'{key} = "{place}"', f"{key} = '{place}', expected a place")
            for key in ("recording.head", "model.store")
            for place in (
                "/etc/compensator",
                "/etc/compensator/../compensator/vmc-07/x",
                "/var/lib/compensator/vmc-08/x",
                "/var/lib/compensator/vmc-07/../x",
            )
        ),
    ],
)
def test_what_the_service_writes_is_where_it_may_write(pc: Pc, table: str, refused: str | None) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    source = pc.folder / "given.toml"
    source.write_text(f'recording.folder = "/var/lib/compensator/vmc-07/recordings"\n{table}\n')
    given = argparse.Namespace(name="vmc-07", config=source, model=[])
    if refused is None:
        install.machine(given, pc.installation, pc.system)
        return
    with pytest.raises(install.InstallError, match=re.escape(refused)):
        install.machine(given, pc.installation, pc.system)
    assert pc.system.units == []


@pytest.mark.parametrize("name", ["", ".", "..", "../../tmp/x", "vmc 07", "-x", "a/b", "x" * 65])
def test_a_name_that_is_no_folder_is_refused(pc: Pc, name: str) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    with pytest.raises(install.InstallError, match="expected letters, digits"):
        pc.machine("", name=name)
    assert not (pc / "etc").exists()


def test_a_configuration_may_begin_with_a_byte_order_mark(pc: Pc) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    assert pc.machine("\ufeff").read_bytes().startswith(b"\xef\xbb\xbf")


def test_removal_keeps_configuration_and_recordings_unless_told(pc: Pc) -> None:
    pc.activate(pc.version("1.0-aaaa"), journal_limits=True)
    config = pc.machine("")
    recording = pc / "var/lib/compensator/vmc-07/recordings/day.mcap"
    recording.parent.mkdir(parents=True)
    recording.touch()
    pc.uninstall(purge=False)
    left = {path.relative_to(pc.folder).as_posix() for path in pc.folder.rglob("*") if path.is_file()}
    assert left == {
        "given.toml",
        "etc/compensator/vmc-07/machine.toml",
        "var/lib/compensator/vmc-07/recordings/day.mcap",
    }
    pc.uninstall(purge=False)
    assert config.exists()
    pc.uninstall(purge=True)
    assert not config.exists() and not recording.exists()


def test_another_prefix_stands_in_the_unit(tmp_path: Path) -> None:
    pc = Pc(tmp_path, "/srv/compensator")
    pc.activate(pc.version("1.0-aaaa"))
    text = (pc / UNIT).read_text()
    assert "ExecStart=/srv/compensator/current/bin/compensator run" in text and "/opt/compensator" not in text


def test_the_newest_wheel_of_a_folder_is_taken_and_none_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for version in ("0.9.0", "0.10.0", "0.2.1"):
        (tmp_path / f"quill_compensator-{version}-py3-none-any.whl").touch()
    assert install.newest(tmp_path).name == "quill_compensator-0.10.0-py3-none-any.whl"
    (tmp_path / "empty").mkdir()
    arguments = ["--destdir", str(tmp_path / "pc"), "install", "--wheels", str(tmp_path / "empty")]
    assert install.main(arguments) == 1
    error = capsys.readouterr().err
    assert "no quill_compensator-*.whl" in error and error.count("\n") == 1


@pytest.mark.parametrize("wrong", ["device", "pipe", "large"])
def test_a_configuration_that_has_no_end_is_refused(pc: Pc, wrong: str, tmp_path: Path) -> None:
    pc.activate(pc.version("1.0-aaaa"))
    given = tmp_path / "given"
    if wrong == "device":
        given.symlink_to("/dev/zero")
    elif wrong == "pipe":
        os.mkfifo(given)
    else:
        given.write_bytes(bytes(1_000_001))
    with pytest.raises(install.InstallError, match=r"not a regular file|larger than 1000000 bytes"):
        install.machine(argparse.Namespace(name="vmc-07", config=given, model=[]), pc.installation, pc.system)
    assert pc.system.units == []


def test_a_second_installer_is_kept_out(pc: Pc) -> None:
    with (
        pc.installation.alone(),
        pytest.raises(install.InstallError, match="another installer is running"),
        pc.installation.alone(),
    ):
        pass
