"""From a printed line to the service's verdict: the real service, a receiver, the bridge, and a control by geometry."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import zenoh

from compensator.demo.machine import configuration, hardware
from compensator.receiver import Receiver
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from sim_hardware.wire import PrintingControl, Rack
from tests.linuxcnc.control import changed
from tests.ports import free_port
from tests.probes.helpers import touch_um
from tests.probes.test_command import bridge
from tests.probes.test_page import MACROS
from tests.receiver.test_subscriber import settings
from tests.receiver.wire import until

PREFIX = "shop/vmc-07"
#: Without the time of day, whose second is as long as a sample here.
MACRO = MACROS["fanuc"].replace("*D#3011[80]*H#3012[60]", "")
#: The deformation of the machine, whatever the model says about it, µm.
DEFORMATION_UM = 6.0
FILE = """
[probes]
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:{port}"]
send_within_s = 900.0
applied_file = "applied.txt"
retry_s = 0.2
[[dprnt]]
address = "{control}"
sign = -1
sign_checked = "simulated"
settle_s = 0.05
delay_s = 0.1
"""


@contextmanager
def service(folder: Path, port: int) -> Iterator[None]:
    """A service on simulated devices with a sample a second, and `[probe]`."""
    duty = Duty.working_day(1, hours=2)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    world.advance_to(1850.0)
    with hardware(world) as (lines, _, _):
        quill = (Path(__file__).parents[2] / "compensator/model/quill.toml").read_text(encoding="utf-8")
        fast = changed(quill, {"sample_period_s = 60.0": "sample_period_s = 1.0"})
        (folder / "fast.toml").write_text(fast, encoding="utf-8")
        text = configuration("vmc-07", lines, port, model="fast.toml", prefix=PREFIX)
        text = changed(
            text, {"poll_interval_s = 10.0": "poll_interval_s = 0.25", "max_um_per_min = 8.0": "max_um_per_min = 600.0"}
        )
        text = re.sub(r"(?m)^rate_max_per_min = .*$", "rate_max_per_min = 10000.0", text)
        text += "[probe]\nstd_um = 1.0\nmeasured_max_um = 100.0\nlargest_um = 50.0\ntolerance_um = 2.0\n"
        (folder / "machine.toml").write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "compensator", "run", "--config", str(folder / "machine.toml")]
        with (folder / "service.log").open("wb") as log, subprocess.Popen(command, stderr=log) as process:
            try:
                yield
            finally:
                process.terminate()
                process.wait(timeout=60)


def test_a_printed_probe_corrects_the_offset(tmp_path: Path) -> None:
    port, seen, lines, ended = free_port(), [], [], threading.Event()  # type: tuple[int, list[Any], list[str], threading.Event]
    with ExitStack() as stack:
        stack.enter_context(service(tmp_path, port))
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        receiver = stack.enter_context(Receiver(settings(port, applied_file=str(tmp_path / "applied.txt"))))
        control = stack.enter_context(Rack()).add(PrintingControl("fanuc"))

        def follow() -> None:
            while not ended.wait(0.05):
                receiver.record(receiver.poll().offset_um)

        thread = threading.Thread(target=follow)
        thread.start()
        stack.callback(thread.join)
        stack.callback(ended.set)
        # None was taken since the zero, so one is wanted as soon as there is a value to probe.
        until(
            lambda: receiver.follower.alive and receiver.probe_wanted and receiver.probe_wanted.wanted,
            lambda: _log(tmp_path),
        )
        session = stack.enter_context(zenoh.open(config))
        session.declare_subscriber(
            f"{PREFIX}/thermal/event", lambda sample: seen.append(json.loads(sample.payload.to_bytes()))
        )
        path = tmp_path / "probes.toml"
        path.write_text(FILE.format(port=port, control=control.address))
        stack.enter_context(bridge(path, lines))
        until(lambda: control.clients == 1, "the bridge at the control")
        settled_s = time.monotonic() + 0.3  # the line must be quiet after connecting
        until(lambda: time.monotonic() > settled_s, "settle_s")
        reading = touch_um(y_um=DEFORMATION_UM, offset_um=receiver.follower.applied_um)
        control.run_macro(MACRO, {101: reading, 102: -reading, 9: 1.0, 20: 99.0})
        until(lambda: verdict(seen), lambda: "".join(lines) + str(seen) + _log(tmp_path))
        assert verdict(seen)["taken"], (verdict(seen), lines)
        assert verdict(seen)["feature"] == "1"
        # What is left at the tip is the deformation and the offset.
        until(
            lambda: abs(DEFORMATION_UM + receiver.follower.applied_um) < 1.5, lambda: receiver.poll().text + str(seen)
        )


def verdict(seen: list[Any]) -> dict[str, Any]:
    return next((event["data"] for event in list(seen) if event["kind"] == "probe"), {})


def _log(folder: Path) -> str:
    return (folder / "service.log").read_text(errors="replace")[-3000:]
