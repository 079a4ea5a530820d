"""Lets the thread of the service run first while another one works."""

from __future__ import annotations

import time
from collections.abc import Callable

#: Number of samples of a warm-up after which the thread sleeps briefly, so that it never delays a sample.
SAMPLES_PER_TURN = 10
MOMENT_S = 0.001


def give_way() -> Callable[[], None]:
    """Return a function that lets the thread of the service run first, every few samples."""
    count = 0

    def pause() -> None:
        nonlocal count
        count += 1
        if count % SAMPLES_PER_TURN == 0:
            time.sleep(MOMENT_S)

    return pause
