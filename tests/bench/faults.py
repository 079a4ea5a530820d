"""Faults at length: every pair of device faults for an hour, drifts by size, and months of healthy machines.

No pass or fail by speed; what must not happen (a wrong value, a jump, a false alarm) is asserted all the same.
"""

import tempfile
from pathlib import Path

import numpy as np

from compensator.messages import number
from compensator.model.model_file import load_model
from compensator.service.compensation import Compensation
from sim_hardware.physics import Duty, PublishedQuill, QuillMachine, World, usual_sensors
from tests.bench.figures import Figure, told
from tests.bench.machines import calibrated
from tests.service.device_faults import HOUR, alone, pairs
from tests.service.records import sample
from tests.service.simulated import TABLE, config
from tests.service.test_device_faults import run_all

CHANNELS = [*TABLE["channel"][:3], {"name": "heat_w", "device": "module", "input": 4}]
#: Hours after the start of the day at which a drift begins.
BEGINS_H = (4, 7, 10, 13)
LIMITS = {
    "offset_max_um": 300.0,
    "offset_rate_max_um_per_min": 8.0,
    "validity": {"t_q_degc": [0.0, 90.0], "at_degc": [0.0, 60.0]},
}


def recorded(plant, seed, days):
    duty = Duty.working_day(seed, hours=24.0 * days)
    return World(plant, duty, usual_sensors(duty.extra_names, heat_known=True), seed).record(60.0)


def settings(**more):
    table = {
        "t_q_below_at_after_min": 15.0,
        "false_alarm_days": 365.0,
        "rest": {"channel": "heat_w", "at_most": 1.0, "after_min": 100.0, "t_q_at_max_k": 3.0},
    }
    return config(channel=CHANNELS, limits=LIMITS, plausibility={**table, **more})


def run(compensation, rows, change=lambda i, values: None):
    """Yield outcomes of a recorded run."""
    names = [channel["name"] for channel in CHANNELS]
    columns = [rows[name].tolist() for name in names]
    for i, row in enumerate(zip(*columns, strict=True)):
        values = dict(zip(names, row, strict=True))
        change(i, values)
        yield i, compensation.process(sample(i, values))


def healthy(name, plant, model, days, seeds, **more):
    """Yield what healthy machines raise."""
    raised, total = [], 0
    for seed in seeds:
        for i, outcome in run(Compensation(settings(**more), model), recorded(plant(), seed, days)):
            raised += [(seed, i, text) for kind, text, _ in outcome.notes if kind == "plausibility"]
            total += 1
    found = f"raised {len(raised)} times in {total / 1440:.0f} days" + (f": {raised[:3]}" if raised else "")
    yield told(Figure(what=f"plausibility, healthy machine ({name})", found=found, wanted="never"))


def drifts(name, plant, model, **more):
    """Yield after how long a drift is raised, who is suspected, and the error by then."""
    for channel, rates in (("t_q_degc", (0.1, 0.5, 1.0, 2.0)), ("at_degc", (0.1, 0.5, 1.0, 2.0)), ("y_um", (1.0, 5.0))):
        for rate in rates:
            delays, errors, right, alone_right = [], [], 0, 0
            for seed in (1, 2):
                rows = recorded(plant(), seed, 1.0)
                for begin in (60 * hour for hour in BEGINS_H):

                    def drift(i, values, begin=begin, channel=channel, rate=rate):
                        values[channel] += rate * max(i - begin, 0) / 60.0

                    first, part = None, {key: column[: begin + 500] for key, column in rows.items()}
                    for i, outcome in run(Compensation(settings(**more), model), part, drift):
                        named = [r for r in outcome.offset.reasons if r.startswith("implausible:")]
                        if named and first is None and i > begin:
                            first = i
                            delays.append(i - begin)
                            errors.append(abs(number(outcome.estimate.residual_um)))
                            right += f"implausible:{channel}" in named
                        if first is not None and i == first + 120:
                            alone_right += named == [f"implausible:{channel}"]
            n = len(delays)
            unit = "µm" if channel == "y_um" else "K"
            yield told(
                Figure(
                    what=f"plausibility, {name}: {channel} drifts by {rate} {unit} an hour; raised after (most), "
                    "error by then; suspected, alone after 2 h",
                    found=f"{np.median(delays):.0f} ({max(delays)}) min, {np.median(errors):.1f} µm; {right} of {n}, "
                    f"alone {alone_right}; raised {n} of {2 * len(BEGINS_H)}",
                )
            )


def episodes(title, courses):
    with tempfile.TemporaryDirectory() as folder:
        found = run_all(Path(folder), courses)
    far = [seen.distance_um for seen in found]
    held = sum("hold" in seen.states for seen in found)
    yield told(
        Figure(
            what=f"{title}: distance to a run without the fault afterwards",
            found=f"median {np.median(far):.2f}, 95 % {np.quantile(far, 0.95):.2f}, most {max(far):.2f} µm "
            f"({len(found)} episodes, {held} held)",
            beside=f"largest stated standard deviation in the fault {max(seen.std_most_um for seen in found):.0f} µm",
        )
    )


def report():
    """Yield everything."""
    model, quill = calibrated()[0], load_model("quill")
    yield from healthy("conduction machine, calibrated", QuillMachine, model, 30.0, (101, 102))
    yield from healthy(
        "published machine, residual_std_um = 0.3", PublishedQuill, quill, 30.0, (103,), residual_std_um=0.3
    )
    yield from drifts("conduction machine, calibrated", QuillMachine, model)
    yield from drifts("published machine, residual_std_um = 0.3", PublishedQuill, quill, residual_std_um=0.3)
    yield from episodes("device faults alone, one sample", alone(1))
    yield from episodes("device faults alone, an hour", alone(HOUR))
    yield from episodes("pairs of device faults, one sample", pairs(1, 5))
    yield from episodes("pairs of device faults, an hour", pairs(HOUR, 5))


if __name__ == "__main__":
    list(report())
