"""Zenoh sessions: they listen and connect only as configured, and do not scout."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import zenoh

from compensator.certificates import TlsFiles
from compensator.codes import Remark, ServiceWarning
from compensator.config import Zenoh
from compensator.errors import ConfigError
from compensator.input_file import SETTINGS_BYTES, read_file, resolved

log = logging.getLogger("compensator")

#: Number of connections that a router accepts at a time; as in the files of `deploy/zenoh/access_list.py`.
PENDING = 4000
#: How long a connection may be silent before it is authenticated, ms.
ACCEPT_TIMEOUT_MS = 3000
#: Most opening brackets in a configuration file of Zenoh: its parser ends the process if some 28,000 are nested.
BRACKETS = 15_000
#: Longest text of an error of Zenoh, characters.
LONGEST_ERROR = 400
#: Time between two attempts to open a session, s.
RETRY_S = 1.0
#: Liveliness token of a service, below its prefix.
ALIVE = "thermal/alive"


def set_key(config: zenoh.Config, key: str, value: object) -> None:
    """Set one key of a Zenoh configuration."""
    config.insert_json5(key, json.dumps(value))


def get(config: zenoh.Config, key: str) -> Any:
    """Return one key of a Zenoh configuration; None if it is missing or unset."""
    try:
        return json.loads(config.get_json(key))
    except (zenoh.ZError, KeyError, ValueError):
        return None


def error_text(error: zenoh.ZError) -> str:
    """Return the text of an error without the place in Zenoh's source; it may cite a whole line of a file."""
    text = re.sub(r"\s+", " ", re.sub(r" at /\S+\.rs:\d+\.", "", str(error))).strip()
    return text if len(text) <= LONGEST_ERROR else f"{text[: LONGEST_ERROR // 2]} … {text[-LONGEST_ERROR // 2 :]}"


def session_config(settings: Zenoh) -> zenoh.Config:
    """Make a Zenoh configuration that listens and connects only as configured."""
    config = zenoh.Config()
    set_key(config, "mode", settings.mode)
    set_key(config, "listen/endpoints", settings.listen)
    set_key(config, "connect/endpoints", settings.connect)
    set_key(config, "scouting/multicast/enabled", False)
    set_key(config, "scouting/gossip/enabled", False)
    # A router that returns is found within 1 s instead of the default 4 s.
    set_key(config, "connect/retry", {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5})
    # No shared memory between processes of one computer: other users could open it, and a killed process leaves its
    # files in /dev/shm.
    set_key(config, "transport/shared_memory/enabled", False)
    # The liveliness token of a dead service expires after this time, ms, if the network does not report the loss.
    set_key(config, "transport/link/tx/lease", 4000)
    if settings.listen:
        bound_silent(config)
    if settings.mode == "router":
        enlarge_queues(config)
    if settings.secured():
        # Zenoh presents its certificate only if `enable_mtls` is set on its side too.
        set_key(config, "transport/link/tls/enable_mtls", True)
        set_key(config, "transport/link/tls/verify_name_on_connect", True)
        set_key(config, "transport/link/tls/root_ca_certificate", settings.tls_ca)
        set_key(config, "transport/link/tls/connect_certificate", settings.tls_certificate)
        set_key(config, "transport/link/tls/connect_private_key", settings.tls_key)
        set_key(config, "transport/link/protocols", ["tls", "quic"])
    return config


def client_config(settings: Zenoh, endpoints: Sequence[str]) -> zenoh.Config:
    """Make the configuration of a client of a service that tries the endpoints once."""
    config = session_config(msgspec.structs.replace(settings, mode="client", listen=[], connect=list(endpoints)))
    try_once(config)
    return config


def try_once(config: zenoh.Config) -> None:
    """Let opening a session fail at once if nothing answers: a running service or router answers at once."""
    set_key(config, "connect/timeout_ms", 0)
    set_key(config, "connect/exit_on_failure", True)


def local_endpoints(settings: Zenoh) -> list[str]:
    """Return a service's listening endpoints, as reached from the same computer, without ports chosen by the system.

    Examples
    --------
    >>> local_endpoints(Zenoh(prefix="shop/vmc-07", listen=["tcp/0.0.0.0:7448", "tcp/127.0.0.1:0"]))
    ['tcp/127.0.0.1:7448']
    """
    listened = [re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", endpoint) for endpoint in settings.listen]
    return [endpoint for endpoint in listened if not endpoint.endswith(":0")]


def tokens(session: zenoh.Session, key: str, timeout_s: float) -> list[str]:
    """Return the keys of the liveliness tokens that match a key expression and are visible to the session."""
    replies = session.liveliness().get(key, timeout=timeout_s)
    return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})


def alive_services(session: zenoh.Session, timeout_s: float, key: str = f"**/{ALIVE}") -> list[str]:
    """Return the prefixes of the services that are alive: all, or those whose token matches `key`."""
    return [token.removesuffix(f"/{ALIVE}") for token in tokens(session, key, timeout_s)]


def services_text(alive: Collection[str]) -> str:
    """Return the prefixes of the services that are alive as text."""
    return f"services there: {', '.join(sorted(alive))}" if alive else "no service is running there"


def bound_silent(config: zenoh.Config) -> None:
    """Let a router, or a service that listens itself, bear connections that are silent before they authenticate.

    With Zenoh's own 100 places of 10 s, 200 of them keep a newcomer out for 10 s, and longer where they come again.
    After a power cut all services of a shop connect at once, with two sessions each.
    """
    pending = get(config, "transport/unicast/accept_pending") or 0
    timeout_ms = get(config, "transport/unicast/accept_timeout") or ACCEPT_TIMEOUT_MS
    set_key(config, "transport/unicast/accept_pending", max(pending, PENDING))
    set_key(config, "transport/unicast/accept_timeout", min(timeout_ms, ACCEPT_TIMEOUT_MS))


def enlarge_queues(config: zenoh.Config) -> None:
    """Enlarge a router's queues for a whole shop that publishes at the same instant.

    Services with synchronised clocks publish at the same time, and messages that do not fit into a client's queue are
    dropped. A queue has at most 16 packets of 64 KiB.
    """
    for priority in ("interactive_high", "data"):
        set_key(config, f"transport/link/tx/queue/size/{priority}", 16)


def tls_files(settings: Zenoh) -> TlsFiles | None:
    """Return the TLS files of the service; None without TLS."""
    if settings.tls_ca is None or settings.tls_certificate is None or settings.tls_key is None:
        return None
    return TlsFiles(Path(settings.tls_ca), Path(settings.tls_certificate), Path(settings.tls_key))


class ConfigFile(NamedTuple):
    """A Zenoh configuration file: its content, with absolute paths of the TLS files, and those paths by key."""

    config: zenoh.Config
    tls: dict[str, str]


_TLS = "transport/link/tls"
_FILES = (
    "root_ca_certificate",
    "listen_certificate",
    "listen_private_key",
    "connect_certificate",
    "connect_private_key",
)


def read_config_file(path: Path) -> ConfigFile:
    """Read a Zenoh configuration file (JSON5, JSON or YAML, as for zenohd).

    Paths in it are relative to the file.

    Raises
    ------
    ConfigError
        If the file cannot be used; the message names the file and the error.
    """
    try:
        data = read_file(path, SETTINGS_BYTES)  # of a device Zenoh would never come back
    except OSError as error:
        words = "no such file" if isinstance(error, FileNotFoundError) else error.strerror
        raise ConfigError(f"{path}: {words}, expected a Zenoh configuration") from error
    if data.count(b"[") + data.count(b"{") > BRACKETS:
        raise ConfigError(f"{path}: more than {BRACKETS} brackets, expected a Zenoh configuration")
    try:
        config = zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise ConfigError(f"{path}: {error_text(error)}") from error
    tls = {}
    for name in _FILES:
        value = get(config, f"{_TLS}/{name}")
        if value is not None:
            tls[name] = str(resolved(path.parent / value))
            set_key(config, f"{_TLS}/{name}", tls[name])
    return ConfigFile(config, tls)


def files_of(source: Path, tls: dict[str, str], side: str) -> TlsFiles:
    """Return the TLS files of one side, `connect` or `listen`, of a configuration file.

    Raises
    ------
    ConfigError
        If one is missing.
    """
    names = ("root_ca_certificate", f"{side}_certificate", f"{side}_private_key")
    for name in names:
        if name not in tls:
            raise ConfigError(f"{source}: {_TLS}/{name}: missing, expected a PEM file")
    ca, certificate, key = names
    return TlsFiles(
        Path(tls[ca]),
        Path(tls[certificate]),
        Path(tls[key]),
        (f"{_TLS}/{ca}", f"{_TLS}/{certificate}", f"{_TLS}/{key}"),
    )


def log_links(session: zenoh.Session, endpoints: Sequence[str]) -> None:
    """Log when a link is established or lost, and once if there is none yet.

    Without this, the service would appear to work while the router refuses its certificate.
    """

    def log_event(event: zenoh.TransportEvent) -> None:
        established = event.kind == zenoh.SampleKind.PUT
        kind = str(event.transport.whatami).rpartition(".")[2].lower()
        who = f"zenoh: {kind} {event.transport.zid}"
        if established or kind == "client":  # clients of the service may connect and disconnect at any time
            log.info("%s is %s", who, "connected" if established else "disconnected")
        else:
            log.warning("%s", Remark(ServiceWarning.LINK_LOST, f"{who} is disconnected; retrying.").marked)

    if endpoints and not session.info.transports():
        figures = f"zenoh: no connection to {', '.join(endpoints)} yet; retrying."
        log.warning("%s", Remark(ServiceWarning.ROUTER_NOT_REACHED, figures).marked)
    session.info.declare_transport_events_listener(log_event, history=True)
