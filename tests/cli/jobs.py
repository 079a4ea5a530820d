"""A job for processes of their own, which import nothing else for it."""

from __future__ import annotations

import os

from compensator.errors import ServiceError


def job(number: int, refused: bool = False) -> tuple[int, int]:
    """Return its number and its process, or refuse."""
    if refused:
        raise ServiceError(f"job {number} cannot be done")
    return number, os.getpid()
