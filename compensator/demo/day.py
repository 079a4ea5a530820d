"""One simulated day in seconds: machine, devices, service, disk and Zenoh.

Machine, sensors and devices come from `sim_hardware` and share no code with the service.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import shutil
import socket
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from compensator.arrays import Vector
from compensator.clock import NS, VirtualClock
from compensator.codes import Reason
from compensator.config import Zenoh, load_config
from compensator.demo.machine import MACHINES, configuration, hardware
from compensator.errors import ServiceError
from compensator.events import CommandName
from compensator.messages import Offset
from compensator.service.command_client import ask
from compensator.service.compensation import Outcome
from compensator.service.composition import run_service
from compensator.service.loading import load
from compensator.service.session import session_config
from sim_hardware.physics import Duty, World, usual_sensors
from sim_hardware.physics.effects.base import UndeclaredEffect

#: 2026-01-05 06:00 UTC, a Monday's early shift.
START_NS = 1_767_592_800 * NS
#: Time at which the service of the second day is sent the extended model, and how long each poll then waits for it, s.
ADOPT_AFTER_S, ADOPT_PATIENCE_S = 3600.0, 0.02


@dataclass(slots=True)
class Received:
    """What a separate Zenoh subscriber has received, as a control does: all offsets, and the last status."""

    offsets: list[Offset] = field(default_factory=list)
    status: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True)
class Running:
    """A day while it is running.

    Parameters
    ----------
    config : pathlib.Path
        Configuration of the service.
    world : World
        The simulated machine.
    outcomes : list of Outcome
        One per sample so far.
    received : Received
        What the control has received.
    """

    config: Path
    world: World
    outcomes: list[Outcome]
    received: Received


#: What is done at the machine: called with the time since the start, s, whenever that has advanced.
AtMachine = Callable[[float, Running], Awaitable[None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Day:
    """Result of a simulated run.

    Parameters
    ----------
    outcomes : list of Outcome
        One per sample.
    received : list of Offset
        Offsets received by a separate Zenoh subscriber.
    truth : dict of str to numpy.ndarray
        True history of the simulated machine.
    seconds : float
        Computing time, s.
    adopted_at : int
        First sample with the full offset of the adopted model; 0 if none was adopted.
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
    effects: Sequence[UndeclaredEffect] = (),
    adopt: Path | None = None,
    probe: AtMachine | None = None,
) -> Day:
    """Run one simulated machine through its devices, the service, disk and Zenoh.

    Parameters
    ----------
    folder : pathlib.Path
        Folder for the configuration and the recordings.
    machine : str
        `conduction` or `published`.
    hours : float
        Length, h.
    seed : int
        Seed of duty and sensors.
    model : str
        Name of a model, or path of its file from the folder.
    effects : sequence of UndeclaredEffect
        Effects in the machine that are absent from its calibration.
    adopt : pathlib.Path, optional
        A model that the running service adopts after `ADOPT_AFTER_S`.
    probe : AtMachine, optional
        Probes Y; the machine then has no displacement sensor.

    Raises
    ------
    ServiceError
        If the service does not adopt it before the end.
    """
    duty = Duty.working_day(seed, hours=hours + 0.1)
    world = World(MACHINES[machine](effects=effects), duty, usual_sensors(duty.extra_names), seed)
    folder.mkdir(parents=True, exist_ok=True)
    # Remove the recordings of an earlier demo, which the service would continue.
    shutil.rmtree(folder / "recordings", ignore_errors=True)
    began = time.perf_counter()
    with hardware(world) as devices:
        port = _free_port()
        config = folder / "config.toml"
        text = configuration(f"sim-{machine}", devices.lines, port, model, is_probed=probe is not None)
        config.write_text(text, encoding="utf-8")
        running = Running(config=config, world=world, outcomes=[], received=Received())
        asked: list[asyncio.Future[dict[str, Any] | None]] = []

        async def advance(t_s: float) -> None:
            world.advance_to(t_s)
            if probe is None:
                devices.capa.push(1)
            else:
                await probe(t_s, running)
            if adopt is not None and t_s >= ADOPT_AFTER_S:
                if not asked:
                    asked.append(asyncio.ensure_future(asyncio.to_thread(_ask_to_adopt, config, adopt)))
                if not asked[0].done():
                    # Simulated time pauses briefly for a command that takes real time.
                    await asyncio.sleep(ADOPT_PATIENCE_S)

        clock = VirtualClock(START_NS, advance)
        asyncio.run(_serve(config, clock, round(hours * 60), running.outcomes.append, running.received, port))
    return Day(
        outcomes=running.outcomes,
        received=running.received.offsets,
        truth=world.history(),
        seconds=time.perf_counter() - began,
        adopted_at=_adopted_at(running.outcomes) if adopt is not None else 0,
    )


def _ask_to_adopt(config: Path, model: Path) -> dict[str, Any] | None:
    """Send the command adopt, as `compensator adopt` does."""
    wanted = json.dumps({"model": model.read_text(encoding="utf-8")}).encode()
    return ask(load_config(config).config.zenoh, CommandName.ADOPT, wanted, timeout_s=60.0)


def _adopted_at(outcomes: Sequence[Outcome]) -> int:
    first = outcomes[0].offset.model_sha256
    for i, outcome in enumerate(outcomes):
        if outcome.offset.model_sha256 != first and Reason.MODEL_CHANGED not in outcome.offset.reasons:
            return i
    raise ServiceError("the service did not adopt the model before the end of the simulated day")


async def _serve(
    config: Path,
    clock: VirtualClock,
    samples: int,
    on_sample: Callable[[Outcome], None],
    received: Received,
    port: int,
) -> None:
    """Run the service with a subscriber in a separate Zenoh session."""
    subscriber: Any = None
    ready = asyncio.Event()

    def keep_status(sample: zenoh.Sample) -> None:
        received.status = sample.payload.to_bytes()

    async def listen() -> None:
        nonlocal subscriber
        await ready.wait()
        settings = Zenoh(prefix="shop/sim", mode="client", connect=[f"tcp/127.0.0.1:{port}"])
        subscriber = await asyncio.to_thread(zenoh.open, session_config(settings))
        subscriber.declare_subscriber(
            "shop/sim/thermal/y/offset",
            lambda s: received.offsets.append(msgspec.json.decode(s.payload.to_bytes(), type=Offset)),
        )
        subscriber.declare_subscriber("shop/sim/thermal/status", keep_status)

    task = asyncio.create_task(listen())
    try:
        await run_service(
            load(str(config)),
            clock=clock,
            samples=samples,
            on_ready=lambda _: ready.set(),
            on_sample=on_sample,
        )
        await task
    finally:
        if subscriber is not None:
            await asyncio.to_thread(subscriber.close)


def _free_port() -> int:
    """Return a port that nothing listens on, none of those that outgoing connections of other days get."""
    for port in random.sample(range(20_000, 30_000), 100):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise ServiceError("no free port between 20000 and 30000")
