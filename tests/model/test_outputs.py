"""Further parts of a model: each gives what it gives alone, whatever is missing, and outputs are their sums."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from compensator.errors import ModelError
from compensator.model.effects import Effect, effect_from
from compensator.model.engine import Engine, Estimate
from compensator.model.outputs import Output, with_outputs
from compensator.model.thermal_model import ThermalModel
from tests.service.several import part

PARTS = ("z", "x", "low", "high")
INPUT = effect_from(
    "input", {"channel": "coolant_degc", "curve": "linear", "tau_min": [9.0], "gain": [2.0], "delay_min": 0.0}
)
LATE = effect_from("delay", {"path": "TTF", "form": "sensor", "delay_min": 2.5, "lag_min": 1.0})
OUTPUTS = (
    Output(name="z", weights=(("z", 1.0),)),
    Output(name="x", weights=(("x", -1.0),)),
    Output(name="a", weights=(("high", 5.0), ("low", -5.0))),
    Output(name="y twice", weights=(("y", 2.0),)),
)


def models(method: str, *late: Effect) -> dict[str, ThermalModel]:
    """Parts of one machine, by name; Z has an effect of its own."""
    found = {name: part(name, *late, *((INPUT,) if name == "z" else ())) for name in ("y", *PARTS)}
    estimator = dataclasses.replace(found["y"].estimator, method=method)  # type: ignore[arg-type]
    return {name: dataclasses.replace(one, estimator=estimator) for name, one in found.items()}


def record(samples: int = 400) -> list[tuple[float, float, dict[str, float]]]:
    """Temperatures and coolant with losses of one sensor, of both, and of the channel, short and long."""
    rng = np.random.default_rng(5)
    heat = np.repeat(rng.uniform(0.0, 8.0, samples // 40 + 1), 40)[:samples]
    t_q = 20.0 + np.convolve(heat, np.exp(-np.arange(60) / 15.0) / 15.0)[:samples] + rng.normal(0.0, 0.03, samples)
    at = 20.0 + 0.8 * np.sin(np.arange(samples) / 70.0) + rng.normal(0.0, 0.02, samples)
    coolant = 21.0 + np.cumsum(rng.normal(0.0, 0.05, samples))
    t_q[90:95] = at[120:123] = coolant[150:160] = math.nan
    t_q[200:280] = at[240:280] = math.nan  # longer than what is bridged
    return [(float(a), float(b), {"coolant_degc": float(c)}) for a, b, c in zip(t_q, at, coolant, strict=True)]


def run(engine: Engine, rows: list[tuple[float, float, dict[str, float]]]) -> list[Estimate]:
    engine.set_reference(20.0, 20.0)
    return [engine.step(*row) for row in rows]


@pytest.mark.parametrize("method", ["kalman", "inverse"])
@pytest.mark.parametrize("late", [(), (LATE,)], ids=["prompt", "late"])
def test_a_part_gives_what_it_gives_alone_whatever_is_missing(method: str, late: tuple[Effect, ...]) -> None:
    parts, rows = models(method, *late), record()
    together = run(Engine(with_outputs(parts, "y", OUTPUTS)), rows)
    z = run(Engine(parts["z"]), rows)
    # What a gap leaves unknown is decided by Y for all parts: with a late T_Q that may be another choice than Z's own.
    near_um, near_part = (0.02, 0.01) if late and method == "kalman" else (1e-6, 1e-6)
    complete = [i for i, row in enumerate(rows) if not any(map(math.isnan, (row[0], row[1], row[2]["coolant_degc"])))]
    for i in complete:
        assert together[i].outputs[0].value == pytest.approx(z[i].y_um, abs=near_um)
        assert together[i].outputs[0].std == pytest.approx(z[i].y_std_um, rel=near_part)
        assert together[i].outputs[0].rate_per_min == pytest.approx(z[i].y_rate_um_per_min, abs=near_um)
        assert together[i].outputs[0].effects == pytest.approx(z[i].y_effects_um, abs=1e-9)


def test_an_output_is_the_weighted_sum_of_its_parts() -> None:
    rows = [(a, b, {"coolant_degc": 21.0}) for a, b, _ in record()[:80]]
    parts = models("kalman")
    together = run(Engine(with_outputs(parts, "y", OUTPUTS)), rows)
    alone = {name: run(Engine(parts[name]), rows) for name in ("y", "x", "low", "high")}
    for i, estimate in enumerate(together):
        values = {name: ones[i] for name, ones in alone.items()}
        _, x, a, twice = estimate.outputs
        assert estimate.y_um == pytest.approx(values["y"].y_um, abs=1e-6)
        assert x.value == pytest.approx(-values["x"].y_um, abs=1e-6)
        assert a.value == pytest.approx(5.0 * (values["high"].y_um - values["low"].y_um), abs=1e-5)
        assert twice.value == pytest.approx(2.0 * values["y"].y_um, abs=1e-5)
        assert twice.std == pytest.approx(2.0 * values["y"].y_std_um, rel=1e-6)
        # Both parts are driven by the same heat: their noise is not independent, their own errors are.
        own = 5.0 * math.sqrt(parts["low"].y_std_um ** 2 + parts["high"].y_std_um ** 2)
        apart = 5.0 * math.hypot(values["high"].y_std_um, values["low"].y_std_um)
        assert own <= a.std <= apart


def test_a_restored_engine_continues_all_parts_to_the_bit_also_within_a_gap() -> None:
    parts, rows = models("kalman"), record(120)
    model = with_outputs(parts, "y", OUTPUTS)
    engine = Engine(model)
    run(engine, rows[:92])
    again = Engine(model)
    again.check(engine.snapshot())
    again.restore(engine.snapshot())
    assert [engine.step(*row) for row in rows[92:]] == [again.step(*row) for row in rows[92:]]


def test_a_model_without_outputs_is_as_it_was() -> None:
    one = models("kalman")["y"]
    assert with_outputs({"y": one}, "y", ()) is one


@pytest.mark.parametrize(
    ("changes", "said"), [({"effects": (LATE,)}, "lateness of T_Q"), ({"inputs": "absolute"}, "inputs"), ({}, "TTF")]
)
def test_parts_of_another_machine_are_refused_by_name(changes: dict[str, Any], said: str) -> None:
    parts = models("kalman")
    ttf = parts["z"].ttf
    assert ttf is not None
    if not changes:
        sampled = dataclasses.replace(ttf.sampled, b=tuple(1.1 * b for b in ttf.sampled.b))
        changes = {"ttf": dataclasses.replace(ttf, sampled=sampled, continuous=None)}
    parts["z"] = dataclasses.replace(parts["z"], **changes)
    with pytest.raises(ModelError, match=rf"axis\.z: another {said} than axis\.y"):
        with_outputs(parts, "y", OUTPUTS)
