"""CapaNCDT 6200: blocks and sums, and the driver against a simulated controller on real TCP ports."""

from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.capancdt import CapaNcdt, CapaNcdtLine, CapaNcdtSettings
from drivers.capancdt_stream import HEADER, Block, BlockReader, ChannelSums, StreamSums, range_um
from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout, DriverError
from drivers.family import LineSettings
from drivers.reading import Quality
from sim_hardware.wire import CapaNcdt as Sim
from sim_hardware.wire import Rack

TIMEOUT_S = 0.15
BOUND_S = 2.0 * TIMEOUT_S + 0.15


def packed(counter, *values, frames=None):
    n = len(values) if frames is None else frames
    data = b"".join(v.to_bytes(4, "little", signed=True) for v in values)
    return HEADER.pack(b"MEAS", 1, 2, 0b01, 0, n, 4, counter) + data


@asynccontextmanager
async def device_of(host, data_port, command_port, **table):
    line = CapaNcdtLine(
        LineSettings(
            name="line",
            protocol="capancdt",
            host=host,
            data_port=data_port,
            command_port=command_port,
            timeout_s=TIMEOUT_S,
        )
    )
    plain = {"name": "gap", "line": "line", "model": "capancdt-6200", "inputs": [{"input": 0}], **table}
    try:
        yield CapaNcdt(msgspec.convert(plain, CapaNcdtSettings), line)
    finally:
        await line.close()
        await line.close()


@pytest.fixture
def sim():
    with Rack() as rack:
        yield rack.add(Sim({1: lambda: 1000.0, 2: lambda: 250.0}, {1: 2000.0, 2: 500.0}, realtime=True))


async def failure(device):
    start_s = time.monotonic()
    with pytest.raises(DriverError) as caught:
        await device.read()
    assert time.monotonic() - start_s < BOUND_S
    assert caught.value.device == "gap"
    return caught.value


async def heals(device, within_s=3.0):
    end_s = time.monotonic() + within_s
    while True:
        try:
            return await device.read()
        except DriverError:
            assert time.monotonic() < end_s
            await asyncio.sleep(0.02)


def test_scaling_polarity_and_zero():
    sums = ChannelSums(2000.0, 1, 0.0)
    sums.add(np.array([0x7FFFFF], dtype=np.int32))
    sums = ChannelSums(2000.0, 1, 0.0)
    sums.add(np.array([0x7FFFFF], dtype=np.int32))
    assert sums.take().value == pytest.approx(0x7FFFFF / 0xFFFFFF * 2000.0, abs=1e-9)
    sums = ChannelSums(0xFFFFFF, -1, 10.0)
    sums.add(np.array([100, 200, 600], dtype=np.int32))
    reading = sums.take()
    assert (reading.value, reading.minimum, reading.maximum, reading.count) == (-290.0, -590.0, -90.0, 3)


@pytest.mark.parametrize(
    ("raw", "quality"), [(0, Quality.UNDER), (0xFFFFFF, Quality.OVER), (1, Quality.GOOD)]
)
def test_ends_of_the_range(raw, quality):
    sums = ChannelSums(2000.0, 1, 0.0)
    sums.add(np.array([5000, raw], dtype=np.int32))
    assert sums.take().quality is quality
    assert sums.take().count == 0


@given(st.lists(st.integers(1, 60), max_size=12))
def test_split_and_joined_blocks(cuts):
    data = (
        b"junk" + packed(0, 1, 2, 3) + packed(3, 4) + b"MEAS junk that is no header, and long" + packed(4, 5)
    )
    reader, values = BlockReader(), []
    for cut in [*cuts, len(data)]:
        values += [v for block in reader.feed(data[:cut]) for v in block.frames[:, 0].tolist()]
        data = data[cut:]
    assert values == [1, 2, 3, 4, 5]


def test_block_shorter_than_it_says_is_dropped_and_the_next_is_not():
    reader = BlockReader()
    blocks = reader.feed(packed(0, 1, 2, frames=3) + packed(3, 7, 8))
    assert [block.frames[:, 0].tolist() for block in blocks] == [[7, 8]]
    assert reader.garbled_bytes > 0


@given(st.lists(st.binary(max_size=200), max_size=10))
def test_random_bytes_give_no_error(pieces):
    reader = BlockReader()
    for piece in pieces:
        reader.feed(piece + b"MEAS")


def test_counter_gap_wrap_and_standstill():
    sums = StreamSums({1: ChannelSums(2000.0, 1, 0.0)})
    frames = np.full((4, 1), 1000, dtype=np.int32)
    for counter in (0xFFFFFFFC, 0, 4, 10):
        sums.add(Block((1,), counter, frames))
    assert sums.lost_frames == 2
    assert sums.take([1])[0].count == 16
    sums.add(Block((1,), 10, frames))
    assert sums.take([1])[0].quality is Quality.STALE


@given(st.text(max_size=60))
def test_random_channel_info(text):
    try:
        assert range_um("d", 1, ":RNG,UNT" + text) > 0.0
    except (DeviceGarbled, DeviceRefused):
        return


def test_channel_info():
    assert range_um("d", 1, ":ANO1,NAMx,SNO1,OFS0,RNG0.5,UNTmmOK") == 500.0
    with pytest.raises(DeviceGarbled):
        range_um("d", 1, ":RNG,UNTumOK")
    with pytest.raises(DeviceRefused):
        range_um("d", 1, "$WRONG PARAMETER")


async def test_good_values(sim):
    inputs = [{"input": 1, "polarity": -1, "zero_um": 300.0}, {"input": 0}]
    async with device_of(sim.host, sim.data_port, sim.command_port, inputs=inputs) as device:
        assert device.units == {0: "um", 1: "um"}
        await device.read()
        await asyncio.sleep(0.1)
        start_s = time.monotonic()
        readings = await device.read()
        assert time.monotonic() - start_s < 0.05
    assert readings[0].value == pytest.approx(1000.0, abs=0.001)
    assert readings[1].value == pytest.approx(50.0, abs=0.001)
    assert readings[0].count > 50


@pytest.mark.parametrize(("fault", "quality"), [("open", "over_range"), ("under", "under_range")])
async def test_bad_input(sim, fault, quality):
    sim.faults.set(fault, input=1)
    async with device_of(sim.host, sim.data_port, sim.command_port) as device:
        assert (await device.read())[0].quality == quality


async def test_counter_that_stands_still(sim):
    sim.faults.set("stale_counter")
    async with device_of(sim.host, sim.data_port, sim.command_port) as device:
        await device.read()
        await asyncio.sleep(0.05)
        assert (await device.read())[0].quality is Quality.STALE


@pytest.mark.parametrize("fault", ["split", "join"])
async def test_split_and_joined_over_tcp(sim, fault):
    sim.faults.set(fault)
    async with device_of(sim.host, sim.data_port, sim.command_port) as device:
        for _ in range(3):
            assert (await device.read())[0].value == pytest.approx(1000.0, abs=0.001)
        assert device.lost_frames == 0


@pytest.mark.parametrize(
    ("fault", "kinds"),
    [
        ("silence", DeviceTimeout),
        ("garbage", DeviceGarbled),
        ("wrong_length", DeviceGarbled),
        ("disconnect", DeviceDisconnected),
    ],
)
async def test_fault_and_return(sim, fault, kinds):
    async with device_of(sim.host, sim.data_port, sim.command_port) as device:
        await device.read()
        sim.faults.set(fault)
        await asyncio.sleep(0.05)
        errors = []
        for _ in range(3):
            try:
                await device.read()  # what came before the fault
            except DriverError as error:
                errors.append(error)
        assert errors
        assert isinstance(await failure(device), kinds)
        sim.faults.clear()
        assert (await heals(device))[0].value == pytest.approx(1000.0, abs=0.001)


async def test_missing_channel_and_dead_controller(sim):
    async with device_of(sim.host, sim.data_port, sim.command_port, inputs=[{"input": 3}]) as device:
        assert isinstance(await failure(device), DeviceRefused)
    sim.faults.set("disconnect")
    async with device_of(sim.host, sim.data_port, sim.command_port) as device:
        assert isinstance(await failure(device), DeviceDisconnected)
    assert isinstance(await failure(device), DeviceDisconnected)
