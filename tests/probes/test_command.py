"""`compensator bridge probes` as a process: real Zenoh, a folder, TCP and a pseudo-terminal, losses, the end."""

from __future__ import annotations

import datetime
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sim_hardware.wire import PrintingControl, Rack
from tests.ports import free_port
from tests.probes.test_printed import MACRO, VARIABLES
from tests.receiver.wire import ScriptedService, router, until

FILE = """
[probes]
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:{port}"]
send_within_s = 900.0
state_file = "state.json"
retry_s = 0.2
timeout_s = 2.0
[[folder]]
path = "."
sign = 1
sign_checked = "simulated"
poll_s = 0.05
[[dprnt]]
address = "{tcp}"
sign = -1
sign_checked = "simulated"
settle_s = 0.05
retry_s = 0.1
[[dprnt]]
port = "{tty}"
bits = "7E"
sign = -1
sign_checked = "simulated"
settle_s = 0.05
retry_s = 0.1
"""


@contextmanager
def bridge(path: Path, lines: list[str]) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "compensator", "bridge", "probes", "--config", str(path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        reader = threading.Thread(target=lambda stream: lines.extend(iter(stream.readline, "")), args=(process.stderr,))
        reader.start()
        try:
            yield process
        finally:
            process.kill()
            reader.join()


def line(seconds_ago: float, measured_um: float) -> str:
    at = datetime.datetime.now(datetime.UTC) - datetime.timedelta(seconds=seconds_ago)
    return f"{at.isoformat()},{measured_um},-12.3,sphere-1\n"


def test_all_sources_to_the_service_over_losses_and_a_restart(tmp_path: Path) -> None:
    port, lines = free_port(), []  # type: tuple[int, list[str]]
    table = tmp_path / "a.csv"
    first, second, third = line(30.0, 1.0), line(20.0, 2.0), line(10.0, 3.0)
    with Rack() as rack:
        tcp = rack.add(PrintingControl("haas"))
        tty = rack.add(PrintingControl("fanuc", serial=True, parity=True))
        path = tmp_path / "probes.toml"
        path.write_text(FILE.format(port=port, tcp=tcp.address, tty=tty.address))
        table.write_text(f"time_utc,measured_um,offset_applied_um,feature\n{first}")
        with bridge(path, lines) as process:
            until(lambda: sum(": connected" in one for one in lines) == 2, lambda: "".join(lines))
            until(lambda: any("retrying" in one for one in lines), "no service yet")
            until(lambda: tcp.clients == 1, "the control's client")
            settle = threading.Event()
            settle.wait(0.3)  # what arrives before the line was quiet for settle_s would be refused
            tcp.run_macro(MACRO, VARIABLES)
            tty.run_macro(MACRO, VARIABLES | {101: -4.0, 102: 4.0})
            with router(port), ScriptedService(port) as service:
                until(lambda: len(service.probes) == 3, lambda: "".join(lines))
                assert sorted(probe["measured_um"] for probe in service.probes) == [-3.2, 1.0, 4.0]
                with table.open("a") as file:
                    file.write(second)
                until(lambda: len(service.probes) == 4, lambda: "".join(lines))
                process.send_signal(signal.SIGTERM)
                assert process.wait(timeout=30) == 0
                with table.open("a") as file:
                    file.write(third)
                with bridge(path, lines):
                    until(lambda: len(service.probes) == 5, lambda: "".join(lines))
                assert [probe["measured_um"] for probe in service.probes][3:] == [2.0, 3.0]
                stamps = [datetime.datetime.fromisoformat(text.partition(",")[0]) for text in (first, second, third)]
                sent = [p["time_utc_ns"] for p in service.probes if p["feature"] == "sphere-1"]
                assert sent == [round(stamp.timestamp() * 1e6) * 1000 for stamp in stamps]
    assert "compensator bridge: stopped\n" in lines and "Traceback" not in "".join(lines)
