"""Settings of a receiver: the table `[receiver]` of a TOML file. An unknown key is an error; no limit has a default."""

from __future__ import annotations

import errno
import os
import re
import stat
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from .errors import ReceiverError
from .limits import Acceptance, Limits

T = TypeVar("T")
S = TypeVar("S", bound="Source")
#: Larger than any setting, and a float.
_LARGEST = 1e30
#: Largest files, bytes: settings, a Zenoh configuration, the state.
SETTINGS_MAX_BYTES, ZENOH_MAX_BYTES, STATE_MAX_BYTES = 1_000_000, 1_000_000, 10_000
#: Most opening brackets in a configuration file of Zenoh: its parser ends the process if some 28,000 are nested.
ZENOH_BRACKETS = 15_000
#: Deepest key of a settings file; the time to read one grows with the square of it.
KEY_PARTS = 32
# A part ends with its line at the latest, and what holds no keys is passed over whole: a scan never goes back.
_PART = rb"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\[^\n])*+"?|'[^'\n]*+'?)"""
_DEEP_KEY = rb"(?P<deep>" + _PART + rb"(?:[ \t]*+\.[ \t]*+" + _PART + rb"){%d})" % KEY_PARTS
_NO_KEY = rb"""\#[^\n]*+|\"{3}(?:[^"\\]|\\.|"(?!""))*+(?:\"{3,5})?|'{3}(?:[^']|'(?!''))*+(?:'{3,5})?"""
_LEXEME = re.compile(_NO_KEY + rb"|" + _DEEP_KEY + rb"|" + _PART, re.DOTALL)
_PREFIX = re.compile(r"[A-Za-z0-9._-]+(/[A-Za-z0-9._-]+)*")


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """What `[receiver]` has for one axis and for several: the machine, and how it is reached.

    Parameters
    ----------
    machine, prefix : str
        As in the service's `machine.name` and `zenoh.prefix`.
    connect : tuple of str
        Addresses of router or service, such as `tcp/127.0.0.1:7447`. Either this or `zenoh_config`.
    zenoh_config : str
        A Zenoh configuration (JSON5) of mode `client`, with certificates for instance; relative to the file.
    check_clock : bool
        Compare every message's time with this computer's clock, if the clocks are synchronised. Answers to queries,
        and messages after an interruption of the loop, are always compared, because nothing else shows their age.
    clock_tolerance_s : float
        Largest time by which a message may be ahead of the wall clock, s.
    valid_max_s : float
        Longest time that one message may be used, s.
    state_file : str
        Keeps the last number over a restart, so that older messages are still dropped; relative to the file.
    applied_file : str
        Where `record` writes the offset that the control had, for probes; relative to the file.
    """

    machine: str
    prefix: str
    connect: tuple[str, ...] = ()
    zenoh_config: str = ""
    check_clock: bool = False
    clock_tolerance_s: float = 5.0
    valid_max_s: float = 600.0
    state_file: str = ""
    applied_file: str = ""

    def acceptance(self, *, step_max_s: float = 1.0) -> Acceptance:
        """Return the limits of age and clock.

        Parameters
        ----------
        step_max_s : float
            Longest time between two calls that counts for the movement, s.
        """
        return Acceptance(valid_max_s=self.valid_max_s, step_max_s=step_max_s, clock_tolerance_s=self.clock_tolerance_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings(Source):
    """`[receiver]` of one axis.

    Parameters
    ----------
    machine, prefix, connect, zenoh_config, check_clock, clock_tolerance_s, valid_max_s, state_file, applied_file
        See `Source`.
    offset_max_um : float
        Largest offset, µm.
    offset_rate_max_um_per_min : float
        Largest rate, µm/min; not below the service's, or the offset lags behind.
    """

    offset_max_um: float
    offset_rate_max_um_per_min: float

    def limits(self, *, step_max_s: float = 1.0) -> Limits:
        """Return the follower's limits.

        Parameters
        ----------
        step_max_s : float
            Longest time between two calls that counts for the movement, s.
        """
        return Limits(
            offset_max_um=self.offset_max_um,
            offset_rate_max_um_per_min=self.offset_rate_max_um_per_min,
            valid_max_s=self.valid_max_s,
            step_max_s=step_max_s,
            clock_tolerance_s=self.clock_tolerance_s,
        )


def load_settings(path: str | Path) -> tuple[Settings, dict[str, Any]]:
    """Read a TOML file with the table `[receiver]`.

    Returns
    -------
    (Settings, dict)
        The settings with paths made absolute, and the file's other tables.

    Raises
    ------
    ReceiverError
        One line that names file, key, value and what was expected.
    """
    path = Path(path)
    table, axes, others = receiver_tables(path)
    if axes:
        raise ReceiverError(f"{path}: axis.{next(iter(axes))}: this program applies one axis; several need load_any")
    return settings_from(table, source=str(path), folder=path.parent), others


def receiver_tables(path: Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]], dict[str, Any]]:
    """Read a TOML file with the table `[receiver]`.

    Returns
    -------
    (dict, dict of str to dict, dict)
        `[receiver]`; the tables such as `[axis.z]` by axis; the file's other tables, with the keys of `[axis]` itself.

    Raises
    ------
    ReceiverError
        If it cannot be read, or has no such table.
    """
    others = load_tables(path)
    table = others.pop("receiver", None)
    if not isinstance(table, dict):
        raise ReceiverError(f"{path}: receiver: missing, expected a table [receiver]")
    axis = others.get("axis")
    axes = {name: one for name, one in axis.items() if isinstance(one, dict)} if isinstance(axis, dict) else {}
    if axes:
        others["axis"] = {key: value for key, value in others["axis"].items() if key not in axes}
        if not others["axis"]:
            del others["axis"]
    return table, axes, others


def read_file(path: Path, most: int) -> bytes:
    """Return the bytes of a regular file.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    most : int
        Largest size, bytes.

    Raises
    ------
    OSError
        If it cannot be read, is a device, a pipe or a folder, or is larger.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # a pipe would wait for its writer
    except ValueError as error:
        raise OSError(errno.EINVAL, "no name of a file") from error
    with open(descriptor, "rb") as file:  # noqa: PTH123  a descriptor
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file")
        data = file.read(most + 1) or b""  # None: /proc/kmsg says it is a file, and would wait
    if len(data) > most:
        raise OSError(errno.EFBIG, f"larger than {most} bytes")
    return data


def write_file(path: Path, text: str, *, append: bool = False) -> None:
    """Write a regular file, made where there is none.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    text : str
        Its new content, or what is added to it.
    append : bool
        Whether to add; otherwise the content is replaced and synced to disk.

    Raises
    ------
    OSError
        If it cannot be written, or is a device, a pipe or a folder.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK  # a pipe would wait for its reader
    try:
        descriptor = os.open(path, flags | (os.O_APPEND if append else os.O_TRUNC), 0o666)
    except ValueError as error:
        raise OSError(errno.EINVAL, "no name of a file") from error
    with open(descriptor, "w", encoding="utf-8") as file:  # noqa: PTH123  a descriptor
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file")
        file.write(text)
        if not append:
            file.flush()
            os.fsync(descriptor)


def _absolute(path: Path) -> str:
    """Return an absolute path; one that leads nowhere is reported where it is opened."""
    try:
        return str(path.resolve())
    except (OSError, RuntimeError, ValueError):  # a loop of links; a name that is none
        return str(path.absolute())


def load_tables(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    ReceiverError
        If it cannot be read.
    """
    try:
        data = read_file(path, SETTINGS_MAX_BYTES)
        if any(lexeme["deep"] for lexeme in _LEXEME.finditer(data)):
            raise ReceiverError(f"{path}: a key of more than {KEY_PARTS} parts")
        return tomllib.loads(data.decode("utf-8-sig"))  # editors on Windows begin a file with a mark
    except OSError as error:
        raise ReceiverError(f"{path}: {error.strerror or error}; expected a settings file") from error
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, or an integer of thousands of digits
        raise ReceiverError(f"{path}: not a TOML file: {error}") from error


def settings_from(table: Mapping[str, Any], *, source: str, folder: Path | None = None) -> Settings:
    """Check the keys of `[receiver]`.

    Parameters
    ----------
    table : mapping
        Keys and values.
    source : str
        File, for messages.
    folder : pathlib.Path, optional
        Folder to which paths are relative; by default the working folder.

    Raises
    ------
    ReceiverError
        As `load_settings`.
    """
    settings = source_from(Settings, table, source=source, folder=folder)
    try:
        settings.limits()
    except ReceiverError as error:
        raise ReceiverError(f"{source}: receiver.{error}") from error
    return settings


def source_from(kind: type[S], table: Mapping[str, Any], *, source: str, folder: Path | None = None) -> S:
    """Read `[receiver]` and check what is the same for one axis and for several; paths become absolute.

    Raises
    ------
    ReceiverError
        As `load_settings`.
    """
    settings = read_table(kind, table, source=source, name="receiver")
    if not settings.machine:
        raise ReceiverError(f"{source}: receiver.machine = '': expected the service's machine.name")
    if not _PREFIX.fullmatch(settings.prefix):
        raise ReceiverError(f"{source}: receiver.prefix = {settings.prefix!r}: expected names separated by /")
    if bool(settings.connect) == bool(settings.zenoh_config):
        raise ReceiverError(
            f"{source}: receiver.connect = {list(settings.connect)}: expected addresses such as "
            f"'tcp/127.0.0.1:7447' here, or a file in receiver.zenoh_config, and not both"
        )
    folder = Path() if folder is None else folder
    absolute: dict[str, Any] = {
        key: _absolute(folder / getattr(settings, key)) if getattr(settings, key) else ""
        for key in ("zenoh_config", "state_file", "applied_file")
    }
    check_apart(absolute, source=source, name="receiver")
    return replace(settings, **absolute)


def check_apart(files: Mapping[str, str], *, source: str, name: str) -> None:
    """Refuse a file that two keys name, or that holds these settings: what is written would replace it.

    Parameters
    ----------
    files : mapping of str to str
        Absolute paths by key; an empty one is not given.
    source, name : str
        File with the settings, and table, for messages.

    Raises
    ------
    ReceiverError
        If there is one.
    """
    taken = {_absolute(Path(source)): "the file with these settings"}
    for key, file in files.items():
        there = taken.setdefault(file, f"{name}.{key}") if file else ""
        if there not in ("", f"{name}.{key}"):
            raise ReceiverError(f"{source}: {name}.{key} = {file!r}: is {there}, expected a file of its own")


def read_table(kind: type[T], table: Mapping[str, Any], *, source: str, name: str) -> T:
    """Make a settings object from a table; unknown keys, wrong types and missing keys are errors.

    Raises
    ------
    ReceiverError
        One line that names file, table, key, value and what was expected.
    """
    known = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
    for key in table:
        if key not in known:
            raise ReceiverError(f"{source}: {name}.{key}: unknown key, expected one of: {', '.join(known)}")
    values = {}
    for key, field in known.items():
        if key in table:
            values[key] = _value(table[key], str(field.type), f"{source}: {name}.{key}")
        elif field.default is MISSING:
            raise ReceiverError(f"{source}: {name}.{key}: missing, expected {_EXPECTED[str(field.type)]}")
    return kind(**values)


def require_sign(table: Mapping[str, Any], where: str, *, how: str) -> None:
    """Refuse a table of a bridge without the sign and who determined it.

    Parameters
    ----------
    table : mapping
        Keys and values.
    where : str
        File and table, for the message.
    how : str
        How the sign is determined.

    Raises
    ------
    ReceiverError
        If one of them is missing.
    """
    for key in ("sign", "sign_checked"):
        if key not in table:
            raise ReceiverError(
                f"{where}.{key}: missing; determine the sign on this machine {how}, and enter who determined it, when "
                'and how (sign = 1 or -1, sign_checked = "…")'
            )


_EXPECTED = {
    "str": "a text",
    "bool": "true or false",
    "int": "a whole number",
    "float": "a number",
    "tuple[str, ...]": "a list of texts",
}


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and "\0" not in value


def _value(value: Any, kind: str, where: str) -> Any:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind == "tuple[str, ...]" and isinstance(value, list) and all(map(_is_text, value)):
        return tuple(value)
    if kind == "float" and number and -_LARGEST < value < _LARGEST:
        return float(value)
    if (kind == "int" and number and isinstance(value, int)) or (kind == "bool" and isinstance(value, bool)):
        return value
    if kind == "str" and _is_text(value):
        return value
    raise ReceiverError(f"{where} = {repr(value)[:60]}: expected {_EXPECTED[kind]}")
