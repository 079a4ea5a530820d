"""How often the diagnosis names an effect of two of three axes and a tilt, with its axes and no other.

A simulated machine with X, Y, Z and two probes at two heights, whose difference is the tilt, calibrated with known heat
on another day without the effect; 20 h of a working day with six further channels. An effect is drawn by a seed: its
kind, the two of X, Y, Z and the tilt that it moves, how far (1.5 to 6 µm standard deviation on one of them, 0.4 to 1.5
times as much on the other one, with any sign), and whether the record has little noise (0.15 µm, 0.01 K) or much
(0.5 µm, 0.04 K). It moves the upper probe of a tilt by that, the lower one by 0.4 of it. All five columns are diagnosed
together.

Right is an effect of the drawn kind, path and channel that is seen on both and on no third one; beside it stands how
often an effect of any kind is.

python -m tests.bench.axes_effects 84        so many cases; each is printed when it is done
python -m tests.bench.axes_effects 84 42     only those from this one
"""

import dataclasses
import sys
import time

import numpy as np
from scipy.signal import lfilter

import compensator as tc
from compensator.blas import in_one_thread
from sim_hardware.physics import Duty, MachineOfAxes, PublishedQuill, World
from sim_hardware.physics.axes import USUAL
from tests.bench.figures import Figure, rows, told

HOURS, CALIBRATION_H, CASES = 20.0, 36.0, 42
LOWER = 0.4
#: Columns of each of X, Y, Z and the tilt.
PROBES = {"x": {"x": 1.0}, "y": {"y": 1.0}, "z": {"z": 1.0}, "tilt": {"high": 1.0, "low": LOWER}}
PAIRS = (("x", "y"), ("y", "z"), ("x", "z"), ("z", "tilt"), ("y", "tilt"), ("x", "tilt"))
CHANNELS = ("coolant_degc", "coolant_flow_lpm", "spindle_rpm", "fan_rpm", "cabinet_degc", "hydraulic_bar")
ACTING = ("coolant_degc", "spindle_rpm", "fan_rpm", "cabinet_degc")
AXES = [name for columns in PROBES.values() for name in columns]
#: Noise of deformations, µm, and temperatures, K.
NOISE = {"clean": (0.15, 0.01), "noisy": (0.5, 0.04)}
#: Time constant with which each column follows the heat in most of its growth, min.
HEAT_TAU_MIN = {one.name.removesuffix("_um"): one.heat_tau_min for one in USUAL}


def lag(values, tau_min):
    """Exact first-order lag of values that are held for a minute."""
    keep = np.exp(-1.0 / tau_min)
    return lfilter([0.0, 1.0 - keep], [1.0, -keep], values - values[0])


def late(values, minutes):
    """The values so many minutes later."""
    return np.concatenate((np.full(minutes, values[0]), values[: values.size - minutes]))


def day(seed, hours=HOURS):
    """Minutes of a working day: true values of the machine."""
    duty = Duty.working_day(seed, hours=hours)
    world = World(MachineOfAxes(PublishedQuill()), duty, {}, seed)
    world.advance_to(duty.duration_s)
    past = world.history()
    minutes = int(hours * 60)
    true = {name: values[1 : 6 * minutes + 1].reshape(minutes, 6).mean(axis=1) for name, values in past.items()}
    heat = np.asarray(duty.columns["heat_w"])[: 6 * minutes].reshape(minutes, 6).mean(axis=1)
    return true | {"heat_w": heat}


def of_channel(rng, true):
    """A channel behind a lag."""
    channel = str(rng.choice(ACTING))
    return ("input", "", channel), lag(true[channel], rng.uniform(5.0, 90.0))


def of_late_channel(rng, true):
    """A channel behind a lag and a delay."""
    channel = str(rng.choice(ACTING))
    return ("input", "", channel), late(lag(true[channel], rng.uniform(5.0, 60.0)), int(rng.integers(5, 25)))


def missing_mode(rng, true):
    """Growth by the heat that the model does not have."""
    return ("dynamics", "DTF", ""), lag(true["heat_w"], rng.uniform(60.0, 150.0))


def gain(rng, true):
    """Another strength of the growth by the heat: of every column in its own course."""
    tau = {"y": 20.92, **HEAT_TAU_MIN}
    return ("gain", "DTF", ""), {name: lag(true["heat_w"], tau[name]) for name in AXES}


def unobserved(rng, true):
    """A source that no channel shows, on and off for hours."""
    switch = np.cumsum(rng.uniform(90.0, 240.0, 40))
    on = np.searchsorted(switch, np.arange(true["heat_w"].size)) % 2.0
    return ("unobserved", "", ""), lag(on, rng.uniform(10.0, 60.0))


def jump(rng, true):
    """A jump at a time, as of a collision."""
    count = true["heat_w"].size
    return ("step", "", ""), 1.0 * (np.arange(count) >= rng.uniform(0.25, 0.75) * count)


def cycle(rng, true):
    """A period that no channel shows."""
    return ("periodic", "", ""), np.sin(2.0 * np.pi * np.arange(true["heat_w"].size) / rng.uniform(20.0, 150.0))


KINDS = {
    "channel": of_channel,
    "late channel": of_late_channel,
    "missing mode of the heat": missing_mode,
    "wrong gain of the heat": gain,
    "unobserved source": unobserved,
    "step": jump,
    "periodic": cycle,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A drawn case: what must be named, on which of X, Y, Z and the tilt, and the table."""

    kind: str
    place: tuple
    moved: dict
    noise: str
    table: dict


def drawn(seed):
    """Draw a case."""
    rng = np.random.default_rng([seed, 1919])
    kind = list(KINDS)[seed % len(KINDS)]
    moved_axes = PAIRS[int(rng.integers(len(PAIRS)))]
    noise = ("clean", "noisy")[seed // len(KINDS) % 2]
    largest = rng.uniform(1.5, 6.0)
    sizes = largest * np.array([1.0, rng.uniform(0.4, 1.5)]) * rng.choice([-1.0, 1.0], 2)
    moved = dict(zip(moved_axes, sizes, strict=True))
    true = day(seed + 1)
    place, course = KINDS[kind](rng, true)
    courses = course if isinstance(course, dict) else dict.fromkeys(AXES, course)
    for element, columns in PROBES.items():
        for name, share in columns.items():
            true[f"{name}_um"] += share * moved.get(element, 0.0) * courses[name] / np.std(courses[name])
    return Case(kind=kind, place=place, moved=moved, noise=noise, table=measured(true, rng, *NOISE[noise]))


def measured(true, rng, noise_um, noise_k):
    """The table of a logger."""
    table = {"t_s": np.arange(true["heat_w"].size) * 60.0}
    for name in ("t_q_degc", "at_degc", *CHANNELS, *(f"{axis}_um" for axis in AXES)):
        deviation = noise_um if name.endswith("_um") else noise_k if name.endswith("_degc") else 0.0
        table[name] = true[name] + rng.normal(0.0, 1.0, true[name].size) * deviation
    return table


def calibrated():
    """The model of all columns, from a day without the effect and with known heat."""
    true = day(1000, CALIBRATION_H)
    table = measured(true, np.random.default_rng(1919), *NOISE["clean"])
    return tc.identify(table | {"heat_w": true["heat_w"]}, axis=AXES).model


def named(effect):
    """Return which of X, Y, Z and the tilt show an effect."""
    seen = {share.axis for share in effect.seen}
    return {element for element, columns in PROBES.items() if seen & set(columns)}


def one(models, seed):
    """Return the row of a case: right, right axes, right and nothing else named, what was named, seconds."""
    case = drawn(seed)
    began = time.perf_counter()
    found = tc.diagnose(models, case.table, axis=AXES)
    seconds = time.perf_counter() - began
    right = any(effect.place == case.place and named(effect) == set(case.moved) for effect in found.machine)
    axes = any(named(effect) == set(case.moved) for effect in found.machine)
    only = right and len(found.machine) == 1
    words = ", ".join(f"{' '.join(filter(None, e.place))} on {'+'.join(sorted(named(e)))}" for e in found.machine)
    moved = ", ".join(f"{axis} {size:+.1f}" for axis, size in case.moved.items())
    return [str(seed), case.kind, moved, case.noise, right, axes, only, words or "nothing", seconds]


def report(cases=CASES, first=0):
    """Yield the share that was named with its axes; every case is printed."""
    models, found = calibrated(), []
    for seed in range(first, cases):
        row = one(models, seed)
        found.append(row)
        sys.stdout.write("  ".join(str(cell) for cell in row[:-1]) + f"  {row[-1]:.1f} s\n")
        sys.stdout.flush()
    body = []
    for kind in KINDS:
        for noise in NOISE:
            of_it = [row for row in found if (row[1], row[3]) == (kind, noise)]
            if of_it:
                body.append([kind, noise, *(f"{sum(row[i] for row in of_it)} of {len(of_it)}" for i in (4, 5, 6))])
    rows("effects of two of X, Y, Z and a tilt", ["kind", "record", "right", "axes right", "right, nothing else"], body)
    right, axes, only = (sum(row[i] for row in found) for i in (4, 5, 6))
    yield told(
        Figure(
            what="effect of two of three axes and a tilt: named with these two and no third",
            found=f"{right} of {len(found)} ({100.0 * right / len(found):.0f} %), "
            f"{np.median([row[-1] for row in found]):.0f} s a case",
            wanted="95 %",
            beside=f"by any kind {axes}, nothing else named {only}",
        )
    )


if __name__ == "__main__":
    in_one_thread(lambda: list(report(*map(int, sys.argv[1:]))))
