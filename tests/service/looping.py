"""A machine for the loop without devices: an undeclared effect of the coolant that begins and ends."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from compensator.arrays import Vector
from compensator.clock import NS
from compensator.config import Config
from compensator.events import Note
from compensator.messages import Sample
from compensator.model.effects import Effect, effect_from
from compensator.model.effects.names import effect_names
from compensator.model.model_file import parse_model
from compensator.model.model_writer import dump_model
from compensator.service.loop.run import Diagnosed, LoopStep, OfflineLoop
from compensator.service.outcome import Outcome
from tests.service.records import QUILL, sample
from tests.service.simulated import START_NS, config
from tests.service.test_restart import QUILL as QUILL_FILE

DAY = 1440
#: A time after every zero of a test, ns since 1970 UTC.
LATER_NS = 1 << 62
LIMITS = {
    "offset_max_um": 200.0,
    "offset_rate_max_um_per_min": 8.0,
    "validity": {"t_q_degc": [0.0, 80.0], "at_degc": [0.0, 40.0]},
}


def settings(**changes: Any) -> Config:
    """The usual configuration, with a loop that adopts, looks for a model once a day, and compares for twelve hours."""
    loop = {"policy": "adopt", "every_h": 24, "shadow_h": 12.0} | changes.pop("loop", {})
    return config(**{"loop": loop, "limits": LIMITS, **changes})


@functools.cache
def extended(gain: float = 3.0, std: float = 0.05, *, tau_min: float = 60.0) -> bytes:
    """The published model with the effect of the coolant."""
    table = {"channel": "coolant_degc", "curve": "linear", "tau_min": [tau_min], "gain": [gain], "delay_min": 5.0}
    effect = dataclasses.replace(effect_from("input", table), std={"gain": [std], "tau_min": [1.0]})
    return _with(effect)


@functools.cache
def stronger(change: float) -> bytes:
    """The published model with another gain, which the machine does not have."""
    return _with(effect_from("gain", {"path": "DTF", "change": change}))


@functools.cache
def together(*models: bytes) -> bytes:
    """The published model with the effects of several others."""
    return _with(*(effect for model in models for effect in parse_model(model, source="test").effects))


def _with(*effects: Effect) -> bytes:
    model = parse_model(QUILL_FILE, source="test")
    return dump_model(dataclasses.replace(model, effects=effects, provenance={})).encode()


def shown(model: bytes | None, verdict: str = "explained") -> Diagnosed:
    """A diagnosis that has found a model."""
    effects = tuple(effect_names(parse_model(model, source="test").effects)) if model is not None else ()
    return Diagnosed(verdict, effects, model, "a diagnosis", needs="")


def heat_w(samples: int) -> Vector:
    """Heat of the machine's work, W."""
    t = np.arange(samples)
    return np.asarray(np.where((t // 60) % 3 == 1, 80.0, 0.0) * (0.5 + 0.5 * ((t // 180) % 2)))


def grown(change: float) -> Callable[[int], float]:
    """What a gain of the DTF adds to Y of `machine`, µm; in four days at most."""
    y_um = QUILL.dtf.sampled.response(heat_w(4 * DAY))
    return lambda i: change * float(y_um[i])


def machine(
    samples: int,
    acts: Callable[[int], float] = lambda i: 1.0,
    *,
    seed: int = 1,
    noise_um: float = 0.4,
    more: Callable[[int], float] = lambda i: 0.0,
    change: Callable[[int, dict[str, float]], None] = lambda i, values: None,
    start_ns: int = START_NS,
) -> Iterator[Sample]:
    """Samples of a working machine whose coolant acts on Y by 3 µm/K, as much as `acts` says; from 6 o'clock on."""
    rng = np.random.default_rng(seed)
    assert QUILL.ttf is not None and QUILL.tdtf is not None
    t, heat = np.arange(samples), heat_w(samples)
    at = 20.0 + 0.8 * np.sin(t / 200.0)
    t_q = at + QUILL.ttf.sampled.response(heat) + 0.02 * rng.normal(size=samples)
    coolant = 22.0 + 1.5 * np.sin(t / 90.0) + 0.8 * np.sin(t / 37.0)
    lagged, state, keep = np.zeros(samples), 0.0, math.exp(-1.0 / 60.0)
    for i in range(samples):
        state = keep * state + (1.0 - keep) * (coolant[max(i - 5, 0)] - coolant[0])
        lagged[i] = state
    y = QUILL.dtf.sampled.response(heat) + QUILL.tdtf.sampled.response(at - at[0]) + noise_um * rng.normal(size=samples)
    for i in range(samples):
        values = {
            "t_q_degc": float(t_q[i]),
            "at_degc": float(at[i]),
            "y_um": float(y[i] + 3.0 * acts(i) * lagged[i] + more(i)),
            "coolant_degc": float(coolant[i]),
        }
        change(i, values)
        yield sample(i, values, start_ns=start_ns)


#: The first night of `evening`, samples after its beginning.
NIGHT = 4 * 60


def evening(
    samples: int, acts: Callable[[int], float] = lambda i: 1.0, *, before_night: int = NIGHT, **changes: Any
) -> Iterator[Sample]:
    """Samples of that machine from four hours before the first night on: of a day before it few tests say anything."""
    return machine(samples, acts, start_ns=START_NS + (20 * 60 - before_night) * 60 * NS, **changes)


class Night:
    """Stands in for the diagnosis: gives what it is told, and keeps what it was asked."""

    def __init__(self, *found: Diagnosed | Exception) -> None:
        self.found = list(found)
        self.asked: list[tuple[int, bytes]] = []

    def __call__(self, record: Sequence[Outcome], model: bytes) -> Diagnosed:
        self.asked.append((len(record), model))
        found = self.found.pop(0) if len(self.found) > 1 else self.found[0]
        if isinstance(found, Exception):
            raise found
        return found


def run(loop: OfflineLoop, samples: Iterator[Sample], count: int = 10**9) -> list[LoopStep]:
    """Run some samples through a loop."""
    return [loop.process(one) for _, one in zip(range(count), samples, strict=False)]


def decisions(steps: Sequence[LoopStep]) -> list[tuple[int, str, str]]:
    """Return each decision: number of the sample, step and reason."""
    notes: list[tuple[int, Note]] = [(step.outcome.sample.seq, note) for step in steps for note in step.events]
    return [(seq, note.data["step"], note.data.get("why", "")) for seq, note in notes if note.kind == "loop"]


def about(notes: Sequence[Note]) -> list[tuple[str, str]]:
    """Return step and reason of decisions."""
    return [(note.data["step"], note.data.get("why", "")) for note in notes]


def crept(i: int) -> float:
    """A mount that creeps by 10 µm in the first hours: measured Y shows no level then, before the effect and after."""
    return 10.0 * min(i / 200.0, 1.0)


def errors(steps: Sequence[LoopStep]) -> np.ndarray:
    """Return measured Y plus the offset at each sample, µm."""
    return np.array([step.outcome.estimate.y_um + step.outcome.offset.y_offset_um for step in steps])
