"""Samples for a compensation without a daemon, and models of every sort."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from compensator.messages import ChannelSample, Sample
from compensator.model.effects import effect_from
from compensator.model.model_file import load_model
from compensator.model.thermal_model import Path, ThermalModel
from compensator.model.transfer_function import TransferFunction
from tests.service.simulated import START_NS

QUILL = load_model("quill")

EFFECTS: tuple[tuple[str, dict[str, Any]], ...] = (
    (
        "input",
        {"channel": "coolant_degc", "curve": "square", "tau_min": [7.0, 90.0], "gain": [0.02, -0.01], "delay_min": 4.5},
    ),
    (
        "input",
        {
            "form": "flow",
            "channel": "spindle_rpm",
            "fluid": "coolant_degc",
            "span": 2000.0,
            "half": 0.3,
            "surface_min": 12.0,
            "tau_min": [0.0, 30.0],
            "gain": [0.1, 0.4],
            "gain_air": [-0.1, 0.2],
        },
    ),
    ("gain", {"path": "TDTF", "change": 0.2}),
    ("dynamics", {"form": "missing", "path": "DTF", "tau_min": 40.0, "gain": 0.05}),
    ("dynamics", {"form": "mistimed", "path": "DTF", "tau_min": 25.0, "instead_of_min": 20.9}),
    ("delay", {"path": "DTF", "delay_min": 3.5, "lag_min": 2.0}),
    ("nonlinear", {"form": "odd square", "path": "DTF", "change": 0.1}),
    ("nonlinear", {"form": "drive", "path": "DTF", "change": 0.1, "b": [0.0, 0.1], "a": [1.0, -0.9]}),
    (
        "scheduled",
        {"form": "share", "origin": "start", "path": "DTF", "channel": "coolant_degc", "change": 0.1, "span": 2.0},
    ),
    (
        "scheduled",
        {
            "form": "drive",
            "origin": "zero",
            "path": "DTF",
            "channel": "spindle_rpm",
            "change": 0.1,
            "span": 2000.0,
            "b": [0.0, 0.1],
            "a": [1.0, -0.9],
        },
    ),
    (
        "scheduled",
        {
            "form": "speed",
            "origin": "zero",
            "path": "TDTF",
            "channel": "spindle_rpm",
            "change": 0.1,
            "span": 2000.0,
            "tau_min": 12.0,
        },
    ),
    (
        "scheduled",
        {
            "form": "film",
            "origin": "zero",
            "path": "DTF",
            "channel": "spindle_rpm",
            "span": 2000.0,
            "half": 0.4,
            "surface_min": 25.0,
            "tau_min": [4.0, 50.0],
            "gain": [0.01, 0.02],
            "gain_share": [0.02, -0.01],
        },
    ),
    (
        "regression",
        {
            "channels": ["coolant_degc", "spindle_rpm", "heat_w", "spindle_rpm"],
            "exponents": [1.0, 1.0, 1.0, 2.0],
            "taus_min": [0.0, 6.0, 70.0],
            "gains": [[0.3, 0.1, -0.2], [1e-4, 2e-4, 3e-4], [0.01, -0.01, 0.02], [1e-8, 2e-8, -1e-8]],
            "std_factor": [[0.1, 0.2, -0.1, *[1e-5] * 3, *[1e-3] * 3, *[1e-9] * 3], [0.0, 0.3, *[0.0] * 10]],
        },
    ),
    ("hysteresis", {"form": "stick", "path": "all", "half_width_um": 1.5}),
)


def with_method(method: str) -> ThermalModel:
    """The published model with one way to the heat."""
    estimator = dataclasses.replace(QUILL.estimator, method=method)  # type: ignore[arg-type]
    return dataclasses.replace(QUILL, estimator=estimator)


def with_effects(base: ThermalModel = QUILL) -> ThermalModel:
    """The published model with an effect of every kind that streams."""
    effects = tuple(effect_from(kind, table) for kind, table in EFFECTS)
    return dataclasses.replace(base, effects=effects, sha256="e" * 64)


def late(base: ThermalModel, **changes: Any) -> ThermalModel:
    """A model with a late T_Q, beside the effects that it has."""
    table = {"path": "TTF", "form": "sensor", "delay_min": 2.5, "lag_min": 3.0} | changes
    return dataclasses.replace(base, effects=(*base.effects, effect_from("delay", table)), sha256="a" * 64)


def direct(method: str) -> ThermalModel:
    """A model from T_Q − AT straight to the deformation."""
    function = TransferFunction(numerator=(4.0, 20.0), denominator=(1.0, 120.0), unit="um/K")
    base = with_method(method)
    return dataclasses.replace(
        base,
        kind="direct",
        ttf=None,
        dtf=Path.from_continuous(function, 60.0),
        sha256="d" * 64,
        estimator=dataclasses.replace(base.estimator, drive_walk_std=0.5),
    )


def channel(value: float, quality: str = "good") -> ChannelSample:
    good = quality == "good" and not math.isnan(value)
    value = value if good else math.nan
    quality = quality if good or quality != "good" else "device_timeout"
    return ChannelSample(
        mean=value,
        min=value - 0.01,
        max=value + 0.01,
        spread=0.01,
        count=6 if good else 0,
        polls=6,
        quality=quality,
        device_quality=quality,
    )


def sample(seq: int, values: dict[str, float], *, start_ns: int = START_NS) -> Sample:
    return Sample(
        schema=1,
        machine="vmc-07",
        seq=seq,
        time_utc_ns=start_ns + seq * 60_000_000_000,
        period_s=60.0,
        channels={name: channel(value) for name, value in values.items()},
    )


def day(samples: int, seed: int = 1, lost: dict[str, list[range]] | None = None) -> Iterator[Sample]:
    """Samples of a working machine; some of them lost."""
    rng = np.random.default_rng(seed)
    assert QUILL.ttf is not None
    heat = np.where((np.arange(samples) // 60) % 2 == 1, 80.0, 0.0)
    at = 20.0 + 0.8 * np.sin(np.arange(samples) / 200.0)
    t_q = at + QUILL.ttf.sampled.response(heat) + 0.02 * rng.normal(size=samples)
    y = QUILL.dtf.sampled.response(heat) + 0.2 * rng.normal(size=samples)
    coolant = 22.0 + np.cumsum(0.05 * rng.normal(size=samples))
    for i in range(samples):
        values = {
            "t_q_degc": t_q[i],
            "at_degc": at[i],
            "y_um": y[i],
            "coolant_degc": coolant[i],
            "spindle_rpm": 50.0 * heat[i],
        }
        for name, ranges in (lost or {}).items():
            if any(i in r for r in ranges):
                values[name] = math.nan
        yield sample(i, {name: float(value) for name, value in values.items()})
