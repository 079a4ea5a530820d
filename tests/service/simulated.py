"""A service without wires: devices that read a simulated machine directly."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from compensator.clock import NS, VirtualClock
from compensator.commands.run import Reporter
from compensator.config import Config
from compensator.model.model_file import load_model
from compensator.recording.recorder import McapRecorder
from compensator.service.compensation import Compensation, Outcome
from compensator.service.daemon import Daemon
from compensator.service.systemd import ServiceManager
from drivers.errors import DriverError
from drivers.reading import Reading
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors

START_NS = 1_767_592_800 * NS
CHANNELS = ("t_q_degc", "at_degc", "y_um", "coolant_degc")

TABLE: dict[str, Any] = {
    "machine": {"name": "vmc-07"},
    "model": {"file": "quill"},
    "sampling": {"poll_interval_s": 10.0},
    "limits": {
        "offset_max_um": 200.0,
        "offset_rate_max_um_per_min": 8.0,
        "validity": {"t_q_degc": [10.0, 60.0], "at_degc": [10.0, 35.0]},
    },
    "loss": {"predict_for_min": 10.0},
    "zero": {"rest_rate_um_per_min": 0.2},
    "guards": {"t_q_below_at_max_k": 2.0},
    "zenoh": {"prefix": "shop/vmc-07"},
    "recording": {"folder": "rec"},
    "line": [],
    "device": [{"name": "module"}],
    "channel": [
        {
            "name": "t_q_degc",
            "device": "module",
            "input": 0,
            "range": [0.0, 80.0],
            "rate_max_per_min": 5.0,
            "stuck_after_min": 60.0,
        },
        {
            "name": "at_degc",
            "device": "module",
            "input": 1,
            "range": [0.0, 50.0],
            "rate_max_per_min": 2.0,
            "stuck_after_min": 60.0,
        },
        {
            "name": "y_um",
            "device": "module",
            "input": 2,
            "range": [-200.0, 200.0],
            "rate_max_per_min": 30.0,
            "stuck_after_min": 60.0,
        },
        {"name": "coolant_degc", "device": "module", "input": 3},
    ],
}


@functools.cache
def working_day(seed: int, hours: float) -> Duty:
    """A day's work, which is the same for every machine of a test run; its columns are read only."""
    duty = Duty.working_day(seed, hours=hours)
    for column in duty.columns.values():
        column.flags.writeable = False
    return duty


def config(**changes: Any) -> Config:
    """The usual configuration with some tables replaced."""
    return msgspec.convert({**TABLE, **changes}, Config)


class FakeDevice:
    """Reads from functions; a test puts faults in."""

    name = "module"
    units: Mapping[int, str] = {0: "degc", 1: "degc", 2: "um", 3: "degc"}

    def __init__(self, sources: list[Callable[[], float]]) -> None:
        self.sources = sources
        self.replaced: dict[int, Reading] = {}
        self.error: DriverError | None = None

    async def read(self) -> Mapping[int, Reading]:
        if self.error is not None:
            raise self.error
        good = {i: Reading.good(source()) for i, source in enumerate(self.sources)}
        return good | self.replaced

    async def close(self) -> None:
        return


def taking(published: list[tuple[str, bytes]]) -> Callable[[str, bytes], None]:
    """Return what takes messages as `compensator run` does after each was published: they are logged."""
    reporter = Reporter(ServiceManager({}))

    def take(name: str, data: bytes) -> None:
        published.append((name, data))
        reporter.report_message(name, data)

    return take


class Bench:
    """A daemon on a simulated machine, with everything it published."""

    def __init__(self, tmp_path: Any, conf: Config | None = None, *, seed: int = 1, noise: bool = True) -> None:
        self.config = conf or config()
        duty = working_day(seed, 48.0)
        sensors = usual_sensors(duty.extra_names) if noise else None
        self.world = World(PublishedQuill(), duty, sensors, seed)
        self.device = FakeDevice([self.world.source(name) for name in CHANNELS])
        self.published: list[tuple[str, bytes]] = []
        self.outcomes: list[Outcome] = []
        self.at_sample: dict[int, Callable[[], None]] = {}

        async def advance(t_s: float) -> None:
            self.world.advance_to(t_s)

        self.clock = VirtualClock(START_NS, advance)
        self.recorder = McapRecorder(tmp_path / "rec", "vmc-07", {"model.toml": b"x"})
        self.daemon = Daemon(
            config=self.config,
            compensation=Compensation(self.config, load_model(self.config.model.file)),
            devices={"module": self.device},
            recorder=self.recorder,
            publish=taking(self.published),
            clock=self.clock,
            first_sequence=0,
        )

    async def run(self, samples: int) -> list[Outcome]:
        def step(outcome: Outcome) -> None:
            self.outcomes.append(outcome)
            action = self.at_sample.pop(len(self.outcomes), None)
            if action is not None:
                action()

        await self.daemon.run(samples=samples, on_sample=step)
        return self.outcomes
