"""`compensator router`: run a Zenoh router in this process, until SIGTERM or SIGINT."""

from __future__ import annotations

import argparse
import asyncio
import datetime
import logging
from pathlib import Path
from typing import Any

import zenoh

from compensator.certificates import check_files, remarks
from compensator.codes import Remark, ServiceWarning
from compensator.commands import Answer, log_warnings
from compensator.commands.stopping import on_stop
from compensator.config import SECURED
from compensator.errors import ConfigError, ServiceError
from compensator.service.session import ConfigFile, bound_silent, error_text, files_of, get, read_config_file, set_key

log = logging.getLogger("compensator")


def run(arguments: argparse.Namespace) -> Answer | None:
    """Run the command."""
    path: Path = arguments.config
    config = checked(path, read_config_file(path))
    endpoints = get(config, "listen/endpoints")
    if arguments.check:
        secured = bool(get(config, "access_control/enabled"))
        text = f"{path}: valid. Listens on {', '.join(endpoints)}, access list {'on' if secured else 'off'}."
        return Answer({"ok": True, "listen": endpoints, "access_control": secured}, text + " Nothing was opened.")
    if arguments.log is not None:
        zenoh.init_log_from_env_or(arguments.log)
    asyncio.run(_serve(path, config, endpoints))
    log.info("compensator: router stopped")
    return None


def checked(path: Path, file: ConfigFile) -> zenoh.Config:
    """Refuse settings that Zenoh would silently ignore; check the TLS files.

    Raises
    ------
    ConfigError
        One line that names file and key.
    """
    config = file.config
    if get(config, "mode") not in (None, "router"):
        raise ConfigError(f"{path}: mode = {get(config, 'mode')!r}, expected router")
    set_key(config, "mode", "router")
    bound_silent(config)
    endpoints = get(config, "listen/endpoints")
    if not isinstance(endpoints, list) or not endpoints:
        raise ConfigError(f'{path}: listen/endpoints: missing, expected a list, such as ["tls/0.0.0.0:7447"]')
    if get(config, "plugins"):
        raise ConfigError(f"{path}: plugins: not supported by this router, expected none (zenohd supports them)")
    for name in ("multicast", "gossip"):  # on by default, which opens more than the listed endpoints
        if get(config, f"scouting/{name}/enabled") is None:
            set_key(config, f"scouting/{name}/enabled", False)
    _check_access(path, config, endpoints)
    if any(endpoint.startswith(SECURED) for endpoint in endpoints):
        now = datetime.datetime.now(datetime.UTC)
        certificate = check_files(str(path), files_of(path, file.tls, "listen"))
        wrong = certificate.wrong_at(now) if certificate is not None else None
        if wrong is not None:
            raise ConfigError(f"{path}: {wrong}")
        log_warnings(path, remarks(certificate, now))
    return config


def _check_access(path: Path, config: zenoh.Config, endpoints: list[str]) -> None:
    access: dict[str, Any] = get(config, "access_control") or {}
    enabled = access.get("enabled")
    if not enabled:
        if access.get("rules") or access.get("policies"):
            raise ConfigError(f"{path}: access_control/enabled: expected true, otherwise the rules have no effect")
        figures = "No access list: every client may publish messages and send commands for every machine."
        log_warnings(path, [Remark(ServiceWarning.NO_ACCESS_LIST, figures)])
        return
    if access.get("default_permission") != "deny":
        raise ConfigError(
            f"{path}: access_control/default_permission = {access.get('default_permission')!r}, expected "
            "deny; with another default, a missing rule would permit access"
        )
    named = any(subject.get("cert_common_names") for subject in access.get("subjects") or [])
    if not named:
        return
    if get(config, "transport/link/tls/enable_mtls") is not True:
        raise ConfigError(f"{path}: transport/link/tls/enable_mtls: expected true; the access list uses certificates")
    for endpoint in endpoints:
        if not endpoint.startswith(SECURED):
            raise ConfigError(
                f"{path}: listen/endpoints: {endpoint!r}, expected tls/HOST:PORT; the access list uses certificates"
            )


async def _serve(path: Path, config: zenoh.Config, endpoints: list[str]) -> None:
    ended = asyncio.Event()
    on_stop(ended.set)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise ServiceError(f"{path}: {error_text(error)}") from error
    with session:
        log.info("compensator: router listens on %s", ", ".join(endpoints))
        session.info.declare_link_events_listener(_LinkLog(), history=True)
        await ended.wait()


class _LinkLog:
    """Log connections and disconnections."""

    def __init__(self) -> None:
        self._open: set[tuple[str, str]] = set()

    def __call__(self, event: Any) -> None:
        """Log an event. Of a link that came while the listener was declared, Zenoh tells twice."""
        link = event.link
        connected = event.kind == zenoh.SampleKind.PUT
        key = (str(link.zid), str(link.dst))
        if connected == (key in self._open):
            return
        self._open ^= {key}
        who = link.auth_identifier or "a participant without a certificate"
        log.info("router: %s (%s, %s) %s", who, link.dst, link.zid, "connected" if connected else "disconnected")
