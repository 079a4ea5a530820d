"""Runs made from the published equations and from simulated machines."""

import functools

import numpy as np
from scipy.signal import lfilter

from compensator.data.record import SampledRecord
from compensator.data.runs import runs_of
from compensator.model.model_file import load_model
from sim_hardware.physics import World, usual_sensors

QUILL = load_model("quill")
CALIBRATION_W = np.where((np.arange(720) >= 30) & (np.arange(720) < 390), 90.0, 0.0)
VALIDATION_W = np.repeat([0.0, 60.0, 30.0, 90.0, 0.0], 192)


def published(heat_w, seed, *, noise_k=0.05, noise_um=0.3):
    """Heat, ambient, measured T_Q − AT and y of the published functions, and the true T_Q − AT and y."""
    rng = np.random.default_rng(seed)
    n = heat_w.size
    slow = lfilter([0.02], [1.0, -0.98], rng.normal(0.0, 1.0, n))
    ambient = np.sin(2 * np.pi * np.arange(n) / 1440.0) + slow - slow[0]
    difference = QUILL.ttf.sampled.response(heat_w)
    y = QUILL.dtf.sampled.response(heat_w) + QUILL.tdtf.sampled.response(ambient)
    return heat_w, ambient, difference + rng.normal(0, noise_k, n), y + rng.normal(0, noise_um, n), difference, y


def fit_pct(y, predicted):
    return 100.0 * (1.0 - np.linalg.norm(y - predicted) / np.linalg.norm(y - y.mean()))


@functools.cache
def simulated(plant, duty, seed, heat=True):
    """A run of a simulated machine, seen through its sensors."""
    sensors = usual_sensors(duty.extra_names, heat_known=heat, temperature_noise_k=0.02)
    columns = World(plant(), duty, sensors, seed).record(60.0)
    t_s = columns.pop("t_s")
    return runs_from(columns, t_s)


def runs_from(columns, t_s=None, name="run"):
    n = next(iter(columns.values())).size
    record = SampledRecord(t_s=np.arange(n) * 60.0 if t_s is None else t_s, columns=columns)
    return list(runs_of(name, record))
