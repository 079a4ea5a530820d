"""Unit, user, folders and device names, judged by systemd's own tools where they are installed."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.deploy.conftest import ROOT

SYSTEMD = ROOT / "deploy/systemd"
UNIT = "compensator@.service"


def tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed here")
    return found


def settings() -> dict[str, list[str]]:
    lines = [line for line in (SYSTEMD / UNIT).read_text().splitlines() if "=" in line and not line.startswith("#")]
    found: dict[str, list[str]] = {}
    for line in lines:
        key, _, value = line.partition("=")
        found.setdefault(key, []).append(value)
    return found


@pytest.fixture(params=[UNIT, "compensator-router.service"])
def unit(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A unit with a program that exists here."""
    path = tmp_path / str(request.param)
    text = (SYSTEMD / path.name).read_text()
    assert "ExecStart=/opt/compensator/current/bin/compensator r" in text
    path.write_text(text.replace("/opt/compensator/current/bin/compensator", "/bin/true"))
    return path


def test_systemd_finds_nothing_to_complain_about(unit: Path) -> None:
    instance = unit.with_name(unit.name.replace("@", "@vmc-07"))
    command = [tool("systemd-analyze"), "verify", "--man=no", str(instance)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    # Of other units on this PC it may say what it likes.
    said = [line for line in (done.stdout + done.stderr).splitlines() if "compensator" in line]
    assert said == []


def test_exposure_is_small(unit: Path) -> None:
    command = [tool("systemd-analyze"), "security", "--offline=true", "--no-pager", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    level = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert level is not None, done.stdout + done.stderr
    assert float(level.group(1)) <= 1.5


def test_a_machine_is_never_left_without_service() -> None:
    found = settings()
    assert found["Restart"] == ["always"] and found["StartLimitIntervalSec"] == ["0"]
    assert "RestartPreventExitStatus" not in found and "StartLimitBurst" not in found
    assert found["Type"] == ["notify"] and found["NotifyAccess"] == ["main"]


def test_what_a_kill_must_leave_in_memory_is_left() -> None:
    """With `RemoveIPC` systemd takes the note of the last offset out of /dev/shm between two starts."""
    found = settings()
    assert found["RemoveIPC"] == ["no"] and "PrivateDevices" not in found


def test_a_restart_by_the_watchdog_ends_before_the_offset_becomes_invalid() -> None:
    """Stuck just after a sample: watchdog, abort, restart, start, and a whole sample again within 150 s."""
    found = {key: float(settings()[key][0]) for key in ("WatchdogSec", "TimeoutAbortSec", "RestartSec")}
    assert sum(found.values()) + 20.0 + 60.0 <= 150.0
    assert float(settings()["TimeoutStartSec"][0]) > 60.0 + 20.0  # the first poll may be a minute away
    assert float(settings()["TimeoutStopSec"][0]) >= 60.0 + 20.0  # and so may the last


def test_the_user_and_its_folders_are_made(tmp_path: Path) -> None:
    for folder in ("etc", "var/lib", "var/log", "usr/lib/sysusers.d"):
        (tmp_path / folder).mkdir(parents=True)
    command = [tool("systemd-sysusers"), f"--root={tmp_path}", str(SYSTEMD / "compensator.sysusers.conf")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    user = next(line for line in (tmp_path / "etc/passwd").read_text().splitlines() if line.startswith("compensator:"))
    assert user.endswith("/var/lib/compensator:/usr/sbin/nologin")
    assert re.search(r"^dialout:.*:compensator$", (tmp_path / "etc/group").read_text(), re.MULTILINE)
    command = [tool("systemd-tmpfiles"), f"--root={tmp_path}", "--create", str(SYSTEMD / "compensator.tmpfiles.conf")]
    assert subprocess.run(command, capture_output=True, text=True, check=False).returncode == 0
    assert all((tmp_path / name / "compensator").is_dir() for name in ("etc", "var/lib", "var/log"))


def test_rules_for_device_names_are_well_formed() -> None:
    lines = (SYSTEMD / "70-compensator.rules").read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    labels = {line.split('"')[1] for line in rules if line.startswith("LABEL")}
    for rule in rules:
        for part in rule.split(", "):
            assert re.fullmatch(r'[A-Z_]+(\{[A-Za-z_]+\})?(==|!=|=|\+=)"[^"]*"', part), rule
        jump = re.search(r'GOTO="(\w+)"', rule)
        assert jump is None or jump.group(1) in labels
    text = "\n".join(rules)
    # Two adapters of one kind must not share a name: by serial number, or else by the socket.
    assert 'SYMLINK+="compensator/$env{ID_SERIAL_SHORT}"' in text
    assert 'SYMLINK+="compensator/port-$env{ID_PATH_TAG}"' in text


def test_the_example_configuration_is_good(capsys: pytest.CaptureFixture[str]) -> None:
    from compensator.cli import main

    assert main(["check", "--config", str(ROOT / "deploy/machine.example.toml")]) == 0
    assert "Nothing was opened" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("", None),
        ("[loop]\n", "\nloop: off (loop.policy)\n"),
        (
            '[loop]\npolicy = "propose"\nat_utc = "03:30"\n',
            "\nloop: propose, a diagnosis at 03:30 UTC and every 6 h\n",
        ),
    ],
)
def test_the_check_says_whether_the_service_looks_for_better_models(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: str, said: str | None
) -> None:
    from compensator.cli import main

    path = tmp_path / "machine.toml"
    path.write_text((ROOT / "deploy/machine.example.toml").read_text(encoding="utf-8") + table, encoding="utf-8")
    assert main(["check", "--config", str(path)]) == 0
    found = capsys.readouterr().out
    assert said in found if said else "loop" not in found
