"""Sends commands to a running service, for an operator's program."""

from __future__ import annotations

import datetime
import getpass
import json
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from compensator.certificates import check_files, common_name_of
from compensator.config import Zenoh
from compensator.errors import ConfigError, ServiceError, UsageError
from compensator.service.publisher import SENDER
from compensator.service.session import (
    ALIVE,
    alive_services,
    client_config,
    files_of,
    get,
    local_endpoints,
    read_config_file,
    set_key,
    try_once,
)


class NotReached(ServiceError):
    """No service received the command."""


class Operator(NamedTuple):
    """How an operator reaches services.

    `name` is the common name of the certificate; without TLS the user's name on this computer, which is no proof. It is
    empty if neither can be part of a key.
    """

    config: zenoh.Config
    name: str


def operator_of_file(path: Path) -> Operator:
    """Read an operator's Zenoh configuration.

    Raises
    ------
    ConfigError
        If it, or a file that it names, cannot be used.
    """
    config, tls = read_config_file(path)
    if get(config, "mode") not in (None, "client"):
        raise ConfigError(f"{path}: mode = {get(config, 'mode')!r}, expected client")
    if not get(config, "connect/endpoints"):
        raise ConfigError(f"{path}: connect/endpoints: missing, expected the router, such as tls/HOST:7447")
    set_key(config, "mode", "client")
    set_key(config, "scouting/multicast/enabled", False)
    try_once(config)
    if not tls:
        return Operator(config, _user())
    files = files_of(path, tls, "connect")
    certificate = check_files(str(path), files)
    wrong = certificate.wrong_at(datetime.datetime.now(datetime.UTC)) if certificate is not None else None
    if wrong is not None:  # the router would refuse it, which looks like a missing service
        raise ConfigError(f"{path}: {wrong}")
    if get(config, "transport/link/tls/enable_mtls") is not True:
        raise ConfigError(f"{path}: transport/link/tls/enable_mtls: expected true, or no certificate is shown")
    name = common_name_of(files.certificate)
    if not SENDER.fullmatch(name):
        raise ConfigError(f"{files.certificate}: common name {name!r}, expected letters, digits, . _ -")
    return Operator(config, name)


def operator_here(settings: Zenoh) -> Operator | None:
    """Return how the service of a configuration is reached from its own computer; None if it cannot be.

    Raises
    ------
    UsageError
        If that needs an operator's certificate: the machine's own may send no commands.
    """
    if settings.secured():
        raise UsageError(
            "--zenoh: missing; over TLS commands need an operator's certificate, expected a Zenoh "
            "configuration such as operator.json5"
        )
    endpoints = [*local_endpoints(settings), *settings.connect]
    return Operator(client_config(settings, endpoints), _user()) if endpoints else None


def _user() -> str:
    try:
        name = getpass.getuser()
    except (OSError, KeyError):
        return ""
    return name if SENDER.fullmatch(name) else ""


def ask(
    settings: Zenoh, command: str, payload: bytes, *, timeout_s: float, operator: Operator | None = None
) -> dict[str, Any]:
    """Send a command to the running service.

    Parameters
    ----------
    settings : Zenoh
        Settings of the service; it is reached where it listens, or through the routers that it connects to.
    command : str
        Such as `hold`.
    payload : bytes
        JSON.
    timeout_s : float
        How long to wait for the reply, s.
    operator : Operator, optional
        Sender; derived from the settings by default.

    Returns
    -------
    dict
        `ok` and `text`.

    Raises
    ------
    NotReached
        If nothing answers at the endpoints, or no service of that prefix is there; it names those that are.
    ServiceError
        If the service is alive but does not answer.
    """
    operator = operator or operator_here(settings)
    unreached = f"{settings.prefix}: the service is not reached"
    if operator is None:
        raise NotReached(f"{unreached}: zenoh has neither listen nor connect to find it at")
    where = ", ".join(get(operator.config, "connect/endpoints") or ())
    key = f"{settings.prefix}/thermal/command/{command}" + (f"/{operator.name}" if operator.name else "")
    try:
        with zenoh.open(operator.config) as session:
            for answer in session.get(key, payload=payload, timeout=timeout_s):
                if answer.ok is not None:
                    reply: dict[str, Any] = json.loads(answer.ok.payload.to_bytes())
                    return reply
            # An operator who may see this machine only must ask for it alone.
            own = alive_services(session, timeout_s, f"{settings.prefix}/{ALIVE}")
            alive = {*own, *alive_services(session, timeout_s)}
    except (zenoh.ZError, ValueError) as error:
        raise NotReached(f"{unreached}: nothing answers at {where}; does the service, or its router, run?") from error
    if settings.prefix in alive:
        raise ServiceError(
            f"{key}: the service is alive but does not answer: does the router's access list permit "
            f"{operator.name or 'this'}?"
        )
    there = f"alive there: {', '.join(sorted(alive))}" if alive else "none is alive there"
    raise NotReached(f"{unreached}: none of that prefix at {where}; {there}")
