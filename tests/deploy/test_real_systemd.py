"""The installer and the service under a real systemd, from nothing to nothing; skipped where none can be started."""

from __future__ import annotations

import itertools
import json
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from compensator.cli import main
from compensator.demo.machine import configuration
from compensator.recording.reading import read_messages, recordings
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from sim_hardware.wire.icpdas import IcpDas
from sim_hardware.wire.modbus_servers import ModbusRtuLine
from sim_hardware.wire.rack import Rack
from tests.cli.test_adopt import LINES
from tests.cli.test_commands import load_fast_model
from tests.deploy.box import PACKAGES, Box, NoBoxError, python_of_the_system, wait

UNIT = "compensator@vmc-07.service"
STATE = "var/lib/compensator/vmc-07"
#: Of the test only: a watchdog of 5 s, no pause before the restart, pseudo-terminals in the place of serial ports.
DROP_IN = "[Service]\nWatchdogSec=5\nRestartSec=100ms\nDeviceAllow=char-pts rw\n"
RATE_MAX_UM_PER_MIN = 8.0


@pytest.fixture
def box(tmp_path: Path) -> Iterator[Box]:
    try:
        with Box(tmp_path) as made:
            yield made
    except NoBoxError as error:
        pytest.skip(f"no systemd of its own here: {error}")


@pytest.fixture
def couples() -> Iterator[str]:
    """Serial port of a module whose inputs 0 and 1 measure T_Q and AT of a machine at work."""
    duty = Duty.working_day(1, hours=1)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    world.advance_to(1200.0)
    sources = {0: world.source("t_q_degc"), 1: world.source("at_degc")}
    with Rack() as rack:
        port = rack.add(ModbusRtuLine({1: IcpDas("m-7018r", ranges="K", sources=sources)})).port
        device = Path(port).resolve()  # the service sees no /tmp of others
        shutil.chown(device, "root", "dialout")
        device.chmod(0o660)
        yield str(device)


def machine_toml(port: str, model: str) -> str:
    """The usual configuration, with one module on one serial line."""
    head = configuration("vmc-07", LINES, 7447, model).split("[[line]]")[0]
    head = head.replace("poll_interval_s = 10.0", "poll_interval_s = 0.25")
    head = head.replace('folder = "recordings"', 'folder = "/var/lib/compensator/vmc-07/recordings"')
    channels = "".join(
        f'[[channel]]\nname = "{name}"\ndevice = "couples"\ninput = {i}\nrange = [0.0, 80.0]\nrate_max_per_min = 5.0\n'
        f"stuck_after_min = 120.0\n"
        for i, name in enumerate(("t_q_degc", "at_degc"))
    )
    return (
        head
        + f"""[[line]]
name = "rs485"
protocol = "modbus-rtu"
port = "{port}"
[[device]]
name = "couples"
line = "rs485"
model = "icpdas-m7018r"
address = 1
format = "hex"
couple = "K"
inputs = [{{ input = 0 }}, {{ input = 1 }}]
{channels}"""
    )


def published(folder: Path) -> list[dict[str, Any]]:
    """Everything that was published, from the recordings."""
    found = [json.loads(r.data) for path in recordings(folder, "vmc-07") for r in read_messages(path, ("offset",))]
    return sorted(found, key=lambda offset: offset["seq"])


@pytest.mark.timeout(900)  # a virtual environment and a dozen starts, on a PC that has other work
def test_installed_killed_stuck_stopped_and_removed(
    box: Box, couples: str, wheel: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        python = python_of_the_system()
    except NoBoxError as error:
        pytest.skip(str(error))
    repository = Path(__file__).parents[2]

    def installer(*words: str, check: bool = True) -> str:
        return box.run(python, str(repository / "deploy/install.py"), *words, check=check)

    def compensates(restarts: int = 0) -> int:
        """Wait until it does, after so many restarts at least; a slow PC may have made the watchdog add some."""
        wait(
            lambda: int(box.show(UNIT, "NRestarts")) >= restarts and "Y offset" in box.show(UNIT, "StatusText"),
            explain=lambda: box.run("systemctl", "status", "--no-pager", "--full", "--lines=40", UNIT, check=False),
        )
        return int(box.show(UNIT, "NRestarts"))

    installer("install", "--wheel", str(wheel), "--no-deps")
    version = box.root / "opt/compensator/current"
    site = next((box.root / "opt/compensator/versions").glob("*/lib/python3*/site-packages"))
    (site / "packages.pth").write_text(PACKAGES + "\n")
    assert version.is_symlink()
    drop_in = box.root / f"etc/systemd/system/{UNIT}.d"
    drop_in.mkdir(parents=True)
    (drop_in / "test.conf").write_text(DROP_IN)
    model = load_fast_model(tmp_path)
    (tmp_path / "machine.toml").write_text(machine_toml(couples, model.name), encoding="utf-8")

    # `enable --now` comes back when the service is ready, that is after its first poll.
    installer("machine", "vmc-07", "--config", str(tmp_path / "machine.toml"), "--model", str(model))
    assert box.show(UNIT, "ActiveState") == "active"
    assert "compensator" in box.run("ps", "-o", "user:20=", "-p", box.show(UNIT, "MainPID"))
    folder = box.root / STATE / "recordings"
    before = compensates()
    for words in ("explain hold", "demo --help", "check --config /etc/compensator/vmc-07/machine.toml"):
        box.run("/usr/local/bin/compensator", *words.split())  # as the wheel alone makes them

    # Sampling stands still: the watchdog ends the service and it is back by itself.
    box.kill(UNIT, signal.SIGSTOP)
    before = compensates(before + 1)
    log = box.run("journalctl", "--unit", UNIT, "--output", "cat")
    # And with it the line where each thread stood, whatever the main one was about.
    for expected in ("Watchdog timeout", "(most recent call first)", 'File "'):
        assert expected in log, log
    box.kill(UNIT, signal.SIGKILL)
    compensates(before + 1)

    # A second time, as an upgrade: nothing is built anew, a running service is restarted and becomes ready.
    said = installer("install", "--wheel", str(wheel), "--no-deps")
    assert "installed already" in said and f"restarted {UNIT}" in said
    compensates()

    # The journal's fields.
    lines = box.run("journalctl", "MACHINE=vmc-07", "KIND=state", "--output", "json").splitlines()
    assert lines and {"STATE", "SEQ", "REASONS"} <= set(json.loads(lines[-1]))
    assert json.loads(lines[-1])["_SYSTEMD_UNIT"] == UNIT

    box.run("systemctl", "stop", UNIT)
    assert box.show(UNIT, "ActiveState") == "inactive" and box.show(UNIT, "Result") == "success"
    assert recordings(folder, "vmc-07")[-1].read_bytes().endswith(b"\x89MCAP0\r\n")
    offsets = published(folder)
    assert all(b["seq"] > a["seq"] for a, b in itertools.pairwise(offsets))
    good = [o for o in offsets if o["y_offset_um"] is not None]
    assert len(good) >= len(offsets) - 5 and "cold_start" not in {r for o in offsets for r in o["reasons"]}
    for a, b in itertools.pairwise(good):
        minutes = max(b["time_utc_ns"] - a["time_utc_ns"], 1_000_000_000) / 60e9
        assert abs(b["y_offset_um"] - a["y_offset_um"]) <= RATE_MAX_UM_PER_MIN * minutes + 1e-9
    copied = tmp_path / "recordings"
    shutil.copytree(folder, copied)
    assert main(["replay", str(copied)]) == 0
    capsys.readouterr()

    installer("uninstall")
    assert not (box.root / "opt/compensator").exists()
    assert "not-found" in box.show(UNIT, "LoadState")
    assert (box.root / "etc/compensator/vmc-07/machine.toml").exists() and published(folder) == offsets
    installer("uninstall", "--purge")
    assert not (box.root / STATE).exists() and not (box.root / "etc/compensator").exists()
