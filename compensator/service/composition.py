"""Puts the service together; the only room that knows the drivers' catalogue."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

import drivers
from compensator.certificates import check_files
from compensator.clock import Clock, SystemClock
from compensator.config import LoadedConfig, load_config
from compensator.errors import CompensatorError, ConfigError, ModelError
from compensator.model.model_file import parse_model, read_model_bytes
from compensator.model.thermal_model import ThermalModel
from compensator.reasons import Remark
from compensator.recording.finishing import Retention
from compensator.recording.reading import first_sequence
from compensator.recording.recorder import McapRecorder
from compensator.recording.signature import Signer
from compensator.service.adoption import Adoption, check_model
from compensator.service.compensation import Outcome
from compensator.service.configuration_warnings import precautions
from compensator.service.daemon import Daemon
from compensator.service.model_store import ModelStore
from compensator.service.offset_checkpoint import OffsetCheckpoint
from compensator.service.presence import sole_user
from compensator.service.publisher import Publisher, Reply, Sender
from compensator.service.restart import resume
from compensator.service.session import tls_files
from drivers.errors import DriverConfigError, DriverError
from drivers.reading import Reading

log = logging.getLogger("compensator")


def load(path: str) -> tuple[LoadedConfig, ThermalModel, bytes, drivers.Fleet]:
    """Read configuration and model and make the devices; nothing is opened.

    Raises
    ------
    ConfigError
        One line that names what is wrong.
    """
    loaded = load_config(path)
    config = loaded.config
    try:
        configured = read_model_bytes(loaded.model_name())
        model = parse_model(configured, source=config.model.file)
        if config.model.alternative:
            model = model.with_alternative(config.model.alternative)
    except ModelError as error:
        raise ConfigError(f"{path}: model: {error}") from error
    data, model = _adopted(loaded, configured, model)
    polls = model.period_s / config.sampling.poll_interval_s
    if abs(polls - round(polls)) > 1e-9 or polls < 1:
        raise ConfigError(
            f"{path}: sampling.poll_interval_s = {config.sampling.poll_interval_s:g}, "
            f"expected a whole part of the model's {model.period_s:g} s"
        )
    try:
        fleet = drivers.build(config.line, config.device, source=str(path))
    except DriverConfigError as error:
        raise ConfigError(str(error)) from error
    for channel in config.channel:
        units = fleet.devices[channel.device].units
        if channel.input not in units:
            raise ConfigError(
                f"{path}: channel {channel.name!r}: input {channel.input} of device {channel.device!r} is not "
                f"configured, expected one of: {', '.join(map(str, sorted(units)))}"
            )
        _check_unit(path, channel.name, units[channel.input])
    _signer(loaded)
    files = tls_files(config.zenoh)
    if files is not None:
        check_files(str(path), files)
    return loaded, model, data, fleet


def _signer(loaded: LoadedConfig) -> Signer | None:
    """Return what signs the recordings, None where no key is configured."""
    name = loaded.config.recording.signing_key
    if name is None:
        return None
    path, folder = loaded.resolve(name), loaded.resolve(loaded.config.recording.folder)
    if path.is_relative_to(folder):
        raise ConfigError(
            f"{loaded.path}: recording.signing_key = {name!r}: stands among the recordings, expected a place where "
            f"nobody who can change them can read it"
        )
    return Signer(path)


def _adopted(loaded: LoadedConfig, configured: bytes, model: ThermalModel) -> tuple[bytes, ThermalModel]:
    """Return the model that was adopted in place of the configured one, if any; one that cannot be used is said."""
    try:
        data = ModelStore(loaded.store(), configured).in_use()
        if data == configured:
            return configured, model
        return data, check_model(loaded.config, data, source="adopted model")
    except CompensatorError as error:
        figures = f"The adopted model cannot be used, the configured one stands in: {error}."
        log.warning("%s", Remark("adopted_unusable", figures).marked)
        return configured, model


def _check_unit(path: str, name: str, unit: str) -> None:
    for role, expected in (("t_q_degc", "degc"), ("at_degc", "degc"), ("y_um", "um")):
        if name == role and unit != expected:
            raise ConfigError(f"{path}: channel {name!r}: its input gives {unit}, expected {expected}")


async def read_once(fleet: drivers.Fleet) -> dict[str, dict[int, Reading] | DriverError]:
    """Read every device once, side by side."""
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


async def run_service(
    path: str,
    *,
    clock: Clock | None = None,
    samples: int | None = None,
    on_ready: Callable[[Daemon], None] | None = None,
    on_sample: Callable[[Outcome], None] | None = None,
    on_poll: Callable[[], None] | None = None,
    on_publish: Callable[[str, bytes], None] | None = None,
) -> Daemon:
    """Run the service of a configuration until it is stopped.

    Parameters
    ----------
    path : str
        Configuration file.
    clock : Clock, optional
        The machine's own where none is given.
    samples : int, optional
        Stop after so many.
    on_ready : callable, optional
        Called with the daemon once everything is open.
    on_sample : callable, optional
        Called after each sample.
    on_poll : callable, optional
        Called after each poll.
    on_publish : callable, optional
        Called with name and JSON of each message after it was published.
    """
    loaded, model, model_bytes, fleet = load(path)
    config = loaded.config
    folder = loaded.resolve(config.recording.folder)
    keep = Retention(keep_days=config.recording.keep_days, keep_mb=config.recording.keep_mb)
    with sole_user(folder, config.machine.name):
        attachments = {"config.toml": loaded.data, "model.toml": model_bytes}
        recorder = McapRecorder(folder, config.machine.name, attachments, retention=keep, signer=_signer(loaded))

        def command(name: str, payload: bytes, sender: Sender) -> Reply:
            return daemon.command(name, payload, sender)

        def publish(name: str, data: bytes) -> None:
            publisher.publish(name, data)
            if on_publish is not None:
                on_publish(name, data)

        publisher = Publisher(config.zenoh, command)
        clock = clock or SystemClock()
        try:
            for warning in precautions(loaded):
                log.warning("%s: warning: %s", path, warning.marked)
        except ConfigError as error:  # recording goes on, whether anybody can be told or not
            log.error("%s; the router will refuse the service", error)
        store = ModelStore(loaded.store(), read_model_bytes(loaded.model_name()))
        note = OffsetCheckpoint(folder, config.machine.name)
        early = note.read(config.limits.offset_max_um)
        resumed = resume(loaded, model, early)
        first = first_sequence(folder, config.machine.name, clock.utc_ns(), model.period_s)
        checks: tuple[str, str, dict[str, Any]] = ("plausibility", resumed.compensation.plausibility.describe(), {})
        daemon = Daemon(
            config=config,
            compensation=resumed.compensation,
            devices=fleet.devices,
            recorder=recorder,
            publish=publish,
            clock=clock,
            first_sequence=max(first, early.seq + 1 if early is not None else 0),
            adoption=Adoption(config, folder, store),
            notes=(*resumed.notes, checks),
            checkpoint=note,
        )
        try:
            with publisher:
                if on_ready is not None:
                    on_ready(daemon)
                await daemon.run(samples=samples, on_sample=on_sample, on_poll=on_poll)
        finally:
            await fleet.close()
    return daemon
