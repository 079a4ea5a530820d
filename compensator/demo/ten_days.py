"""Ten simulated days, unattended: effects that begin and end are found, compared, adopted and dropped by the loop.

One machine has a displacement sensor, the other one a touch probe each hour. The same service and loop as in operation,
without devices, so that ten days take minutes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from compensator.api.loop_diagnosis import diagnosis_in_process
from compensator.api.shop import LOOP_EVENTS
from compensator.arrays import Vector
from compensator.clock import NS
from compensator.commands.progress_bar import progress_bar
from compensator.commands.workers import in_parallel
from compensator.config import Channel, Config, LoopSettings, Plausibility, parse_config
from compensator.demo.calibration import PERIOD_S, calibrate
from compensator.demo.day import START_NS
from compensator.demo.machine import PROBE_RANGE_UM, TOUCH_STD_UM, configuration
from compensator.demo.offline import probe_of, run_alone, sample_of
from compensator.messages import SCHEMA, Event, Sample, number
from compensator.model.model_file import parse_model
from compensator.report.ten_days import DAYS, MachineDays, Times
from compensator.service.loop.run import OfflineLoop
from compensator.service.outcome import Outcome
from sim_hardware.physics import Duty, QuillMachine, World, usual_sensors
from sim_hardware.physics.effects import BearingFriction, FanMotor
from sim_hardware.physics.effects.during import During

HOUR_S = 3600.0
#: Rest at the start of the first day, s.
REST_S = 1800.0
#: Hours since the start, at 06:00 of the first day.
TIMES = Times(first_begins_h=50.0, second_begins_h=122.0, break_h=174.0, repaired_h=175.0, first_ends_h=194.0)
FIRST = BearingFriction(full_speed_w=6.0)
SECOND = FanMotor(full_speed_w=30.0, place="rear")
#: A probe in minutes, and the seed of its noise beside that of the demo.
PROBE_EVERY_MIN, PROBE_SEED = 60, 16
LOOP = LoopSettings(policy="adopt", every_h=24, misfit_h=3.0, record_h=24.0, shadow_h=6.0)
#: The same with a probe each hour: a day of them names nothing.
PROBED_LOOP = msgspec.structs.replace(LOOP, every_h=12, record_h=48.0)
#: Measured and predicted Y that diverge begin a diagnosis, too.
CHECKS = Plausibility(false_alarm_days=30.0)
#: Lines of the simulated devices, which are not opened here.
_LINES = {"rtu": "/dev/null", "tcp": 502, "plc": 503, "dcon": "/dev/null", "data": 10001, "command": 23}


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """What a machine's sensors read over the days, one row a minute, and the truth."""

    columns: dict[str, Vector]
    true_um: Vector


def ten_days(out: Path, *, seed: int) -> list[MachineDays]:
    """Run ten days of both machines, on two cores where there are.

    Parameters
    ----------
    out : pathlib.Path
        Folder for the calibration of each machine.
    seed : int
        Seed of duties, sensors and probes.
    """
    jobs = [partial(machine_days, out, name, seed=seed) for name in ("sensor", "probes")]
    with progress_bar("ten days of two machines") as progress:
        return in_parallel(jobs, progress)


def machine_days(out: Path, name: str, *, seed: int) -> MachineDays:
    """Run ten days of a machine: `sensor` has a displacement sensor, `probes` a touch probe each hour."""
    is_probed = name == "probes"
    seed += 100 * is_probed
    folder = out / name
    calibrate(folder, machine="conduction", seed=seed)
    file = (folder / "calibration" / "model.toml").read_bytes()
    record = _record(seed)
    config = _config(name, is_probed=is_probed)
    samples = _samples(name, config, record, is_probed=is_probed, seed=seed)
    outcomes, events = _looped(OfflineLoop(config, file, diagnosis_in_process(config)), samples)
    first = run_alone(config, parse_model(file, source="calibration"), samples)
    return MachineDays(
        name=name,
        is_probed=is_probed,
        times=TIMES,
        start_ns=START_NS,
        t_h=np.array([(one.sample.time_utc_ns - START_NS) / (HOUR_S * NS) for one in outcomes]),
        first_um=_error(first, record.true_um),
        loop_um=_error(outcomes, record.true_um),
        model_sha256=[one.offset.model_sha256 for one in outcomes],
        events=events,
    )


def _record(seed: int) -> Record:
    """Return what a machine reads; its first effect acts for six days, its second one to the end."""
    at = {name: HOUR_S * hours for name, hours in asdict(TIMES).items()}
    effects = [
        During(effect=FIRST, from_s=at["first_begins_h"], to_s=at["first_ends_h"]),
        During(effect=SECOND, from_s=at["second_begins_h"]),
    ]
    duty = _duty(seed)
    world = World(QuillMachine(effects=effects), duty, usual_sensors(duty.extra_names), seed)
    columns = world.record(PERIOD_S)
    del columns["t_s"]
    past = world.history()
    n = columns["y_um"].size
    true_um = past["y_um"][1:][: 6 * n].reshape(n, 6).mean(axis=1)
    broken = slice(round(60.0 * TIMES.break_h), round(60.0 * TIMES.repaired_h))
    columns["t_q_degc"][broken] = math.nan
    columns["y_um"] = columns["y_um"] + PROBE_RANGE_UM / 2
    return Record(columns=columns, true_um=np.asarray(true_um))


def _duty(seed: int) -> Duty:
    """Return ten days of work; the fan stands still too while the machine is at rest at the start."""
    drawn = Duty.working_day(seed, hours=24.0 * DAYS)
    columns = dict(drawn.columns)
    columns["fan_rpm"] = np.where(np.arange(columns["fan_rpm"].size) < REST_S / 10.0, 0.0, columns["fan_rpm"])
    return Duty(drawn.duration_s, **columns)


def _config(name: str, *, is_probed: bool) -> Config:
    text = configuration(f"sim-{name}", _LINES, 7447, is_probed=is_probed)
    config = parse_config(text.encode(), source="demo")
    fan = Channel(name="fan_rpm", device="control", input=0)
    return msgspec.structs.replace(
        config, loop=PROBED_LOOP if is_probed else LOOP, plausibility=CHECKS, channel=[*config.channel, fan]
    )


def _samples(
    name: str, config: Config, record: Record, *, is_probed: bool, seed: int
) -> list[tuple[Sample, float, bool]]:
    """Return each sample with what a probe before it shows, µm; NaN without one."""
    names = [channel.name for channel in config.channel]
    table = np.column_stack([record.columns[channel] for channel in names])
    shown = np.full(len(table), math.nan)
    if is_probed:
        at = np.arange(PROBE_EVERY_MIN, len(table), PROBE_EVERY_MIN)
        noise = np.random.default_rng([PROBE_SEED, seed]).normal(0.0, TOUCH_STD_UM, at.size)
        # In the middle of the minute that the next sample is the mean of.
        shown[at] = record.true_um[at] - record.true_um[0] + noise
    return [
        (
            sample_of(
                f"sim-{name}",
                i,
                START_NS + round((i + 1) * PERIOD_S) * NS,
                dict(zip(names, values, strict=True)),
                period_s=PERIOD_S,
            ),
            float(shown[i]),
            False,
        )
        for i, values in enumerate(table)
    ]


def _looped(run: OfflineLoop, samples: Sequence[tuple[Sample, float, bool]]) -> tuple[list[Outcome], list[Event]]:
    """Return the outcome of each sample, and the events of the loop."""
    outcomes, events = list[Outcome](), list[Event]()
    for sample, shown_um, _ in samples:
        probe = None
        if math.isfinite(shown_um):
            before = outcomes[-1].offset if outcomes else None
            probe = probe_of(shown_um, before, sample.time_utc_ns - round(sample.period_s * NS / 2))
        step = run.process(sample, [probe] if probe is not None else [])
        outcomes.append(step.outcome)
        events += [
            Event(
                schema=SCHEMA,
                machine=sample.machine,
                seq=sample.seq,
                time_utc_ns=sample.time_utc_ns,
                kind=note.kind,
                text=note.text,
                data=dict(note.data),
            )
            for note in step.events
            if note.kind in LOOP_EVENTS
        ]
    return outcomes, events


def _error(outcomes: Sequence[Outcome], true_um: Vector) -> Vector:
    """Return the error at the part with the offset applied, µm."""
    offset = np.array([number(one.offset.y_offset_um) for one in outcomes])
    return np.asarray(true_um - true_um[0] + offset)


def results(days: Sequence[MachineDays]) -> dict[str, Any]:
    """Return the figures for `--json`."""
    return {one.name: one.figures() for one in days}
