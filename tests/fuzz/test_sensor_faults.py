"""Drawn faults of thermocouples: whatever they do, the offset never jumps, and a jump is not believed.

`python -m tests.soak --kills 0 --days 0 --faults 500 --seed 2000` goes on with other seeds; a failure names its own.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from compensator.messages import number
from compensator.service.compensation import Compensation
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.fuzz.sensor_faults import JUMPS, draw
from tests.service.records import QUILL, sample
from tests.service.simulated import TABLE, config

STEP_UM = 8.0
CHANNELS = TABLE["channel"][:3]


def working_day() -> dict[str, np.ndarray]:
    duty = Duty.working_day(2, hours=18.0)
    return World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 2).record(60.0)


@pytest.fixture(scope="module")
def day() -> dict[str, np.ndarray]:
    return working_day()


def run(day: dict[str, np.ndarray], change: object = None) -> tuple[np.ndarray, np.ndarray]:
    limits = TABLE["limits"] | {"validity": {"t_q_degc": [0.0, 90.0], "at_degc": [0.0, 60.0]}}
    guards = {"t_q_below_at_max_k": 2.0, "suspect_jumps": True, "jump_min_k": 1.0}
    compensation = Compensation(config(channel=CHANNELS, guards=guards, limits=limits), QUILL)
    offsets, states = [], []
    for i in range(len(day["t_s"])):
        values = {channel["name"]: float(day[channel["name"]][i]) for channel in CHANNELS} | {"y_um": math.nan}
        if callable(change):
            change(i, values)
        outcome = compensation.process(sample(i, values))
        offsets.append(number(outcome.offset.y_offset_um))
        states.append(str(outcome.offset.state))
    return np.array(offsets), np.array(states)


@pytest.fixture(scope="module")
def healthy(day: dict[str, np.ndarray]) -> np.ndarray:
    return run(day)[0]


def missed(day: dict[str, np.ndarray], healthy: np.ndarray, seed: int) -> str:
    """What a drawn fault does that it must not; empty if nothing."""
    fault = draw(seed, samples=len(healthy))
    offsets, states = run(day, fault.change())
    if not np.all(np.isfinite(offsets)) or np.max(np.abs(np.diff(offsets))) > STEP_UM + 1e-9:
        return f"a jump of the offset: {fault}"
    wrong = np.abs(offsets - healthy) > 5.0
    if np.any(wrong[: fault.begin]):
        return f"wrong before the fault: {fault}"
    believed = int(np.sum(wrong & (states == "ok")))
    if fault.kind in JUMPS and believed > 0.02 * (fault.end - fault.begin + 120):
        return f"believed for {believed} samples: {fault}"
    return ""


@pytest.mark.parametrize("seed", range(1, 13))
def test_a_drawn_fault(day: dict[str, np.ndarray], healthy: np.ndarray, seed: int) -> None:
    assert missed(day, healthy, seed) == ""
