"""A machine to try things on: its day is on record, its sensors break by typing, a second one is refused."""

from __future__ import annotations

import asyncio
import io
import itertools
import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from compensator.cli import main
from compensator.clock import NS
from compensator.config import load_config
from compensator.demo.live import STUCK_AFTER_MIN, _noticing, _read_commands, apply_fault, run_live
from compensator.demo.machine import CapaNcdt, configuration, hardware
from compensator.messages import Offset
from compensator.recording.reading import read_messages, recordings
from compensator.service.composition import read_once
from compensator.service.loading import load
from compensator.service.publisher import Publisher
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from sim_hardware.wire import Faults
from tests.ports import free_port

QUILL = Path(__file__).parents[2] / "compensator/model/quill.toml"
#: How often a device is asked that must answer.
ATTEMPTS = 30


@contextmanager
def streaming(capa: CapaNcdt) -> Iterator[None]:
    """The probe sends what it measures, as it does while the clock of a service goes on."""
    ended = threading.Event()

    def stream() -> None:
        while not ended.wait(0.05):
            capa.push(1)

    thread = threading.Thread(target=stream)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def readings(config: Path) -> list[str]:
    """The qualities of T_Q, AT and Y as a service would read them now; what its device says where that fails."""
    setup = load(str(config))
    loaded, fleet = setup.loaded, setup.fleet
    answers = asyncio.run(read_once(fleet))
    found = []
    for channel in loaded.config.channel[:3]:
        answer = answers[channel.device]
        found.append(str(answer[channel.input].quality) if isinstance(answer, dict) else answer.code)
    return found


def readings_become(config: Path, expected: list[str]) -> list[str]:
    """The qualities; asked again only while a device that must answer has been late, on a busy computer."""
    for _ in range(ATTEMPTS):
        found = readings(config)
        if all(a == b or a != "device_timeout" for a, b in zip(found, expected, strict=True)):
            break
    return found


def test_typing_breaks_a_sensor_and_mends_it(tmp_path: Path) -> None:
    duty = Duty.working_day(1, hours=1)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    with hardware(world) as (lines, capa, faults), streaming(capa):
        config = tmp_path / "machine.toml"
        config.write_text(configuration("vmc-07", lines, 7447), encoding="utf-8")
        sound = ["good", "good", "good"]
        assert readings_become(config, sound) == sound
        for line, number, expected in (
            ("break t_q", 0, "open_circuit"),
            ("unplug at", 1, "device_timeout"),
            ("break y", 2, "over_range"),
            ("unplug y", 2, "device_disconnected"),
        ):
            assert apply_fault(line + "\n", faults).startswith(f"{line}: done")
            broken = [*sound[:number], expected, *sound[number + 1 :]]
            assert readings_become(config, broken) == broken
            assert apply_fault("mend\n", faults) == "all sensors repaired"
            assert readings_become(config, sound) == sound, line


def test_what_is_promised_of_a_frozen_value_is_what_is_configured(tmp_path: Path) -> None:
    faults = {name: (Faults(), 0) for name in STUCK_AFTER_MIN}
    duty = Duty.working_day(1, hours=1.0)
    with hardware(World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)) as devices:
        config = tmp_path / "machine.toml"
        config.write_text(_noticing(configuration("vmc-07", devices.lines, 7447)), encoding="utf-8")
    for channel, (name, minutes) in zip(("t_q_degc", "at_degc", "y_um"), STUCK_AFTER_MIN.items(), strict=True):
        (one,) = [c for c in load_config(config).config.channel if c.name == channel]
        assert one.stuck_after_min == minutes
        promised = float(apply_fault(f"freeze {name}", faults).split("within ")[1].split()[0])
        assert minutes < promised <= minutes + 2.0


def test_a_value_can_be_made_to_stand_still() -> None:
    faults = {"t_q": (Faults(), 0)}
    apply_fault("freeze t_q", faults)
    assert "frozen" in faults["t_q"][0].of_input(0)
    apply_fault("mend", faults)
    assert not faults["t_q"][0].of_input(0)


@pytest.mark.parametrize("line", ["break", "break oil", "smash t_q", "", "mend t_q", "unplug t_q now"])
def test_what_is_mistyped_is_answered_with_what_can_be_typed(line: str) -> None:
    faults = {name: (Faults(), 0) for name in ("t_q", "at", "y")}
    assert apply_fault(line, faults).endswith("expected one of break, freeze, unplug with one of t_q, at, y; or mend")
    assert not any(fault.of_input(0) for fault, _ in faults.values())


def test_messages_of_the_simulated_past_are_recorded_and_not_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A watch that listens meanwhile would take them for those of a service that has fallen silent."""
    calibrated = tmp_path / "conduction/calibration"
    calibrated.mkdir(parents=True)
    shutil.copy(QUILL, calibrated / "model.toml")
    ages_s: list[float] = []

    def publish(_: object, name: str, data: bytes) -> None:
        if name == "offset":
            ages_s.append((time.time_ns() - json.loads(data)["time_utc_ns"]) / NS)
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Publisher, "publish", publish)
    folder = run_live(tmp_path, hours=1.0, seed=1, port=free_port(), typed=io.StringIO())
    recorded = [record for path in recordings(folder, "vmc-07") for record in read_messages(path, ("offset",))]
    assert len(recorded) >= 58
    assert 1 <= len(ages_s) <= 3 and max(ages_s) < 150.0


def test_a_machine_runs_on_with_its_past_on_record(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """As its user starts it: an hour on record up to now, a sensor broken by typing, Ctrl-C; the audit is clean."""
    calibrated = tmp_path / "conduction/calibration"
    calibrated.mkdir(parents=True)
    shutil.copy(QUILL, calibrated / "model.toml")
    command = ["demo", "--live", "--hours", "1", "--out", str(tmp_path), "--port", str(free_port())]
    folder = tmp_path / "live/recordings"
    began_ns = time.time_ns()
    process = subprocess.Popen(
        [sys.executable, "-m", "compensator", *command, "--json"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdin is not None and process.stderr is not None
        assert any("Ctrl-C ends the demo" in line for line in process.stderr)
        process.stdin.write("break t_q\n")
        process.stdin.flush()
        assert any(line == "break t_q: done; visible within 2 minutes\n" for line in process.stderr)
        assert main(command) == 1, "a second one in the same folder is refused, and leaves alone what is there"
        assert "locked by another service of vmc-07" in capfd.readouterr().err
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=60)
        assert process.returncode == 0 and json.loads(said) == {"recordings": str(folder)}
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            pipe.close()
    offsets = [
        msgspec.json.decode(record.data, type=Offset)
        for path in recordings(folder, "vmc-07")
        for record in read_messages(path, ("offset",))
    ]
    assert 59 <= len(offsets) <= 62
    assert abs(offsets[-1].time_utc_ns - began_ns) < 300 * NS and offsets[-1].state in ("ok", "degraded")
    steps = {b.time_utc_ns - a.time_utc_ns for a, b in itertools.pairwise(offsets)}
    assert steps == {60 * NS}, "no gap where the past ends and real time begins"
    assert main(["replay", str(folder)]) == 0


class Endless(io.TextIOBase):
    """An input that never ends, as /dev/zero, and counts what is read of it."""

    def __init__(self, text: str) -> None:
        self.text, self.read_chars = text, 0

    def readline(self, size: int = -1) -> str:
        assert size > 0, "an endless line must not be read whole"
        self.read_chars += size
        assert self.read_chars < 10_000, "the input must not be read without an end"
        return self.text * size


class NoText(io.TextIOBase):
    def readline(self, size: int = -1) -> str:
        raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")


@pytest.mark.parametrize("typed", [Endless("\0"), Endless("x"), NoText()], ids=["zeros", "one line", "no text"])
def test_an_input_without_an_end_is_left_alone(typed: io.TextIOBase, capsys: pytest.CaptureFixture[str]) -> None:
    _read_commands(typed, {})
    assert capsys.readouterr().err == "The input is no text: typed commands are not read any more.\n"


def test_a_closed_input_is_no_error(capsys: pytest.CaptureFixture[str]) -> None:
    _read_commands(None, {})
    _read_commands(io.StringIO(""), {})
    _read_commands(io.StringIO("hello"), {})
    assert capsys.readouterr().err.startswith("'hello': expected one of break")
