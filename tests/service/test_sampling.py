"""Readings of devices that answer late: no value gets the time of a later sample."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Collection, Mapping
from typing import Any

import pytest

import drivers
from compensator.clock import VirtualClock
from compensator.codes import SampleQuality
from compensator.messages import ChannelSample, number
from compensator.service.sampling import ChannelCollector, Sampler
from drivers.errors import DeviceGarbled
from drivers.reading import Reading
from sim_hardware.wire import IcpDas, ModbusRtuLine
from tests.service.shared_time import SharedTime, TimedRack
from tests.service.simulated import START_NS, TABLE, config


class LoopClock(VirtualClock):
    """Waits for devices as the clock of the computer does, in the time of the loop."""

    async def settle(self, tasks: Collection[asyncio.Future[Any]], timeout_s: float) -> None:
        if tasks:
            await asyncio.wait(tasks, timeout=timeout_s)


@pytest.mark.parametrize("value", [1.1e12, -1e300, math.inf, math.nan])
def test_a_reading_that_no_recording_holds_is_invalid(value: float) -> None:
    """Else the service could not read its own recording at the next start."""
    collector = ChannelCollector(0.5)
    for _ in range(4):
        collector.add(Reading.good(value))
    collector.add(Reading.good(20.0))
    sample = collector.close()
    assert sample.quality == "invalid" and sample.errors == {"invalid": 4} and sample.count == 1
    assert math.isnan(sample.mean or 0.0) and sample.max == 20.0


EXTRA: dict[str, Any] = {"device": "module", "input": 7}


async def mean_of(channel: str, values: list[float]) -> tuple[float, int]:
    """Return mean and number of outliers of a sample that a channel's device measures so."""
    conf = config(channel=[*TABLE["channel"][:2], {**EXTRA, "name": channel}])
    left = iter(values)

    class Device:
        name = "module"
        units: Mapping[int, str] = {}

        async def read(self) -> Mapping[int, Reading]:
            value = next(left)
            return {number: Reading.good(value) for number in (0, 1, EXTRA["input"])}

        async def close(self) -> None:
            """Nothing to release."""

    sampler = Sampler(conf, {"module": Device()}, VirtualClock(START_NS), lambda *_: None)
    for _ in values:
        await sampler.poll(1.0)
    sample = sampler.close_sample()[channel]
    return number(sample.mean), sample.errors.get("outlier", 0)


@pytest.mark.parametrize("value", [23.4, 0.0, -3.0])
@pytest.mark.parametrize("wrong", [(61.6,), (61.6, 38.6), (38.6, 38.6), (21.6, 7.0, -70.0)])
@pytest.mark.parametrize("channel", ["nut_degc", "base_um"])
async def test_wrong_readings_of_a_quiet_channel_are_left_out_however_many(
    channel: str, wrong: tuple[float, ...], value: float
) -> None:
    """Else the nearest wrong one counts as the step of the converter, and the others are near it in such steps."""
    assert await mean_of(channel, [value] * 10 + [value + one for one in wrong]) == (value, len(wrong))


@pytest.mark.parametrize(
    ("channel", "quiet", "others"),
    [
        ("nut_degc", 23.4, (23.5, 23.5, 23.3, 23.6)),  # 0.1 K
        ("nut_degc", 0.4, (0.5, 0.5, 0.6)),  # near zero
        ("nut_degc", 23.0, (24.0, 24.0, 24.0)),  # whole degrees
        ("base_um", 0.0, (1.0, 1.0, -1.0)),
        ("base_um", 0.0, (4.9, 4.9)),  # 12 bit of ±10 mm
        ("spindle_rpm", 0.0, (3000.0, 9000.0, 12000.0)),  # it starts
        ("spindle_rpm", 12000.0, (0.0, 0.0, 8000.0, 8000.0)),  # a change of the tool
        ("pump_percent", 0.0, (100.0, 100.0)),
        ("flow_lpm", 8.0, (0.0, 0.0, 0.0)),
    ],
)
async def test_steps_of_a_converter_and_what_is_switched_count(
    channel: str, quiet: float, others: tuple[float, ...]
) -> None:
    values = [quiet] * 8 + list(others)
    mean, outliers = await mean_of(channel, values)
    assert outliers == 0 and mean == pytest.approx(math.fsum(values) / len(values), abs=1e-12)


class SlowDevice:
    """A device that answers each request when the test says so."""

    name = "slow"
    units: Mapping[int, str] = {0: "degc"}

    def __init__(self) -> None:
        self.asked: list[asyncio.Future[float]] = []

    async def read(self) -> Mapping[int, Reading]:
        answer = asyncio.get_running_loop().create_future()
        self.asked.append(answer)
        return {0: Reading.good(await answer)}

    async def close(self) -> None:
        """Nothing to release."""

    async def answer(self, value: float | Exception) -> None:
        """Answer the last request."""
        if isinstance(value, Exception):
            self.asked[-1].set_exception(value)
        else:
            self.asked[-1].set_result(value)
        await asyncio.sleep(0)
        await asyncio.sleep(0)


def make_sampler(device: Any) -> Sampler:
    channel = {**TABLE["channel"][0], "device": device.name, "input": 0}
    at = {**TABLE["channel"][1], "device": device.name, "input": 1}
    settings = config(device=[{"name": device.name}], channel=[channel, at])
    return Sampler(settings, {device.name: device}, LoopClock(START_NS), lambda *_: None)


def close(sampler: Sampler) -> ChannelSample:
    return sampler.close_sample()["t_q_degc"]


@pytest.mark.parametrize("interval_s", [60.0, 3600.0])
def test_a_device_that_comes_back_between_two_samples_gives_the_value_of_the_sample(interval_s: float) -> None:
    """One poll a sample, over the wire: after a time-out nobody waits for the device, so its answer comes late."""
    shared = SharedTime()
    now = 0.0

    async def run() -> list[ChannelSample]:
        nonlocal now
        line = {"name": "a", "protocol": "modbus-rtu", "port": str(rtu.port), "timeout_s": 0.3}
        device = {"name": "couples", "line": "a", "model": "icpdas-m7018r", "address": 1, "format": "hex"}
        fleet = drivers.build([line], [{**device, "inputs": [{"input": 0, "couple": "K"}]}], source="test")
        sampler, samples = make_sampler(fleet.devices["couples"]), []
        for minute in range(8):
            now = 20.0 + 10.0 * minute
            await sampler.poll(interval_s)
            samples.append(close(sampler))
            if minute in (2, 3):
                module.faults.set("silence") if minute == 2 else module.faults.clear()
            await asyncio.sleep(interval_s)
        await sampler.close()
        await fleet.close()
        return samples

    with TimedRack(shared) as rack:
        rtu = rack.add(ModbusRtuLine({1: IcpDas("m-7018r", ranges="K", sources={0: lambda: now})}))
        module = rtu.module(1)
        samples = shared.run(run())
    for minute, sample in enumerate(samples):
        if sample.quality == SampleQuality.GOOD:
            assert number(sample.mean) == pytest.approx(20.0 + 10.0 * minute, abs=0.2), minute
    missing = [minute for minute, sample in enumerate(samples) if sample.quality != SampleQuality.GOOD]
    assert 3 in missing
    assert missing == list(range(3, 3 + len(missing)))
    assert 7 not in missing


async def test_a_late_answer_counts_for_the_poll_that_asked_while_its_sample_is_open() -> None:
    device = SlowDevice()
    sampler = make_sampler(device)
    for value in (20.0, 21.0, 22.0):
        await sampler.poll(0.02)
        await device.answer(value)
    await sampler.poll(0.02)
    sample = close(sampler)
    assert len(device.asked) == 4
    assert (sample.count, sample.polls, sample.errors) == (3, 4, {"device_timeout": 1})
    assert number(sample.mean) == pytest.approx(21.0)
    # The answer to the last poll comes after its sample was closed.
    await device.answer(99.0)
    await sampler.poll(0.02)
    await device.answer(23.0)
    await sampler.poll(0.02)
    sample = close(sampler)
    assert (sample.count, sample.polls, number(sample.mean)) == (1, 2, 23.0)
    await sampler.close()


async def test_a_device_slower_than_a_sample_is_missing() -> None:
    device = SlowDevice()
    sampler = make_sampler(device)
    for _ in range(3):
        await sampler.poll(0.02)
        sample = close(sampler)
        assert (sample.count, sample.polls, sample.quality) == (0, 1, "device_timeout")
        assert math.isnan(number(sample.mean))
    assert len(device.asked) == 1
    assert sampler.device_states() == {"slow": "ok"}
    await sampler.close()


async def test_a_late_error_belongs_to_its_sample_and_is_noted() -> None:
    device = SlowDevice()
    sampler = make_sampler(device)
    await sampler.poll(0.02)
    close(sampler)
    await device.answer(DeviceGarbled("slow", "half an answer"))
    await sampler.poll(0.02)
    assert "half an answer" in sampler.device_states()["slow"]
    assert close(sampler).errors == {"device_timeout": 1}
    await sampler.close()
