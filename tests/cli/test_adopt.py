"""`adopt` and `back` as their users call them, and a service that is killed, on the real wire."""

from __future__ import annotations

import asyncio
import itertools
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from compensator.cli import main
from compensator.demo.machine import configuration, hardware
from compensator.recording.reading import read_messages, recordings
from compensator.service.loading import load
from compensator.service.presence import sole_user
from compensator.service.transfer.model_store import sha256_of
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.cli.test_commands import load_fast_model
from tests.ports import free_port
from tests.service.living import Machine

LINES = {"rtu": "/dev/ttyS90", "dcon": "/dev/ttyS91", "tcp": 1502, "plc": 1503, "data": 10001, "command": 10023}
PREFIX = "shop/sim"


def stronger(folder: Path, base: Path, change: float = 0.3) -> Path:
    effect = f'\n[[effect]]\nkind = "gain"\npath = "DTF"\nchange = {change}\n'
    path = folder / f"stronger-{change}.toml"
    path.write_text(base.read_text(encoding="utf-8") + effect, encoding="utf-8")
    return path


def test_a_service_that_runs_and_is_not_reached_keeps_its_model(
    idle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its loop may change the model meanwhile."""
    quill = Path(__file__).parents[2] / "compensator/model/quill.toml"
    before, other = in_use(idle, capsys), stronger(tmp_path, quill)
    with sole_user(load(str(idle)).recordings, "vmc-07"):
        for words in (["adopt", str(other)], ["back"]):
            assert main([*words, "--config", str(idle)]) == 1
            assert "a service of vmc-07 runs here and could not be reached" in capsys.readouterr().err
        assert in_use(idle, capsys) == before
        assert main(["adopt", str(other), "--config", str(idle), "--force"]) == 0
        capsys.readouterr()
    assert in_use(idle, capsys) == sha256_of(other.read_bytes())


def result(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def in_use(config: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["check", "--config", str(config), "--json"]) == 0
    return str(result(capsys)["model_sha256"])


@pytest.fixture
def idle(tmp_path: Path) -> Path:
    """A configuration whose service does not run."""
    config = tmp_path / "machine.toml"
    config.write_text(configuration("vmc-07", LINES, free_port()), encoding="utf-8")
    return config


def test_without_the_service_the_model_is_kept_for_its_next_start(
    idle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configured = in_use(idle, capsys)
    quill = Path(__file__).parents[2] / "compensator/model/quill.toml"
    first, second = stronger(tmp_path, quill, 0.3), stronger(tmp_path, quill, 0.4)
    before = idle.read_bytes()
    for model in (first, second):
        assert main(["adopt", str(model), "--config", str(idle), "--json"]) == 0
        answer = result(capsys)
        assert answer["service_reached"] is False and "could not be reached" in answer["text"]
        assert in_use(idle, capsys) == answer["model_sha256"] == sha256_of(model.read_bytes())
    assert idle.read_bytes() == before  # the configuration stays as it is
    assert main(["adopt", str(second), "--config", str(idle)]) == 1
    assert "already" in capsys.readouterr().err
    assert main(["back", "--config", str(idle)]) == 0
    assert "could not be reached" in capsys.readouterr().out
    assert in_use(idle, capsys) == sha256_of(first.read_bytes())
    assert main(["back", "--config", str(idle)]) == 0
    capsys.readouterr()
    assert in_use(idle, capsys) == configured
    assert main(["back", "--config", str(idle)]) == 1
    error = capsys.readouterr().err
    assert "no previous model" in error and error.count("\n") == 1


#: The channels of `tests.service.simulated` on devices that a configuration can name.
RECORDED = """
[[device]]
name = "probe"
line = "probe-line"
model = "capancdt-6200"
inputs = [{ input = 0 }]
""" + "".join(
    f"""
[[channel]]
name = "{name}"
device = "{device}"
input = 0
range = {span}
rate_max_per_min = 30.0
stuck_after_min = 90.0
"""
    for name, device, span in (
        ("t_q_degc", "spindle-thermocouples", [0.0, 80.0]),
        ("at_degc", "cabinet-thermocouples", [0.0, 50.0]),
        ("y_um", "probe", [-200.0, 200.0]),
    )
)


@pytest.fixture
def recorded(idle: Path) -> Path:
    """A configuration whose service does not run, and ten hours on record."""
    text = idle.read_text(encoding="utf-8")
    idle.write_text(text[: text.index('[[device]]\nname = "probe"')] + RECORDED, encoding="utf-8")
    machine = Machine(idle.parent)
    asyncio.run(machine.run(600))
    machine.recordings.rename(idle.parent / "recordings")
    return idle


def test_without_the_service_a_worse_model_is_refused_and_stored_only_by_force(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configured = in_use(recorded, capsys)
    model = stronger(tmp_path, Path(__file__).parents[2] / "compensator/model/quill.toml")
    assert main(["adopt", str(model), "--config", str(recorded)]) == 1
    error = capsys.readouterr().err
    assert "clearly worse: last" in error and "µm rms, this one" in error and "--force" in error
    assert error.count("\n") == 1 and in_use(recorded, capsys) == configured
    assert main(["adopt", str(model), "--config", str(recorded), "--json"]) == 1
    refused = result(capsys)
    assert not refused["ok"] and refused["comparison"]["verdict"] == "worse" and "clearly worse" in refused["text"]
    assert main(["adopt", str(model), "--config", str(recorded), "--force", "--json"]) == 0
    answer = result(capsys)
    assert answer["comparison"]["verdict"] == "worse" and answer["comparison"]["deviations"] < -10.0
    assert f"this one {answer['comparison']['candidate_rms_um']:.1f}" in answer["text"]
    assert in_use(recorded, capsys) == sha256_of(model.read_bytes())
    assert main(["back", "--config", str(recorded), "--json"]) == 0
    answer = result(capsys)
    assert answer["comparison"]["verdict"] == "better" and "the offset would move by" in answer["text"]
    assert in_use(recorded, capsys) == configured


def test_without_recordings_it_is_said_that_nothing_was_judged(
    idle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = stronger(tmp_path, Path(__file__).parents[2] / "compensator/model/quill.toml")
    assert main(["adopt", str(model), "--config", str(idle)]) == 0
    assert "no verdict" in capsys.readouterr().out


def test_an_adopted_model_that_was_damaged_is_said_and_the_configured_one_stands_in(
    idle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configured = in_use(idle, capsys)
    model = stronger(tmp_path, Path(__file__).parents[2] / "compensator/model/quill.toml")
    assert main(["adopt", str(model), "--config", str(idle)]) == 0
    store = next((tmp_path / "recordings" / "models").glob("*.toml"))
    store.write_bytes(b"damaged")
    capsys.readouterr()
    assert main(["check", "--config", str(idle), "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["model_sha256"] == configured
    assert "the configured one is used instead" in captured.err


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda text: "nonsense", "not a TOML file"),
        (lambda text: text.replace("sample_period_s = 60.0", "sample_period_s = 55.0"), "whole multiple"),
        (
            lambda text: (
                text + '\n[[effect]]\nkind = "input"\nchannel = "oil_degc"\ncurve = "linear"\n'
                "tau_min = [5.0]\ngain = [1.0]\ndelay_min = 0.0\n"
            ),
            "oil_degc",
        ),
    ],
)
def test_a_model_that_the_service_cannot_run_is_never_kept(
    idle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Any, expected: str
) -> None:
    quill = (Path(__file__).parents[2] / "compensator/model/quill.toml").read_text(encoding="utf-8")
    bad = tmp_path / "bad.toml"
    bad.write_text(change(quill), encoding="utf-8")
    assert main(["adopt", str(bad), "--config", str(idle)]) == 2
    error = capsys.readouterr().err
    assert expected in error and "bad.toml" in error and error.count("\n") == 1
    assert not (tmp_path / "recordings").exists()


def test_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("adopt", "back"):
        with pytest.raises(SystemExit) as ended:
            main([command, "--help"])
        assert ended.value.code == 0
        assert f"example: compensator {command}" in capsys.readouterr().out


@contextmanager
def service(config: Path) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "compensator", "run", "--config", str(config)], stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        assert any("running" in line for line in process.stderr)
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stderr is not None
        process.stderr.close()


class Receiver:
    """A control: receives offsets as a program apart from the project would."""

    def __init__(self, port: int) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        self._config = config
        self.offsets: list[dict[str, Any]] = []

    def until(self, done: Any) -> None:
        with zenoh.open(self._config) as session:
            subscriber = session.declare_subscriber(f"{PREFIX}/thermal/y/offset")
            while not self.offsets or not done(self.offsets):
                self.offsets.append(json.loads(subscriber.recv().payload.to_bytes()))


def test_killed_restarted_and_given_another_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """kill -9, restart, adopt, SIGTERM, restart: numbers go on, nothing jumps, the model stays, all is on disk."""
    duty = Duty.working_day(1, hours=1)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    world.advance_to(1200.0)
    port = free_port()
    with hardware(world) as (lines, _capa, _):
        fast = load_fast_model(tmp_path)
        text = configuration("vmc-07", lines, port).replace('file = "quill"', f'file = "{fast.name}"')
        config = tmp_path / "machine.toml"
        config.write_text(text.replace("poll_interval_s = 10.0", "poll_interval_s = 0.25"), encoding="utf-8")
        model = stronger(tmp_path, fast)
        new = sha256_of(model.read_bytes())
        receiver = Receiver(port)
        with service(config) as process:
            receiver.until(lambda offsets: sum(o["y_offset_um"] is not None for o in offsets) >= 4)
            process.kill()
            process.wait()
        killed = len(receiver.offsets)
        with service(config) as process:
            receiver.until(lambda offsets: len(offsets) >= killed + 3)
            assert main(["adopt", str(model), "--config", str(config), "--json"]) == 0
            answer = result(capsys)
            assert answer["service_reached"] and answer["model_sha256"] == new and answer["state_known"]
            assert answer["comparison"]["verdict"] == "not_judged" and "no verdict: " in answer["text"]
            receiver.until(lambda offsets: offsets[-1]["model_sha256"] == new)
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=20) == 0
        ended = len(receiver.offsets)
        with service(config) as process:
            receiver.until(lambda offsets: len(offsets) >= ended + 2)
            assert receiver.offsets[-1]["model_sha256"] == new
            assert main(["back", "--config", str(config), "--json"]) == 0
            assert result(capsys)["service_reached"]
            receiver.until(lambda offsets: offsets[-1]["model_sha256"] != new)
    offsets = receiver.offsets
    assert offsets[-1]["model_sha256"] == sha256_of(fast.read_bytes())
    seqs = [o["seq"] for o in offsets]
    assert all(b > a for a, b in itertools.pairwise(seqs))
    values = [(o["time_utc_ns"], o["y_offset_um"]) for o in offsets if o["y_offset_um"] is not None]
    first = next(i for i, o in enumerate(offsets) if o["y_offset_um"] is not None)
    assert all(o["y_offset_um"] is not None for o in offsets[first:])  # also right after a start
    for (t0, a), (t1, b) in itertools.pairwise(values):
        assert abs(b - a) <= 8.0 / 60.0 * max((t1 - t0) / 1e9, 1.0) + 1e-9
    logged = {
        json.loads(r.data)["seq"]
        for path in recordings(tmp_path / "recordings", "vmc-07")
        for r in read_messages(path, ("offset",))
    }
    assert set(seqs) <= logged
    references = {
        json.loads(r.data)["t_q_ref_degc"]
        for path in recordings(tmp_path / "recordings", "vmc-07")
        for r in read_messages(path, ("estimate",))
    }
    assert len(references - {None}) == 1  # one zero, across kill, stop and models


def test_a_candidate_or_a_file_and_only_a_running_service_has_a_candidate(
    idle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for given in (["adopt"], ["adopt", "quill", "--candidate"]):
        assert main([*given, "--config", str(idle)]) == 2
        assert "either MODEL, or --candidate" in capsys.readouterr().err
    for given in (["adopt", "--candidate"], ["dismiss"]):
        assert main([*given, "--config", str(idle), "--timeout", "1"]) == 1
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and "Traceback" not in error
