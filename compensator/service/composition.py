"""Builds the service from its parts and runs it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

import drivers
from compensator.clock import Clock, SystemClock
from compensator.errors import ConfigError
from compensator.events import EventKind, Note
from compensator.recording.finishing import Retention
from compensator.recording.live_file import topics_of
from compensator.recording.recorder import McapRecorder
from compensator.service.axes import planned_outputs
from compensator.service.compensation import Outcome
from compensator.service.daemon import Daemon
from compensator.service.loading import Setup
from compensator.service.loop.live import LoopParts
from compensator.service.loop.process import DiagnosisProcess
from compensator.service.loop.resuming import resume_loop
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.presence import sole_user
from compensator.service.publisher import Publisher, Reply, Sender
from compensator.service.transfer.restart import Resumed, resume
from drivers.errors import DriverError
from drivers.reading import Reading

log = logging.getLogger("compensator")


async def read_once(fleet: drivers.Fleet) -> dict[str, dict[int, Reading] | DriverError]:
    """Read every device once, in parallel."""
    results = await asyncio.gather(*(device.read() for device in fleet.devices.values()), return_exceptions=True)
    answers: dict[str, dict[int, Reading] | DriverError] = {}
    for name, result in zip(fleet.devices, results, strict=True):
        if isinstance(result, DriverError):
            answers[name] = result
        elif isinstance(result, BaseException):
            raise result
        else:
            answers[name] = dict(result)
    await fleet.close()
    return answers


def loop_parts(setup: Setup, resumed: Resumed) -> LoopParts | None:
    """Return the parts of the loop, which continues from the last recording; None without `[loop]`."""
    core = resume_loop(setup.loaded, resumed, setup.store)
    if core is None:
        return None
    diagnose = DiagnosisProcess(setup.config, setup.recordings, setup.store.folder / "diagnoses")
    return LoopParts(core=core, model=setup.model_bytes, store=setup.store, diagnose=diagnose)


async def run_service(
    setup: Setup,
    *,
    clock: Clock | None = None,
    samples: int | None = None,
    on_ready: Callable[[Daemon], None] | None = None,
    on_sample: Callable[[Outcome], None] | None = None,
    on_poll: Callable[[], None] | None = None,
    on_publish: Callable[[str, bytes], None] | None = None,
    publishes: Callable[[], bool] = lambda: True,
) -> Daemon:
    """Run the service of a configuration until it is stopped.

    Parameters
    ----------
    setup : Setup
        The parts of the service; see `loading.load`.
    clock : Clock, optional
        By default the system clock.
    samples : int, optional
        Number of samples to stop after.
    on_ready : callable, optional
        Called with the daemon once everything is open.
    on_sample, on_poll : callable, optional
        Called after each sample, with its outcome, and after each poll.
    on_publish : callable, optional
        Called with name and JSON of each message after it was published; an error of it is logged.
    publishes : callable, optional
        Whether messages are published now, or only recorded, as those of a simulated past.
    """
    loaded, config, folder = setup.loaded, setup.config, setup.recordings
    machine, clock = config.machine.name, clock or SystemClock()
    with sole_user(folder, machine):
        axes = config.axis.names() if config.axis is not None else ()
        recorder = McapRecorder(
            folder,
            machine,
            {"config.toml": loaded.data, "model.toml": setup.model_bytes},
            retention=Retention(keep_days=config.recording.keep_days, keep_mb=config.recording.keep_mb),
            signer=setup.signer,
            head=setup.head,
            topics=topics_of(
                probes=config.probe is not None, loop=config.loop is not None and config.loop.is_on, axes=axes
            ),
            axes=axes,
        )

        def command(name: str, payload: bytes, sender: Sender) -> Reply:
            return daemon.command(name, payload, sender)

        def publish(name: str, data: bytes) -> None:
            if not publishes():
                return
            publisher.publish(name, data)
            if on_publish is not None:
                try:
                    on_publish(name, data)
                except Exception:
                    # Whoever listens must not end what is published here: half of an exchange, or a sample.
                    log.exception("internal error of a listener to published messages")

        publisher = Publisher(config.zenoh, command, axes)
        try:
            for warning in setup.warnings():
                log.warning("%s: warning: %s", loaded.path, warning.marked)
        except ConfigError as error:  # recording continues even if the offset cannot be received
            log.error("%s; the router will refuse the service", error)
        checkpoint = OffsetCheckpoint(folder, machine)
        further_max = {one.name: one.bounds.offset_max_um for one in planned_outputs(config.axis)}
        checkpointed = checkpoint.read(config.limits.offset_max_um, further_max)
        resumed = resume(loaded, setup.model, checkpointed)
        loop = loop_parts(setup, resumed)
        first = recorder.first_sequence(clock.utc_ns(), setup.model.period_s)
        compensation = resumed.compensation
        # As before on a machine that does not watch for jumps: its recordings stay the same.
        watches = config.guards.suspect_jumps
        described = compensation.describe_checks() if watches else compensation.plausibility.describe()
        checks = Note(EventKind.PLAUSIBILITY, described, {})
        daemon = Daemon(
            config=config,
            compensation=compensation,
            devices=setup.fleet.devices,
            recorder=recorder,
            publish=publish,
            clock=clock,
            first_sequence=max(first, checkpointed.seq + 1 if checkpointed is not None else 0),
            recordings=folder,
            store=setup.store,
            notes=(*resumed.notes, checks),
            checkpoint=checkpoint,
            loop=loop,
        )
        try:
            with publisher:
                if on_ready is not None:
                    on_ready(daemon)
                await daemon.run(samples=samples, on_sample=on_sample, on_poll=on_poll)
        finally:
            await setup.fleet.close()
    return daemon
