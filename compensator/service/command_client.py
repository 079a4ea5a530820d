"""Sends an operator's commands to a running service."""

from __future__ import annotations

import datetime
import getpass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import zenoh

from compensator.certificates import check_files, common_name_of
from compensator.config import Zenoh
from compensator.errors import ConfigError, ServiceError, UsageError
from compensator.events import CommandName
from compensator.messages import UNREADABLE, ProbeRequest, encode
from compensator.service.publisher import SENDER
from compensator.service.session import (
    ALIVE,
    alive_services,
    client_config,
    files_of,
    get,
    local_endpoints,
    read_config_file,
    services_text,
    set_key,
    try_once,
)

#: Longest reply to a command that is read, bytes.
LONGEST_REPLY = 1_000_000


class NotReached(ServiceError):
    """No service received the command."""


class Operator(NamedTuple):
    """Name and Zenoh configuration of an operator.

    `name` is the common name of the certificate, or without TLS the user name on this computer, which is not
    authenticated. It is empty if neither can be part of a key.
    """

    config: zenoh.Config
    name: str


def operator_of_file(path: Path) -> Operator:
    """Read an operator's Zenoh configuration.

    Raises
    ------
    ConfigError
        If the file, or a file named in it, cannot be used.
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
        raise ConfigError(
            f"{path}: transport/link/tls/enable_mtls: expected true, otherwise the certificate is not presented"
        )
    name = common_name_of(files.certificate)
    if not SENDER.fullmatch(name):
        raise ConfigError(f"{files.certificate}: common name {name!r}, expected letters, digits, . _ -")
    return Operator(config, name)


def operator_here(settings: Zenoh) -> Operator | None:
    """Return the operator for a service on this computer, from its configuration; None if it cannot be reached.

    Raises
    ------
    UsageError
        If an operator's certificate is needed: the machine's own must not send commands.
    """
    if settings.secured():
        raise UsageError(
            "--zenoh: missing; commands over TLS need an operator's certificate, expected a Zenoh "
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
        Settings of the service; it is reached at its listening endpoints, or through its routers.
    command : str
        Name of the command, such as `hold`.
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
        If nothing answers at the endpoints, or no service of that prefix is alive; the message names those that are.
    ServiceError
        If the service is alive but does not answer in time, or what answers is no service.
    """
    operator = operator or operator_here(settings)
    unreached = f"{settings.prefix}: the service cannot be reached"
    if operator is None:
        raise NotReached(f"{unreached}: [zenoh] has neither listen nor connect endpoints")
    where = ", ".join(get(operator.config, "connect/endpoints") or ())
    key = f"{settings.prefix}/thermal/command/{command}" + (f"/{operator.name}" if operator.name else "")
    try:
        with zenoh.open(operator.config) as session:
            for answer in session.get(key, payload=payload, timeout=timeout_s):
                if answer.ok is not None:
                    return _reply(key, answer.ok.payload)
            # An operator who may see only this machine must query only this machine.
            own = alive_services(session, timeout_s, f"{settings.prefix}/{ALIVE}")
            alive = {*own, *alive_services(session, timeout_s)}
    except (zenoh.ZError, ValueError) as error:
        raise NotReached(
            f"{unreached}: nothing answers at {where}; check that the service, or its router, is running"
        ) from error
    if settings.prefix in alive:
        raise ServiceError(
            f"{key}: the service is alive but has not answered within {timeout_s:g} s, so it is unknown whether the "
            "command acts: look at `compensator watch`; if it never answers, check that the router's access list "
            f"permits {operator.name or 'this command'}"
        )
    raise NotReached(f"{unreached}: no service with that prefix at {where}; {services_text(alive)}")


def _reply(key: str, payload: zenoh.ZBytes) -> dict[str, Any]:
    """Read the reply to a command, which anybody may have sent where no access list is enabled."""
    try:
        reply = msgspec.json.decode(payload.to_bytes() if len(payload) <= LONGEST_REPLY else b"", type=dict[str, Any])
    except UNREADABLE:
        reply = {}
    if not isinstance(reply.get("ok"), bool) or not isinstance(reply.get("text"), str):
        raise ServiceError(
            f"{key}: the answer is not that of a service, so it is unknown whether the command acts; find out which "
            f"program answers below this prefix"
        )
    return reply


def send_probe(
    settings: Zenoh, probe: ProbeRequest, *, timeout_s: float = 10.0, operator: Operator | None = None
) -> dict[str, Any]:
    """Send what a touch probe measured to the running service.

    The reply comes at once. It refuses what the service can refuse from what it has published; a probe that passes is
    compared with the prediction at the next sample, and an event and the recording contain the verdict.

    Parameters
    ----------
    settings : Zenoh
        Settings of the service, as in `ask`.
    probe : ProbeRequest
        The measured value.
    timeout_s : float
        How long to wait for the reply, s.
    operator : Operator, optional
        Sender; derived from the settings by default.

    Returns
    -------
    dict
        `ok`, `text`, and `code`, which is empty or why the probe is refused (`compensator explain` explains it).

    Raises
    ------
    NotReached, ServiceError
        As `ask`. After these errors the probe may be sent again: the service refuses a duplicate.
    """
    return ask(settings, CommandName.PROBE, encode(probe), timeout_s=timeout_s, operator=operator)
