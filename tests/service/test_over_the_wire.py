"""Device faults on the real wire, and what the receiver sees of them."""

from __future__ import annotations

import asyncio
import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import drivers
from compensator.clock import VirtualClock
from compensator.messages import number
from compensator.model.model_file import load_model
from compensator.recording.recorder import McapRecorder
from compensator.service import disk_writer
from compensator.service.compensation import Compensation, Outcome
from compensator.service.daemon import Daemon
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from sim_hardware.wire import CapaNcdt, IcpDas, ModbusRtuLine, ModbusTcpServer, Rack
from tests.service.shared_time import QUIET_S, SharedTime, TimedRack
from tests.service.simulated import START_NS, TABLE, config

CHANNELS = [
    {**channel, "device": device, "input": 0, **changes}
    for channel, device, changes in zip(
        TABLE["channel"][:3],
        ("couples", "cabinet", "probe"),
        ({}, {}, {"range": [10.0, 490.0]}),
        strict=True,
    )
]


#: The fault begins after so many samples.
BEGIN = 40
#: Time of the drivers between two polls from then on, s.
POLL_S = 1.0


class Wired:
    """A service on simulated devices over a pseudo-terminal and TCP ports."""

    def __init__(self, rack: Rack, folder: Path) -> None:
        duty = Duty.working_day(1, hours=60)
        self.world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
        source = self.world.source
        self.rtu = rack.add(ModbusRtuLine({1: IcpDas("m-7018r", ranges="K", sources={0: source("t_q_degc")})}))
        self.tcp = rack.add(ModbusTcpServer({1: IcpDas("et-7018z", ranges="T", sources={0: source("at_degc")})}))
        self.capa = rack.add(CapaNcdt({1: lambda: 250.0 + source("y_um")()}, 500.0))
        self.fleet = drivers.build(*self._tables(), source="test")
        self.config = config(device=[{"name": n} for n in ("couples", "cabinet", "probe")], channel=CHANNELS)
        self.outcomes: list[Outcome] = []
        self.at_sample: dict[int, Callable[[], Any]] = {}

        async def advance(t_s: float) -> None:
            self.world.advance_to(t_s)
            self.capa.push(1)
            if len(self.outcomes) >= BEGIN:
                # The drivers' own time goes on as well, or no line would be opened again.
                await asyncio.sleep(POLL_S)

        self.daemon = Daemon(
            config=self.config,
            compensation=Compensation(self.config, load_model("quill")),
            devices=self.fleet.devices,
            recorder=McapRecorder(folder, "vmc-07", {}),
            publish=lambda name, data: None,
            clock=VirtualClock(START_NS, advance),
            first_sequence=0,
        )

    def _tables(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        host = {"host": "127.0.0.1", "timeout_s": 0.3}
        lines = [
            {"name": "a", "protocol": "modbus-rtu", "port": str(self.rtu.port), "timeout_s": 0.3},
            {"name": "b", "protocol": "modbus-tcp", "tcp_port": self.tcp.port, **host},
            {
                "name": "c",
                "protocol": "capancdt",
                "data_port": self.capa.data_port,
                "command_port": self.capa.command_port,
                **host,
            },
        ]
        devices = [
            {
                "name": "couples",
                "line": "a",
                "model": "icpdas-m7018r",
                "address": 1,
                "format": "hex",
                "inputs": [{"input": 0, "couple": "K"}],
            },
            {
                "name": "cabinet",
                "line": "b",
                "model": "icpdas-et7018z",
                "address": 1,
                "format": "hex",
                "inputs": [{"input": 0, "couple": "T"}],
            },
            {"name": "probe", "line": "c", "model": "capancdt-6200", "inputs": [{"input": 0}]},
        ]
        return lines, devices

    async def run(self, most: int, done: Callable[[Wired], bool]) -> None:
        def step(outcome: Outcome) -> None:
            self.outcomes.append(outcome)
            self.at_sample.pop(len(self.outcomes), lambda: None)()
            if done(self):
                self.daemon.stop()

        try:
            await self.daemon.run(samples=most, on_sample=step)
        finally:
            await self.fleet.close()


#: How a line or a device fails and comes back; every kind on every carrier is in `device_faults`.
FAULTS = [
    ("couples", "silence", {}, "t_q_degc"),
    ("couples", "bad_crc", {}, "t_q_degc"),
    ("couples", "disconnect", {}, "t_q_degc"),
    ("couples", "late", {"delay_s": 0.8}, "t_q_degc"),
    ("couples", "open", {"input": 0}, "t_q_degc"),
    ("cabinet", "silence", {}, "at_degc"),
    ("cabinet", "disconnect", {}, "at_degc"),
    ("cabinet", "open", {"input": 0}, "at_degc"),
    ("probe", "silence", {}, "y_um"),
    ("probe", "over", {"input": 1}, "y_um"),
]


@pytest.mark.parametrize(("device", "fault", "parameters", "channel"), FAULTS)
def test_a_fault_is_missing_never_a_number_and_heals(
    tmp_path: Path, device: str, fault: str, parameters: dict[str, Any], channel: str
) -> None:
    shared = SharedTime()

    async def run() -> None:
        wired = Wired(rack, tmp_path)
        faults = {"couples": wired.rtu.module(1), "cabinet": wired.tcp.module(1), "probe": wired.capa}[device].faults
        wired.at_sample[BEGIN] = lambda: faults.set(fault, **parameters)
        wired.at_sample[BEGIN + 8] = faults.clear

        def healed(w: Wired) -> bool:
            return len(w.outcomes) > 60 and all(
                o.sample.channels[channel].quality == "good" and o.offset.state == "ok" for o in w.outcomes[-5:]
            )

        await wired.run(300, healed)
        outcomes = wired.outcomes
        assert healed(wired), outcomes[-1].offset
        bad = [o.sample.channels[channel] for o in outcomes[BEGIN + 1 : BEGIN + 7]]
        assert all(c.quality != "good" and c.count == 0 and math.isnan(number(c.mean)) for c in bad), bad
        if channel == "y_um":
            assert all(o.offset.state == "ok" for o in outcomes[BEGIN + 1 : BEGIN + 7]), [
                (o.offset.state, o.offset.reasons, {n: (c.quality, c.errors) for n, c in o.sample.channels.items()})
                for o in outcomes[BEGIN + 1 : BEGIN + 7]
            ]
            assert all(math.isnan(number(o.estimate.residual_um)) for o in outcomes[BEGIN + 1 : BEGIN + 7])
        else:
            assert all(o.offset.state in ("degraded", "hold") for o in outcomes[BEGIN + 1 : BEGIN + 7])
            assert all(not math.isnan(number(o.offset.y_offset_um)) for o in outcomes[BEGIN + 1 : BEGIN + 7])
        # A line that opens late on a busy machine leaves the first samples without an offset; from the first number
        # on there is always one, and it never jumps.
        started = next(i for i, o in enumerate(outcomes) if o.offset.state != "starting")
        assert started < 30
        offsets = [number(o.offset.y_offset_um) for o in outcomes[started:]]
        jumps = [i for i, (a, b) in enumerate(itertools.pairwise(offsets)) if not abs(b - a) <= 8.0 + 1e-9]
        assert not jumps, [outcomes[started + i + 1].offset for i in jumps[:2]]
        times = [o.offset.time_utc_ns for o in outcomes]
        assert all(b - a == 60_000_000_000 for a, b in itertools.pairwise(times))

    with TimedRack(shared) as rack:
        shared.run(run())


def test_the_shared_time_stands_still_while_something_is_written_to_disk() -> None:
    """A slow disk makes no device late: the disk takes far longer than the loop waits before the time jumps."""
    shared = SharedTime()

    async def run() -> None:
        executor = disk_writer.ThreadPoolExecutor(1)
        async with asyncio.timeout(5.0):
            await asyncio.wrap_future(executor.submit(time.sleep, 20 * QUIET_S))
        executor.shutdown()

    shared.run(run())
    assert shared.now_s < 1.0
