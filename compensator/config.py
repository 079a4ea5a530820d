"""The configuration of the service: one TOML file, units in the keys, an unknown key is an error.

Physical limits have no default: they are set when the machine is commissioned.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec
from msgspec import Meta

from compensator.config_axes import Axes, check_axes, with_limits_of_y
from compensator.config_types import Kelvins, Micrometres, MicrometresPerMin, Minutes, Name, Rate, Text
from compensator.config_types import Table as _Table
from compensator.errors import ConfigError, UsageError
from compensator.input_file import SETTINGS_BYTES, parse_toml, read_file, resolved

#: Megabytes, or days, that are kept: a slip of the pen must not remove a whole history.
Amount = Annotated[float, Meta(ge=1, le=1e9)]

#: Roles that the model and the residual need; every other channel is auxiliary.
ROLES = ("t_q_degc", "at_degc", "y_um", "heat_w")

#: Limits of the rate of a temperature, K/min, and the temperatures that any part of a machine can have, °C.
_RATES, _DEGC_RANGE = (0.001, 10_000.0), (-273.15, 2000.0)
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
#: Largest magnitude of a value of a channel of any unit.
_VALUE_MAX = 1e12
_LOOPBACK = re.compile(r"unixsock-stream/|[a-z]+/(127\.[0-9.]+|localhost|\[::1\]):")
#: Transports on which participants authenticate by certificates.
SECURED = ("tls/", "quic/")
_TLS_KEYS = ("tls_ca", "tls_certificate", "tls_key")


class Machine(_Table, frozen=True, kw_only=True):
    """`[machine]`: the name in every message and file."""

    name: Name


class ModelChoice(_Table, frozen=True, kw_only=True):
    """`[model]`: a model file (relative to the configuration) or `quill`.

    `store`: folder of adopted models, relative to the configuration; by default `models` in the recording folder.
    """

    file: Text
    alternative: Text | None = None
    store: Text | None = None


class Sampling(_Table, frozen=True, kw_only=True):
    """`[sampling]`: how often devices are polled, and how many readings make a sample."""

    poll_interval_s: Annotated[float, Meta(ge=0.01, le=3600)] = 1.0
    min_good_fraction: Annotated[float, Meta(ge=0.001, le=1)] = 0.5

    def polls_of(self, period_s: float) -> int | None:
        """Return the number of polls in a sample of a length, s; None if it is not a whole one."""
        polls = period_s / self.poll_interval_s
        return round(polls) if polls >= 1.0 and abs(polls - round(polls)) <= 1e-9 else None


class Channel(_Table, frozen=True, kw_only=True):
    """`[[channel]]`: one measured quantity and its plausible values.

    The limits are optional for auxiliary channels and required for T_Q, AT and Y.
    """

    name: Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,62}\Z", examples=["t_q_degc", "coolant_degc"])]
    device: Text
    input: Annotated[int, Meta(ge=0, le=65535)]
    range: tuple[float, float] | None = None
    rate_max_per_min: Rate | None = None
    stuck_after_min: Minutes | None = None


class Guards(_Table, frozen=True, kw_only=True):
    """`[guards]`: plausibility between channels, and what a jump of T_Q or AT leads to.

    `suspect_jumps`: after a change beyond `rate_max_per_min` the channel is not used until its new value is confirmed;
    by default it is used again as soon as the permitted change, which grows with the time, includes its value.
    `jump_min_k`: a smaller jump, too, down to this one, makes T_Q suspect if the next samples show that it is no change
    of the heat, and AT unconfirmed if T_Q does not follow; a change below it is none. Needs `suspect_jumps`.
    """

    t_q_below_at_max_k: Kelvins
    suspect_jumps: bool = False
    jump_min_k: Kelvins | None = None


class Validity(_Table, frozen=True, kw_only=True):
    """`[limits.validity]`: ranges of the temperatures in the calibration, °C."""

    t_q_degc: tuple[float, float]
    at_degc: tuple[float, float]


class Limits(_Table, frozen=True, kw_only=True):
    """`[limits]`: limits of the offset; on a machine of several axes those of Y are in `[axis.y]`."""

    offset_max_um: Micrometres
    offset_rate_max_um_per_min: MicrometresPerMin
    validity: Validity


class Loss(_Table, frozen=True, kw_only=True):
    """`[loss]`: how long the model's own prediction replaces a lost temperature."""

    predict_for_min: Minutes


class Zero(_Table, frozen=True, kw_only=True):
    """`[zero]`: when and how the references are set.

    `rest_rate_um_per_min`: a machine that grows more slowly than this counts as at rest at the zero.
    """

    rest_rate_um_per_min: MicrometresPerMin
    at_start: bool = True


class Restart(_Table, frozen=True, kw_only=True):
    """`[restart]`: how a service continues after an interruption.

    `bridge_max_min`: longest interruption that is interpolated; by default the model's slowest time constant.
    """

    bridge_max_min: Minutes | None = None


class Rest(_Table, frozen=True, kw_only=True):
    """`[plausibility.rest]`: when the machine counts as at rest, and the largest change of T_Q − AT then.

    `channel`: such as `heat_w` or `spindle_rpm`; at or below `at_most` for `after_min`, the machine is at rest.
    `t_q_at_max_k`: largest change of T_Q − AT since the zero after such a rest.
    """

    channel: Text
    at_most: Annotated[float, Meta(ge=-1e12, le=1e12)]
    after_min: Minutes
    t_q_at_max_k: Kelvins


class Plausibility(_Table, frozen=True, kw_only=True):
    """`[plausibility]`: checks between T_Q, AT and measured Y; a check without its limit is off.

    `t_q_below_at_after_min`: T_Q below AT by more than `guards.t_q_below_at_max_k` for this long means
    exchanged sensors.
    `false_alarm_days`: mean time between two false alarms of the residual. `residual_std_um`: standard deviation of the
    residual of the healthy machine, by default the model's own; `residual_correlation_min`: its correlation time.
    `residual_hold_um`: during an alarm, a residual beyond this holds the offset. `sensor_must_fit`: a sensor is
    suspected only where its fault explains most of the residual, otherwise only the model is.
    """

    t_q_below_at_after_min: Minutes | None = None
    false_alarm_days: Annotated[float, Meta(ge=1, le=100_000)] | None = None
    residual_std_um: Micrometres | None = None
    residual_correlation_min: Annotated[float, Meta(ge=10, le=1440)] = 60.0
    residual_hold_um: Micrometres | None = None
    sensor_must_fit: bool = False
    rest: Rest | None = None


class Probe(_Table, frozen=True, kw_only=True):
    """`[probe]`: Y measured now and then by a touch probe; without this table no probe is used.

    `std_um`: standard deviation of one measured value, unless the probe states its own. `measured_max_um`: a measured
    value beyond this is impossible. `largest_um`: limit of the correction. `tolerance_um`: a probe is wanted once the
    standard deviation exceeds this; without it only the first one and the one after a refused one are.
    `oldest_min`: how late a probe may arrive. `match_um`: largest difference between the offset that the control had
    applied and the published one.
    """

    std_um: Annotated[float, Meta(ge=0.01, le=100)]
    measured_max_um: Micrometres
    largest_um: Micrometres
    tolerance_um: Micrometres | None = None
    oldest_min: Annotated[float, Meta(ge=1, le=240)] = 30.0
    match_um: Micrometres = 1.0


class LoopSettings(_Table, frozen=True, kw_only=True):
    """`[loop]`: the service looks for what its model lacks; without this table it does not.

    `policy`: `propose` asks a person before a better model is adopted, `adopt` adopts it. `at_utc`, `every_h`: a
    diagnosis is made at this time of the day, UTC, and then every so many hours; `misfit_h`: one is made at once
    after measured and predicted Y have diverged for so long, and again each time this has lasted twice as long.
    `record_h`: how much is diagnosed. `shadow_h`, `probes`, `deviations`: what a candidate must show beside the
    present model, on data after the diagnosis: hours of measured Y or the number of probes, and by how many
    standard deviations the present model is refuted (by half as many the candidate is the better one), by any of those
    that run at once.
    `watch_h`: how long the model before is compared after an adoption, and a candidate at most.
    `memory_mb`, `time_limit_min`: limits of a diagnosis.
    """

    policy: Literal["off", "propose", "adopt"] = "off"
    at_utc: Annotated[str, Meta(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]\Z", examples=["02:00", "14:30"])] = "02:00"
    every_h: Literal[4, 6, 8, 12, 24] = 6
    misfit_h: Annotated[float, Meta(ge=1, le=10_000)] = 3.0
    record_h: Annotated[float, Meta(ge=6, le=336)] = 36.0
    shadow_h: Annotated[float, Meta(ge=6, le=168)] = 6.0
    probes: Annotated[int, Meta(ge=8, le=100)] = 8
    deviations: Annotated[float, Meta(ge=3, le=20)] = 4.0
    watch_h: Annotated[float, Meta(ge=24, le=1000)] = 168.0
    memory_mb: Annotated[float, Meta(ge=256, le=1e6)] = 1500.0
    time_limit_min: Annotated[float, Meta(ge=1, le=720)] = 120.0

    @property
    def is_on(self) -> bool:
        """Whether the service looks for better models."""
        return self.policy != "off"

    @property
    def at_min(self) -> int:
        """Minute of the day of a planned diagnosis, UTC."""
        hours, minutes = self.at_utc.split(":")
        return 60 * int(hours) + int(minutes)


#: What zenoh opens by its form; whether the host or the folder is there, only the start of the service can tell.
_PORT = r"0*(6553[0-5]|655[0-2][0-9]|65[0-4][0-9]{2}|6[0-4][0-9]{3}|[1-5]?[0-9]{1,4})"
_ENDPOINT = (
    rf"^((tcp|tls|quic|udp|ws)/(\[[^\s\]?#]+\]|[^\s\[\]/?#]*[^\s\[\]/?#:]):{_PORT}|unixsock-stream/[^?#]+)"
    r"(\?[^?#]+)?(#[^?#]+)?\Z"
)
Endpoint = Annotated[
    str,
    Meta(
        pattern=_ENDPOINT, max_length=4096, examples=["tcp/127.0.0.1:7447", "tcp/[::1]:7447, with a port up to 65535"]
    ),
]


class Zenoh(_Table, frozen=True, kw_only=True):
    """`[zenoh]`: where the offset is published. The service listens only on endpoints that are given here.

    `tls_ca`, `tls_certificate`, `tls_key`: the authority of the router's certificate, the machine's own certificate and
    its key, PEM, relative to the configuration. With them the service connects to a router only, whose access list
    authenticates the senders of commands. `unproven_commands`: accept commands of senders that are not authenticated;
    by default only on loopback without TLS.
    """

    prefix: Annotated[
        str, Meta(pattern=r"^[A-Za-z0-9._-]+(/[A-Za-z0-9._-]+)*\Z", max_length=200, examples=["shop/vmc-07"])
    ]
    mode: Literal["peer", "client", "router"] = "peer"
    listen: Annotated[list[Endpoint], Meta(max_length=50)] = msgspec.field(default_factory=list)
    connect: Annotated[list[Endpoint], Meta(max_length=50)] = msgspec.field(default_factory=list)
    tls_ca: Text | None = None
    tls_certificate: Text | None = None
    tls_key: Text | None = None
    unproven_commands: bool | None = None

    def secured(self) -> bool:
        """Return whether both sides of every connection are authenticated."""
        return self.tls_key is not None

    def on_loopback(self) -> bool:
        """Return whether all endpoints are on this computer."""
        return all(self.is_loopback(endpoint) for endpoint in self.listen + self.connect)

    @staticmethod
    def is_loopback(endpoint: str) -> bool:
        """Return whether an endpoint is on this computer."""
        return _LOOPBACK.match(endpoint) is not None

    def accepts_unproven(self) -> bool:
        """Return whether commands are accepted whose sender is not authenticated."""
        if self.unproven_commands is not None:
            return self.unproven_commands
        return self.on_loopback() and not self.secured()


class Recording(_Table, frozen=True, kw_only=True):
    """`[recording]`: folder of the MCAP files, relative to the configuration.

    `keep_days`, `keep_mb`: finished files beyond that age, or beyond that size of all of them, are removed, the oldest
    first; by default everything is kept. `signing_key`: Ed25519 private key, PEM, that signs the seals; it must be
    outside the folder. `head`: file for the head of the chain, outside the folder, too; by default `MACHINE.head.json`
    beside the folder. It is kept if there is a key.
    """

    folder: Text
    keep_days: Amount | None = None
    keep_mb: Amount | None = None
    signing_key: Text | None = None
    head: Text | None = None


class Config(_Table, frozen=True, kw_only=True):
    """A complete configuration file; `limits` are those of Y, `axis` is None on a machine that has Y alone."""

    machine: Machine
    model: ModelChoice
    limits: Limits
    loss: Loss
    zero: Zero
    guards: Guards
    zenoh: Zenoh
    recording: Recording
    line: Annotated[list[dict[str, Any]], Meta(max_length=100)]
    device: Annotated[list[dict[str, Any]], Meta(max_length=200)]
    channel: Annotated[list[Channel], Meta(max_length=500)]
    sampling: Sampling = Sampling()
    restart: Restart = Restart()
    plausibility: Plausibility | None = None
    probe: Probe | None = None
    loop: LoopSettings | None = None
    axis: Axes | None = None


class LoadedConfig(msgspec.Struct, frozen=True, kw_only=True):
    """A configuration with its file.

    Parameters
    ----------
    config : Config
        The settings.
    path : pathlib.Path
        The file.
    data : bytes
        Its bytes, which are attached to every recording.
    """

    config: Config
    path: Path
    data: bytes

    def resolve(self, name: str) -> Path:
        """Return a path of the file relative to the file's folder.

        Raises
        ------
        ConfigError
            For a loop of links.
        """
        try:
            return resolved(self.path.parent / name)
        except UsageError as error:
            raise ConfigError(f"{self.path}: {error}") from error

    def store(self) -> Path:
        """Return the folder of adopted models."""
        store = self.config.model.store
        return self.resolve(store) if store is not None else self.resolve(self.config.recording.folder) / "models"

    def model_name(self) -> str | Path:
        """Return the model's name if it is built in, otherwise its path."""
        name = self.config.model.file
        return self.resolve(name) if name.endswith(".toml") or "/" in name else name


def zenoh_below(prefix: str) -> Zenoh:
    """Return the settings for the prefix that an option `--prefix` names.

    Raises
    ------
    UsageError
        If no machine can have it.
    """
    try:
        return msgspec.convert({"prefix": prefix}, Zenoh)
    except msgspec.ValidationError as error:
        words = "expected names between single slashes, such as shop/vmc-07, of 200 characters at most"
        raise UsageError(f"--prefix {prefix[:210]!r}: {words}") from error


def load_config(path: str | Path) -> LoadedConfig:
    """Read and check a configuration; nothing is opened.

    Raises
    ------
    ConfigError
        If the file is invalid; the message names file, table, key, value and what was expected.
    """
    path = Path(path)
    try:
        data = read_file(path, SETTINGS_BYTES)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}; expected a configuration file") from error
    config = parse_config(data, source=str(path))
    loaded = LoadedConfig(config=config, path=path, data=data)
    files = {key: getattr(config.zenoh, key) for key in _TLS_KEYS}
    files = {key: str(loaded.resolve(name)) for key, name in files.items() if name is not None}
    zenoh = msgspec.structs.replace(config.zenoh, **files)
    return msgspec.structs.replace(loaded, config=msgspec.structs.replace(config, zenoh=zenoh))


def parse_config(data: bytes, *, source: str) -> Config:
    """Parse the bytes of a configuration file.

    Raises
    ------
    ConfigError
        As `load_config`.
    """
    try:
        table = parse_toml(data)
    except ValueError as error:
        raise ConfigError(f"{source}: not a TOML file: {error}") from error
    if (place := _with_control(table)) is not None:
        raise ConfigError(f"{source}: {place}: has a control character, such as a line end, expected a text without")
    try:
        config = msgspec.convert(with_limits_of_y(table), Config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {_in_words(str(error), table)}") from error
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error
    try:
        _check(config)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error
    return config


def _with_control(value: Any, where: str = "") -> str | None:
    """Return place and value of a text with a control character, which no name should have."""
    if isinstance(value, str):
        return f"{where} = {value[:60]!r}" if _CONTROL.search(value) else None
    if not isinstance(value, (dict, list)):
        return None
    items = value.items() if isinstance(value, dict) else ((f"[{i}]", one) for i, one in enumerate(value))
    found = (_with_control(one, f"{where}.{key}".lstrip(".").replace(".[", "[")) for key, one in items)
    return next((place for place in found if place is not None), None)


def _type_at(where: str) -> Any:
    """Return the annotation of a table or a value, such as `limits` or `channel[1].name`."""
    found: Any = Config
    for part in re.findall(r"[^.\[\]]+", re.sub(r"\[\d+\]", "", where)):
        found = {field.encode_name: field.type for field in msgspec.structs.fields(_table_in(found))}[part]
    return found


def _table_in(annotation: Any) -> type[msgspec.Struct]:
    (table,) = (one for one in _types_in(annotation) if isinstance(one, type) and issubclass(one, msgspec.Struct))
    return table


def _keys_at(where: str) -> list[str]:
    """Return the keys of a table."""
    return [field.encode_name for field in msgspec.structs.fields(_table_in(_type_at(where)))]


def _expected_at(where: str, text: str) -> str:
    """Return what a value may be, in words; `text`, as it was refused, where nothing else is known."""
    try:
        types = _types_in(_type_at(where))
    except (KeyError, ValueError):  # a name that the user gave, such as a channel's
        return text
    if choices := [str(choice) for one in types if get_origin(one) is Literal for choice in get_args(one)]:
        return f"expected one of: {', '.join(choices)}"
    for meta in (one for one in types if isinstance(one, Meta)):
        if "regex" in text and meta.examples:
            return f"expected such as {' or '.join(meta.examples)}"
        sides = (("at least", meta.ge), ("more than", meta.gt), ("at most", meta.le), ("less than", meta.lt))
        bounds = [f"{words} {side:g}" for words, side in sides if side is not None]
        if bounds and re.fullmatch(r"Expected `(int|float)` [<>]=? \S+", text):
            return f"expected {' and '.join(bounds)}"
    return text


def _types_in(annotation: Any) -> list[Any]:
    """Return a type and those that it is made of."""
    parts = () if get_origin(annotation) is Literal else get_args(annotation)
    return [annotation, *(one for part in parts for one in _types_in(part))]


def _in_words(message: str, table: object) -> str:
    """Convert "…- at `$.limits.offset_max_um`" to "limits.offset_max_um = …: …"."""
    match = re.search(r" - at `\$\.?([^`]*)`$", message)
    where, text = (match.group(1), message[: match.start()]) if match is not None else ("", message)
    key = re.fullmatch(r"Object (missing required|contains unknown) field `([^`]*)`", text)
    if key is not None:
        what = f"{f'{where}.' if where else ''}{key[2]}"
        if key[1] == "missing required":
            return f"{what}: missing, expected a value (every key: deploy/CONFIGURATION.md)"
        return f"{what}: no such key, expected one of: {', '.join(_keys_at(where))}"
    if match is None:
        return message
    value = table
    for part in re.findall(r"[^.\[\]]+", where):
        try:
            value = value[int(part)] if isinstance(value, list) else value[part]  # type: ignore[index]
        except (KeyError, IndexError, ValueError, TypeError):
            value = None
            break
    shown = "" if value is None or isinstance(value, (dict, list)) else f" = {repr(value)[:60]}"
    return f"{where}{shown}: {_expected_at(where, text)}"


def _check(config: Config) -> None:
    names = [channel.name for channel in config.channel]
    for name, count in Counter(names).items():
        if count > 1:
            raise ConfigError(f"channel: name {name!r} occurs twice")
    for role in ("t_q_degc", "at_degc"):
        if role not in names:
            raise ConfigError(f"channel: no channel named {role!r}; the model needs it")
    devices = {str(device.get("name")) for device in config.device}
    for channel in config.channel:
        _check_channel(channel, devices)
    rest = config.plausibility.rest if config.plausibility is not None else None
    if rest is not None and rest.channel not in names:
        raise ConfigError(
            f"plausibility.rest.channel = {rest.channel!r}: no such channel, expected one of: {', '.join(names)}"
        )
    if config.guards.jump_min_k is not None and not config.guards.suspect_jumps:
        raise ConfigError(f"guards.jump_min_k = {config.guards.jump_min_k:g}: expected guards.suspect_jumps = true")
    probe, offset_max = config.probe, config.limits.offset_max_um
    if probe is not None and probe.largest_um > offset_max:
        raise ConfigError(f"probe.largest_um = {probe.largest_um:g}, expected at most offset_max_um = {offset_max:g}")
    if config.loop is not None and config.loop.is_on and probe is None and "y_um" not in names:
        raise ConfigError(
            f"loop.policy = {config.loop.policy!r}: nothing measures Y, expected a channel 'y_um' or the table [probe]"
        )
    if config.axis is not None:
        check_axes(config.axis, loop=config.loop is not None and config.loop.is_on)
    for key in ("t_q_degc", "at_degc"):
        _check_range(f"limits.validity.{key}", getattr(config.limits.validity, key), _DEGC_RANGE)
    _check_zenoh(config.zenoh)


def _check_zenoh(zenoh: Zenoh) -> None:
    given = [key for key in _TLS_KEYS if getattr(zenoh, key) is not None]
    for endpoint in zenoh.listen + zenoh.connect:
        if bool(given) != endpoint.startswith(SECURED) and endpoint in zenoh.connect:
            expected = "tls/HOST:PORT with tls_ca, tls_certificate and tls_key" if given else "with tls_ca, …"
            raise ConfigError(f"zenoh.connect: {endpoint!r}, expected {expected}")
        if endpoint.startswith(SECURED) and endpoint in zenoh.listen:
            raise ConfigError(
                f"zenoh.listen: {endpoint!r}, expected a router (`compensator router`): it has an "
                f"access list, the service has none"
            )
    if not given:
        return
    for key in _TLS_KEYS:
        if key not in given:
            raise ConfigError(f"zenoh.{key}: missing, expected with {given[0]}")
    if zenoh.listen or zenoh.mode == "router" or not zenoh.connect:
        raise ConfigError(
            "zenoh: with tls_key, expected only connect, without listen and mode router: a client "
            "of the service could otherwise use its certificate"
        )


def _check_channel(channel: Channel, devices: set[str]) -> None:
    where = f"channel {channel.name!r}"
    if channel.device not in devices:
        raise ConfigError(
            f"{where}: device {channel.device!r} is not configured, expected one of: {', '.join(sorted(devices))}"
        )
    if channel.name in ROLES[:3]:
        for key in ("range", "rate_max_per_min", "stuck_after_min"):
            if getattr(channel, key) is None:
                raise ConfigError(f"{where}: {key} is missing; a limit of {channel.name} has no default")
    is_temperature = channel.name in ROLES[:2]
    rate = channel.rate_max_per_min
    if is_temperature and rate is not None and not _RATES[0] <= rate <= _RATES[1]:
        raise ConfigError(f"{where}: rate_max_per_min = {rate:g}, expected from {_RATES[0]:g} to {_RATES[1]:g}")
    if channel.range is not None:
        possible = _DEGC_RANGE if is_temperature else (-_VALUE_MAX, _VALUE_MAX)
        _check_range(f"{where}: range", channel.range, possible)


def _check_range(where: str, bounds: tuple[float, float], possible: tuple[float, float]) -> None:
    if not all(possible[0] <= bound <= possible[1] for bound in bounds):
        expected = f"expected values from {possible[0]:g} to {possible[1]:g}"
        raise ConfigError(f"{where} = [{bounds[0]:g}, {bounds[1]:g}], {expected}")
    if not bounds[0] < bounds[1]:
        raise ConfigError(f"{where} = [{bounds[0]:g}, {bounds[1]:g}], expected the lower bound first")
