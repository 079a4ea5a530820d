"""Modules on a serial line: above all, that a late answer is never taken for another one's."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import pytest

import drivers
from drivers import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout, Quality
from tests.drivers.fleet.conftest import BOUND_S, TIMEOUT_S

OLD, NEW = 111, 222


def adam(address: int = 1, **keys: Any) -> dict[str, Any]:
    inputs = [{"input": 0, "couple": "K"}]
    return {"model": "adam-4118", "address": address, "inputs": inputs, "verify": False, **keys}


def words(unit: Any, value: int) -> None:
    unit.block(3, 0, [value] * 8)


def degc(word: int) -> float:
    return word / 65535 * 1370


def made(slave: Any) -> Any:
    unit = slave(coils=dict.fromkeys(range(8), 0))
    unit.block(3, 200, [0x0F] * 8)
    unit.block(3, 210, [0x4118])
    words(unit, OLD)
    return unit


def with_crc(frame: bytes) -> bytes:
    value = 0xFFFF
    for byte in frame:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return frame + value.to_bytes(2, "little")


async def test_printed_request(rig: Any, slave: Any) -> None:
    unit = slave({(3, 486): 0x0F}, {268: 1})
    unit.block(4, 0, [215, -15, 0, 0, 0, 0, 0, 0x7FFF])
    inputs = [{"input": n, "couple": "K"} for n in (0, 1, 7)]
    table = {"model": "icpdas-m7018r", "address": 1, "format": "engineering", "inputs": inputs}
    bus, _, [device] = await rig.modbus({1: unit}, table, rtu=True)
    readings = await device.read()
    assert (readings[0].value, readings[1].value) == (pytest.approx(21.5), pytest.approx(-1.5))
    assert readings[7].quality is Quality.OPEN
    assert bus.frames[-1].hex() == "010400000008f1cc"


@pytest.mark.parametrize(
    ("register", "value", "text"),
    [
        (
            (3, 203),
            0x0E,
            "type code in register 203 is 0x0E (type J), the configuration expects 0x0F (type K)",
        ),
        ((3, 210), 0x4117, "module name in register 210 is 0x4117, the configuration expects 0x4118"),
    ],
)
async def test_adam_says_another_type(rig: Any, slave: Any, register: tuple[int, int], value: int, text: str) -> None:
    unit = made(slave)
    unit.registers[register] = value
    table = adam(verify=True, inputs=[{"input": n, "couple": "K"} for n in range(8)])
    _, _, [device] = await rig.modbus({1: unit}, table, rtu=True)
    with pytest.raises(DeviceRefused) as caught:
        await device.read()
    assert text in str(caught.value)


async def test_a_register_that_the_module_does_not_have_is_asked_for_once(rig: Any, slave: Any) -> None:
    unit = made(slave)
    for register in range(200, 208):
        del unit.registers[3, register]
    _, _, [device] = await rig.modbus({1: unit}, adam(verify=True), rtu=True)
    for _ in range(4):
        assert (await device.read())[0].value == pytest.approx(degc(OLD))
    assert unit.requests.count((3, 200, 8)) == 1
    unit.requests.clear()
    await device.read()
    assert unit.requests == [(3, 0, 8), (1, 0, 8)]


@pytest.mark.parametrize("lost", [1, 2, 3])
async def test_late_answer_is_not_taken_for_a_later_one(rig: Any, slave: Any, lost: int) -> None:
    """Every answer is late by up to three requests, and all of them come just before the next one is due."""
    unit = made(slave)
    bus, _, [device] = await rig.modbus({1: unit}, adam(), rtu=True)
    bus.faults.extend([bus.hold] * lost)
    for _ in range(lost):
        with pytest.raises(DeviceTimeout):
            await device.read()
    words(unit, NEW)
    reading = None
    async with asyncio.timeout(30.0):
        while reading is None:
            with contextlib.suppress(DeviceTimeout):  # spaced out after the third loss
                reading = (await device.read())[0]
            await asyncio.sleep(0.02)
    assert reading.value == pytest.approx(degc(NEW))
    assert not bus.held


async def test_late_answer_between_the_fence_and_the_next_request(rig: Any, slave: Any) -> None:
    """The old answer comes alone while the fence waits, and the fence's own answer is late as well."""
    unit = made(slave)
    bus, _, [device] = await rig.modbus({1: unit}, adam(), rtu=True)
    bus.faults.append(bus.hold)
    with pytest.raises(DeviceTimeout):
        await device.read()

    def late_alone(frame: bytes) -> bytes:
        late = bus.held.pop()
        asyncio.get_running_loop().call_soon(bus.held.append, frame)
        return late

    words(unit, NEW)
    bus.faults.append(late_alone)
    with pytest.raises(DeviceGarbled, match="the answer is function 3, 16 bytes"):
        await device.read()
    assert (await device.read())[0].value == pytest.approx(degc(NEW))
    assert (await device.read())[0].value == pytest.approx(degc(NEW))


async def test_late_refusal_is_not_taken_for_a_later_one(rig: Any, slave: Any) -> None:
    unit = made(slave)
    bus, _, [device] = await rig.modbus({1: unit}, adam(), rtu=True)
    bus.faults.append(lambda frame: bus.hold(with_crc(bytes([1, 0x83, 6]))))
    with pytest.raises(DeviceTimeout):
        await device.read()
    words(unit, NEW)
    assert (await device.read())[0].value == pytest.approx(degc(NEW))


async def test_late_answer_of_another_unit_of_the_same_size(rig: Any, slave: Any) -> None:
    one, two = made(slave), made(slave)
    words(two, NEW)
    bus, _, devices = await rig.modbus({1: one, 2: two}, adam(1), adam(2), rtu=True)
    bus.faults.append(bus.hold)
    with pytest.raises(DeviceTimeout):
        await devices[0].read()
    assert (await devices[1].read())[0].value == pytest.approx(degc(NEW))
    assert (await devices[0].read())[0].value == pytest.approx(degc(OLD))


async def test_late_answer_of_a_register_read_is_not_taken_for_a_verification(rig: Any, slave: Any) -> None:
    """Values and type codes are both eight registers; only their order tells them apart."""
    unit = made(slave)
    bus, _, [device] = await rig.modbus({1: unit}, adam(verify=True), rtu=True)
    await device.read()
    bus.faults.append(bus.hold)
    with pytest.raises(DeviceTimeout):
        await device.read()
    words(unit, NEW)
    assert (await device.read())[0].value == pytest.approx(degc(NEW))


@pytest.mark.parametrize(
    ("fault", "error", "text"),
    [
        (lambda frame: None, DeviceTimeout, "no answer from unit 1"),
        (lambda frame: frame[:-1] + bytes([frame[-1] ^ 1]), DeviceGarbled, "CRC"),
        (lambda frame: frame[:9], DeviceGarbled, "no valid frame in 9 bytes"),
        (lambda frame: bytes(range(60)), DeviceGarbled, "no valid frame"),
        (lambda frame: bytes(3000), DeviceGarbled, "no valid frame"),
        (lambda frame: b"\x01", DeviceGarbled, "1 stray bytes"),
        (
            lambda frame: with_crc(b"\x01\x03\x0e" + bytes(14)),
            DeviceGarbled,
            "asked .* 16 bytes, .* 14 bytes",
        ),
        (lambda frame: with_crc(b"\x01\x04\x10" + bytes(16)), DeviceGarbled, "function 4"),
        (lambda frame: with_crc(b"\x02\x03\x10" + bytes(16)), DeviceTimeout, "no answer"),
        (lambda frame: with_crc(b"\x01\x2b\x10" + bytes(16)), DeviceGarbled, "function 43"),
        (lambda frame: with_crc(b"\x01\x83\x04"), DeviceRefused, "device failure"),
    ],
)
async def test_faults_and_the_next_read(
    rig: Any, slave: Any, fault: Any, error: type[drivers.DriverError], text: str
) -> None:
    unit = made(slave)
    bus, _, [device] = await rig.modbus({1: unit}, adam(), rtu=True)
    bus.faults.append(fault)
    began = asyncio.get_running_loop().time()
    with pytest.raises(error, match=text):
        await device.read()
    assert asyncio.get_running_loop().time() - began < BOUND_S
    words(unit, NEW)
    assert (await device.read())[0].value == pytest.approx(degc(NEW))


async def test_noise_before_an_answer_is_passed_over(rig: Any, slave: Any) -> None:
    bus, _, [device] = await rig.modbus({1: made(slave)}, adam(), rtu=True)
    bus.faults.append(lambda frame: b"\xff\x00\x01" + frame)
    assert (await device.read())[0].value == pytest.approx(degc(OLD))


async def test_babble_is_bounded_in_time_and_memory(rig: Any, slave: Any) -> None:
    bus, end, [device] = await rig.modbus({1: made(slave)}, adam(), rtu=True)
    stop = asyncio.Event()

    async def babble() -> None:
        while not stop.is_set():
            for writer in end.writers:
                writer.write(b"\x55" * 200)
            await asyncio.sleep(0.001)  # many times what a line carries

    task = asyncio.create_task(babble())
    bus.faults.extend([lambda frame: None] * 2)
    for _ in range(2):
        began = asyncio.get_running_loop().time()
        with pytest.raises((DeviceGarbled, DeviceTimeout)):
            await device.read()
        assert asyncio.get_running_loop().time() - began < BOUND_S
    stop.set()
    await task


async def pty_device(rig: Any, unit: Any, make_bus: Callable[..., Any], **line: Any) -> tuple[Any, Any, Any]:
    bus = make_bus({1: unit}, rtu=True)
    end = rig.pty(bus.feed)
    fleet = rig.fleet({"protocol": "modbus-rtu", "port": end.link, "timeout_s": TIMEOUT_S, **line}, adam())
    return bus, end, fleet.devices["d0"]


async def test_serial_port(rig: Any, slave: Any, modbus_bus: Any) -> None:
    unit = made(slave)
    bus, _, device = await pty_device(rig, unit, modbus_bus, baudrate=115200, parity="N", stopbits=1)
    assert (await device.read())[0].value == pytest.approx(degc(OLD))
    unit.coils[0] = 1
    assert (await device.read())[0].quality is Quality.OPEN
    bus.faults.append(bus.hold)
    with pytest.raises(DeviceTimeout):
        await device.read()
    unit.coils[0] = 0
    words(unit, NEW)
    assert (await device.read())[0].value == pytest.approx(degc(NEW))


async def test_adapter_unplugged_and_back(rig: Any, slave: Any, modbus_bus: Any) -> None:
    unit = made(slave)
    _, end, device = await pty_device(rig, unit, modbus_bus)
    await device.read()
    end.stop()
    for _ in range(5):
        began = asyncio.get_running_loop().time()
        with pytest.raises(DeviceDisconnected, match="port0"):
            await device.read()
        assert asyncio.get_running_loop().time() - began < BOUND_S
    end.start()
    assert (await device.read())[0].value == pytest.approx(degc(OLD))


async def test_adapter_unplugged_during_a_request(rig: Any, slave: Any, modbus_bus: Any) -> None:
    bus, end, device = await pty_device(rig, made(slave), modbus_bus, timeout_s=2.0)
    await device.read()
    bus.faults.append(lambda frame: asyncio.get_running_loop().call_soon(end.stop) and None)
    began = asyncio.get_running_loop().time()
    with pytest.raises(DeviceDisconnected):
        await device.read()
    assert asyncio.get_running_loop().time() - began < BOUND_S


async def test_port_that_is_no_port(rig: Any, tmp_path: Any) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    for protocol, port in [("modbus-rtu", str(file)), ("dcon", str(file)), ("dcon", "/dev/does-not-exist")]:
        table = adam() if protocol == "modbus-rtu" else {**adam(), "model": "dcon"}
        device = rig.fleet({"protocol": protocol, "port": port}, table).devices["d0"]
        with pytest.raises(DeviceDisconnected, match="cannot open") as refused:
            await device.read()
        assert str(refused.value).count(port) == 1


async def test_port_in_use_by_another_line(rig: Any, slave: Any, modbus_bus: Any) -> None:
    _, end, device = await pty_device(rig, made(slave), modbus_bus)
    await device.read()
    other = rig.fleet({"protocol": "modbus-rtu", "port": end.link}, adam()).devices["d0"]
    with pytest.raises(DeviceDisconnected, match="in use by another program"):
        await other.read()
    await device.close()
    assert (await other.read())[0].quality is Quality.GOOD
