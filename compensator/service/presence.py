"""One service for each machine: a second one, started by mistake here or elsewhere, is refused.

On one computer a lock on a file among the recordings shows it; the kernel releases it however the service ends.
Elsewhere the liveliness token shows it: before anything is published, a client session of its own asks for
`thermal/alive` (a router does not announce peers to each other). Two that start at the same moment declare a token
each first: at most one continues. Two that start while no router is reached do not notice each other.
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

#: How long a router that refuses is retried at the start, s.
REACHED_S = 1.0
#: How long the token of a killed service may remain (the lease and a margin), s.
STALE_S = 6.0
#: How long a starting service waits for others that start, s.
SHOWN_S = 0.4
#: Time limit of a query for tokens, s.
ANSWER_S = 2.0


@contextmanager
def sole_user(folder: Path, machine: str) -> Iterator[None]:
    """Hold the folder of the recordings for one machine.

    Parameters
    ----------
    folder : pathlib.Path
        Created if it does not exist. If it cannot be locked the service continues: compensation must not depend on a
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
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ServiceError(
                f"{path}: held by another service of {machine}, which continues; this one ends"
            ) from error
        except OSError as error:
            figures = f"{path}: cannot be locked, so a second service is not noticed here: {error}."
            log.warning("%s", Remark(ServiceWarning.NOT_LOCKED, figures).marked)
        yield


def is_used(folder: Path, machine: str) -> bool:
    """Return whether a service of a machine holds the folder of its recordings; changes nothing."""
    try:
        descriptor = os.open(folder / f"{machine}.lock", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)  # and with it the lock
    return False


def _opened(path: Path) -> int:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC)  # the disk may have become read-only


@contextmanager
def sole_publisher(settings: Zenoh) -> Iterator[None]:
    """Ensure that no other service of this prefix is alive; the block declares the own token.

    If no router is reached nothing is known about others, and compensation starts all the same.

    Parameters
    ----------
    settings : Zenoh
        Settings of the service.

    Raises
    ------
    ServiceError
        If another service of this prefix is alive, or was first to start at the same moment.
    zenoh.ZError
        If a client reaches no router.
    """
    with ExitStack() as held:
        if settings.connect:
            try:
                session = held.enter_context(_reached(settings))
            except zenoh.ZError:
                if settings.mode == "client":  # it can publish nothing either
                    raise
                figures = "zenoh: no router is reached, so it is unknown whether another service runs elsewhere."
                log.warning("%s", Remark(ServiceWarning.OTHERS_UNKNOWN, figures).marked)
            else:
                held.callback(_claim(session, settings.prefix).undeclare)
        yield


def _reached(settings: Zenoh) -> zenoh.Session:
    """Open a session; retry a router that a whole shop asks at once.

    A client without its router is retried by the publisher.
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
    """Return the token of a starting service, if none is alive and no other was first."""
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
