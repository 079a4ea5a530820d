"""A job for processes of their own, which import nothing else for it."""

from __future__ import annotations

import os
import signal

from compensator.errors import ServiceError


def job(number: int, refused: bool = False) -> tuple[int, int]:
    """Return its number and its process, or refuse."""
    if refused:
        raise ServiceError(f"job {number} cannot be done")
    return number, os.getpid()


def ended_job() -> None:
    """End its process, as the system does where memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)
