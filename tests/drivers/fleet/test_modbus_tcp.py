"""Modules over Modbus TCP: readings of every family, and every way a connection can go wrong."""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from collections.abc import Callable
from typing import Any

import pytest

import drivers
from drivers import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout, Quality
from drivers.lines import backoff
from drivers.lines.modbus_wire import ModbusWire
from tests.drivers.fleet.conftest import BOUND_S

VOLTS = {"input": 0}
PROBE = {"um_per_v": 5.0, "polarity": -1, "standoff_um": 50.0, "volt_min": -9.9, "volt_max": 9.9}


def k_inputs(*numbers: int) -> list[dict[str, Any]]:
    return [{"input": number, "couple": "K"} for number in numbers]


def adam6018(**keys: Any) -> dict[str, Any]:
    return {"model": "adam-6018", "address": 1, "inputs": k_inputs(0, 1), **keys}


async def test_icpdas_et7018z(rig: Any, slave: Any) -> None:
    unit = slave({(3, 559): 0x7018}, {631: 0})
    unit.block(3, 427, [0x0F, 0x0E, *[0x10] * 8])
    unit.block(4, 0, [0x0250, 0xE000, 0x7FFF, 0x8000, 0, 0, 0, 0, 0, 0x1000])
    couples = {0: "K", 1: "J", 2: "T", 3: "T", 9: "T"}
    inputs = [{"input": number, "couple": couple} for number, couple in couples.items()]
    _, _, [device] = await rig.modbus({1: unit}, {"model": "icpdas-et7018z", "address": 1, "inputs": inputs})
    readings = await device.read()
    assert list(readings) == [0, 1, 2, 3, 9]
    assert readings[0].value == pytest.approx(0x250 / 32767 * 1372)
    assert readings[1].value == pytest.approx(-190.0)
    assert readings[2].quality is Quality.OPEN
    assert readings[3].quality is Quality.UNDER
    assert readings[9].value == pytest.approx(0x1000 / 32767 * 400)
    assert (readings[9].minimum, readings[9].count) == (readings[9].value, 1)
    await device.read()
    assert unit.requests[-1] == unit.requests[-2] == (4, 0, 10)  # verified once only


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            lambda unit: unit.registers.update({(3, 428): 0x0E}),
            "type code in register 428 is 0x0E (type J), the",
        ),
        (lambda unit: unit.coils.update({631: 1}), "coil 631 is engineering, the configuration expects hex"),
        (lambda unit: unit.registers.update({(3, 559): 0x7019}), "module name in register 559 is 0x7019"),
    ],
)
async def test_what_the_module_says_must_agree(rig: Any, slave: Any, change: Callable[[Any], None], text: str) -> None:
    unit = slave({(3, 559): 0x7018}, {631: 0})
    unit.block(3, 427, [0x0F] * 10)
    unit.block(4, 0, [0] * 10)
    change(unit)
    table = {"model": "icpdas-et7018z", "address": 1, "inputs": k_inputs(0, 1)}
    _, _, [device] = await rig.modbus({1: unit}, table)
    for _ in range(2):
        with pytest.raises(DeviceRefused) as caught:
            await device.read()
        assert text in str(caught.value)
    unit.registers[3, 559], unit.registers[3, 428], unit.coils[631] = 0x7018, 0x0F, 0
    assert (await device.read())[0].value == 0.0


async def test_module_without_the_registers_is_not_verified(rig: Any, slave: Any) -> None:
    unit = slave()
    unit.block(4, 0, [0] * 10)
    table = {"model": "icpdas-et7018z", "address": 1, "inputs": k_inputs(0)}
    _, _, [device] = await rig.modbus({1: unit}, table)
    assert (await device.read())[0].value == 0.0


async def test_verify_false_asks_nothing(rig: Any, slave: Any) -> None:
    unit = slave()
    unit.block(4, 0, [0] * 10)
    table = {"model": "icpdas-et7018z", "address": 1, "inputs": k_inputs(0), "verify": False}
    _, _, [device] = await rig.modbus({1: unit}, table)
    await device.read()
    assert unit.requests == [(4, 0, 10)]


async def test_adam_6018_and_its_burnout_coils(rig: Any, slave: Any) -> None:
    unit = slave(coils={16 + number: int(number == 1) for number in range(8)})
    unit.block(3, 0, [996, 996, 0, 65535, 0, 0, 0, 0])
    table = adam6018(inputs=k_inputs(0, 1, 2, 3), burnout_coil=16)
    _, _, [device] = await rig.modbus({1: unit}, table)
    readings = await device.read()
    assert readings[0].value == pytest.approx(20.82, abs=0.005)
    assert [readings[n].quality for n in (1, 2, 3)] == [Quality.OPEN, Quality.UNDER, Quality.OVER]
    assert "burn-out coil" in readings[1].detail


async def test_voltages_and_probes(rig: Any, slave: Any) -> None:
    adam, icp = slave(), slave({(3, 559): 0x7017}, {631: 1})
    adam.block(3, 0, [49151, 49151, 65535, 65530, 0, 0, 0, 0])
    icp.block(4, 0, [4000, -4000, 9950, 0, 0, 0, 0, 10000])
    icp.block(3, 427, [0x08] * 8)
    inputs = [VOLTS, *({"input": n, "probe": PROBE} for n in (1, 2, 3))]
    tables = [
        {"model": "adam-6017", "address": 1, "inputs": inputs},
        {
            "model": "icpdas-et7017",
            "address": 2,
            "format": "engineering",
            "inputs": [VOLTS, *({"input": n, "probe": PROBE} for n in (1, 2)), {"input": 7}],
        },
    ]
    _, _, [one, two] = await rig.modbus({1: adam, 2: icp}, *tables)
    assert one.units == {0: "v", 1: "um", 2: "um", 3: "um"}
    readings = await one.read()
    assert readings[0].value == pytest.approx(5.0, abs=2e-4)
    assert readings[1].value == pytest.approx(25.0, abs=1e-3)
    assert readings[2].quality is readings[3].quality is Quality.OVER
    readings = await two.read()
    assert readings[0].value == 4.0
    assert readings[1].value == 70.0
    assert readings[2].quality is readings[7].quality is Quality.OVER


@pytest.mark.parametrize("word_order", ["big", "little"])
async def test_moxa(rig: Any, slave: Any, word_order: str) -> None:
    unit = slave()
    values = [20.5, -3.25, float("nan"), 1e9, 0.0, 0.0, 0.0, 0.0]
    step = 1 if word_order == "big" else -1
    words = [w for value in values for w in struct.unpack(">2H", struct.pack(">f", value))[::step]]
    unit.block(4, 2064, words)
    counts = [205, -33, *[0] * 6]
    unit.block(4, 2048, [w for n in counts for w in struct.unpack(">2H", struct.pack(">i", n))[::step]])
    table = {"model": "moxa-e1262", "address": 1, "couple": "K", "word_order": word_order}
    inputs = [{"input": number} for number in range(4)]
    _, end, [device] = await rig.modbus({1: unit}, {**table, "inputs": inputs})
    readings = await device.read()
    assert (readings[0].value, readings[1].value) == (20.5, -3.25)
    assert (readings[2].quality, readings[3].quality) == (Quality.INVALID, Quality.OVER)
    line = {"protocol": "modbus-tcp", "host": "127.0.0.1", "tcp_port": end.port}
    fleet = rig.fleet(line, {**table, "inputs": inputs, "register": "multiplied"})
    readings = await fleet.devices["d0"].read()
    assert readings[1].value == pytest.approx(-3.3)


async def test_modbus_map(rig: Any, slave: Any) -> None:
    unit = slave()
    unit.block(3, 100, [8000, 0xFFFF, 0xFF38, 0x7FFF])
    unit.block(3, 110, [12])
    unit.block(4, 5, [0x0000, 0x41A0])
    inputs = [
        {"input": 0, "unit": "rpm", "address": 100, "type": "uint16", "maximum": 20000.0},
        {"input": 1, "unit": "um", "address": 101, "type": "int32", "scale": 0.1, "offset": 1.0},
        {
            "input": 2,
            "unit": "degc",
            "address": 103,
            "type": "int16",
            "bad_values": {"32767": "open_circuit"},
        },
        {"input": 3, "unit": "a", "address": 110, "type": "int16", "minimum": 20.0},
        {"input": 4, "unit": "w", "address": 5, "type": "float32", "word_order": "little", "function": 4},
        {
            "input": 5,
            "unit": "rpm",
            "address": 100,
            "type": "uint16",
            "bad_values": {"under_range": [0, 8000]},
        },
    ]
    _, _, [device] = await rig.modbus({1: unit}, {"model": "modbus-map", "address": 1, "inputs": inputs})
    readings = await device.read()
    assert unit.requests == [(3, 100, 4), (3, 110, 1), (4, 5, 2)]
    assert readings[0].value == 8000.0
    assert readings[1].value == pytest.approx(-19.0)
    assert readings[2].quality is Quality.OPEN
    assert readings[3].quality is Quality.UNDER
    assert readings[4].value == 20.0
    assert readings[5].quality is Quality.UNDER
    assert device.units == {0: "rpm", 1: "um", 2: "degc", 3: "a", 4: "w", 5: "rpm"}


@pytest.mark.parametrize(
    ("kind", "words", "number"),
    [
        ("float32", [0xC479, 0xF99A], -999.9),
        ("float32", [0x454C, 0xCB33], 3276.7),
        ("int16", [0x8000], "0x8000"),
        ("int16", [0x8000], -32768),
        ("float32", [0xC479, 0xF99A], "-999.9"),
        ("uint16", [0xFFFF], -1),
        ("int32", [0x8000, 0x0000], 0x80000000),
    ],
)
async def test_a_fault_number_is_recognised_as_the_registers_hold_it(
    rig: Any, slave: Any, kind: str, words: list[int], number: float | str
) -> None:
    unit = slave()
    unit.block(3, 100, words)
    table = {"input": 0, "unit": "degc", "address": 100, "type": kind, "bad_values": {"open_circuit": [number]}}
    _, _, [device] = await rig.modbus({1: unit}, {"model": "modbus-map", "address": 1, "inputs": [table]})
    assert (await device.read())[0].quality is Quality.OPEN


async def test_modbus_map_reads_small_gaps_along_when_told(rig: Any, slave: Any) -> None:
    unit = slave()
    unit.block(3, 100, list(range(11)))
    keys = {"unit": "x", "type": "int16"}
    inputs = [{"input": n, "address": address, **keys} for n, address in enumerate((100, 104, 110))]
    table = {"model": "modbus-map", "address": 1, "inputs": inputs, "max_gap": 4}
    _, _, [device] = await rig.modbus({1: unit}, table)
    assert [reading.value for reading in (await device.read()).values()] == [0.0, 4.0, 10.0]
    assert unit.requests == [(3, 100, 5), (3, 110, 1)]


def exception(code: int) -> Callable[[bytes], bytes]:
    return lambda frame: frame[:4] + b"\x00\x03" + frame[6:7] + bytes([frame[7] | 0x80, code])


@pytest.mark.parametrize(
    ("fault", "error", "text"),
    [
        (exception(2), DeviceRefused, r"holding register 0 .count 8. of unit 1 .*illegal data address"),
        (exception(6), DeviceRefused, "device busy"),
        (exception(11), DeviceRefused, "gateway target did not answer"),
        (lambda frame: None, DeviceTimeout, r"no answer from unit 1 on 127.0.0.1:\d+ within 0.5 s"),
        (lambda frame: frame[:12], DeviceTimeout, "no answer"),
        (lambda frame: b"HTTP/1.1 400 Bad Request\r\n\r\n", DeviceGarbled, "no Modbus TCP header"),
        (lambda frame: frame[:6] + b"\x02" + frame[7:], DeviceGarbled, "unit 2 answers"),
        (lambda frame: frame[:7] + b"\x04" + frame[8:], DeviceGarbled, "function 4"),
        (lambda frame: frame[:5] + b"\x11" + frame[6:8] + b"\x0e" + frame[9:23], DeviceGarbled, "has 14"),
        (lambda frame: frame[:8] + b"\x0e" + frame[9:], DeviceGarbled, "16 bytes"),
        (lambda frame: frame[:2] + b"\x00\x07" + frame[4:], DeviceGarbled, "no Modbus TCP header"),
    ],
)
async def test_faults_and_the_next_read(
    rig: Any, slave: Any, fault: Any, error: type[drivers.DriverError], text: str
) -> None:
    unit = slave()
    unit.block(3, 0, [996] * 8)
    bus, _, [device] = await rig.modbus({1: unit}, adam6018())
    bus.faults.append(fault)
    with pytest.raises(error, match=text) as caught:
        await device.read()
    assert caught.value.device == "d0" and str(caught.value).startswith("d0: ")
    assert (await device.read())[0].value == pytest.approx(20.82, abs=0.005)


async def test_late_and_split_answers(rig: Any, slave: Any) -> None:
    unit = slave()
    unit.block(3, 0, [100] * 8)
    bus, end, [device] = await rig.modbus({1: unit}, adam6018())
    bus.faults.append(bus.hold)
    with pytest.raises(DeviceTimeout):
        await device.read()
    unit.block(3, 0, [200] * 8)
    # The late answer and the right one come in one piece.
    assert (await device.read())[0].value == pytest.approx(200 / 65535 * 1370)

    def split(frame: bytes) -> bytes:
        asyncio.get_running_loop().call_soon(end.writers[-1].write, frame[9:])
        return frame[:9]

    bus.faults.append(split)
    assert (await device.read())[0].value == pytest.approx(200 / 65535 * 1370)


async def test_connection_lost_is_told_at_once_and_made_anew(rig: Any, slave: Any) -> None:
    unit = slave()
    unit.block(3, 0, [996] * 8)
    bus, end, [device] = await rig.modbus({1: unit}, adam6018(), timeout_s=2.0)
    await device.read()
    bus.faults.append(lambda frame: end.drop())
    began = asyncio.get_running_loop().time()
    with pytest.raises(DeviceDisconnected, match="connection"):
        await device.read()
    assert asyncio.get_running_loop().time() - began < BOUND_S
    assert (await device.read())[0].quality is Quality.GOOD
    assert end.connections == 2
    await end.stop()
    with pytest.raises(DeviceDisconnected):
        await device.read()
    with pytest.raises(DeviceDisconnected, match="cannot open"):
        await device.read()
    await end.start()
    assert (await device.read())[0].quality is Quality.GOOD


async def test_host_that_swallows_connections(rig: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    tries, connect = [], ModbusWire.connect

    async def counted(wire: ModbusWire) -> None:
        tries.append(wire)
        await connect(wire)

    monkeypatch.setattr(ModbusWire, "connect", counted)
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        fillers = []
        for _ in range(4):  # fill the queue, so that a further SYN is not answered
            filler = socket.socket()
            filler.setblocking(False)
            filler.connect_ex(full.getsockname())
            fillers.append(filler)
        line = {"protocol": "modbus-tcp", "host": "127.0.0.1", "tcp_port": full.getsockname()[1]}
        line["timeout_s"] = 0.5
        fleet = rig.fleet(line, adam6018(), adam6018(address=2), adam6018(address=3))
        results = await asyncio.gather(*(d.read() for d in fleet.devices.values()), return_exceptions=True)
        assert all(isinstance(result, DeviceTimeout) for result in results), results
        assert len(tries) == 1  # for all three: their reads last no longer than one
        for filler in fillers:
            filler.close()


async def test_dead_unit_does_not_starve_the_others(rig: Any, slave: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "FIRST_WAIT_S", 2.0)
    unit = slave()
    unit.block(3, 0, [996] * 8)
    bus, _, [alive, dead] = await rig.modbus({1: unit}, adam6018(), adam6018(address=9))
    for _ in range(8):
        result, _ = await asyncio.gather(dead.read(), alive.read(), return_exceptions=True)
        assert isinstance(result, DeviceTimeout)
    assert sum(frame[6] == 9 for frame in bus.frames) == 3
    assert "next attempt in" in str(result)
    bus.units[9] = unit
    async with asyncio.timeout(30.0):
        while isinstance((await asyncio.gather(dead.read(), return_exceptions=True))[0], DeviceTimeout):
            await asyncio.sleep(0.01)


async def test_cancelled_read_leaves_the_line_usable(rig: Any, slave: Any) -> None:
    unit = slave()
    unit.block(3, 0, [100] * 8)
    bus, _, [device] = await rig.modbus({1: unit}, adam6018())
    bus.faults.append(bus.hold)
    task = asyncio.create_task(device.read())
    await bus.asked.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    unit.block(3, 0, [200] * 8)
    assert (await device.read())[0].value == pytest.approx(200 / 65535 * 1370)


async def test_close_during_a_read(rig: Any, slave: Any) -> None:
    bus, _, [device] = await rig.modbus({1: slave()}, adam6018(), timeout_s=2.0)
    bus.faults.append(lambda frame: None)
    task = asyncio.create_task(device.read())
    await bus.asked.wait()
    await device.close()
    with pytest.raises(DeviceDisconnected):
        await asyncio.wait_for(task, BOUND_S)


async def test_eight_registers_take_well_under_a_millisecond(rig: Any, slave: Any) -> None:
    unit = slave()
    unit.block(3, 0, [996] * 8)
    _, _, [device] = await rig.modbus({1: unit}, adam6018())
    times = []
    for _ in range(200):
        began = time.perf_counter()
        await device.read()
        times.append(time.perf_counter() - began)
    print(f"median {sorted(times)[100] * 1e3:.2f} ms")
    assert sorted(times)[20] < 2e-3  # a tenth of the reads; the machine is shared
