"""`watch` as its users call it, on a service that runs on simulated hardware."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from compensator.cli import main
from compensator.clock import SystemClock
from compensator.commands.watch import _Watch
from compensator.demo.machine import configuration, hardware
from compensator.watch.listener import of_endpoints
from compensator.watch.shop import Shop
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.cli.test_adopt import Receiver, service
from tests.cli.test_commands import load_fast_model
from tests.ports import free_port
from tests.watch.heard import offset


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, int]]:
    """A service with a sample each second that has published four offsets; its configuration and port."""
    folder = tmp_path_factory.mktemp("watched")
    duty = Duty.working_day(1, hours=1)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    world.advance_to(1200.0)
    port = free_port()
    with hardware(world) as (lines, capa, _):
        fast = load_fast_model(folder)
        text = configuration("vmc-07", lines, port, fast.name).replace(
            "poll_interval_s = 10.0", "poll_interval_s = 0.25"
        )
        config = folder / "machine.toml"
        config.write_text(text, encoding="utf-8")
        ended = threading.Event()

        def stream() -> None:
            while not ended.wait(0.1):
                capa.push(1)

        thread = threading.Thread(target=stream)
        thread.start()
        try:
            with service(config):
                Receiver(port).until(lambda offsets: len(offsets) >= 4)
                yield config, port
        finally:
            ended.set()
            thread.join()


def test_one_look_as_json(running: tuple[Path, int], capsys: pytest.CaptureFixture[str]) -> None:
    config, port = running
    for arguments in (
        ["--config", str(config)],
        ["--connect", f"tcp/127.0.0.1:{port}", "--wait", "2.5"],
        ["--connect", f"tcp/127.0.0.1:{port}", "--prefix", "shop"],
    ):
        assert main(["watch", *arguments, "--json"]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        (machine,) = found["machines"]
        assert (machine["machine"], machine["prefix"], machine["alive"]) == ("vmc-07", "shop/sim", True)
        assert machine["shown"] in ("ok", "degraded") and machine["y_offset_um"] is not None
        assert 0.0 <= machine["age_s"] < 60.0 and found["headline"].startswith("1 machine: 1 ")
        if "--prefix" not in arguments:
            # From the recordings of the configuration, or from the samples that came meanwhile.
            assert machine["t_q_degc"] is not None and {share["name"] for share in machine["shares"]} >= {"DTF", "TDTF"}


def test_one_look_for_people(running: tuple[Path, int], capsys: pytest.CaptureFixture[str]) -> None:
    config, _ = running
    assert main(["watch", "--config", str(config), "--once"]) == 0
    out = capsys.readouterr().out
    assert "vmc-07" in out and "offset" in out and "residual" in out and "\x1b" not in out
    assert all(len(line) <= 80 for line in out.splitlines())


class Turns(threading.Event):
    """A stop that comes after some turns, without waiting."""

    turns = 20

    def wait(self, timeout: float | None = None) -> bool:
        self.turns -= 1
        return self.turns < 0


@pytest.mark.parametrize(
    ("connected", "received", "expected"),
    [
        (False, "", "no connection to tcp/127.0.0.1:1 yet; waiting"),
        (True, "", "no service is heard below shop at tcp/127.0.0.1:1; waiting"),
        (True, "alive", "the service has published nothing yet below shop at tcp/127.0.0.1:1; waiting"),
        (True, "offset", ""),
    ],
)
def test_a_pipe_that_receives_nothing_says_so_once(
    connected: bool, received: str, expected: str, caplog: pytest.LogCaptureFixture
) -> None:
    shop = Shop(SystemClock())
    shown = _Watch(shop, of_endpoints("shop", ["tcp/127.0.0.1:1"]), Turns())
    if connected:
        shown.connection(True)
    if received == "alive":
        shop.set_alive("shop/sim/thermal/alive", True)
    if received == "offset":
        shop.receive("shop/sim/thermal/y/offset", offset(1))
    caplog.clear()
    with caplog.at_level("INFO", logger="compensator"):
        shown.show(terminal=False, lines=True)
    assert [record.getMessage() for record in caplog.records] == ([f"compensator: {expected}"] if expected else [])


def watch(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "compensator", "watch", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_without_a_terminal_each_sample_is_a_line_and_ctrl_c_ends_well(
    running: tuple[Path, int], number: signal.Signals
) -> None:
    with watch("--connect", f"tcp/127.0.0.1:{running[1]}") as process:
        try:
            assert process.stdout is not None
            lines = [process.stdout.readline() for _ in range(2)]
            process.send_signal(number)
            assert process.wait(timeout=60) == 0
        finally:
            process.kill()
    assert all("shop/sim" in line and "µm" in line for line in lines) and lines[0] != lines[1]


def test_a_recording_of_the_shop_ends_whole(running: tuple[Path, int], tmp_path: Path) -> None:
    config, port = running
    receiver = Receiver(port)
    with watch("--config", str(config), "--prefix", "shop", "--record", str(tmp_path), "--json") as process:
        try:
            assert process.stderr is not None
            assert any("connected" in line for line in process.stderr)
            receiver.until(lambda offsets: len(offsets) >= 4)
            process.send_signal(signal.SIGINT)
            assert process.stdout is not None
            result = json.loads(process.stdout.read())
            assert process.wait(timeout=60) == 0
        finally:
            process.kill()
    (path,) = tmp_path.iterdir()
    assert result["files"] == [str(path)] and result["missed"] == {} and result["not_recorded"] == 0
    with path.open("rb") as file:
        recorded = {
            message.data
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
            if channel.topic == "/shop/sim/thermal/y/offset"
        }
    assert len(recorded) >= 2
    received = {offset["seq"]: offset for offset in receiver.offsets}
    both = [json.loads(data) for data in recorded if json.loads(data)["seq"] in received]
    assert both and all(received[offset["seq"]] == offset for offset in both)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "expected --config FILE, --zenoh FILE or --connect ENDPOINT"),
        (["--connect", "tcp/127.0.0.1:1", "--once"], "no answer at tcp/127.0.0.1:1"),
        (["--connect", "127.0.0.1:1", "--once"], "expected an endpoint"),
        (["--connect", "tcp/127.0.0.1:1", "--prefix", "shop/**"], "expected names"),
        (["--connect", "tcp/127.0.0.1:1", "--prefix", "a" * 201, "--once"], "of 200 characters at most"),
        (["--connect", "tcp/127.0.0.1:1", "--page", "--port", "99999999"], "--port 99999999"),
    ],
)
def test_wrong_usage_is_one_line(arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", *arguments]) in (1, 2)
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1


def test_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["watch", "--help"])
    assert ended.value.code == 0 and "example: compensator watch" in capsys.readouterr().out
