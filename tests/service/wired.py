"""The whole service on simulated devices and wires, and a receiver in a Zenoh session of its own.

A simulated hour takes seconds: the clock is handed in, and each sample waits until the receiver has its offset, so that
nothing is lost to the pace.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

import drivers
from compensator.clock import VirtualClock
from compensator.config import Config, Zenoh
from compensator.messages import Event, Offset, Sample
from compensator.model.model_file import load_model
from compensator.model.thermal_model import ThermalModel
from compensator.recording.recorder import McapRecorder
from compensator.service.compensation import Compensation, Outcome
from compensator.service.daemon import Daemon
from compensator.service.publisher import Publisher, session_config
from drivers import catalog
from drivers.errors import DriverError
from drivers.families.base import Line
from drivers.lines.settings import CapancdtLine, LineSettings
from sim_hardware.physics import World
from sim_hardware.wire import (
    CapaNcdt,
    DconLine,
    DconSettings,
    IcpDas,
    ModbusRtuLine,
    ModbusTcpServer,
    Rack,
    Register,
    RegisterMap,
)
from sim_hardware.wire.faults import Faults
from tests.ports import free_port
from tests.service.simulated import START_NS, TABLE, config

TIMEOUT_S = 0.4
PATIENCE_S = 60.0
KINDS: dict[str, type] = {"offset": Offset, "sample": Sample, "event": Event}
KEYS = {"offset": "thermal/y/offset", "sample": "thermal/sample", "event": "thermal/event"}


def _patient(settings: Zenoh) -> zenoh.Config:
    """Return settings whose links outlast what a test waits for: on a busy computer nobody may answer for 10 s."""
    config = session_config(settings)
    config.insert_json5("transport/link/tx/lease", str(round(2e3 * PATIENCE_S)))
    return config


class Receiver:
    """Everything that one subscriber gets, by machine; services that publish to it keep their link as it does."""

    def __init__(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.got: dict[tuple[str, str], list[Any]] = defaultdict(list)
        self._arrived = threading.Condition()
        self._session: Any = None
        self._patch = pytest.MonkeyPatch()

    def __enter__(self) -> Receiver:
        self._patch.setattr("compensator.service.publisher.session_config", _patient)
        self._session = zenoh.open(_patient(Zenoh(prefix="x", listen=[self.endpoint])))
        for name, key in KEYS.items():
            self._session.declare_subscriber(f"shop/*/{key}", lambda sample, name=name: self._take(name, sample))
        return self

    def __exit__(self, *_: object) -> None:
        self._patch.undo()
        self._session.close()

    def _take(self, name: str, sample: Any) -> None:
        message = msgspec.json.decode(sample.payload.to_bytes(), type=KINDS[name])
        with self._arrived:
            self.got[message.machine, name].append(message)
            self._arrived.notify_all()

    def wait(self, machine: str, name: str, seq: int) -> None:
        """Wait until a message with this number, or a later one, is there."""
        got = self.got[machine, name]
        with self._arrived:
            assert self._arrived.wait_for(lambda: bool(got) and got[-1].seq >= seq, PATIENCE_S), (machine, name, seq)


@contextlib.contextmanager
def patient_lines() -> Iterator[None]:
    """Build lines that wait far longer for a reply than a configuration may say: for devices that all answer.

    Not those that send by themselves: who reads them before they have sent anything waits for nothing.
    """
    made = catalog._new_line

    def patient(config: LineSettings) -> Line:
        is_asked = not isinstance(config, CapancdtLine)
        return made(msgspec.structs.replace(config, timeout_s=PATIENCE_S) if is_asked else config)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(catalog, "_new_line", patient)
        yield


class WiredMachine:
    """One machine on its wires.

    Layouts: `apart` has T_Q on a serial Modbus line, AT on Modbus TCP; `one line` has both on one serial line, `dcon`
    on one DCON line with checksums, `map` both in the registers of one device. Y is always on a capaNCDT controller.

    Where every device answers, a patient machine waits for each reply, however busy the computer is.
    """

    def __init__(
        self,
        rack: Rack,
        folder: Path,
        world: World,
        *,
        name: str = "vmc-07",
        layout: str = "apart",
        model: ThermalModel | None = None,
        receiver: Receiver | None = None,
        sources: Mapping[str, Callable[[], float]] | None = None,
        timeout_s: float = TIMEOUT_S,
        is_patient: bool = False,
        **changes: Any,
    ) -> None:
        self.world, self.name, self.layout, self.timeout_s = world, name, layout, timeout_s
        self.sources: dict[str, Callable[[], float]] = {
            channel: sources[channel] if sources and channel in sources else world.source(channel)
            for channel in ("t_q_degc", "at_degc", "y_um")
        }
        self.lines: list[dict[str, Any]] = []
        self.devices: list[dict[str, Any]] = []
        #: Faults that act on the device of a channel, and the number of its input.
        self.faults: dict[str, tuple[Faults, int]] = {}
        #: Device and input of each channel.
        self._inputs = {"t_q_degc": ("couples", 0), "at_degc": ("cabinet", 0), "y_um": ("probe", 0)}
        self._build(rack)
        with patient_lines() if is_patient else contextlib.nullcontext():
            self.fleet = drivers.build(self.lines, self.devices, source="test")
        self.config = self._config(changes)
        self.outcomes: list[Outcome] = []
        self.after: Callable[[Outcome], None] = lambda outcome: None
        self.waits_for: set[str] = set()
        #: What a minute takes by the clock of the loop, s. Where that clock jumps, replies arrive in their own minute.
        self.minute_s = 0.0
        self.receiver = receiver
        self.publisher: Publisher | None = None
        if receiver is not None:
            settings = Zenoh(prefix=f"shop/{name}", mode="client", connect=[receiver.endpoint])
            self.publisher = Publisher(settings, lambda *asked: self.daemon.command(*asked))
        publish = self.publisher.publish if self.publisher else lambda what, data: None
        self.daemon = Daemon(
            config=self.config,
            compensation=Compensation(self.config, model or load_model("quill")),
            devices=self.fleet.devices,
            recorder=McapRecorder(folder, name, {}),
            publish=publish,
            clock=VirtualClock(START_NS, self._advance),
            first_sequence=0,
        )

    def read(self, channel: str) -> Callable[[], float]:
        """Read a source by its name at each call, so that a test may exchange it."""
        return lambda: self.sources[channel]()

    def _build(self, rack: Rack) -> None:
        t_q = IcpDas("m-7018r", ranges="K", sources={0: self.read("t_q_degc")})
        host = {"host": "127.0.0.1", "timeout_s": self.timeout_s}
        couple = {"inputs": [{"input": 0, "couple": "K"}]}
        if self.layout == "apart":
            at = IcpDas("et-7018z", ranges="T", sources={0: self.read("at_degc")})
            rtu, tcp = rack.add(ModbusRtuLine({1: t_q})), rack.add(ModbusTcpServer({1: at}))
            self.lines += [
                {"name": "a", "protocol": "modbus-rtu", "port": str(rtu.port), "timeout_s": self.timeout_s},
                {"name": "b", "protocol": "modbus-tcp", "tcp_port": tcp.port, **host},
            ]
            self.devices += [
                {"name": "couples", "line": "a", "model": "icpdas-m7018r", "address": 1, "format": "hex", **couple},
                {
                    "name": "cabinet",
                    "line": "b",
                    "model": "icpdas-et7018z",
                    "address": 1,
                    "format": "hex",
                    "inputs": [{"input": 0, "couple": "T"}],
                },
            ]
        elif self.layout == "one line":
            at = IcpDas("m-7018r", ranges="K", sources={0: self.read("at_degc")})
            line = rack.add(ModbusRtuLine({1: t_q, 2: at}))
            self.lines.append(
                {"name": "a", "protocol": "modbus-rtu", "port": str(line.port), "timeout_s": self.timeout_s}
            )
            self.devices += [
                {"name": name, "line": "a", "model": "icpdas-m7018r", "address": i, "format": "hex", **couple}
                for i, name in ((1, "couples"), (2, "cabinet"))
            ]
        elif self.layout == "map":
            plc = RegisterMap(
                {
                    0: Register(source=self.read("t_q_degc"), kind="float32"),
                    2: Register(source=self.read("at_degc"), per_unit=100.0),
                }
            )
            tcp = rack.add(ModbusTcpServer({1: plc}))
            self.lines.append({"name": "b", "protocol": "modbus-tcp", "tcp_port": tcp.port, **host})
            number = {"unit": "degc", "type": "int16"}
            self.devices.append(
                {
                    "name": "couples",
                    "line": "b",
                    "model": "modbus-map",
                    "address": 1,
                    "max_gap": 2,
                    "inputs": [
                        {"input": 0, "unit": "degc", "type": "float32", "address": 0},
                        {"input": 1, **number, "address": 2, "scale": 0.01, "bad_values": {"32767": "stale"}},
                    ],
                }
            )
            self._inputs["at_degc"] = "couples", 1
            self.faults = {"t_q_degc": (plc.faults, 0), "at_degc": (plc.faults, 2)}
        else:
            at = IcpDas("m-7018r", ranges="K", sources={0: self.read("at_degc")})
            settings = dict.fromkeys((1, 2), DconSettings(checksum=True))
            dcon = rack.add(DconLine({1: t_q, 2: at}, settings=settings))
            self.lines.append({"name": "a", "protocol": "dcon", "port": str(dcon.port), "timeout_s": self.timeout_s})
            self.devices += [
                {"name": name, "line": "a", "model": "dcon", "address": i, "checksum": True, **couple}
                for i, name in ((1, "couples"), (2, "cabinet"))
            ]
        if self.layout != "map":
            self.faults = {"t_q_degc": (t_q.faults, 0), "at_degc": (at.faults, 0)}
        self.capa = rack.add(CapaNcdt({1: lambda: 250.0 + self.sources["y_um"]()}, 500.0))
        self.lines.append(
            {
                "name": "c",
                "protocol": "capancdt",
                "data_port": self.capa.data_port,
                "command_port": self.capa.command_port,
                **host,
            }
        )
        self.devices.append({"name": "probe", "line": "c", "model": "capancdt-6200", "inputs": [{"input": 0}]})
        self.faults["y_um"] = self.capa.faults, 1

    def _config(self, changes: Mapping[str, Any]) -> Config:
        names = [device["name"] for device in self.devices]
        limits: tuple[dict[str, Any], ...] = ({}, {}, {"range": [10.0, 490.0]})
        channels = [
            {**channel, "device": device, "input": number, "stuck_after_min": 30.0, **more}
            for channel, (device, number), more in zip(TABLE["channel"][:3], self._inputs.values(), limits, strict=True)
        ]
        table = {
            "machine": {"name": self.name},
            "sampling": {"poll_interval_s": 60.0},
            "device": [{"name": name} for name in names],
            "channel": channels,
        }
        return config(**{**table, **changes})

    async def _advance(self, t_s: float) -> None:
        if self.minute_s:
            # All machines wait for the same time, so that it jumps once for all.
            await asyncio.sleep(self.minute_s - asyncio.get_running_loop().time() % self.minute_s)
        self.world.advance_to(t_s)
        self.capa.push(1)
        # A device that is asked again after a few seconds is back long before the minute is over.
        for channel in sorted(self.waits_for):
            async with asyncio.timeout(PATIENCE_S):
                while True:
                    with contextlib.suppress(DriverError):
                        await self.fleet.devices[self._inputs[channel][0]].read()
                        break
                    await asyncio.sleep(0.02)
                    self.capa.push(1)
        if self.waits_for:
            self.waits_for = set()
            self.capa.push(1)

    async def run(self, samples: int) -> None:
        """Run the service for so many samples."""

        def step(outcome: Outcome) -> None:
            self.outcomes.append(outcome)
            if self.receiver is not None:
                self.receiver.wait(self.name, "offset", outcome.offset.seq)
                self.receiver.wait(self.name, "sample", outcome.offset.seq)
            self.after(outcome)

        with self.publisher or contextlib.nullcontext():
            try:
                await self.daemon.run(samples=samples, on_sample=step)
            finally:
                await self.fleet.close()

    @property
    def offsets(self) -> list[Offset]:
        """What the receiver got."""
        return self._received("offset")

    @property
    def samples(self) -> list[Sample]:
        """What the receiver got."""
        return self._received("sample")

    def events(self, kind: str) -> list[Event]:
        """What the receiver got."""
        return [event for event in self._received("event") if event.kind == kind]

    def _received(self, name: str) -> list[Any]:
        assert self.receiver is not None
        return self.receiver.got[self.name, name]


@contextlib.contextmanager
def workshop() -> Iterator[tuple[Rack, Receiver]]:
    """A place for machines: simulated devices, and a receiver."""
    with Rack() as rack, Receiver() as receiver:
        yield rack, receiver
