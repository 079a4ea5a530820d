"""The clock makes up for the past without going beyond now, then waits."""

from __future__ import annotations

import asyncio

import pytest

from compensator.clock import NS, VirtualClock
from compensator.demo.clock import LateClock

START_NS = 1_800_000_000 * NS


class Wall(VirtualClock):
    """A wall clock of the test's own, which notes for how long somebody waited."""

    def __init__(self) -> None:
        super().__init__(START_NS)
        self.waited: list[float] = []

    async def sleep(self, seconds: float) -> None:
        self.waited.append(seconds)
        await super().sleep(seconds)


def late(behind_s: float, wall: VirtualClock) -> tuple[LateClock, list[float], list[int]]:
    advanced: list[float] = []
    caught_up: list[int] = []

    async def advance(t_s: float) -> None:
        advanced.append(t_s)

    return LateClock(behind_s, advance, lambda: caught_up.append(len(advanced)), wall), advanced, caught_up


async def test_it_leaps_up_to_now_and_then_waits_for_what_is_left() -> None:
    wall = Wall()
    clock, advanced, caught_up = late(25.0, wall)
    assert clock.utc_ns() == START_NS - 25 * NS and clock.monotonic_ns() == 0 and clock.behind_s == 25.0
    for _ in range(2):
        await clock.sleep(10.0)
    assert advanced == [10.0, 20.0] and not wall.waited and not caught_up
    assert clock.utc_ns() == START_NS - 5 * NS and clock.behind_s == 5.0
    await clock.sleep(10.0)
    assert wall.waited == [5.0] and caught_up == [2] and advanced[-1] == 30.0
    assert clock.utc_ns() == wall.utc_ns() == START_NS + 5 * NS and clock.behind_s == 0.0
    await clock.sleep(10.0)
    assert wall.waited == [5.0, 10.0] and caught_up == [2] and clock.monotonic_ns() == 40 * NS


async def test_time_stands_still_while_work_is_done_in_the_past() -> None:
    wall = Wall()
    clock, _, _ = late(100.0, wall)
    await clock.sleep(10.0)
    await wall.sleep(7.0)  # the work took so long
    assert clock.utc_ns() == START_NS - 90 * NS and clock.monotonic_ns() == 10 * NS
    await clock.sleep(90.0)
    assert wall.waited == [7.0], "7 s more have passed, so that it is still behind"


async def test_once_on_time_it_goes_with_a_wall_clock_that_is_set() -> None:
    wall = Wall()
    clock, _, _ = late(0.0, wall)
    await clock.sleep(1.0)
    wall.set_wall_clock(3600.0)
    assert clock.utc_ns() == START_NS + 3601 * NS and clock.monotonic_ns() == NS


async def test_what_does_not_end_is_waited_for_in_the_past_only() -> None:
    clock, _, _ = late(10.0, Wall())
    never = asyncio.get_running_loop().create_future()
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(clock.settle([never], 0.0), 0.05)
    await clock.sleep(20.0)
    await clock.settle([never], 0.0)
    assert not never.done()
