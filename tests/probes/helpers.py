"""A sink that answers as a test says, and a machine whose probe obeys geometry alone."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

from compensator.probes.probe import NotSent, Probe, Reply


class Sink:
    """Keeps what it is sent; refuses what it had before, as a service does."""

    def __init__(self) -> None:
        self.probes: list[Probe] = []
        self.reachable = True
        self.attempts = 0

    def send(self, probe: Probe) -> Reply:
        self.attempts += 1
        if not self.reachable:
            raise NotSent("shop/vmc-07: the service cannot be reached")
        if probe in self.probes:
            return Reply(False, "known", "duplicate")
        self.probes.append(probe)
        return Reply(True, "probe: acts at the next sample")


def touch_um(*, y_um: float, offset_um: float, includes_offset: bool = False) -> float:
    """Where a control finds a fixed feature at 0 with a probe in the spindle, by geometry, µm.

    The slide is at `slide`, the tip at slide + y. It touches where the tip is at 0. The control commands slide −
    offset, and displays either.
    """
    slide = -y_um
    return slide if includes_offset else slide - offset_um


async def until(condition: Callable[[], Any], what: str | Callable[[], str], timeout_s: float = 120.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"not within {timeout_s} s: {what if isinstance(what, str) else what()}"
        await asyncio.sleep(0.005)
