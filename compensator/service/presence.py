"""Ensures that each machine has only one service: a second one, on this or another computer, is refused.

On the same computer it is detected by a lock on a file in the recording folder, which the kernel releases however the
service ends. On another computer it is detected by the liveliness token: before anything is published, a separate
client session queries `thermal/alive` (a router does not announce peers to each other). Services that start at the same
moment each declare a token first, and at most one continues. Services that start while no router is reached are not
detected.
"""

from __future__ import annotations

import fcntl
import logging
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import zenoh

from compensator.codes import Remark, ServiceWarning
from compensator.config import Zenoh
from compensator.errors import ServiceError
from compensator.service.session import ALIVE, client_config, tokens

log = logging.getLogger("compensator")

#: How long a start retries a lock that may be that of a command, s.
LOOKED_AT_S = 0.5
#: How long a start retries a router that refuses the connection, s.
REACHED_S = 1.0
#: How long the token of a killed service may remain (the lease and a margin), s.
STALE_S = 6.0
#: How long a starting service waits for others that are starting, s.
SHOWN_S = 0.4
#: Time limit of a query for tokens, s.
ANSWER_S = 2.0


@contextmanager
def sole_user(folder: Path, machine: str) -> Iterator[None]:
    """Lock the recording folder for one machine.

    Parameters
    ----------
    folder : pathlib.Path
        Created if it does not exist. If it cannot be locked the service continues: compensation must not depend on the
        disk.
    machine : str
        Name of the machine.

    Raises
    ------
    ServiceError
        If another service holds it.
    """
    path = folder / f"{machine}.lock"
    with ExitStack() as held:
        try:
            descriptor = _opened(path)
            held.callback(os.close, descriptor)
            _lock(descriptor)
        except BlockingIOError as error:
            raise ServiceError(
                f"{path}: locked by another service of {machine}, which continues; this one ends"
            ) from error
        except OSError as error:
            figures = f"{path}: cannot be locked, so a second service would not be detected here: {error}."
            log.warning("%s", Remark(ServiceWarning.NOT_LOCKED, figures).marked)
        yield


def _lock(descriptor: int) -> None:
    """Lock a file; a command that looks whether it is locked (`is_used`) holds it for an instant."""
    end = time.monotonic() + LOOKED_AT_S
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > end:
                raise
            time.sleep(LOOKED_AT_S / 50.0)


def is_used(folder: Path, machine: str) -> bool:
    """Return whether a service of a machine has locked its recording folder; nothing is changed."""
    try:
        descriptor = os.open(folder / f"{machine}.lock", os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)  # also releases the lock
    return False


def _opened(path: Path) -> int:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # the disk may have become read-only


@contextmanager
def sole_publisher(settings: Zenoh) -> Iterator[None]:
    """Ensure that no other service of this prefix is alive; the block declares the service's own token.

    If no router is reached, other services cannot be detected, and compensation starts nevertheless.

    Parameters
    ----------
    settings : Zenoh
        Settings of the service.

    Raises
    ------
    ServiceError
        If another service of this prefix is alive, or started at the same moment and has precedence.
    zenoh.ZError
        If a client reaches no router.
    """
    with ExitStack() as held:
        if settings.connect:
            try:
                session = held.enter_context(_reached(settings))
            except zenoh.ZError:
                if settings.mode == "client":  # it cannot publish either
                    raise
                figures = "zenoh: no router is reached, so a service on another computer would not be detected."
                log.warning("%s", Remark(ServiceWarning.OTHERS_UNKNOWN, figures).marked)
            else:
                held.callback(_claim(session, settings.prefix).undeclare)
        yield


def _reached(settings: Zenoh) -> zenoh.Session:
    """Open a session; retry if the router is overloaded by the start of a whole shop.

    If a client reaches no router, the publisher retries.
    """
    end = time.monotonic() + REACHED_S
    while True:
        try:
            return zenoh.open(client_config(settings, settings.connect))
        except zenoh.ZError:
            if settings.mode == "client" or time.monotonic() > end:
                raise
            time.sleep(REACHED_S / 5.0)


def _claim(session: zenoh.Session, prefix: str) -> zenoh.LivelinessToken:
    """Return the token of a starting service, if no other is alive or has precedence."""
    key = f"{prefix}/{ALIVE}"
    end = time.monotonic() + STALE_S
    while tokens(session, key, ANSWER_S):
        if time.monotonic() > end:
            raise ServiceError(f"{key}: another service is alive there and continues; this one ends")
        time.sleep(0.5)
    others = f"{prefix}/thermal/starting"
    own = f"{others}/{time.time_ns():020d}-{secrets.token_hex(8)}"
    candidate = session.liveliness().declare_token(own)
    time.sleep(SHOWN_S)
    first = min([own, *tokens(session, f"{others}/*", ANSWER_S)])
    if first != own or tokens(session, key, ANSWER_S):
        candidate.undeclare()  # type: ignore[no-untyped-call]
        raise ServiceError(f"{key}: another service started at the same moment and continues; this one ends")
    return candidate
