"""One simulated day: a machine through its devices, the service, disk and Zenoh, in seconds.

The simulated machine, its sensors and its devices come from `sim_hardware` and share nothing with the
service. Time is handed in.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import zenoh
from rich.console import Console
from rich.progress import Progress

from compensator.arrays import Vector
from compensator.clock import NS, VirtualClock
from compensator.config import Zenoh, load_config
from compensator.demo.machine import MACHINES, configuration, hardware
from compensator.errors import ServiceError
from compensator.messages import Offset
from compensator.service.command_client import ask
from compensator.service.compensation import Outcome
from compensator.service.composition import run_service
from compensator.service.loading import load
from compensator.service.session import session_config
from sim_hardware.physics import Duty, World, usual_sensors
from sim_hardware.physics.effects.base import Effect

#: 2026-01-05 06:00 UTC, a Monday's early shift.
START_NS = 1_767_592_800 * NS
#: When the second day's service is asked to adopt the extended model, and what a poll then waits for it, s.
ADOPT_AFTER_S, ADOPT_PATIENCE_S = 3600.0, 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Day:
    """What came of one simulated run.

    Parameters
    ----------
    outcomes : list of Outcome
        One for each sample.
    received : list of Offset
        What a separate Zenoh subscriber got.
    truth : dict of str to numpy.ndarray
        The simulated machine's own history.
    seconds : float
        How long it took, s.
    adopted_at : int
        Sample from which the offset is wholly that of the adopted model; 0 where none was to be adopted.
    """

    outcomes: list[Outcome]
    received: list[Offset]
    truth: Mapping[str, Vector]
    seconds: float
    adopted_at: int = 0


def run_day(
    folder: Path,
    *,
    machine: str,
    hours: float,
    seed: int,
    model: str = "quill",
    effects: Sequence[Effect] = (),
    adopt: Path | None = None,
) -> Day:
    """Run one simulated machine through its devices, the service, disk and Zenoh.

    Parameters
    ----------
    folder : pathlib.Path
        Where the configuration and the recordings go.
    machine : str
        `conduction` or `published`.
    hours : float
        Length, h.
    seed : int
        Seed of duty and sensors.
    model : str
        Name of a model, or path of its file from the folder.
    effects : sequence of Effect
        What acts in the machine that its calibration never saw.
    adopt : pathlib.Path, optional
        A model that the running service is asked to take over after `ADOPT_AFTER_S`.

    Raises
    ------
    ServiceError
        If the service did not take it over before the end.
    """
    duty = Duty.working_day(seed, hours=hours + 0.1)
    world = World(MACHINES[machine](effects=effects), duty, usual_sensors(duty.extra_names), seed)
    folder.mkdir(parents=True, exist_ok=True)
    # A day of its own, not the continuation of the one that an earlier demo left here.
    shutil.rmtree(folder / "recordings", ignore_errors=True)
    began = time.perf_counter()
    with hardware(world) as devices:
        port = _free_port()
        config = folder / "config.toml"
        config.write_text(configuration(f"sim-{machine}", devices.lines, port, model), encoding="utf-8")

        asked: list[asyncio.Future[dict[str, Any] | None]] = []

        async def advance(t_s: float) -> None:
            world.advance_to(t_s)
            devices.capa.push(1)
            if adopt is not None and t_s >= ADOPT_AFTER_S:
                if not asked:
                    asked.append(asyncio.ensure_future(asyncio.to_thread(_ask_to_adopt, config, adopt)))
                if not asked[0].done():
                    # Simulated time waits a little for what takes its own time.
                    await asyncio.sleep(ADOPT_PATIENCE_S)

        outcomes: list[Outcome] = []
        received: list[Offset] = []
        clock = VirtualClock(START_NS, advance)
        samples = round(hours * 60)
        with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as progress:
            bar = progress.add_task(f"simulated machine {machine}", total=samples)

            def took(outcome: Outcome) -> None:
                outcomes.append(outcome)
                progress.advance(bar)

            asyncio.run(_serve(config, clock, samples, took, received, port))
    return Day(
        outcomes=outcomes,
        received=received,
        truth=world.history(),
        seconds=time.perf_counter() - began,
        adopted_at=_adopted_at(outcomes) if adopt is not None else 0,
    )


def _ask_to_adopt(config: Path, model: Path) -> dict[str, Any] | None:
    """Ask the running service as `compensator adopt` does."""
    wanted = json.dumps({"model": model.read_text(encoding="utf-8")}).encode()
    return ask(load_config(config).config.zenoh, "adopt", wanted, timeout_s=60.0)


def _adopted_at(outcomes: Sequence[Outcome]) -> int:
    first = outcomes[0].offset.model_sha256
    for i, outcome in enumerate(outcomes):
        if outcome.offset.model_sha256 != first and "model_changed" not in outcome.offset.reasons:
            return i
    raise ServiceError("the service did not take the model over before the simulated day ended")


async def _serve(
    config: Path,
    clock: VirtualClock,
    samples: int,
    took: Callable[[Outcome], None],
    received: list[Offset],
    port: int,
) -> None:
    """Run the service with a subscriber in a Zenoh session of its own."""
    subscriber: Any = None
    ready = asyncio.Event()

    async def listen() -> None:
        nonlocal subscriber
        await ready.wait()
        settings = Zenoh(prefix="shop/sim", mode="client", connect=[f"tcp/127.0.0.1:{port}"])
        subscriber = await asyncio.to_thread(zenoh.open, session_config(settings))
        subscriber.declare_subscriber(
            "shop/sim/thermal/y/offset",
            lambda s: received.append(msgspec.json.decode(s.payload.to_bytes(), type=Offset)),
        )

    task = asyncio.create_task(listen())
    try:
        await run_service(
            load(str(config)),
            clock=clock,
            samples=samples,
            on_ready=lambda _: ready.set(),
            on_sample=took,
        )
        await task
    finally:
        if subscriber is not None:
            await asyncio.to_thread(subscriber.close)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
