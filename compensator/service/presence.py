"""One service for one machine: a second one, started by mistake here or elsewhere, is refused and harms nothing.

On one computer a lock on a file in the folder of the recordings tells; the kernel lets go of it however the service
ends. Elsewhere the liveliness token tells. Two that start at the same moment show themselves by a token each before
they count as alive: one at most goes on. Two that begin while nobody is reached are not noticed.
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
from typing import Any

import msgspec
import zenoh

from compensator.config import Zenoh
from compensator.errors import ServiceError
from compensator.reasons import Remark
from compensator.service.session import put, session_config

log = logging.getLogger("compensator")

#: So long a router that refuses is asked again at the start, s.
REACHED_S = 1.0
#: So long the token of a service that is gone without a sign may stand (the lease, and some more), s.
STALE_S = 6.0
#: So long one that starts waits for others that do, s.
SHOWN_S = 0.4
#: So long a question for tokens may take, s.
ANSWER_S = 2.0


@contextmanager
def sole_user(folder: Path, machine: str) -> Iterator[None]:
    """Hold the folder of the recordings for one machine.

    Parameters
    ----------
    folder : pathlib.Path
        Made when it is not there. Where the disk does not take the lock the service goes on without it: compensation
        must not wait for a disk.
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
            raise ServiceError(f"{path}: held by another service of {machine}, which goes on; this one ends") from error
        except OSError as error:
            figures = f"{path}: cannot be locked, so a second service is not noticed here: {error}."
            log.warning("%s", Remark("not_locked", figures).marked)
        yield


def is_used(folder: Path, machine: str) -> bool:
    """Tell whether a service of a machine holds the folder of its recordings; changes nothing.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the recordings.
    machine : str
        Name of the machine.
    """
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
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC)  # on a disk that is read-only by now


@contextmanager
def sole_voice(settings: Zenoh) -> Iterator[None]:
    """See that no service of this prefix is alive; the block declares the own token.

    A session of its own asks, a client: a router does not tell peers of each other. Where it reaches nobody nothing is
    known of others, and compensation begins all the same.

    Parameters
    ----------
    settings : Zenoh
        Of the service.

    Raises
    ------
    ServiceError
        If another service of this prefix is alive, or starts at the same moment and was first.
    zenoh.ZError
        If a client reaches nobody.
    """
    with ExitStack() as held:
        if settings.connect:
            try:
                session = held.enter_context(_reached(settings))
            except zenoh.ZError:
                if settings.mode == "client":  # it can say nothing either
                    raise
                figures = "zenoh: nobody is reached, so whether another service is alive elsewhere is not known."
                log.warning("%s", Remark("others_unknown", figures).marked)
            else:
                held.callback(_claim(session, settings.prefix).undeclare)
        yield


def _reached(settings: Zenoh) -> Any:
    """Open a session; a router that a whole shop asks at once is asked again after a moment.

    A client without its router comes back here by itself.
    """
    end = time.monotonic() + REACHED_S
    while True:
        try:
            return zenoh.open(_asking(settings))
        except zenoh.ZError:
            if settings.mode == "client" or time.monotonic() > end:
                raise
            time.sleep(REACHED_S / 5.0)


def _asking(settings: Zenoh) -> zenoh.Config:
    config = session_config(msgspec.structs.replace(settings, mode="client", listen=[]))
    put(config, "connect/timeout_ms", 0)  # one attempt
    put(config, "connect/exit_on_failure", True)
    return config


def _claim(session: Any, prefix: str) -> Any:
    """Return the token of a service that starts, where none is alive and no other was first."""
    key = f"{prefix}/thermal/alive"
    end = time.monotonic() + STALE_S
    while _tokens(session, key):
        if time.monotonic() > end:
            raise ServiceError(f"{key}: another service is alive there and goes on; this one ends")
        time.sleep(0.5)
    others = f"{prefix}/thermal/starting"
    own = f"{others}/{time.time_ns():020d}-{secrets.token_hex(8)}"
    candidate = session.liveliness().declare_token(own)
    time.sleep(SHOWN_S)
    first = min([own, *_tokens(session, f"{others}/*")])
    if first != own or _tokens(session, key):
        candidate.undeclare()
        raise ServiceError(f"{key}: another service started at the same moment and goes on; this one ends")
    return candidate


def _tokens(session: Any, key: str) -> list[str]:
    replies = session.liveliness().get(key, timeout=ANSWER_S)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
