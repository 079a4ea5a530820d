"""Settings of the sources of probes: a TOML file; an unknown key is an error."""

from __future__ import annotations

import zoneinfo
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from compensator.errors import ConfigError
from compensator.input_file import resolved
from compensator.probes.probe import Convention
from compensator.receiver import ReceiverError
from compensator.receiver.settings import check_apart, load_tables, read_table, require_sign

#: µm for each unit of a control.
UNITS_UM = {"mm": 1000.0, "inch": 25400.0}
_TABLES = ("folder", "dprnt", "linuxcnc")
#: `sign_checked` of probes.example.toml, which nobody has checked.
PLACEHOLDER = "date, who, how"
#: How the sign of a reading is determined.
_SIGN_BY = "by probing a feature with two offsets"


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """`[probes]`.

    Parameters
    ----------
    prefix : str
        The service's `zenoh.prefix`.
    send_within_s : float
        A probe is sent, and retried, until it is this old, s; not longer than the service's own limit.
    connect : tuple of str
        Addresses of service or router, such as `tcp/127.0.0.1:7447`. Either this or `zenoh_config`.
    zenoh_config : str
        A Zenoh configuration with certificates, such as `probe.json5`; relative to the file.
    applied_file : str
        What the receiver records (`applied_file` there), for lines without an offset; relative to the file.
    state_file : str
        Where folders keep which lines were sent; relative to the file.
    retry_s, timeout_s : float
        Pause after an attempt without answer, and time limit of an answer, s.
    """

    prefix: str
    send_within_s: float
    connect: tuple[str, ...] = ()
    zenoh_config: str = ""
    applied_file: str = ""
    state_file: str = ""
    retry_s: float = 5.0
    timeout_s: float = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Folder:
    """`[[folder]]`: CSV files.

    Parameters
    ----------
    path, pattern : str
        The folder, and which files in it.
    sign, includes_offset, sign_checked
        As in `Dprnt`, for the column `measured_um`.
    poll_s : float
        Interval of looking, s.
    """

    path: str
    sign: int
    sign_checked: str
    includes_offset: bool = False
    pattern: str = "*.csv"
    poll_s: float = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Dprnt:
    """`[[dprnt]]`: a control that prints lines.

    Parameters
    ----------
    address, port : str
        Either `HOST:PORT` of a control or converter, or a serial port.
    baud : int
        Of the serial port, 1/s.
    bits : str
        `8N`, or `7E`: 7 bits with even parity, or ISO code.
    sign, includes_offset, sign_checked
        As `Convention`; who determined it on the machine, when and how. No default.
    feature : str
        For lines without `F`.
    zone : str
        Time zone of the control's clock, such as `UTC` or `Europe/Prague`.
    clock_tolerance_s : float
        Largest difference between the time in a line and its arrival, s.
    delay_s : float
        From the print to the arrival, s; for lines without a time.
    settle_s : float
        What arrives before the line has been quiet for this time after connecting was waiting somewhere, s.
    pause_s : float
        If this program stood still for longer, what it then reads was waiting, s.
    retry_s : float
        Pause before the next attempt to connect, s.
    """

    sign: int
    sign_checked: str
    includes_offset: bool = False
    address: str = ""
    port: str = ""
    baud: int = 9600
    bits: str = "8N"
    feature: str = ""
    zone: str = "UTC"
    clock_tolerance_s: float = 10.0
    delay_s: float = 0.2
    settle_s: float = 2.0
    pause_s: float = 2.0
    retry_s: float = 5.0

    @property
    def name(self) -> str:
        """Where it is."""
        return self.address or self.port


@dataclass(frozen=True, slots=True, kw_only=True)
class LinuxCnc:
    """`[[linuxcnc]]`: a file that `(PROBEOPEN …)` makes, for one feature.

    Parameters
    ----------
    file : str
        The file, on this computer.
    feature : str
        What is probed into it.
    nominal : float
        Where it belongs: Y in the file's coordinates and unit.
    unit : str
        `mm` or `inch`.
    sign, includes_offset, sign_checked
        As in `Dprnt`.
    within_um : float
        Largest distance from where it belongs; beyond that another feature was probed, µm.
    tool : str
        Name of the probe.
    poll_s, pause_s : float
        Interval of looking; after a longer pause the age of new lines is not known, s.
    """

    file: str
    feature: str
    nominal: float
    unit: str
    sign: int
    sign_checked: str
    includes_offset: bool
    within_um: float = 500.0
    tool: str = ""
    poll_s: float = 0.2
    pause_s: float = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeSettings:
    """All of the file, with absolute paths."""

    service: Service
    folders: tuple[Folder, ...]
    dprnt: tuple[Dprnt, ...]
    linuxcnc: tuple[LinuxCnc, ...]


class _Signed(Protocol):
    @property
    def sign(self) -> int: ...
    @property
    def sign_checked(self) -> str: ...
    @property
    def includes_offset(self) -> bool: ...


def convention(settings: _Signed) -> Convention:
    """Return how the readings of a control become measured values."""
    return Convention(sign=settings.sign, includes_offset=settings.includes_offset)


def load_probes(path: str | Path) -> ProbeSettings:
    """Read and check the file; nothing is opened.

    Raises
    ------
    ConfigError
        One line that names file, key, value and what was expected.
    """
    try:
        return _load(Path(path))
    except ReceiverError as error:
        raise ConfigError(str(error)) from error


def _load(path: Path) -> ProbeSettings:
    tables = load_tables(path)
    table = tables.pop("probes", None)
    if not isinstance(table, dict):
        raise ReceiverError(f"{path}: probes: missing, expected a table [probes]")
    lists = {name: tables.pop(name, []) for name in _TABLES}
    if tables:
        raise ReceiverError(f"{path}: {next(iter(tables))}: unknown table, expected probes, {', '.join(_TABLES)}")
    for name, given in lists.items():
        if not isinstance(given, list) or not all(isinstance(one, dict) for one in given):
            raise ReceiverError(f"{path}: {name}: expected tables [[{name}]]")
    if not any(lists.values()):
        raise ReceiverError(f"{path}: no source, expected [[folder]], [[dprnt]] or [[linuxcnc]]")
    settings = ProbeSettings(
        service=_service(path, table),
        folders=tuple(_folder(path, one) for one in lists["folder"]),
        dprnt=tuple(_dprnt(path, one) for one in lists["dprnt"]),
        linuxcnc=tuple(_linuxcnc(path, one) for one in lists["linuxcnc"]),
    )
    if settings.folders and not settings.service.state_file:
        raise ReceiverError(f"{path}: probes.state_file: missing; with it a folder's lines are sent once")
    return settings


def _service(path: Path, table: Mapping[str, Any]) -> Service:
    service = read_table(Service, table, source=str(path), name="probes")
    if bool(service.connect) == bool(service.zenoh_config):
        raise ReceiverError(
            f"{path}: probes.connect = {list(service.connect)}: expected addresses such as 'tcp/127.0.0.1:7447' here, "
            f"or a file in probes.zenoh_config, and not both"
        )
    bounds = {"send_within_s": (10.0, 86400.0), "retry_s": (0.05, 600.0), "timeout_s": (0.5, 60.0)}
    _within(service, bounds, f"{path}: probes")
    files: dict[str, Any] = {
        key: _absolute(path, getattr(service, key)) for key in ("zenoh_config", "applied_file", "state_file")
    }
    check_apart(files, source=str(path), name="probes")
    return replace(service, **files)


def _folder(path: Path, table: Mapping[str, Any]) -> Folder:
    require_sign(table, f"{path}: folder", how=_SIGN_BY)
    folder = read_table(Folder, table, source=str(path), name="folder")
    _check_sign(f"{path}: folder", folder)
    _within(folder, {"poll_s": (0.02, 600.0)}, f"{path}: folder")
    if set(folder.pattern) <= {"."} or "/" in folder.pattern or "**" in folder.pattern:  # "." is the folder itself
        raise ReceiverError(f"{path}: folder.pattern = {folder.pattern!r}: expected a name such as '*.csv'")
    return replace(folder, path=_absolute(path, folder.path))


def _dprnt(path: Path, table: Mapping[str, Any]) -> Dprnt:
    where = f"{path}: dprnt"
    require_sign(table, where, how=_SIGN_BY)
    dprnt = read_table(Dprnt, table, source=str(path), name="dprnt")
    _check_sign(where, dprnt)
    if bool(dprnt.address) == bool(dprnt.port):
        raise ReceiverError(f"{where}.address = {dprnt.address!r}: expected either address or port")
    if dprnt.address and not address_of(dprnt.address)[1]:
        raise ReceiverError(f"{where}.address = {dprnt.address!r}: expected HOST:PORT")
    if dprnt.bits not in ("8N", "7E"):
        raise ReceiverError(f"{where}.bits = {dprnt.bits!r}: expected 8N or 7E")
    if dprnt.zone not in zoneinfo.available_timezones():
        raise ReceiverError(f"{where}.zone = {dprnt.zone!r}: expected a time zone such as UTC or Europe/Prague")
    bounds = {
        "baud": (110, 1_000_000),
        "clock_tolerance_s": (1.0, 60.0),
        "delay_s": (0.0, 60.0),
        "settle_s": (0.02, 60.0),
        "pause_s": (0.1, 60.0),
        "retry_s": (0.05, 600.0),
    }
    _within(dprnt, bounds, where)
    return dprnt


def _linuxcnc(path: Path, table: Mapping[str, Any]) -> LinuxCnc:
    where = f"{path}: linuxcnc"
    require_sign(table, where, how=_SIGN_BY)
    linuxcnc = read_table(LinuxCnc, table, source=str(path), name="linuxcnc")
    _check_sign(where, linuxcnc)
    if linuxcnc.unit not in UNITS_UM:
        raise ReceiverError(f"{where}.unit = {linuxcnc.unit!r}: expected one of {', '.join(UNITS_UM)}")
    if not linuxcnc.feature:
        raise ReceiverError(f"{where}.feature = '': expected a name: each feature has its own zero")
    _within(linuxcnc, {"within_um": (1.0, 5000.0), "poll_s": (0.02, 1.0), "pause_s": (0.1, 60.0)}, where)
    return replace(linuxcnc, file=_absolute(path, linuxcnc.file))


def address_of(text: str) -> tuple[str, int]:
    """Split `HOST:PORT`; the port is 0 where there is none."""
    host, _, port = text.rpartition(":")
    valid = bool(host) and port.isascii() and port.isdigit() and 0 < int(port) < 65536
    return host.strip("[]"), int(port) if valid else 0


def _check_sign(where: str, settings: _Signed) -> None:
    if settings.sign not in (1, -1):
        raise ReceiverError(f"{where}.sign = {settings.sign!r}: expected 1 or -1, determined on this machine")
    if settings.sign_checked.strip() in ("", PLACEHOLDER):
        raise ReceiverError(
            f"{where}.sign_checked = {settings.sign_checked!r}: expected who determined the sign, when and how"
        )


def _within(settings: object, bounds: Mapping[str, tuple[float, float]], where: str) -> None:
    for key, (least, most) in bounds.items():
        value = getattr(settings, key)
        if not least <= value <= most:
            raise ReceiverError(f"{where}.{key} = {value!r}: expected {least:g} to {most:g}")


def _absolute(path: Path, name: str) -> str:
    return str(resolved(path.parent / name)) if name else ""
