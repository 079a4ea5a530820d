"""A month of a machine to which everything happens, in simulated time: memory, every minute, the audit."""

from __future__ import annotations

import asyncio
import math
import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compensator.audit.machine_audit import Audit, audit
from compensator.clock import NS, VirtualClock
from compensator.config import LoadedConfig, parse_config
from compensator.messages import Event, Offset, Sample, number
from compensator.model.model_file import parse_model
from compensator.recording import recorder as recorder_module
from compensator.recording.numbering import first_sequence
from compensator.recording.reading import decode, read_messages, recordings
from compensator.recording.recorder import McapRecorder
from compensator.recording.signature import Signer
from compensator.service.compensation import Outcome
from compensator.service.daemon import Daemon
from compensator.service.transfer.restart import resume
from drivers.errors import DeviceDisconnected, DeviceTimeout
from drivers.reading import Quality, Reading
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.audit.made import CONFIG, MACHINE, QUILL
from tests.audit.test_signatures import write_key
from tests.service.simulated import CHANNELS, START_NS, FakeDevice

DAY = 1440
RATE_UM_PER_MIN = 8.0
#: What can happen, and how often in a day.
A_DAY = {
    "sensor": 3.0,
    "device": 1.0,
    "full": 0.5,
    "hang": 0.5,
    "clock": 0.3,
    "command": 2.0,
    "defect": 0.2,
    "stop": 0.4,
    "kill": 0.6,
}


@dataclass
class Month:
    """What came of it."""

    days: float = 0.0
    happened: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    samples: int = 0
    minutes: dict[str, float] = field(default_factory=dict)
    largest_step_um: float = 0.0
    rss_mb: list[float] = field(default_factory=list)
    files: int = 0
    early: int = 0
    seconds: float = 0.0
    audit_seconds: float = 0.0


class _Clock(VirtualClock):
    """Does not wait for a disk that hangs."""

    hangs = False

    async def settle(self, tasks: Collection[asyncio.Future[Any]], timeout_s: float) -> None:
        if self.hangs and any(not isinstance(task, asyncio.Task) for task in tasks):
            await asyncio.sleep(0)
        else:
            await super().settle(tasks, timeout_s)


class _Disk:
    """Full or hanging, as the recorder meets it."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.full = False
        self.moves = threading.Event()
        self.moves.set()
        sync = recorder_module.RecordingFile.sync

        def syncing(live: Any) -> None:
            assert self.moves.wait(600.0)
            if self.full:
                raise OSError(28, "No space left on device")
            sync(live)

        patch.setattr(recorder_module.RecordingFile, "sync", syncing)


class _Machine:
    def __init__(self, folder: Path, days: float, seed: int, patch: pytest.MonkeyPatch) -> None:
        self.folder, self.samples_wanted = folder, round(days * DAY)
        self.random = random.Random(seed)
        duty = Duty.working_day(seed, hours=24 * (days + 3))
        self.world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), seed)
        self.device = FakeDevice([self.world.source(name) for name in CHANNELS])
        self.disk = _Disk(patch)
        self.private, self.public = write_key(folder, "machine", 7)
        self.head = folder / "machine.head.json"
        self.result = Month(days=days)
        self.config = parse_config(CONFIG.replace(b"poll_interval_s = 10.0", b"poll_interval_s = 30.0"), source="test")
        self.config_bytes = CONFIG.replace(b"poll_interval_s = 10.0", b"poll_interval_s = 30.0")
        self.daemon: Daemon | None = None
        self.ends: dict[int, Callable[[], None]] = {}
        self.away_min = 0
        self.taken = 0
        self.last: Offset | None = None
        self._ending = ""

        async def advance(t_s: float) -> None:
            self.world.advance_to(t_s)
            # The simulated machine keeps its history; what is measured here is the service's memory.
            del self.world._times[:-1], self.world._rows[:-1]

        self.clock = _Clock(START_NS, advance)

    async def run(self) -> None:
        """Run to the end, over all stops and kills."""
        while self.taken < self.samples_wanted:
            await self._once()
            await self.clock.sleep(60.0 * self.away_min)

    async def _once(self) -> None:
        self._ending, self.away_min = "", 0
        loaded = LoadedConfig(config=self.config, path=self.folder / "m.toml", data=self.config_bytes)
        resumed = resume(loaded, parse_model(QUILL, source="test"))
        recorder = McapRecorder(
            self.folder / "rec",
            MACHINE,
            {"config.toml": self.config_bytes, "model.toml": QUILL},
            signer=Signer(self.private),
            head=self.head,
        )
        daemon = self.daemon = Daemon(
            config=self.config,
            compensation=resumed.compensation,
            devices={"module": self.device},
            recorder=recorder,
            publish=self._published,
            clock=self.clock,
            notes=resumed.notes,
            first_sequence=first_sequence(self.folder / "rec", MACHINE, self.clock.utc_ns(), 60.0),
        )
        close = daemon._journal.close

        async def closing(state: bytes, opening: Mapping[str, bytes] | None = None) -> None:
            if self._ending != "kill":
                await close(state, opening)
                return
            # A kill leaves the file as it is, and lets go of it.
            daemon._writer._executor.shutdown(wait=True)
            recorder._finisher.wait()
            if recorder._live is not None:
                os.close(recorder._live._descriptor)

        daemon._journal.close = closing  # type: ignore[method-assign]
        await daemon.run(samples=self.samples_wanted - self.taken, on_sample=self._step)

    # ------------------------------------------------------------------ what is published

    def _published(self, name: str, data: bytes) -> None:
        if name != "offset":
            return
        offset = msgspec.json.decode(data, type=Offset)
        if self.last is not None:
            assert offset.seq > self.last.seq, (self.last, offset)
            step = abs(number(offset.y_offset_um) - number(self.last.y_offset_um))
            # Over a pause, too, it moves by one step only.
            if not math.isnan(number(self.last.y_offset_um)):
                assert step <= RATE_UM_PER_MIN + 1e-9, (self.last, offset)
                self.result.largest_step_um = max(self.result.largest_step_um, step)
        self.last = offset
        self.result.states[offset.state] += 1

    # ------------------------------------------------------------------ what happens

    def _step(self, outcome: Outcome) -> None:
        self.taken += 1
        for due in [at for at in self.ends if at <= self.taken]:
            self.ends.pop(due)()
        if self.taken % DAY == 0:
            self.result.rss_mb.append(rss_mb())
        for kind, often in A_DAY.items():
            if self.random.random() < often / DAY:
                self._happen(kind)

    def _later(self, minutes: int, action: Callable[[], None]) -> None:
        at = self.taken + minutes
        while at in self.ends:
            at += 1
        self.ends[at] = action

    def _happen(self, kind: str) -> None:
        disk_is_well = self.disk.moves.is_set() and not self.disk.full
        if kind in ("full", "hang", "stop", "kill") and (not disk_is_well or self._ending):
            return
        self.result.happened[kind] += 1
        getattr(self, f"_{kind}")()

    def _sensor(self) -> None:
        lost = self.random.choice([Reading.bad(Quality.OPEN, "wire broken"), Reading.bad(Quality.OVER, "over range")])
        places = self.random.sample(range(4), self.random.choice([1, 1, 2]))
        self.device.replaced.update(dict.fromkeys(places, lost))
        minutes = self.random.choice([1, 1, 5, 60, 60, DAY])
        self._later(minutes, lambda: [self.device.replaced.pop(place, None) for place in places])  # type: ignore[func-returns-value]

    def _device(self) -> None:
        self.device.error = self.random.choice(
            [DeviceTimeout("module", "no answer"), DeviceDisconnected("module", "gone")]
        )
        self._later(self.random.choice([1, 10, 60]), lambda: setattr(self.device, "error", None))

    def _full(self) -> None:
        self.disk.full = True
        self._later(self.random.choice([1, 60, 60]), lambda: setattr(self.disk, "full", False))

    def _hang(self) -> None:
        def go_on() -> None:
            self.clock.hangs = False
            self.disk.moves.set()

        self.clock.hangs = True
        self.disk.moves.clear()
        self._later(self.random.choice([1, 5, 30]), go_on)

    def _clock(self) -> None:
        self.clock.set_wall_clock(self.random.choice([-3600.0, 3600.0, -120.0, 120.0]))

    def _command(self) -> None:
        assert self.daemon is not None
        name, payload = self.random.choice(
            [("hold", b""), ("resume", b""), ("resume", b""), ("zero", b""), ("zero", b'{"mode": "warm"}')]
        )
        self.daemon.command(name, payload)
        if name == "hold":
            self._later(60, lambda: self.daemon.command("resume", b"") and None)  # type: ignore[union-attr]

    def _defect(self) -> None:
        decision = self.daemon._compensation._decision  # type: ignore[union-attr]
        decide = decision.decide

        def broken(*_: Any) -> Any:
            decision.decide = decide  # type: ignore[method-assign]
            raise ZeroDivisionError("a defect")

        decision.decide = broken  # type: ignore[method-assign]
        self._later(20, lambda: self.daemon.command("resume", b"") and None)  # type: ignore[union-attr]

    def _stop(self) -> None:
        self._leave("stop")

    def _kill(self) -> None:
        self._leave("kill")

    def _leave(self, how: str) -> None:
        assert self.daemon is not None
        self._ending = how
        self.away_min = self.random.choice([0, 1, 5, 60, 600])
        self.daemon.stop()


def rss_mb() -> float:
    """Resident memory of this process, MB."""
    with Path("/proc/self/statm").open() as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def run(folder: Path, days: float, *, seed: int = 1) -> tuple[Month, Audit]:
    """Run it, count every minute, audit everything."""
    began = time.monotonic()
    with pytest.MonkeyPatch.context() as patch:
        machine = _Machine(folder, days, seed, patch)
        asyncio.run(machine.run())
    result = machine.result
    result.seconds = time.monotonic() - began
    count_minutes(folder / "rec", result)
    began = time.monotonic()
    found = audit(recordings(folder / "rec", MACHINE), public_key=machine.public, head=machine.head)
    result.audit_seconds = time.monotonic() - began
    result.files, result.early = len(found.files), sum(file.early for file in found.files)
    return result, found


def count_minutes(folder: Path, result: Month) -> None:
    """Count what the recordings say of every minute from the first to the last."""
    times: list[int] = []
    held: list[int] = []
    minutes: Counter[str] = Counter()
    seqs: set[int] = set()
    for path in recordings(folder, MACHINE):
        with_sample: set[int] = set()
        for record in read_messages(path, ("sample", "offset", "event")):
            message = decode(record, path)
            if isinstance(message, Sample):
                assert message.seq not in seqs, message.seq
                seqs.add(message.seq)
                with_sample.add(message.seq)
                times.append(message.time_utc_ns)
            elif isinstance(message, Offset) and message.seq not in with_sample:
                held.append(message.time_utc_ns)
            elif isinstance(message, Event):
                minutes["service away"] += message.data.get("missing") or 0 if message.kind == "restart" else 0
                minutes["clock set"] += round(message.data["seconds"] / 60.0) if message.kind == "clock" else 0
                minutes["given up by the disk"] += message.data.get("lost") or 0 if message.kind == "recording" else 0
    result.samples = len(times)
    whole = round((times[-1] - times[0]) / (60 * NS)) + 1
    minutes["sample"], minutes["held after an internal error"] = len(times), len(held)
    minutes["service away"] -= len(held)  # a service counts them as missing, too
    minutes["not accounted for"] = whole - sum(minutes.values())
    result.minutes = dict(minutes)
