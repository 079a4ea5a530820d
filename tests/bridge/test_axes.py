"""Several axes and a PLC: all values move, or none; offset and slope are a pair for the control."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from compensator.bridge.axes_settings import OpcUaAxes, load_any_bridge
from compensator.bridge.opcua import AxesBridge
from compensator.bridge.register import AxesRegisters, AxisPlace
from compensator.cli import main
from compensator.errors import ConfigError
from compensator.receiver import AxesFollower, AxesReceiver, AxesSettings, ControlState
from compensator.receiver.applied_record import applied_at
from compensator.receiver.limits import Acceptance
from tests.bridge.plc import Plc
from tests.bridge.test_opcua import Clock, refused, until
from tests.fuzz.mutation import mutated
from tests.ports import free_port
from tests.receiver.limits import MAX_UM, plain, sloped
from tests.receiver.offsets import MACHINE, axis_offset, slope
from tests.receiver.wire import ScriptedService, router

CYCLE_S, RATE_UM_PER_S = 0.05, 100.0
FILE = """
[receiver]
machine = "vmc-07"
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:{zenoh}"]
applied_file = "applied.txt"

[axis.y]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6000.0
slope_max_um_per_m = 60.0
position_min_mm = -100.0
position_max_mm = 900.0
position_speed_max_mm_per_s = 500.0

[axis.z]
offset_max_um = 100.0
offset_rate_max_um_per_min = 6000.0

[axis.a]
offset_max_urad = 100.0

[tool]
length_min_mm = 20.0
length_max_mm = 400.0

[opcua]
endpoint = "{endpoint}"
unit = "mm"
cycle_s = 0.05
resume_after_s = 1.0
retry_s = 0.2
timeout_s = 5.0
heartbeat_node = "ns=2;s=/Plc/DB100.DBW4"
state_node = "ns=2;s=/Plc/DB100.DBW6"
enable_node = "ns=2;s=/Plc/DB100.DBX8.0"
tool_length_node = "ns=2;s=/Plc/DB100.DBD24:REAL"
cutting_node = "ns=2;s=/Plc/DB100.DBX8.2"

[opcua.axis.y]
offset_node = "ns=2;s=/Plc/DB100.DBD0:REAL"
slope_node = "ns=2;s=/Plc/DB100.DBD16:LREAL"
reference_mm = 200.0
sign = -1
sign_checked = "2026-03-02, dial gauge, J. Novak"

[opcua.axis.z]
offset_node = "ns=2;s=/Plc/DB100.DBD12:REAL"
sign = 1
sign_checked = "2026-03-02, dial gauge, J. Novak"
"""


def written(folder: Path, endpoint: str = "opc.tcp://127.0.0.1:4840", zenoh: int = 7447, **changes: str) -> Path:
    text = FILE.format(endpoint=endpoint, zenoh=zenoh)
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "bridge.toml"
    path.write_text(text, encoding="utf-8")
    return path


@asynccontextmanager
async def bridging(path: Path, said: list[str]) -> AsyncIterator[AxesBridge]:
    receiver_settings, opcua = load_any_bridge(path)
    assert isinstance(receiver_settings, AxesSettings) and isinstance(opcua, OpcUaAxes)
    stop = asyncio.Event()
    with AxesReceiver(receiver_settings, step_max_s=2.0 * opcua.plc.cycle_s) as receiver:
        bridge = AxesBridge(opcua, receiver, said.append)
        task = asyncio.create_task(bridge.run(stop))
        try:
            yield bridge
        finally:
            stop.set()
            await task


async def test_all_axes_to_the_data_block_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    zenoh, plc, said = free_port(), Plc(free_port(), value=0.002), []  # type: tuple[int, Plc, list[str]]
    path = written(tmp_path, plc.endpoint, zenoh)

    async def holds(y_um: float, z_um: float, um_per_m: float) -> bool:
        y, z, ratio = await plc.um(), await plc.z.read_value() * 1000.0, await plc.slope.read_value()
        return abs(y - y_um) < 0.02 and abs(z - z_um) < 0.02 and abs(ratio - um_per_m * 1e-6) < 1e-8

    async def recorded(name: str, um: float) -> bool:
        found = applied_at(tmp_path / name, time.time_ns())
        return found is not None and abs(found - um) < 0.01

    async def says(text: str) -> bool:
        return text in said[-1]

    async def following() -> bool:
        return said[-1] == "following"

    def publish(seq: int, y: float, z: float, um_per_m: float, without: str = "", **own: Any) -> None:
        line = slope(um_per_m, 100.0)
        service.put_axes(seq, without=without, y={"value": y, **line, **own}, z={"value": z, **own}, a=20.0)

    with router(zenoh), ScriptedService(zenoh) as service:
        async with plc, bridging(path, said) as bridge:
            await until(lambda: asyncio.sleep(0, bridge._beat > 3), "connected")
            assert await holds(2.0, 2.0, 0.0)  # what it held stands
            await plc.tool_mm.write_value(50.0, plc.kind)
            # The pair is for 200 mm: 10 + 20 µm/m · 0.1 m, and 20 µrad · (50 − 100) mm; with the sign of the control.
            publish(1, 10.0, -4.0, 20.0)
            await until(lambda: holds(-11.0, -4.0, -20.0), "offset and slope")
            await until(following, "all is written")
            await until(lambda: recorded("applied.txt", 11.0), "what the PLC holds, in the service's direction")
            await until(lambda: recorded("applied-z.txt", -4.0), "the same of Z")
            await plc.tool_mm.write_value(math.nan, plc.kind)
            await until(lambda: says("[tool_length_beyond]"), "no length")
            await until(lambda: holds(-12.0, -4.0, -20.0), "that of the reference")
            await plc.tool_mm.write_value(150.0, plc.kind)
            await until(lambda: holds(-13.0, -4.0, -20.0), "another tool")
            publish(2, 50.0, 50.0, 50.0, without="a")
            await until(lambda: says("[incomplete]"), "a sample that is not whole")
            assert await holds(-13.0, -4.0, -20.0) and await plc.state.read_value() == 1
            # Somebody else writes Z: neither moves.
            with clock.stopped():
                await plc.z.write_value(0.03, plc.kind)
                await until(lambda: says("z: the PLC holds +30.000 µm instead of the written -4.000 µm"), "it is said")
                publish(3, 20.0, -10.0, 20.0)
                beat = bridge._beat
                await until(lambda: asyncio.sleep(0, bridge._beat >= beat + 4), "some cycles")
                assert await holds(-13.0, 30.0, -20.0) and await plc.state.read_value() == 4
            await until(lambda: holds(-23.0, -10.0, -20.0), "both go on from what stands")
            # A write that is refused for one: no heartbeat, so that the PLC takes over nothing of it.
            await until(following, "all is written")
            await plc.z.set_writable(False)
            publish(4, 10.0, -4.0, 20.0)
            await until(lambda: says("[plc_not_reached]"), "refused")
            for name in ("applied.txt", "applied-z.txt"):
                assert " -\n" in (tmp_path / name).read_text()  # nobody knows what was written
            beat = await plc.heartbeat.read_value()
            await asyncio.sleep(6 * CYCLE_S)
            assert await plc.heartbeat.read_value() == beat
            assert abs(await plc.z.read_value() * 1000.0 + 10.0) < 0.02
            await plc.z.set_writable(True)
            await until(lambda: holds(-13.0, -4.0, -20.0), "it goes on")
            await plc.slope.write_value(1.0)  # a metre for each metre
            await until(lambda: says("[plc_beyond_limit]"), "no slope")
            await plc.slope.write_value(0.0)
            await until(lambda: holds(-13.0, -4.0, -20.0), "it goes on")
            publish(5, 10.0, -4.0, 20.0, sign=-1)  # turned by the service as well; Z is turned by nobody else
            await until(lambda: says("in effect neither does. (y) [signs_cancel]"), "both signs")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("sign = -1\n", "", "opcua.axis.y.sign: missing; determine the sign"),
        ("sign = -1\n", "sign = 3\n", "opcua.axis.y.sign = 3: expected 1 or -1"),
        ('"2026-03-02, dial gauge, J. Novak"', '" "', "opcua.axis.y.sign_checked = ' '"),
        ("[opcua.axis.z]", "[opcua.axis.x]", "opcua.axis.z: expected a table for each of: y, z"),
        ("[opcua]", "[opcua.axis.x]\n[opcua]", "opcua.axis.x: expected a table for each of: y, z"),
        ("[axis.z]", "[axis.z]\nsign = -1", "axis.z.sign = -1: expected the sign in opcua.axis.z alone"),
        ("slope_node", "slopes_node", "opcua.axis.y.slopes_node: unknown key"),
        ('slope_node = "ns=2;s=/Plc/DB100.DBD16:LREAL"\n', "", "opcua.axis.y.slope_node and axis.y.slope_max_um_per_m"),
        ("reference_mm = 200.0", "reference_mm = 901.0", "opcua.axis.y.reference_mm = 901: expected a position"),
        ("cycle_s = 0.05", "cycle_s = 0.0", "opcua.cycle_s = 0.0: expected 0.05 to 10"),
        ("length_max_mm = 400.0", 'length_max_mm = 400.0\nlength_from = "zenoh"', "opcua.tool_length_node: expected"),
        ("[opcua]", "[other]\nx = 1\n[opcua]", "other: unknown table"),
    ],
)
def test_it_does_not_start_like_this(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, expected: str
) -> None:
    assert expected in refused(written(tmp_path, **{old: new}), capsys)


@settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**32))
def test_whatever_stands_in_the_file_it_is_loaded_or_refused_in_one_line(tmp_path: Path, seed: int) -> None:
    path = written(tmp_path)
    path.write_bytes(mutated(seed, path.read_bytes()))
    try:
        load_any_bridge(path)
    except ConfigError as error:
        assert "\n" not in str(error) and str(path) in str(error)


def test_the_example_can_be_loaded_once_the_signs_are_entered(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "deploy/opcua/bridge_axes.example.toml").read_text(encoding="utf-8")
    path = tmp_path / "bridge.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"opcua\.axis\.y\.sign: missing"):
        load_any_bridge(path)
    path.write_text(text.replace("# sign", "sign"), encoding="utf-8")
    _, opcua = load_any_bridge(path)
    assert isinstance(opcua, OpcUaAxes) and opcua.places()["y"].reference_mm == 300.0


def test_check_names_each_axis(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bridge", "opcua", "--config", str(written(tmp_path)), "--check"]) == 0
    text = capsys.readouterr().out
    assert "y: ns=2;s=/Plc/DB100.DBD0:REAL, slope ns=2;s=/Plc/DB100.DBD16:LREAL from 200 mm, sign -1" in text


# ---------------------------------------------------------------------- against a PLC that does as it likes

RATE, STEP_S = 60.0, 2.0
PLACES = {
    "y": AxisPlace(sign=-1, per_um=1e-3, per_slope=1e-6, reference_mm=200.0, tolerance_um=0.1, travel_mm=1000.0),
    "z": AxisPlace(sign=1, per_um=1e-3, tolerance_um=0.1),
}
near = st.floats(-0.06, 0.06)
actions = st.one_of(
    st.tuples(st.just("offset"), st.tuples(st.floats(-15.0, 15.0), st.floats(-30.0, 30.0), st.floats(-50.0, 50.0))),
    st.tuples(st.just("plc"), st.tuples(near, st.floats(-6e-5, 6e-5) | st.just(math.nan), near | st.just(math.nan))),
    st.tuples(st.sampled_from(["lost", "refused", "wait"]), st.just((0.0, 0.0, 0.0))),
)


@settings(max_examples=80, deadline=None)
@given(st.booleans(), st.lists(actions, max_size=50))
def test_no_write_is_further_from_what_the_plc_holds_than_the_rate_allows_at_any_position(
    single: bool, steps: list[tuple[str, Any]]
) -> None:
    f = AxesFollower(MACHINE, {"y": sloped(RATE), "z": plain(RATE)}, None, Acceptance(step_max_s=STEP_S))
    registers = AxesRegisters(f, PLACES, 5.0)
    registers.single = [single] * 3
    plc, now, seq = (0.001, 0.0, -0.002), 0.0, 0
    for what, numbers in steps:
        now += 30.0 if what == "wait" else 1.0
        if what == "offset":
            seq += 1
            y, um_per_m, z = numbers
            f.receive(now, "y", axis_offset("y", seq, y, axes="yz", **slope(um_per_m, 300.0)))
            f.receive(now, "z", axis_offset("z", seq, z, axes="yz"))
        elif what == "plc":
            plc = numbers
        elif what == "lost":
            registers.lost("gone")
        may_move = registers.check_all(now, plc)
        f.follow() if may_move else f.hold()
        applied = f.advance(now, ControlState(positions_mm={"y": 200.0}))
        values = registers.values(applied) if may_move else None
        if values is None:
            continue
        for position_mm in (0.0, 640.0, 1000.0):
            was, wanted = (v[0] * 1e3 + v[1] * 1e6 * (position_mm - 200.0) / 1000.0 for v in (plc, values))
            # What the PLC holds may be off by the tolerances of both and still be ours.
            assert abs(wanted - was) <= RATE / 60.0 * STEP_S + 0.2 + 1e-4 and abs(wanted) <= MAX_UM + 1e-4
        assert abs(values[2] - plc[2]) * 1e3 <= RATE / 60.0 * STEP_S + 0.1 + 1e-4
        if what == "refused":
            registers.lost("refused")
        else:
            plc = values
            registers.wrote(values)
