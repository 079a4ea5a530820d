"""The service of version 0.1.0 on a simulated machine and simulated time; everything comes out the same each time."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import tomllib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from compensator.service.adoption import Adoption, check_model
from compensator.service.early import EarlyNote
from compensator.service.finishing import Finisher
from compensator.service.model_store import ModelStore
from compensator.service.recorder import Recorder
from compensator.service.restart import resume
from compensator.signature import Signer

from compensator.clock import NS, VirtualClock
from compensator.config import LoadedConfig, parse_config
from compensator.recording import first_sequence, recordings
from compensator.service import recorder as recorder_module
from compensator.service.compensation import Outcome
from compensator.service.daemon import Daemon
from drivers.errors import DriverError
from drivers.reading import Quality, Reading
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors

MACHINE = "vmc-07"
#: 2026-01-05T06:00:00Z.
START_NS = 1_767_592_800 * NS
#: Inputs of the one device, in this order.
INPUTS = ("t_q_degc", "at_degc", "y_um", "coolant_degc", "spindle_rpm", "fan_rpm")
OPEN = Reading.bad(Quality.OPEN, "wire broken")

_put = Finisher.put


def _put_and_wait(self: Finisher, path: Path, now_ns: int) -> None:
    """Make a file compact at once: what is said of it then stands with the same sample each time."""
    _put(self, path, now_ns)
    self.wait()


Finisher.put = _put_and_wait  # type: ignore[method-assign]


class Device:
    """Reads the simulated machine; a scene puts faults in."""

    name = "module"

    def __init__(self, world: World) -> None:
        self.units = {i: name.rpartition("_")[2] for i, name in enumerate(INPUTS)}
        self._sources = [world.source(name) for name in INPUTS]
        self.replaced: dict[int, Reading] = {}
        self.error: DriverError | None = None

    async def read(self) -> Mapping[int, Reading]:
        if self.error is not None:
            raise self.error
        return {i: Reading.good(source()) for i, source in enumerate(self._sources)} | self.replaced

    async def close(self) -> None:
        return


class Machine:
    """A machine whose service is started, ended and started again; its recordings stay in a folder."""

    def __init__(
        self,
        folder: Path,
        config: bytes,
        model: bytes,
        *,
        seed: int = 1,
        start_ns: int = START_NS,
        signer: Signer | None = None,
        hours: float = 72.0,
    ) -> None:
        self.folder, self.config, self.model, self.signer = folder, config, model, signer
        duty = Duty.working_day(seed, hours=hours)
        self.world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), seed)
        self.device = Device(self.world)
        #: What is to happen after the sample of that number, counted over all runs.
        self.at_sample: dict[int, Callable[[], Any]] = {}
        self.published: list[bytes] = []
        self.samples = 0
        self.daemon: Daemon | None = None
        self._promised: list[Future[Any]] = []

        async def advance(t_s: float) -> None:
            while any(not promise.done() for promise in self._promised):
                await asyncio.sleep(0.002)
            self.world.advance_to(t_s)

        self.clock = VirtualClock(start_ns, advance)

    @property
    def recordings(self) -> Path:
        return self.folder / "recordings"

    def command(self, name: str, payload: bytes = b"") -> Any:
        """Send a command; simulated time stands still until it is answered."""
        assert self.daemon is not None
        reply = self.daemon.command(name, payload)
        if isinstance(reply, Future):
            self._promised.append(reply)
        return reply

    def at(self, sample: int, name: str, payload: bytes = b"") -> None:
        """Send a command after a sample."""
        self.do(sample, lambda: self.command(name, payload))

    def do(self, sample: int, action: Callable[[], Any]) -> None:
        """Let something happen after a sample."""
        before = self.at_sample.get(sample, lambda: None)

        def both() -> None:
            before()
            action()

        self.at_sample[sample] = both

    def lose(self, *inputs: int, at: int, until: int, reading: Reading = OPEN) -> None:
        """Take inputs away from one sample to another."""
        self.do(at, lambda: self.device.replaced.update(dict.fromkeys(inputs, reading)))
        self.do(until, lambda: [self.device.replaced.pop(i) for i in inputs])

    def run(self, samples: int, *, broken: int | None = None) -> None:
        """Start the service, run it, end it cleanly; `broken`: number of a sample of this run with a defect."""
        asyncio.run(self._run(samples, broken))

    async def _run(self, samples: int, broken: int | None) -> None:
        config = parse_config(self.config, source="reference")
        store = ModelStore(self.folder / "models", self.model, MACHINE)
        data = store.in_use()
        loaded = LoadedConfig(config=config, path=self.folder / "machine.toml", data=self.config, sha256="unused")
        note = EarlyNote(self.recordings, MACHINE, self.folder)
        early = note.read(config.limits.offset_max_um)
        model = check_model(config, data, source="reference")
        resumed = resume(loaded, model, early)
        compensation = resumed.compensation
        if broken is not None:
            _break(compensation, broken)
        attachments = {"config.toml": self.config, "model.toml": data}
        self.recorder = Recorder(self.recordings, MACHINE, attachments, signer=self.signer)
        daemon = self.daemon = Daemon(
            config=config,
            compensation=compensation,
            devices={"module": self.device},
            recorder=self.recorder,
            publish=self._publish,
            clock=self.clock,
            first_sequence=first_sequence(self.recordings, MACHINE, self.clock.utc_ns(), model.period_s),
            adoption=Adoption(config, self.recordings, store),
            notes=resumed.notes,
            early=note,
        )

        def step(outcome: Outcome) -> None:
            del outcome
            self.samples += 1
            self.at_sample.pop(self.samples, lambda: None)()

        await daemon.run(samples=samples, on_sample=step)

    def _publish(self, name: str, data: bytes) -> None:
        if name == "offset":
            self.published.append(data)

    def run_and_kill(self, samples: int, *, torn: int = 0) -> None:
        """Run the service and leave on disk what a kill after the last sample leaves, less some bytes."""
        copy = self.folder / "killed"
        hidden = shutil.ignore_patterns("*.part")
        self.do(self.samples + samples, lambda: shutil.copytree(self.recordings, copy, ignore=hidden))
        self.run(samples)
        shutil.rmtree(self.recordings)
        copy.rename(self.recordings)
        path = recordings(self.recordings, MACHINE)[-1]
        if torn:
            path.write_bytes(path.read_bytes()[:-torn])

    def sleep(self, minutes: float) -> None:
        """Let the machine work on without the service."""
        asyncio.run(self.clock.sleep(60.0 * minutes))

    def stand_still(self, minutes: float) -> None:
        """Let the service stand still, as a computer that sleeps."""
        self.clock._elapsed_ns += round(60.0 * minutes * NS)

    def adopt(self, sample: int, model: bytes) -> None:
        """Send a model after a sample."""
        import json

        self.at(sample, "adopt", json.dumps({"model": model.decode()}).encode())


def _break(compensation: Any, number: int) -> None:
    """Put a defect into one sample."""
    process, count = compensation.process, [0]

    def breaking(raw: Any) -> Any:
        count[0] += 1
        if count[0] == number:
            raise ValueError("a defect")
        return process(raw)

    compensation.process = breaking


@contextlib.contextmanager
def disk() -> Iterator[Callable[[bool], None]]:
    """Give a switch that fills the disk."""
    sync, full = recorder_module._Live.sync, [False]

    def failing(live: Any) -> None:
        if full[0]:
            raise OSError(28, "No space left on device")
        sync(live)

    recorder_module._Live.sync = failing  # type: ignore[method-assign]
    try:
        yield lambda value: full.__setitem__(0, value)
    finally:
        recorder_module._Live.sync = sync  # type: ignore[method-assign]


def checked(config: bytes) -> bytes:
    """Return the configuration; the service itself must take it, devices included."""
    import drivers

    parse_config(config, source="reference")
    table = tomllib.loads(config.decode())
    drivers.build(table["line"], table["device"], source="reference")
    return config
