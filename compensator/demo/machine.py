"""A simulated machine on simulated devices, one for each protocol, and its configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

from sim_hardware.physics import PublishedQuill, QuillMachine, World
from sim_hardware.wire import (
    CapaNcdt,
    DconLine,
    Faults,
    IcpDas,
    ModbusRtuLine,
    ModbusTcpServer,
    Rack,
    Register,
    RegisterMap,
)

MACHINES = {"conduction": QuillMachine, "published": PublishedQuill}
POLL_INTERVAL_S = 10.0
#: Devices answer in real time, while the day is simulated: a computer that is busy for a moment loses no reading.
TIMEOUT_S = 2.0
PROBE_RANGE_UM = 500.0
#: Standard deviation of one value of the touch probe, µm.
TOUCH_STD_UM = 1.5
TOUCH_PROBE = f"""
[probe]
std_um = {TOUCH_STD_UM}
measured_max_um = 60.0
largest_um = 40.0
oldest_min = 5.0
"""


class Hardware(NamedTuple):
    """A simulated machine's devices.

    Parameters
    ----------
    lines : dict
        Addresses of the lines by protocol.
    capa : CapaNcdt
        The displacement controller, whose stream the clock drives.
    faults : dict of str to (Faults, int)
        For each channel the faults of its device, and its input number.
    """

    lines: dict[str, Any]
    capa: CapaNcdt
    faults: dict[str, tuple[Faults, int]]


@contextmanager
def hardware(world: World) -> Iterator[Hardware]:
    """Connect the sensors of a simulated machine to simulated devices, one for each protocol.

    Yields
    ------
    Hardware
        The devices, until the block ends.
    """
    source = world.source
    with Rack() as rack:
        spindle = IcpDas("m-7018r", ranges="K", sources={0: source("t_q_degc")})
        cabinet = IcpDas("et-7018z", ranges="T", sources={0: source("at_degc")})
        rtu = rack.add(ModbusRtuLine({1: spindle}))
        tcp = rack.add(ModbusTcpServer({1: cabinet}))
        plc = rack.add(
            ModbusTcpServer(
                {
                    1: RegisterMap(
                        {
                            0: Register(source=source("spindle_rpm")),
                            1: Register(source=source("coolant_degc"), per_unit=100.0),
                        }
                    )
                }
            )
        )
        dcon = rack.add(DconLine({2: IcpDas("m-7018r", ranges="K", sources={0: source("base_degc")})}))
        capa = rack.add(CapaNcdt({1: lambda: PROBE_RANGE_UM / 2 + source("y_um")()}, PROBE_RANGE_UM))
        lines = {
            "rtu": rtu.port,
            "tcp": tcp.port,
            "plc": plc.port,
            "dcon": dcon.port,
            "data": capa.data_port,
            "command": capa.command_port,
        }
        faults = {"t_q": (spindle.faults, 0), "at": (cabinet.faults, 0), "y": (capa.faults, 1)}
        yield Hardware(lines, capa, faults)


def configuration(
    machine: str,
    lines: Mapping[str, Any],
    zenoh_port: int,
    model: str = "quill",
    *,
    prefix: str = "shop/sim",
    is_probed: bool = False,
) -> str:
    """Return the configuration of the simulated machine, with a touch probe instead of the displacement sensor."""
    sensor = {"line": "", "device": "", "channel": ""} if is_probed else displacement_sensor(lines)
    return f"""# Configuration of a simulated machine.
[machine]
name = "{machine}"

[model]
file = "{model}"

[sampling]
poll_interval_s = {POLL_INTERVAL_S}

[limits]
offset_max_um = 200.0
offset_rate_max_um_per_min = 8.0
[limits.validity]
t_q_degc = [10.0, 60.0]
at_degc = [12.0, 32.0]

[loss]
predict_for_min = 30.0

[zero]
rest_rate_um_per_min = 0.2

[guards]
t_q_below_at_max_k = 2.0
suspect_jumps = true
jump_min_k = 1.0

[zenoh]
prefix = "{prefix}"
mode = "peer"
listen = ["tcp/127.0.0.1:{zenoh_port}"]

[recording]
folder = "recordings"

[[line]]
name = "rs485"
protocol = "modbus-rtu"
port = "{lines["rtu"]}"
timeout_s = {TIMEOUT_S}
[[line]]
name = "cabinet"
protocol = "modbus-tcp"
host = "127.0.0.1"
tcp_port = {lines["tcp"]}
timeout_s = {TIMEOUT_S}
[[line]]
name = "plc"
protocol = "modbus-tcp"
host = "127.0.0.1"
tcp_port = {lines["plc"]}
timeout_s = {TIMEOUT_S}
[[line]]
name = "base-line"
protocol = "dcon"
port = "{lines["dcon"]}"
timeout_s = {TIMEOUT_S}
{sensor["line"]}
[[device]]
name = "spindle-thermocouples"
line = "rs485"
model = "icpdas-m7018r"
address = 1
format = "hex"
inputs = [{{ input = 0, couple = "K" }}]
[[device]]
name = "cabinet-thermocouples"
line = "cabinet"
model = "icpdas-et7018z"
address = 1
format = "hex"
inputs = [{{ input = 0, couple = "T" }}]
[[device]]
name = "control"
line = "plc"
model = "modbus-map"
address = 1
inputs = [
  {{ input = 0, unit = "rpm", function = 4, address = 0, type = "int16" }},
  {{ input = 1, unit = "degc", function = 4, address = 1, type = "int16", scale = 0.01 }},
]
[[device]]
name = "base-thermocouples"
line = "base-line"
model = "dcon"
address = 2
inputs = [{{ input = 0, couple = "K" }}]
{sensor["device"]}
[[channel]]
name = "t_q_degc"
device = "spindle-thermocouples"
input = 0
range = [0.0, 80.0]
rate_max_per_min = 5.0
stuck_after_min = 120.0
[[channel]]
name = "at_degc"
device = "cabinet-thermocouples"
input = 0
range = [5.0, 45.0]
rate_max_per_min = 2.0
stuck_after_min = 240.0
{sensor["channel"]}[[channel]]
name = "base_degc"
device = "base-thermocouples"
input = 0
[[channel]]
name = "spindle_rpm"
device = "control"
input = 0
[[channel]]
name = "coolant_degc"
device = "control"
input = 1
{TOUCH_PROBE if is_probed else ""}"""


def displacement_sensor(lines: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of the configuration for the displacement sensor."""
    return {
        "line": f"""[[line]]
name = "probe-line"
protocol = "capancdt"
host = "127.0.0.1"
data_port = {lines["data"]}
command_port = {lines["command"]}
timeout_s = {TIMEOUT_S}
""",
        "device": """[[device]]
name = "probe"
line = "probe-line"
model = "capancdt-6200"
inputs = [{ input = 0 }]
""",
        "channel": """[[channel]]
name = "y_um"
device = "probe"
input = 0
range = [10.0, 490.0]
rate_max_per_min = 30.0
stuck_after_min = 60.0
""",
    }
