"""Zenoh sessions: they listen and connect only as configured, and do not scout."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import zenoh

from compensator.certificates import TlsFiles
from compensator.codes import Remark, ServiceWarning
from compensator.config import Zenoh
from compensator.errors import ConfigError

log = logging.getLogger("compensator")

#: Participants that a router admits at one time.
PENDING = 1000
#: Time between two attempts to open a session, s.
RETRY_S = 1.0
#: Liveliness token of a service, below its prefix.
ALIVE = "thermal/alive"


def set_key(config: zenoh.Config, key: str, value: object) -> None:
    """Set one key of a Zenoh configuration."""
    config.insert_json5(key, json.dumps(value))


def get(config: zenoh.Config, key: str) -> Any:
    """Return one key of a Zenoh configuration, None if it is missing or unset."""
    try:
        return json.loads(config.get_json(key))
    except (zenoh.ZError, KeyError, ValueError):
        return None


def error_text(error: zenoh.ZError) -> str:
    """Return the text of an error without the place in Zenoh's source."""
    return re.sub(r"\s+", " ", re.sub(r" at /\S+\.rs:\d+\.", "", str(error))).strip()


def session_config(settings: Zenoh) -> zenoh.Config:
    """Make a Zenoh configuration that listens and connects only as configured."""
    config = zenoh.Config()
    set_key(config, "mode", settings.mode)
    set_key(config, "listen/endpoints", settings.listen)
    set_key(config, "connect/endpoints", settings.connect)
    set_key(config, "scouting/multicast/enabled", False)
    set_key(config, "scouting/gossip/enabled", False)
    # A router that comes back is found within a second, not within the default's four.
    set_key(config, "connect/retry", {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5})
    # Shared memory between processes of one computer: others there could open it, and a killed process leaves its
    # files behind in /dev/shm.
    set_key(config, "transport/shared_memory/enabled", False)
    # A dead service loses its liveliness token after this time, ms, if the network gives no sign.
    set_key(config, "transport/link/tx/lease", 4000)
    if settings.mode == "router":
        enlarge_queues(config)
    if settings.secured():
        # Zenoh shows its certificate only where `enable_mtls` is set on its side too.
        set_key(config, "transport/link/tls/enable_mtls", True)
        set_key(config, "transport/link/tls/verify_name_on_connect", True)
        set_key(config, "transport/link/tls/root_ca_certificate", settings.tls_ca)
        set_key(config, "transport/link/tls/connect_certificate", settings.tls_certificate)
        set_key(config, "transport/link/tls/connect_private_key", settings.tls_key)
        set_key(config, "transport/link/protocols", ["tls", "quic"])
    return config


def client_config(settings: Zenoh, endpoints: Sequence[str]) -> zenoh.Config:
    """Make the configuration of a client of a service, which tries the endpoints once."""
    config = session_config(msgspec.structs.replace(settings, mode="client", listen=[], connect=list(endpoints)))
    try_once(config)
    return config


def try_once(config: zenoh.Config) -> None:
    """Let opening a session fail at once where nothing answers: a running service or router answers at once."""
    set_key(config, "connect/timeout_ms", 0)
    set_key(config, "connect/exit_on_failure", True)


def local_endpoints(settings: Zenoh) -> list[str]:
    """Return where a service listens, as reached from its own computer; ports that the system chose are left out.

    Examples
    --------
    >>> local_endpoints(Zenoh(prefix="shop/vmc-07", listen=["tcp/0.0.0.0:7448", "tcp/127.0.0.1:0"]))
    ['tcp/127.0.0.1:7448']
    """
    listened = [re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", endpoint) for endpoint in settings.listen]
    return [endpoint for endpoint in listened if not endpoint.endswith(":0")]


def tokens(session: zenoh.Session, key: str, timeout_s: float) -> list[str]:
    """Return the keys of the liveliness tokens that a key expression matches, as far as the session may see them."""
    replies = session.liveliness().get(key, timeout=timeout_s)
    return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})


def alive_services(session: zenoh.Session, timeout_s: float, key: str = f"**/{ALIVE}") -> list[str]:
    """Return the prefixes of the services that are alive, of all of them or of those whose token is `key`."""
    return [token.removesuffix(f"/{ALIVE}") for token in tokens(session, key, timeout_s)]


def enlarge_queues(config: zenoh.Config) -> None:
    """Enlarge a router's queues for a whole shop that publishes at the same instant.

    Services whose clocks agree publish at the same time, and what does not fit into a client's queue is dropped. A
    queue has packets of 64 KiB, 16 at most. After a power cut all services connect at once, two sessions each; by
    default Zenoh admits a hundred at a time.
    """
    set_key(config, "transport/unicast/accept_pending", PENDING)
    for priority in ("interactive_high", "data"):
        set_key(config, f"transport/link/tx/queue/size/{priority}", 16)


def tls_files(settings: Zenoh) -> TlsFiles | None:
    """Return the TLS files of the service, None if it uses none."""
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
        One line that names the file and what is wrong.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: no such file, expected a Zenoh configuration")
    try:
        config = zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise ConfigError(f"{path}: {error_text(error)}") from error
    tls = {}
    for name in _FILES:
        value = get(config, f"{_TLS}/{name}")
        if value is not None:
            tls[name] = str((path.parent / value).resolve())
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

    Without this, a certificate that the router refuses looks like a running service.
    """

    def log_event(event: zenoh.TransportEvent) -> None:
        established = event.kind == zenoh.SampleKind.PUT
        kind = str(event.transport.whatami).rpartition(".")[2].lower()
        who = f"zenoh: {kind} {event.transport.zid}"
        if established or kind == "client":  # clients look at the service and leave as they like
            log.info("%s is %s", who, "connected" if established else "gone")
        else:
            log.warning("%s", Remark(ServiceWarning.LINK_LOST, f"{who} is gone; it is tried again.").marked)

    if endpoints and not session.info.transports():
        figures = f"zenoh: no connection to {', '.join(endpoints)} yet; it is tried again."
        log.warning("%s", Remark(ServiceWarning.ROUTER_NOT_REACHED, figures).marked)
    session.info.declare_transport_events_listener(log_event, history=True)
