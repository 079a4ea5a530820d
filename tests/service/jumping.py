"""A compensation that watches for jumps, on a day of the published machine."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from compensator.messages import number
from compensator.service.compensation import Compensation, Outcome
from sim_hardware.physics import Duty, PublishedQuill, World, usual_sensors
from tests.service.records import QUILL, sample
from tests.service.simulated import TABLE, config

CHANNELS = TABLE["channel"][:3]
GUARDS = {"t_q_below_at_max_k": 2.0, "suspect_jumps": True, "jump_min_k": 1.0}
BEGIN, END = 300, 480
Change = Callable[[int, dict[str, float]], None]
Act = Callable[[int, Compensation], None]


def nothing(i: int, compensation: Compensation) -> None:
    """Nobody gives an order."""


@functools.cache
def working_day() -> dict[str, np.ndarray]:
    """The published machine, until all that the tests change has been undone for hours."""
    duty = Duty.working_day(3, hours=14.0)
    columns = World(PublishedQuill(), duty, usual_sensors(duty.extra_names), 3).record(60.0)
    return {name: values[: END + 220] for name, values in columns.items()}


def settings(checks: dict[str, float] | None = None, channel: Any = CHANNELS, **guards: Any) -> Any:
    limits = TABLE["limits"] | {
        "offset_rate_max_um_per_min": 20.0,
        "validity": {"t_q_degc": [0, 90], "at_degc": [0, 60]},
    }
    plausibility = {"t_q_below_at_after_min": 15.0, "residual_std_um": 0.3} | (checks or {})
    return config(channel=channel, guards=GUARDS | guards, limits=limits, plausibility=plausibility)


def readings(day: dict[str, np.ndarray], i: int) -> dict[str, float]:
    """What the channels read in a sample of a day."""
    return {channel["name"]: float(day[channel["name"]][i]) for channel in CHANNELS}


def run(
    day: dict[str, np.ndarray],
    change: Change = lambda i, v: None,
    act: Act = nothing,
    *,
    y: bool = False,
    model: Any = QUILL,
    channel: Any = CHANNELS,
    **guards: Any,
) -> list[Outcome]:
    compensation, outcomes = Compensation(settings(channel=channel, **guards), model), []
    for i in range(len(day["t_s"])):
        values = readings(day, i)
        change(i, values)
        if not y:
            values["y_um"] = math.nan
        act(i, compensation)
        outcomes.append(compensation.process(sample(i, values)))
    return outcomes


def offsets(outcomes: list[Outcome]) -> np.ndarray:
    return np.array([number(o.offset.y_offset_um) for o in outcomes])


def zero_at(sample_number: int) -> Act:
    """A zero on the warm machine at a sample."""
    return lambda i, compensation: compensation.zero("warm") if i == sample_number else None


@functools.cache
def undisturbed(zero: int | None = None, *, y: bool = False) -> np.ndarray:
    """Offsets of the working day on which nothing is wrong, with a zero at a sample: most tests compare with them."""
    found = offsets(run(working_day(), act=nothing if zero is None else zero_at(zero), y=y))
    found.flags.writeable = False
    return found


def biased(channel: str, size: float, begin: int = BEGIN, end: int = END) -> Change:
    def change(i: int, values: dict[str, float]) -> None:
        values[channel] += size if begin <= i < end else 0.0

    return change


def events(outcomes: list[Outcome], code: str) -> list[int]:
    return [i for i, o in enumerate(outcomes) for _, _, data in o.notes if data.get("code") == code]


def steps(*found: tuple[int, str, float]) -> Change:
    """Each channel keeps the last of its steps, K; NaN is missing."""

    def change(i: int, values: dict[str, float]) -> None:
        last = {name: size for begin, name, size in found if begin <= i}
        for name, size in last.items():
            values[name] += size

    return change


def is_wrong_in_ok(outcomes: list[Outcome], zero: int | None = None) -> bool:
    wrong = np.abs(offsets(outcomes) - undisturbed(zero)) > 5.0
    return any(wrong[i] and o.offset.state == "ok" for i, o in enumerate(outcomes))
