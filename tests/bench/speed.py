"""Speed, latency, memory and load of the service."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from scipy import signal as filters

from compensator.clock import VirtualClock
from compensator.demo.day import START_NS
from compensator.demo.machine import configuration, hardware
from compensator.model.engine import Engine
from compensator.model.model_file import load_model
from compensator.service.composition import run_service
from compensator.service.loading import load
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.bench.figures import Figure, spread, told

PORT = 17461
NAMES = {"kalman": "Kalman filter", "inverse": "plain inverse"}


def timed(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


def engine_steps() -> Iterator[Figure]:
    """One step of the engine, settled, beside scipy's lfilter over the same samples."""
    model = load_model("quill")
    assert model.ttf is not None and model.tdtf is not None
    rng = np.random.default_rng(1)
    n = 5000
    t_q = 22.0 + rng.normal(0.0, 0.05, n)
    at = 20.0 + rng.normal(0.0, 0.05, n)
    ttf, dtf, tdtf = model.ttf.sampled, model.dtf.sampled, model.tdtf.sampled

    def compiled() -> None:
        heat = filters.lfilter(ttf.a, ttf.b, t_q - at)
        filters.lfilter(dtf.b, dtf.a, heat)
        filters.lfilter(tdtf.b, tdtf.a, at)

    for method in ("inverse", "kalman"):
        engine = Engine(dataclasses.replace(model, estimator=dataclasses.replace(model.estimator, method=method)))
        engine.set_reference(22.0, 20.0)
        engine.run(t_q, at)
        runs = [(timed(lambda engine=engine: engine.run(t_q, at)), timed(compiled)) for _ in range(7)]
        ratio = statistics.median(a / b for a, b in runs)
        yield spread(
            f"one step of the engine, {NAMES[method]}, settled",
            [a / n * 1e6 for a, _ in runs],
            "µs",
            wanted="under 20 µs",
            beside=f"{ratio:.0f} × scipy.signal.lfilter over whole arrays",
        )


@contextmanager
def machine(hours: float) -> Iterator[tuple[Path, VirtualClock, World]]:
    """A simulated machine on its devices, its configuration, and a clock that drives it."""
    duty = Duty.working_day(1, hours=hours + 0.1)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    with tempfile.TemporaryDirectory() as folder, hardware(world) as (lines, capa, _):
        config = Path(folder) / "config.toml"
        config.write_text(configuration("bench", lines, PORT), encoding="utf-8")

        async def advance(t_s: float) -> None:
            world.advance_to(t_s)
            capa.push(1)

        yield config, VirtualClock(START_NS, advance), world


def simulated_days() -> Iterator[Figure]:
    """A day over the real protocols, and the latency of each of its samples."""
    seconds, medians, highest, ratios = [], [], [], []
    for _ in range(3):
        with machine(24.0) as (config, clock, _world):
            began = time.perf_counter()
            daemon = asyncio.run(run_service(load(str(config)), clock=clock, samples=1440))
            seconds.append(time.perf_counter() - began)
        latency = np.array(daemon.latency_s) * 1e3
        medians.append(float(np.median(latency)))
        highest.append(float(np.percentile(latency, 99)))
        duty = Duty.working_day(1, hours=24.1)
        plant = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
        ratios.append(seconds[-1] / timed(lambda plant=plant: plant.advance_to(86_400.0)))
    beside = f"{statistics.median(ratios):.0f} × the simulated physics alone"
    yield spread(
        "1,440 samples over the real protocols, 6 polls each", seconds, "s", wanted="under 60 s", beside=beside
    )
    yield spread("end of the last poll to offset published, sample on disk first", medians, "ms", wanted="under 10 ms")
    yield spread("the same, 99th percentile", highest, "ms", wanted="under 10 ms")


#: Works as a diagnosis does, with its priority.
DIAGNOSIS = """
import os, numpy as np
from compensator.commands.loop_diagnosis import take_priority
take_priority()
values = np.random.default_rng(1).normal(size=(400, 400))
while True:
    np.linalg.svd(values)
"""


def beside_diagnoses() -> Iterator[Figure]:
    """The latency of a sample, alone and with as many processes of diagnoses as there are cores, by turns."""
    found: dict[bool, list[float]] = {False: [], True: []}
    for is_beside in (False, True) * 2:
        count = os.cpu_count() or 1 if is_beside else 0
        others = [subprocess.Popen([sys.executable, "-c", DIAGNOSIS]) for _ in range(count)]
        try:
            with machine(4.0) as (config, clock, _world):
                daemon = asyncio.run(run_service(load(str(config)), clock=clock, samples=240))
        finally:
            for other in others:
                other.kill()
                other.wait()
        found[is_beside] += [1e3 * seconds for seconds in daemon.latency_s]
    for is_beside, name in ((False, "alone"), (True, "beside a diagnosis on each core")):
        middle, high = np.percentile(found[is_beside], [50, 99])
        what = f"end of the last poll to offset published, {name}: median, 99th percentile"
        yield told(Figure(what=what, found=f"{middle:.1f}, {high:.1f} ms", wanted="under 10 ms"))


def service_process() -> Iterator[Figure]:
    """The service as a process of its own at one poll a second: processor time and memory."""
    duty = Duty.working_day(1, hours=1.0)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    with tempfile.TemporaryDirectory() as folder, hardware(world) as (lines, capa, _):
        config = Path(folder) / "config.toml"
        text = configuration("bench", lines, PORT)
        config.write_text(text.replace("poll_interval_s = 10.0", "poll_interval_s = 1.0"), encoding="utf-8")
        process = subprocess.Popen([sys.executable, "-m", "compensator", "run", "--config", str(config)])
        try:
            stream_for(capa.push, 10.0)
            before, began = cpu_seconds(process.pid), time.perf_counter()
            stream_for(capa.push, 65.0)
            load = 100.0 * (cpu_seconds(process.pid) - before) / (time.perf_counter() - began)
            status = Path(f"/proc/{process.pid}/status").read_text()
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=20)
    largest = next(int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM"))
    what = "the service at one poll a second, 5 devices"
    yield told(Figure(what=f"{what}: processor", found=f"{load:.2f} % of a core", wanted="under 1 %"))
    yield told(Figure(what=f"{what}: largest memory", found=f"{largest:.0f} MB", wanted="under 120 MB"))


def report() -> Iterator[Figure]:
    """Measure everything here."""
    yield from engine_steps()
    yield from simulated_days()
    yield from beside_diagnoses()
    yield from service_process()


def stream_for(push: Callable[[int], None], seconds: float) -> None:
    """Let the displacement controller stream, five frames a second."""
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        push(1)
        time.sleep(0.2)


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
