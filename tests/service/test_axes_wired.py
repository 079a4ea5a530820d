"""Several axes over the real protocols: the service from its configuration, its keys, its recordings, its check."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from compensator.audit.machine_audit import audit
from compensator.cli import main
from compensator.clock import VirtualClock
from compensator.config import Zenoh
from compensator.demo.machine import configuration, hardware
from compensator.recording.reading import recordings
from compensator.service.composition import run_service
from compensator.service.loading import load
from compensator.service.publisher import Publisher
from compensator.service.session import session_config
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.ports import free_port
from tests.service.several import AXES, SLOPE, TILT, model_text
from tests.service.simulated import START_NS

LIMITS = "offset_max_um = 200.0\noffset_rate_max_um_per_min = 8.0\n"


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[tuple[Path, VirtualClock]]:
    """A configuration of several axes for simulated devices, whose X and Z nothing measures."""
    duty = Duty.working_day(1, hours=2.0)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    with hardware(world) as (lines, capa, _):

        async def advance(t_s: float) -> None:
            world.advance_to(t_s)
            capa.push(1)

        model = tmp_path / "model.toml"
        model.write_bytes(model_text("y", "x", "z", "low", "high", "y_slope"))
        text = configuration("vmc-07", lines, free_port(), str(model))
        assert LIMITS in text
        path = tmp_path / "machine.toml"
        path.write_text(text.replace(LIMITS, "") + AXES + TILT + SLOPE, encoding="utf-8")
        yield path, VirtualClock(START_NS, advance)


def test_a_service_of_several_axes_from_its_file(machine: tuple[Path, VirtualClock]) -> None:
    path, clock = machine
    published: list[str] = []
    setup = load(str(path))
    asyncio.run(run_service(setup, clock=clock, samples=4, on_publish=lambda name, data: published.append(name)))
    for name in ("x_offset", "z_offset", "a_offset", "offset"):
        assert published.count(name) == 4
    assert audit(recordings(setup.recordings, "vmc-07")).clean
    asyncio.run(run_service(load(str(path)), clock=clock, samples=1))
    assert audit(recordings(setup.recordings, "vmc-07")).samples == 5


def test_an_error_of_a_listener_to_messages_ends_neither_a_sample_nor_an_event(
    machine: tuple[Path, VirtualClock], caplog: pytest.LogCaptureFixture
) -> None:
    path, clock = machine
    setup = load(str(path))

    def fails(name: str, data: bytes) -> None:
        raise KeyError(name)

    asyncio.run(run_service(setup, clock=clock, samples=2, on_publish=fails))
    audited = audit(recordings(setup.recordings, "vmc-07"))
    assert audited.clean and audited.samples == 2
    assert "internal error of a listener to published messages" in caplog.text


def test_the_check_names_the_axes_and_what_the_model_has_beyond(
    machine: tuple[Path, VirtualClock], capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = machine
    assert main(["check", "--config", str(path)]) == 0
    assert "axes: x, y, z, a\nof Y alone: probes, and the checks of measured" in capsys.readouterr().out
    plain = path.read_text(encoding="utf-8")
    path.write_text(plain.replace("[axis.z]", "[axis.z]\nsign = -1"), encoding="utf-8")
    assert main(["check", "--config", str(path)]) == 0
    assert "axes: x, y, z, a; sign = -1 of z: the published offset is turned, so no rec" in capsys.readouterr().out
    path.write_text(plain, encoding="utf-8")
    path.write_text(path.read_text(encoding="utf-8").replace(TILT, ""), encoding="utf-8")
    assert main(["check", "--config", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["axes"], found["unused_parts"]) == (["x", "y", "z"], ["low", "high"])
    path.write_text(path.read_text(encoding="utf-8").replace("[axis.z]", '[axis.z]\npart = "w"'), encoding="utf-8")
    assert main(["check", "--config", str(path)]) == 2
    (error,) = capsys.readouterr().err.strip().splitlines()
    assert "axis z: no part axis.w in the model" in error


def test_the_check_of_y_alone_names_what_the_model_has_beyond(
    machine: tuple[Path, VirtualClock], capsys: pytest.CaptureFixture[str]
) -> None:
    """Who calibrates X, Y and Z and forgets the tables would wait for offsets that never come."""
    path, _ = machine
    text = path.read_text(encoding="utf-8").replace(AXES + TILT + SLOPE, "")
    path.write_text(text.replace("[limits]\n", f"[limits]\n{LIMITS}"), encoding="utf-8")
    assert main(["check", "--config", str(path)]) == 0
    said = capsys.readouterr().out
    assert "axes: y; the model also has x, z, low, high, y_slope, for which there is no table" in said
    assert "of Y alone" not in said


def test_each_axis_has_its_key_and_answers_with_its_latest() -> None:
    settings = Zenoh(prefix="shop/vmc-07", listen=[f"tcp/127.0.0.1:{free_port()}"])
    client = Zenoh(prefix="shop/vmc-07", mode="client", connect=settings.listen)
    with (
        Publisher(settings, lambda *_: {}, ("x", "y", "z", "a")) as service,
        zenoh.open(session_config(client)) as session,
    ):
        for name, axis in (("x_offset", "x"), ("offset", "y"), ("z_offset", "z"), ("a_offset", "a")):
            service.publish(name, json.dumps({"axis": axis}).encode())
        found: dict[str, str] = {}
        ends = time.monotonic() + 30.0
        while len(found) < 4 and time.monotonic() < ends:
            for answer in session.get("shop/vmc-07/thermal/*/offset"):
                if answer.ok is not None:
                    found[str(answer.ok.key_expr)] = json.loads(answer.ok.payload.to_bytes())["axis"]
        assert found == {f"shop/vmc-07/thermal/{axis}/offset": axis for axis in "xyza"}


def test_a_machine_with_y_alone_answers_for_no_other_axis() -> None:
    settings = Zenoh(prefix="shop/vmc-07", listen=[f"tcp/127.0.0.1:{free_port()}"])
    assert "z_offset" not in Publisher(settings, lambda *_: {})._keys
