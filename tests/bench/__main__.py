"""Measure speed, latency, memory and load of the service: `make bench`. Nothing passes or fails here."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import platform
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy import signal as filters

from compensator.clock import VirtualClock
from compensator.demo import START_NS, configuration, hardware
from compensator.model.engine import Engine
from compensator.model.model_file import load_model
from compensator.service.composition import run_service
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.bench import audit, diagnosis, faults, identification, machines, spindle

PORT = 17461


def spread(name: str, values: list[float], unit: str) -> None:
    """Print the median of some runs, with the smallest and largest."""
    middle = statistics.median(values)
    print(f"{name:<66} {middle:10.3f} {unit:<4} ({min(values):.3f} to {max(values):.3f}, n={len(values)})")


def timed(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


def engine_steps() -> None:
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
        spread(f"engine step, {method}, settled", [a / n * 1e6 for a, _ in runs], "us")
        spread("  over scipy.signal.lfilter on whole arrays (same run)", [a / b for a, b in runs], "x")


@contextmanager
def machine(hours: float) -> Iterator[tuple[Path, VirtualClock, World]]:
    """A simulated machine on its devices, its configuration, and a clock that drives it."""
    duty = Duty.working_day(1, hours=hours + 0.1)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    with tempfile.TemporaryDirectory() as folder, hardware(world) as (lines, capa):
        config = Path(folder) / "config.toml"
        config.write_text(configuration("bench", lines, PORT), encoding="utf-8")

        async def advance(t_s: float) -> None:
            world.advance_to(t_s)
            capa.push(1)

        yield config, VirtualClock(START_NS, advance), world


def simulated_days() -> None:
    """A day over the real protocols, and the latency of each of its samples."""
    seconds, medians, highest, ratios = [], [], [], []
    for _ in range(3):
        with machine(24.0) as (config, clock, _world):
            began = time.perf_counter()
            daemon = asyncio.run(run_service(str(config), clock=clock, samples=1440))
            seconds.append(time.perf_counter() - began)
        latency = np.array(daemon.latency.seconds) * 1e3
        medians.append(float(np.median(latency)))
        highest.append(float(np.percentile(latency, 99)))
        duty = Duty.working_day(1, hours=24.1)
        plant = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
        ratios.append(seconds[-1] / timed(lambda plant=plant: plant.advance_to(86_400.0)))
    spread("1,440 samples over the real protocols, 6 polls each", seconds, "s")
    spread("  over the simulated physics alone (same run)", ratios, "x")
    spread("last poll read to offset published, on disk first: median", medians, "ms")
    spread("  99th percentile", highest, "ms")


def service_process() -> None:
    """The service as a process of its own at one poll a second: processor time and memory."""
    duty = Duty.working_day(1, hours=1.0)
    world = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 1)
    with tempfile.TemporaryDirectory() as folder, hardware(world) as (lines, capa):
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
    print(f"{'service at one poll a second: processor':<66} {load:10.3f} % of one core")
    print(f"{'  largest memory':<66} {largest:10.1f} MB")


def stream_for(push: Callable[[int], None], seconds: float) -> None:
    """Let the displacement controller stream, five frames a second."""
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        push(1)
        time.sleep(0.2)


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rows(title: str, head: list[str], body: list[list[str]]) -> None:
    """Print a table."""
    widths = [max(len(row[i]) for row in (head, *body)) for i in range(len(head))]
    print(f"\n{title}")
    for row in (head, *body):
        print("  " + "  ".join(f"{cell:{'<' if i < 2 else '>'}{widths[i]}}" for i, cell in enumerate(row)))


def calibrations() -> None:
    rows("calibration, published case: fit %, median (worst) of 20 seeds; targets 0.02 and 0.2 points, 96.5 %, 50 ms",
         ["path", "by", "fit %", "below the true model", "ms a fit", "of ours"], identification.table())  # fmt: skip
    rows("calibration of simulated physics, free run on other runs; target 99 %",
         ["kind", "judged on", "fit %", "rms µm"], identification.physics())  # fmt: skip
    rows("measured spindle, ch3 by t5 and t16, fitted on the first 20 of 32 h, µm rms",
         ["part", "model", "no compensation", "persistence"], identification.spindle())  # fmt: skip


def diagnoses() -> None:
    rows("diagnosis, published machine, 10 seeds a kind; targets 98 % named, removed 99 (97) %, under 10 s",
         ["effect", "named, nothing else", "removed %, median (tenth)", "s, median (most)"],
         diagnosis.table(10))  # fmt: skip
    machines.report(1000, 26)
    spindle.report()


def main() -> None:
    cpu = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
        "",
    )
    print(
        f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, {cpu}; Python {platform.python_version()}"
    )
    names = ("numpy", "scipy", "pymodbus", "pyserial", "eclipse-zenoh", "mcap")
    print(", ".join(f"{name} {version(name)}" for name in names) + "\n")
    engine_steps()
    simulated_days()
    service_process()
    calibrations()
    diagnoses()
    audit.measurements()
    faults.report()


if __name__ == "__main__":
    main()
