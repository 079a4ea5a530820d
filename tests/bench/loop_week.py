"""A drawn machine-week as the service gets it: its configuration, its samples, and the error that is left."""

import math

import numpy as np

from compensator.clock import NS
from compensator.config import parse_config
from compensator.demo.offline import sample_of
from compensator.messages import number
from compensator.service.outcome import sets_zero
from sim_hardware.drawn_machines.trouble import moved_um

#: 2026-01-05T00:00:00Z.
MIDNIGHT_NS = 1_767_571_200 * NS
PERIOD_S, MINUTE_NS = 60.0, 60 * NS
#: For so long after a fault of a temperature the state of the model is wrong, and after a zero the offset is limited.
AFTER_FAULT_MIN, LIMITED_MIN = 360, 15
#: Largest changes per minute that are permitted at least, °C; else twice those of the calibration (deploy/README.md).
LEAST_RATES = {"t_q_degc": 5.0, "at_degc": 2.0}
LOOP = '[loop]\npolicy = "adopt"\n'


def config_of(week, model):
    """Return the configuration of a machine as its commissioning would have it."""
    calibration = week.calibration.columns
    low, high = (
        {name: float(side(calibration[name])) for name in ("t_q_degc", "at_degc")} for side in (np.nanmin, np.nanmax)
    )
    rates = {name: max(least, 2.0 * _fastest(calibration[name])) for name, least in LEAST_RATES.items()}
    channels = "".join(_channel(name, rates) for name in week.columns)
    probe = ""
    if week.probes:
        probe = f"[probe]\nstd_um = {week.probe_std_um}\nmeasured_max_um = 100.0\nlargest_um = 60.0\n"
    text = f"""
line = []
device = [{{name = "simulated"}}]
machine.name = "{week.family}-{week.seed}"
model.file = "model.toml"
loss.predict_for_min = 30.0
zero.rest_rate_um_per_min = 0.2
guards.t_q_below_at_max_k = 2.0
guards.suspect_jumps = true
guards.jump_min_k = 1.0
zenoh.prefix = "bench"
recording.folder = "recordings"
[limits]
offset_max_um = 300.0
offset_rate_max_um_per_min = 8.0
[limits.validity]
t_q_degc = [{low["t_q_degc"] - 10.0}, {high["t_q_degc"] + 15.0}]
at_degc = [{low["at_degc"] - 8.0}, {high["at_degc"] + 8.0}]
[plausibility]
t_q_below_at_after_min = 30.0
false_alarm_days = 30.0
{probe}{LOOP}{channels}"""
    return parse_config(text.encode(), source=f"{week.family} {week.seed}")


def _fastest(column):
    """Return the largest change per minute without single wrong readings."""
    whole = np.median([column[:-2], column[1:-1], column[2:]], axis=0)
    return float(np.nanmax(np.abs(np.diff(whole))))


def _channel(name, rates):
    limits = {
        "t_q_degc": f"range = [0.0, 90.0]\nrate_max_per_min = {rates['t_q_degc']}\nstuck_after_min = 120.0\n",
        "at_degc": f"range = [0.0, 50.0]\nrate_max_per_min = {rates['at_degc']}\nstuck_after_min = 240.0\n",
        "y_um": "range = [-400.0, 400.0]\nrate_max_per_min = 30.0\nstuck_after_min = 60.0\n",
    }
    return f'[[channel]]\nname = "{name}"\ndevice = "simulated"\ninput = 0\n{limits.get(name, "")}'


def samples_of(week, columns, true_um):
    """Return for each minute in which the service runs: sample, what a probe before it shows, whether a zero is set.

    Probes show the displacement that belongs to what is read.
    """
    start_ns = MIDNIGHT_NS + round(week.start_h * 60) * MINUTE_NS
    visited = np.zeros(week.minutes, dtype=bool)
    for minute in week.visits:
        visited[minute + int(np.argmax(week.running[minute:]))] = True
    # A person who sets a zero also sets that of the feature, once the service has taken it: with both temperatures.
    readable = np.isfinite(columns["t_q_degc"]) & np.isfinite(columns["at_degc"]) & week.running
    taken = [minute + int(np.argmax(readable[minute:])) for minute in np.flatnonzero(visited)]
    zeros = np.array([0, *taken])
    moved = moved_um(week.troubles, week.minutes)
    shown = np.full(week.minutes, math.nan)
    for probe in week.probes:
        zero = zeros[np.searchsorted(zeros, probe.minute) - 1]
        # In the middle of the minute that the next sample is the mean of.
        shown[probe.minute] = true_um[probe.minute] - true_um[zero] + probe.error_um - (moved[zero] - moved[0])
    names = list(columns)
    table = np.column_stack([columns[name] for name in names])
    return [
        (
            sample_of(
                week.family, i, start_ns + i * MINUTE_NS, dict(zip(names, table[i], strict=True)), period_s=PERIOD_S
            ),
            float(shown[i]),
            bool(visited[i]),
        )
        for i in np.flatnonzero(week.running).tolist()
    ]


def error_of(outcomes, true_um):
    """Return the error by minute since the last zero, µm, shape (n,); NaN where the service did not run."""
    error, zero_um = np.full(true_um.size, math.nan), 0.0
    for outcome in outcomes:
        i = outcome.sample.seq
        if sets_zero(outcome):
            zero_um = true_um[i]
        error[i] = true_um[i] - zero_um + number(outcome.offset.y_offset_um)
    return error


def whole(week):
    """Return at which minutes every sensor is whole and has been for some hours: elsewhere faults make the error.

    A displacement sensor makes no error of the offset; a probed feature that has moved does until somebody sees to it.
    """
    found = np.ones(week.minutes, dtype=bool)
    for trouble in week.troubles:
        if trouble.channel != "y_um":
            found[trouble.from_min : trouble.to_min + AFTER_FAULT_MIN] = False
        elif week.probes:
            found[trouble.from_min : seen_to(week, trouble)] = False
    for minute in week.visits:
        found[minute : minute + LIMITED_MIN] = False
    return found


def undisturbed(week):
    """Return at which minutes nothing is wrong beside the machine, or has been seen to."""
    found = np.ones(week.minutes, dtype=bool)
    for trouble in week.troubles:
        found[trouble.from_min : seen_to(week, trouble)] = False
    return found


def seen_to(week, trouble):
    """Return the minute in which a person has seen to a trouble, or from which on it is over by itself."""
    after = [minute for minute in week.visits if minute >= trouble.to_min]
    return after[0] if after and trouble.kind not in ("break", "period", "hand") else trouble.to_min


def rms(error):
    good = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(good**2))) if good.size else math.nan
