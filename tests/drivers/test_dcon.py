"""DCON modules: texts, and the driver against simulated modules on a pseudo-terminal."""

from __future__ import annotations

import asyncio
import threading
import time
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.dcon import DconDevice, DconSettings
from drivers.dcon_line import DconLine
from drivers.dcon_text import checksum, decode, encode, split_values, to_reading
from drivers.errors import (
    DeviceDisconnected,
    DeviceGarbled,
    DeviceRefused,
    DeviceTimeout,
    DriverConfigError,
    DriverError,
)
from drivers.family import LineSettings
from drivers.reading import Quality
from sim_hardware.wire import Adam, IcpDas, Rack
from sim_hardware.wire import DconLine as SimLine
from sim_hardware.wire import DconSettings as SimSettings

TIMEOUT_S = 0.15
BOUND_S = 2.0 * TIMEOUT_S + 0.15


@pytest.fixture
def rack():
    with Rack() as rack:
        yield rack


def module(value=21.5, **more):
    return IcpDas("m-7018r", couples="K", sources={0: lambda: value, 1: lambda: value + 1.0}, **more)


@asynccontextmanager
async def devices(port, *tables, timeout_s=TIMEOUT_S):
    line = DconLine(LineSettings(name="line", protocol="dcon", port=port, timeout_s=timeout_s))
    made = []
    for number, table in enumerate(tables, 1):
        plain = {"name": f"d{number}", "line": "line", "model": "dcon", "address": number}
        plain["inputs"] = [{"input": 0}, {"input": 1}]
        made.append(DconDevice(msgspec.convert({**plain, **table}, DconSettings), line))
    try:
        yield made
    finally:
        await line.close()
        await line.close()


async def failure(device):
    start_s = time.monotonic()
    with pytest.raises(DriverError) as caught:
        await device.read()
    assert time.monotonic() - start_s < BOUND_S
    assert caught.value.device == device.name
    return caught.value


async def heals(device, within_s=2.0):
    end_s = time.monotonic() + within_s
    while True:
        try:
            return await device.read()
        except DriverError:
            assert time.monotonic() < end_s
            await asyncio.sleep(0.02)


def test_checksum_vectors():
    assert checksum("$012") == "B7"
    assert checksum("!01200600") == "AA"
    assert encode("$012", summed=True) == b"$012B7\r"
    assert decode("d", b"!01200600AA", summed=True) == "!01200600"
    with pytest.raises(DeviceGarbled):
        decode("d", b"!01200600AB", summed=True)


def test_texts_of_mixed_width():
    texts = split_values(
        "d", ">+05.123-0000+9999       +10.000-05.133-9999.9+08.234", count=8, data_format="engineering"
    )
    assert texts == ["+05.123", "-0000", "+9999", None, "+10.000", "-05.133", "-9999.9", "+08.234"]
    qualities = [to_reading(t, couple="K", data_format="engineering", vendor="icpdas").quality for t in texts]
    assert [q.value for q in qualities[:4]] == ["good", "under_range", "over_range", "invalid"]


@pytest.mark.parametrize(
    "reply", [">+05.123", ">+05.123+05.12", ">+5.123.+05.123", "+05.123+05.123", ">", "?01"]
)
def test_reply_that_is_not_two_values(reply):
    with pytest.raises(DeviceGarbled):
        split_values("d", reply, count=2, data_format="engineering")


@pytest.mark.parametrize(
    ("text", "vendor", "couple", "data_format", "expected"),
    [
        ("E6D0", "icpdas", "K", "hex", -269.98),
        ("7FFF", "icpdas", "K", "hex", Quality.OVER),
        ("8000", "icpdas", "K", "hex", Quality.UNDER),
        ("FFFF", "adam", "K", "hex", Quality.OVER),
        ("0000", "adam", "K", "hex", Quality.UNDER),
        ("E000", "adam", "T", "hex", -100.0),
        ("2492", "adam", "R", "hex", 500.0),
        ("+050.00", "adam", "K", "percent", 685.0),
        ("+2000.0", "adam", "K", "engineering", Quality.INVALID),
    ],
)
def test_one_value(text, vendor, couple, data_format, expected):
    reading = to_reading(text, couple=couple, data_format=data_format, vendor=vendor)
    if isinstance(expected, Quality):
        assert reading.quality is expected
    else:
        assert reading.value == pytest.approx(expected, abs=0.05)


@given(st.binary(max_size=80), st.booleans(), st.sampled_from(["engineering", "percent", "hex"]))
def test_random_bytes_are_garbled_at_worst(data, summed, data_format):
    try:
        texts = split_values("d", decode("d", data, summed=summed), count=8, data_format=data_format)
    except DeviceGarbled:
        return
    for text in texts:
        to_reading(text, couple="K", data_format=data_format, vendor="adam")


@given(st.text("+-0129. ", max_size=60), st.sampled_from(["engineering", "percent"]))
def test_nearly_sound_text_is_garbled_at_worst(text, data_format):
    try:
        texts = split_values("d", ">" + text, count=2, data_format=data_format)
    except DeviceGarbled:
        return
    for each in texts:
        to_reading(each, couple="T", data_format=data_format, vendor="icpdas")


@pytest.mark.parametrize("summed", [False, True])
@pytest.mark.parametrize("data_format", ["engineering", "percent", "hex"])
@pytest.mark.parametrize("vendor", ["icpdas", "adam"])
async def test_good_values(rack, summed, data_format, vendor):
    sources = {0: lambda: 21.5, 1: lambda: 22.5}
    made = (
        IcpDas("m-7018r", couples="K", sources=sources)
        if vendor == "icpdas"
        else Adam("adam-4018+", couples="K", sources=sources)
    )
    sim = rack.add(SimLine({1: made}, settings={1: SimSettings(data_format=data_format, checksum=summed)}))
    table = {"checksum": summed, "format": data_format, "vendor": vendor}
    async with devices(sim.port, table) as (device,):
        readings = await device.read()
    assert device.units == {0: "degc", 1: "degc"}
    assert [readings[n].value for n in (0, 1)] == pytest.approx([21.5, 22.5], abs=0.15)


async def test_open_over_under(rack):
    sim = rack.add(SimLine({1: module(), 2: IcpDas("m-7018", couples="K", sources={0: lambda: 5000.0})}))
    sim.module(1).faults.set("open", input=0)
    sim.module(1).faults.set("under", input=1)
    async with devices(sim.port, {}, {"inputs": [{"input": 0}, {"input": 7}]}) as (first, second):
        readings = await first.read()
        assert [readings[n].quality for n in (0, 1)] == [Quality.OPEN, Quality.UNDER]
        sim.module(1).faults.clear()
        assert (await first.read())[0].value == pytest.approx(21.5, abs=0.1)
        assert (await second.read())[0].quality in {Quality.OPEN, Quality.OVER}


async def test_set_otherwise_than_configured(rack):
    sim = rack.add(
        SimLine(
            {1: module(), 2: module(), 3: Adam("adam-4118", couples=["K"] * 7 + ["T"], sources={})},
            settings={1: SimSettings(data_format="percent")},
        )
    )
    third = {"vendor": "adam", "inputs": [{"input": 7}, {"input": 0}]}
    async with devices(sim.port, {}, {"inputs": [{"input": 0, "couple": "T"}]}, third) as made:
        for device in made:
            assert isinstance(await failure(device), DeviceRefused)
    with pytest.raises(DriverConfigError):
        async with devices(sim.port, {"vendor": "adam", "inputs": [{"input": 0, "couple": "N"}]}):
            pass


@pytest.mark.parametrize(
    ("fault", "kinds"),
    [
        ("silence", (DeviceTimeout,)),
        ("garbage", (DeviceTimeout, DeviceGarbled)),
        ("truncate", (DeviceTimeout,)),
        ("wrong_length", (DeviceGarbled,)),
        ("bad_crc", (DeviceGarbled,)),
        ("exception", (DeviceRefused,)),
        ("disconnect", (DeviceDisconnected,)),
    ],
)
async def test_fault_and_return(rack, fault, kinds):
    sim = rack.add(SimLine({1: module()}, settings={1: SimSettings(checksum=True)}))
    async with devices(sim.port, {"checksum": True}) as (device,):
        await device.read()
        sim.module(1).faults.set(fault)
        for _ in range(2):
            assert isinstance(await failure(device), kinds)
        sim.module(1).faults.clear()
        readings = await heals(device)
        assert readings[0].value == pytest.approx(21.5, abs=0.1)


@pytest.mark.parametrize("delay_s", [TIMEOUT_S * 1.2, TIMEOUT_S * 2.5])
async def test_late_reply_is_not_taken_for_the_next(rack, delay_s):
    sim = rack.add(SimLine({1: module(21.5), 2: module(80.0)}))
    async with devices(sim.port, {}, {}) as (first, second):
        await first.read()
        await second.read()
        sim.module(1).faults.set("late", delay_s=delay_s, times=1)
        assert isinstance(await failure(first), DeviceTimeout)
        end_s = time.monotonic() + 3 * delay_s
        good = 0
        while time.monotonic() < end_s:
            try:
                readings = await second.read()
            except DriverError:
                continue
            good += 1
            assert readings[0].value == pytest.approx(80.0, abs=0.1)
        assert good > 3
        assert (await heals(first))[0].value == pytest.approx(21.5, abs=0.1)


async def test_dead_module_rests_and_does_not_starve_the_others(rack):
    sim = rack.add(SimLine({1: module(), 2: module(30.0)}))
    sim.module(1).faults.set("silence")
    async with devices(sim.port, {}, {}) as (dead, alive):
        for _ in range(3):
            await failure(dead)
        start_s = time.monotonic()
        error = await failure(dead)
        assert time.monotonic() - start_s < 0.02
        assert isinstance(error, DeviceTimeout)
        assert "next attempt" in str(error)
        assert (await alive.read())[0].value == pytest.approx(30.0, abs=0.1)
        start_s = time.monotonic()
        assert (await alive.read())[0].value == pytest.approx(30.0, abs=0.1)
        assert time.monotonic() - start_s < 0.1


async def test_no_port_and_closed_line(tmp_path):
    async with devices(str(tmp_path / "none"), {}) as (device,):
        assert isinstance(await failure(device), DeviceDisconnected)
    assert isinstance(await failure(device), DeviceDisconnected)


async def test_close_leaves_no_thread_and_no_descriptor(rack):
    sim = rack.add(SimLine({1: module()}))
    before = len(list(Path("/proc/self/fd").iterdir()))
    async with devices(sim.port, {}) as (device,):
        await device.read()
        assert len(list(Path("/proc/self/fd").iterdir())) > before
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("dcon-")]
