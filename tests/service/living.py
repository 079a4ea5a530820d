"""A service that is ended and started again on one simulated machine, with its recordings on disk."""

from __future__ import annotations

import asyncio
import functools
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from compensator.clock import VirtualClock
from compensator.config import Config, LoadedConfig
from compensator.messages import Event, encode, number
from compensator.model.model_file import parse_model, read_model_bytes
from compensator.recording.live_file import topics_of
from compensator.recording.numbering import first_sequence
from compensator.recording.reading import recordings
from compensator.recording.recorder import McapRecorder
from compensator.service.compensation import Compensation, Outcome
from compensator.service.daemon import Daemon
from compensator.service.loop.live import LoopParts
from compensator.service.loop.resuming import resume_loop
from compensator.service.loop.state import Running
from compensator.service.loop.weighing import Diagnosed
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.replay import apply, opening_of, steps_of
from compensator.service.transfer.model_store import ModelStore, check_model
from compensator.service.transfer.restart import resume
from sim_hardware.physics import PublishedQuill, World
from tests.service.promises import Promises
from tests.service.simulated import CHANNELS, START_NS, FakeDevice, config, taking, working_day

MACHINE = "vmc-07"


def settings(**changes: Any) -> Config:
    """The usual configuration, polled twice a minute: a device without noise says no more when it is asked more."""
    return config(**{"sampling": {"poll_interval_s": 30.0}, **changes})


class Machine:
    """A machine without sensor noise, so that two runs of it measure the same."""

    def __init__(
        self, folder: Path, conf: Config | None = None, model: bytes | None = None, *, start_ns: int = START_NS
    ) -> None:
        self.folder = folder
        self.config = conf or settings()
        self.config_bytes = b"the configuration"
        self.configured = model or read_model_bytes("quill")
        self.world = World(PublishedQuill(), working_day(1, 72.0), seed=1)
        self.device = FakeDevice([functools.partial(self.world.truth, name) for name in CHANNELS])
        self.outcomes: list[Outcome] = []
        self.published: list[tuple[str, bytes]] = []
        self._take = taking(self.published)
        self.at_sample: dict[int, Callable[[], Any]] = {}
        self.daemon: Daemon | None = None

        self.promises = Promises()
        #: Whether simulated time waits for diagnoses and what follows from them.
        self.waits_for_diagnoses = True
        self.at_poll: Callable[[], Any] = lambda: None

        async def advance(t_s: float) -> None:
            self.world.advance_to(t_s)
            await self.promises.wait(self.config.sampling.poll_interval_s / 60.0)
            while self.waits_for_diagnoses and self.is_diagnosing:
                await asyncio.sleep(0.002)

        self.clock = VirtualClock(start_ns, advance)

    @property
    def is_diagnosing(self) -> bool:
        """Whether a diagnosis, or what follows from it, is in progress beside the samples."""
        loop = self.daemon._loop if self.daemon is not None else None
        return loop is not None and loop.is_working

    def publish(self, name: str, data: bytes) -> None:
        """Take a message."""
        self._take(name, data)

    @property
    def recordings(self) -> Path:
        return self.folder / "rec"

    @property
    def store(self) -> ModelStore:
        return ModelStore(self.recordings / "models", self.configured, MACHINE)

    def command(self, name: str, payload: bytes = b"") -> Any:
        assert self.daemon is not None
        return self.promises.add(self.daemon.command(name, payload))

    async def diagnose(self, wanted: Running, calibrated: bytes) -> Diagnosed:
        """Stand in for the process of a diagnosis."""
        raise NotImplementedError

    async def run(self, samples: int, until: Callable[[Outcome], bool] = lambda outcome: False) -> None:
        """Start the service, run it, end it cleanly."""
        data = self.store.in_use()
        loaded = LoadedConfig(config=self.config, path=self.folder / "machine.toml", data=self.config_bytes)
        note = OffsetCheckpoint(self.recordings, MACHINE, self.folder)
        early = note.read(self.config.limits.offset_max_um)
        resumed = resume(loaded, check_model(self.config, data, source="test"), early)
        recorder = McapRecorder(
            self.recordings,
            MACHINE,
            {"config.toml": self.config_bytes, "model.toml": data},
            topics=topics_of(probes=self.config.probe is not None, loop=self.config.loop is not None),
        )
        core = resume_loop(loaded, resumed, self.store)
        loop = None
        if core is not None:
            loop = LoopParts(core=core, model=data, store=self.store, diagnose=self.diagnose)
        daemon = self.daemon = Daemon(
            config=self.config,
            compensation=resumed.compensation,
            devices={"module": self.device},
            recorder=recorder,
            publish=self.publish,
            clock=self.clock,
            first_sequence=first_sequence(self.recordings, MACHINE, self.clock.utc_ns(), 60.0),
            recordings=self.recordings,
            store=self.store,
            notes=resumed.notes,
            checkpoint=note,
            loop=loop,
        )

        def step(outcome: Outcome) -> None:
            self.outcomes.append(outcome)
            self.at_sample.pop(len(self.outcomes), lambda: None)()
            if until(outcome):
                daemon.stop()

        await daemon.run(samples=samples, on_sample=step, on_poll=lambda: self.at_poll())

    async def run_and_kill(self, samples: int, *, torn: int = 0) -> None:
        """Run the service and leave on disk what a kill after the last sample leaves, less some bytes."""
        copy = self.folder / "killed"
        last = len(self.outcomes) + samples
        self.at_sample[last] = lambda: shutil.copytree(self.recordings, copy, ignore=shutil.ignore_patterns("*.part"))
        await self.run(samples)
        shutil.rmtree(self.recordings)
        copy.rename(self.recordings)
        path = recordings(self.recordings, MACHINE)[-1]
        assert not path.read_bytes().endswith(b"\x89MCAP0\r\n")
        if torn:
            path.write_bytes(path.read_bytes()[:-torn])

    async def sleep(self, minutes: float) -> None:
        """Let the machine work on without the service."""
        await self.clock.sleep(60.0 * minutes)

    def events(self, kind: str) -> list[Event]:
        sent = [msgspec.json.decode(data, type=Event) for name, data in self.published if name == "event"]
        return [event for event in sent if event.kind == kind]

    def offsets(self) -> np.ndarray:
        return np.array([number(o.offset.y_offset_um) for o in self.outcomes])

    def by_time(self) -> dict[int, Outcome]:
        return {outcome.offset.time_utc_ns: outcome for outcome in self.outcomes}


def largest_step(outcomes: list[Outcome]) -> float:
    """Largest change between two published offsets, µm; once there is one, there always is one."""
    offsets = [number(o.offset.y_offset_um) for o in outcomes]
    first = next(i for i, value in enumerate(offsets) if not math.isnan(value))
    steps = np.abs(np.diff(offsets[first:]))
    assert not np.any(np.isnan(steps))
    return float(np.max(steps))


def check_files(machine: Machine) -> int:
    """Work every recording out again from what travels in it alone; return the number of samples."""
    samples = 0
    seqs = []
    for path in recordings(machine.recordings, MACHINE):
        opening = opening_of(path)
        compensation = Compensation(machine.config, parse_model(opening["model.toml"], source="attached"))
        compensation.restore(opening["state.json"])
        for step in steps_of(path):
            outcome = apply(compensation, step)
            if not isinstance(outcome, Outcome):
                continue
            seq = outcome.sample.seq
            assert encode(outcome.sample) == step.records["sample"].data, (path.name, seq)
            if step.estimate is not None:
                assert encode(outcome.estimate) == step.records["estimate"].data, (path.name, seq)
            if step.offset is not None and not {"recording_failed", "recording_late"} & set(step.offset.reasons):
                assert encode(outcome.offset) == step.records["offset"].data, (path.name, seq)
            seqs.append(seq)
            samples += 1
    assert seqs == sorted(set(seqs))
    return samples
