"""Faults at length: every pair of device faults for an hour, drifts by size, and months of healthy machines.

No pass or fail by speed; what must not happen (a wrong value, a jump, a false alarm) is asserted all the same.
"""

import asyncio
import tempfile
from pathlib import Path

import numpy as np

from compensator.messages import number
from compensator.model.model_file import load_model
from compensator.service.compensation import Compensation
from sim_hardware.physics import Duty, PublishedQuill, QuillMachine, World, usual_sensors
from tests.bench.machines import calibrated
from tests.service.device_faults import HOUR, alone, pairs
from tests.service.records import sample
from tests.service.simulated import TABLE, config
from tests.service.test_device_faults import run_all

CHANNELS = [*TABLE["channel"][:3], {"name": "heat_w", "device": "module", "input": 4}]
#: Hours after the start of the day at which a drift begins.
BEGINS_H = (4, 7, 10, 13)
LIMITS = {"offset_max_um": 300.0, "offset_rate_max_um_per_min": 8.0,
          "validity": {"t_q_degc": [0.0, 90.0], "at_degc": [0.0, 60.0]}}  # fmt: skip


def recorded(plant, seed, days):
    duty = Duty.working_day(seed, hours=24.0 * days)
    return World(plant, duty, usual_sensors(duty.extra_names, heat_known=True), seed).record(60.0)


def settings(**more):
    table = {"t_q_below_at_after_min": 15.0, "false_alarm_days": 365.0,
             "rest": {"channel": "heat_w", "at_most": 1.0, "after_min": 100.0, "t_q_at_max_k": 3.0}}  # fmt: skip
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
    """Count what healthy machines raise."""
    raised, total = [], 0
    for seed in seeds:
        for i, outcome in run(Compensation(settings(**more), model), recorded(plant(), seed, days)):
            raised += [(seed, i, text) for kind, text in outcome.notes if kind == "plausibility"]
            total += 1
    print(f"healthy, {name}: {total / 1440:.0f} days, raised {len(raised)} times {raised[:3]}", flush=True)
    return raised


def drifts(name, plant, model, **more):
    """Print after how long a drift is raised, who is suspected, and the error by then."""
    print(
        f"drifts, {name}: raised after min (error of the offset then, µm); named: the right one, and it alone after 2 h"
    )
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
            print(f"  {channel:<9} {rate:>4} /h: {np.median(delays):4.0f} (most {max(delays)}), "
                  f"{np.median(errors):.1f} µm; {right} of {n}, alone {alone_right}; raised {n} of {2 * len(BEGINS_H)}",
                  flush=True)  # fmt: skip


def episodes(title, courses):
    with tempfile.TemporaryDirectory() as folder:
        found = asyncio.run(run_all(Path(folder), courses))
    far = [seen.distance_um for seen in found]
    held = sum("hold" in seen.states for seen in found)
    print(f"{title}: {len(found)} episodes, {held} held; distance to a run without the fault afterwards: median "
          f"{np.median(far):.2f}, 95 % {np.quantile(far, 0.95):.2f}, most {max(far):.2f} µm; largest stated std in a "
          f"fault {max(seen.std_most_um for seen in found):.0f} µm", flush=True)  # fmt: skip


def report():
    """Print everything."""
    print("\nfaults and plausibility")
    model, quill = calibrated()[0], load_model("quill")
    healthy("conduction machine, calibrated", QuillMachine, model, 30.0, (101, 102))
    healthy("published machine, residual_std_um = 0.3", PublishedQuill, quill, 30.0, (103,), residual_std_um=0.3)
    drifts("conduction machine, calibrated", QuillMachine, model)
    drifts("published machine, residual_std_um = 0.3", PublishedQuill, quill, residual_std_um=0.3)
    episodes("device faults alone, one sample", alone(1))
    episodes("device faults alone, an hour", alone(HOUR))
    episodes("pairs of device faults, one sample", pairs(1, 5))
    episodes("pairs of device faults, an hour", pairs(HOUR, 5))


if __name__ == "__main__":
    report()
