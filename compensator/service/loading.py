"""Reads everything that a service needs, once: configuration, model, signing key, devices, certificate."""

from __future__ import annotations

import datetime
import logging
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drivers
from compensator.axes import column_of
from compensator.certificates import Certificate, check_files, remarks
from compensator.codes import Remark, ServiceWarning
from compensator.config import ROLES, Config, LoadedConfig, Zenoh, load_config
from compensator.data.table import is_taken
from compensator.errors import CompensatorError, ConfigError, ModelError
from compensator.input_file import resolved
from compensator.model.model_file import read_model_bytes
from compensator.model.thermal_model import ThermalModel
from compensator.recording.signature import Signer
from compensator.service.compensation import model_of
from compensator.service.probing.probing import MOST_SAMPLES
from compensator.service.session import tls_files
from compensator.service.transfer.model_store import ModelStore, check_model
from drivers.errors import DriverConfigError

log = logging.getLogger("compensator")

#: Port names that depend on the order in which adapters are connected or found.
_NUMBERED = re.compile(r"/dev/tty(USB|ACM)\d+")
_BY_ID = Path("/dev/serial/by-id")

#: Units of channels: where its name ends in one and its input gives another one, a model would get wrong values.
_UNITS = frozenset({"degc", "degf", "k", "um", "mm", "v", "rpm", "w", "kw", "lpm", "bar", "pct"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """The parts of a service by its configuration; nothing is open.

    Parameters
    ----------
    loaded : LoadedConfig
        The configuration and its file.
    model : ThermalModel
        The model in use: the adopted one, or else the configured one.
    model_bytes : bytes
        The model's file.
    store : ModelStore
        Adopted models.
    signer : Signer, optional
        Signs the recordings.
    head : pathlib.Path, optional
        File for the head of their chain; None without a signer.
    fleet : drivers.Fleet
        The devices.
    certificate : Certificate, optional
        The machine's certificate; None without TLS or without the package `cryptography`.
    """

    loaded: LoadedConfig
    model: ThermalModel
    model_bytes: bytes
    store: ModelStore
    signer: Signer | None
    head: Path | None
    fleet: drivers.Fleet
    certificate: Certificate | None

    @property
    def config(self) -> Config:
        """The settings."""
        return self.loaded.config

    @property
    def recordings(self) -> Path:
        """Folder of the recordings."""
        return self.loaded.resolve(self.config.recording.folder)

    def warnings(self, now: datetime.datetime | None = None) -> list[Remark]:
        """Return warnings about the configuration; `check` shows them, and `run` continues in spite of them.

        Parameters
        ----------
        now : datetime.datetime, optional
            Time for which the certificate is checked, UTC; by default now.

        Raises
        ------
        ConfigError
            If the certificate is not valid at that time: the router will refuse the service.
        """
        zenoh = self.config.zenoh
        found = [remark for line in self.config.line if (remark := _numbered_port(line)) is not None]
        found += _exposures(zenoh)
        probe, loop, checks = self.config.probe, self.config.loop, self.config.plausibility
        is_checked = probe is not None or (checks is not None and checks.false_alarm_days is not None)
        if loop is not None and loop.is_on and not is_checked:
            figures = f"loop.misfit_h = {loop.misfit_h:g} has no effect: plausibility.false_alarm_days is not given."
            found.append(Remark(ServiceWarning.LOOP_WITHOUT_CHECK, figures))
        if probe is not None and probe.tolerance_um is not None and probe.tolerance_um < probe.std_um:
            figures = (
                f"probe.tolerance_um = {probe.tolerance_um:g} is below probe.std_um = {probe.std_um:g}: a probe is "
                "wanted nearly always."
            )
            found.append(Remark(ServiceWarning.PROBE_TOLERANCE, figures))
        if probe is not None and probe.measured_max_um < probe.largest_um:
            figures = (
                f"probe.measured_max_um = {probe.measured_max_um:g} is below probe.largest_um = {probe.largest_um:g}: "
                "a probe that shows such an error is refused."
            )
            found.append(Remark(ServiceWarning.PROBE_BOUNDS, figures))
        longest_min = MOST_SAMPLES * self.model.period_s / 60.0
        if probe is not None and probe.oldest_min > longest_min:
            figures = (
                f"probe.oldest_min = {probe.oldest_min:g} is more than {MOST_SAMPLES} samples of "
                f"{self.model.period_s:g} s: an older probe than {longest_min:.3g} min is refused."
            )
            found.append(Remark(ServiceWarning.PROBE_OLDEST, figures))
        found += _unwritable_head(self.head, self.recordings)
        if zenoh.secured():
            now = now or datetime.datetime.now(datetime.UTC)
            wrong = self.certificate.wrong_at(now) if self.certificate is not None else None
            if wrong is not None:
                raise ConfigError(f"{self.loaded.path}: zenoh.tls_certificate = {zenoh.tls_certificate!r}: {wrong}")
            found += remarks(self.certificate, now)
        return found


def load(path: str) -> Setup:
    """Read configuration, model and keys, and make the devices; nothing is opened.

    Raises
    ------
    ConfigError
        If something cannot be used; the message is one line.
    """
    loaded = load_config(path)
    config = loaded.config
    # Only here: recordings of such a machine can still be read and audited.
    channels = [channel.name for channel in config.channel]
    if taken := [name for name in channels if is_taken(name, channels)]:
        words = "`export` writes another column of this name, expected a name of its own"
        raise ConfigError(f"{path}: channel {taken[0]!r}: {words}")
    rest = config.plausibility.rest if config.plausibility is not None else None
    if rest is not None and rest.channel in ROLES[:3]:
        words = "which says nothing of a machine at rest, expected a channel such as heat_w or spindle_rpm"
        raise ConfigError(f"{path}: plausibility.rest.channel = {rest.channel!r}: {words}")
    folder = loaded.resolve(config.recording.folder)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{path}: recording.folder = {config.recording.folder!r}: is a file, expected a folder")
    model, model_bytes, store = _model(loaded)
    if config.sampling.polls_of(model.period_s) is None:
        raise ConfigError(
            f"{path}: sampling.poll_interval_s = {config.sampling.poll_interval_s:g}, "
            f"expected the model's {model.period_s:g} s divided by an integer"
        )
    fleet = _fleet(path, config)
    signer = load_signer(loaded)
    files = tls_files(config.zenoh)
    return Setup(
        loaded=loaded,
        model=model,
        model_bytes=model_bytes,
        store=store,
        signer=signer,
        head=head_file(loaded),
        fleet=fleet,
        certificate=check_files(str(path), files) if files is not None else None,
    )


def _model(loaded: LoadedConfig) -> tuple[ThermalModel, bytes, ModelStore]:
    """Return the adopted model, or the configured one if none was adopted or it cannot be used."""
    config = loaded.config
    try:
        configured = read_model_bytes(loaded.model_name())
        model = model_of(config, configured, source=config.model.file)
    except ModelError as error:
        raise ConfigError(f"{loaded.path}: model: {error}") from error
    store = ModelStore(loaded.store(), configured, config.machine.name)
    try:
        data = store.in_use()
        if data != configured:
            return check_model(config, data, source="adopted model"), data, store
    except CompensatorError as error:
        figures = f"The adopted model cannot be used, the configured one is used instead: {error}."
        log.warning("%s", Remark(ServiceWarning.ADOPTED_UNUSABLE, figures).marked)
    return model, configured, store


def _fleet(path: str, config: Config) -> drivers.Fleet:
    try:
        fleet = drivers.build(config.line, config.device, source=str(path))
    except DriverConfigError as error:
        raise ConfigError(str(error)) from error
    expected_units = {"t_q_degc": "degc", "at_degc": "degc", "y_um": "um"}
    if config.axis is not None:
        expected_units |= {column_of(axis): "um" for axis in config.axis.linear()}
    owners: dict[tuple[str, int], str] = {}
    for channel in config.channel:
        units = fleet.devices[channel.device].units
        if channel.input not in units:
            raise ConfigError(
                f"{path}: channel {channel.name!r}: input {channel.input} of device {channel.device!r} is not "
                f"configured, expected one of: {', '.join(map(str, sorted(units)))}"
            )
        # Only here, and not in `parse_config`: recordings of such a machine can still be audited.
        if (owner := owners.setdefault((channel.device, channel.input), channel.name)) != channel.name:
            raise ConfigError(
                f"{path}: channel {channel.name!r}: input {channel.input} of device {channel.device!r} is that of "
                f"channel {owner!r}, expected one of its own"
            )
        unit, suffix = units[channel.input], channel.name.rpartition("_")[2]
        expected = expected_units.get(channel.name, suffix if {suffix, unit} <= _UNITS else None)
        if expected not in (None, unit):
            raise ConfigError(f"{path}: channel {channel.name!r}: its input gives {unit}, expected {expected}")
    return fleet


def load_signer(loaded: LoadedConfig) -> Signer | None:
    """Return the signer of the recordings; None if no key is configured.

    Raises
    ------
    ConfigError
        If the key is among the recordings, or cannot be used.
    """
    name = loaded.config.recording.signing_key
    if name is None:
        return None
    path, folder = loaded.resolve(name), loaded.resolve(loaded.config.recording.folder)
    if path.is_relative_to(folder):
        raise ConfigError(
            f"{loaded.path}: recording.signing_key = {name!r}: is in the recording folder, expected a place that "
            "is not readable by those who can change the recordings"
        )
    return Signer(path)


def head_file(loaded: LoadedConfig) -> Path | None:
    """Return the file for the head of the chain; None if no signing key is configured.

    Raises
    ------
    ConfigError
        If it is among the recordings, what the service reads, no regular file, or configured without a key.
    """
    recording = loaded.config.recording
    folder = loaded.resolve(recording.folder)
    if recording.signing_key is None:
        if recording.head is not None:
            raise ConfigError(
                f"{loaded.path}: recording.head = {recording.head!r}: needs recording.signing_key, which signs it"
            )
        return None
    path = loaded.resolve(recording.head or f"{folder.parent}/{loaded.config.machine.name}.head.json")
    if path.is_relative_to(folder):
        raise ConfigError(
            f"{loaded.path}: recording.head = {recording.head!r}: is in the recording folder, expected a place that "
            "is not writable by those who can change the recordings"
        )
    if path.exists() and not path.is_file():
        raise ConfigError(f"{loaded.path}: recording.head = {str(path)!r}: is not a regular file, expected one")
    for name, read in _read_by(loaded).items():
        if path == resolved(read) or (path.exists() and read.exists() and path.samefile(read)):
            words = f"is {name}, which it would replace, expected another file"
            raise ConfigError(f"{loaded.path}: recording.head = {str(path)!r}: {words}")
    return path


def _read_by(loaded: LoadedConfig) -> dict[str, Path]:
    """Return the files that the service reads, by what they are."""
    zenoh, key, model = loaded.config.zenoh, loaded.config.recording.signing_key, loaded.model_name()
    files = {f"zenoh.{name}": getattr(zenoh, name) for name in ("tls_ca", "tls_certificate", "tls_key")}
    found = {name: loaded.resolve(file) for name, file in files.items() if file is not None}
    found["the configuration itself"] = loaded.path
    if key is not None:
        found["recording.signing_key"] = loaded.resolve(key)
    if isinstance(model, Path):
        found["model.file"] = model
    return found


# ---------------------------------------------------------------------- warnings


def _unwritable_head(head: Path | None, recordings: Path) -> list[Remark]:
    """Warn where the head of the chain cannot be replaced."""
    if head is None:
        return []
    folder = head.parent
    while not folder.exists() and folder in recordings.parents:  # it is made with that of the recordings
        folder = folder.parent
    if folder.is_dir() and os.access(folder, os.W_OK | os.X_OK):
        return []
    return [Remark(ServiceWarning.HEAD_NOT_WRITABLE, f"The head of the chain {head} cannot be written by this user.")]


def _numbered_port(line: Mapping[str, Any]) -> Remark | None:
    """Warn of a serial port without a permanent name."""
    port = str(line.get("port", ""))
    if not _NUMBERED.fullmatch(port):
        return None
    lasting = [link for link in sorted(_BY_ID.glob("*")) if _same_file(link, Path(port))]
    name = f" Its permanent name is {lasting[0]}." if lasting else ""
    figures = f"Line {line.get('name')!r}: port {port} is numbered in the order of connection; after a restart it may "
    return Remark(ServiceWarning.NUMBERED_PORT, f"{figures}be another adapter.{name}")


def _same_file(link: Path, port: Path) -> bool:
    try:
        return link.resolve() == port.resolve()
    except (OSError, RuntimeError, ValueError):  # a loop of links
        return False


def _exposures(zenoh: Zenoh) -> list[Remark]:
    """Warn if others on the network can act as the machine or its operator."""
    found = []
    outside = [endpoint for endpoint in zenoh.listen if not zenoh.is_loopback(endpoint)]
    if outside:
        figures = (
            f"zenoh.listen {', '.join(outside)}: any program that reaches it can publish offsets and send commands."
        )
        found.append(Remark(ServiceWarning.OPEN_LISTEN, figures))
    outside = [endpoint for endpoint in zenoh.connect if not zenoh.is_loopback(endpoint)]
    if outside and not zenoh.secured():
        figures = f"zenoh.connect {', '.join(outside)}: neither encrypted nor authenticated."
        found.append(Remark(ServiceWarning.UNSECURED_CONNECT, figures))
    if zenoh.unproven_commands and not zenoh.on_loopback():
        figures = "zenoh.unproven_commands: the service accepts commands whose sender is not authenticated."
        found.append(Remark(ServiceWarning.UNPROVEN_COMMANDS, figures))
    return found
