"""Every device fault, alone and in pairs, for a sample and for an hour: what the receiver sees of it.

Through real lines, the drivers, the whole service and a Zenoh session; simulated machines run side by side.
"""

from __future__ import annotations

import asyncio
import itertools
from pathlib import Path

import pytest

from drivers.errors import DriverError
from drivers.reading import Quality
from sim_hardware.wire import Rack
from sim_hardware.wire.faults import DEVICE_FAULTS, INPUT_FAULTS
from tests.service.device_faults import EXPECTED, HOUR, SUPPORTED, Course, Seen, alone, pairs, run_course, without
from tests.service.shared_time import SharedTime, TimedRack
from tests.service.wired import Receiver

#: Machines that run at the same time: one waits for a silent device while others work.
SIDE_BY_SIDE = 12


def run_all(folder: Path, courses: list[Course]) -> list[Seen]:
    shared = SharedTime()
    with TimedRack(shared) as rack, Receiver() as receiver:
        return shared.run(_run_all(rack, receiver, folder, courses))


async def _run_all(rack: Rack, receiver: Receiver, folder: Path, courses: list[Course]) -> list[Seen]:
    free = asyncio.Semaphore(SIDE_BY_SIDE)

    async def one(i: int, course: Course) -> list[Seen]:
        async with free:
            return await run_course(rack, receiver, folder / str(i), f"machine-{i}", course)

    found = await asyncio.gather(*(one(i, c) for i, c in enumerate(courses)), return_exceptions=True)
    for result in found:
        if isinstance(result, BaseException):
            raise result
    every = [seen for result in found if not isinstance(result, BaseException) for seen in result]
    assert sum(seen.slow for seen in every) <= 0.1 * sum(seen.episode.samples for seen in every)
    return every


def test_every_kind_of_fault_has_a_row() -> None:
    """A kind that somebody adds to the simulated devices fails here until its row is written."""
    for carrier, kinds in SUPPORTED.items():
        assert set(EXPECTED[carrier]) == kinds, carrier
    assert set().union(*SUPPORTED.values()) == DEVICE_FAULTS | INPUT_FAULTS


def test_every_pair_of_kinds_is_placed() -> None:
    """All unordered pairs, but those of two kinds that only the one controller has."""
    placed = {tuple(sorted(kind for _, kind in e.places)) for course in pairs(1, 5) for e in course.episodes}
    every = set(itertools.combinations_with_replacement(sorted(DEVICE_FAULTS | INPUT_FAULTS), 2))
    only = sorted(SUPPORTED["capancdt"] - SUPPORTED["modbus-rtu"])
    assert every - placed == set(itertools.combinations_with_replacement(only, 2))


def test_alone_for_one_sample(tmp_path: Path) -> None:
    found = run_all(tmp_path, alone(1))
    shown = {code for seen in found for codes in seen.codes.values() for code in codes}
    drivers_know = {str(quality) for quality in Quality} | {error.code for error in DriverError.__subclasses__()}
    # A configuration that cannot be used is refused before anything runs.
    assert drivers_know - shown == {"device_config"}
    assert {seen.states[0] for seen in found} == {"ok", "degraded"}


def test_alone_for_an_hour(tmp_path: Path) -> None:
    """`make bench` runs every kind on every carrier."""
    found = run_all(tmp_path, alone(HOUR, every_carrier=False))
    assert {"ok", "degraded", "hold"} <= {state for seen in found for state in seen.states}
    lost = [seen for seen in found if "hold" in seen.states]
    assert all(seen.std_most_um > seen.std_before_um + 1.0 for seen in lost)


def test_pairs_for_one_sample(tmp_path: Path) -> None:
    run_all(tmp_path, pairs(1, seed=5))


@pytest.mark.parametrize("seed", [7])
def test_some_pairs_for_an_hour(tmp_path: Path, seed: int) -> None:
    """`make bench` runs all of them."""
    run_all(tmp_path, without(pairs(HOUR, seed), 3, seed))
