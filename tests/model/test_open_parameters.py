"""What the data of a diagnosis leave open of an effect's parameters: how far the offset may be off for it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from compensator.errors import ModelError
from compensator.model.effects import Effect, effect_from
from compensator.model.engine import Engine, Estimate
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model
from compensator.model.thermal_model import ThermalModel

QUILL = load_model("quill")
N = 240
AT = 20.0 + 0.5 * np.sin(np.arange(N) / 50.0)
T_Q = AT + np.repeat([0.0, 6.0, 12.0, 3.0], N // 4)
SPEED = np.repeat([0.0, 4000.0, 0.0, 9000.0], N // 4)
GAIN = {"path": "DTF", "change": 0.1}
INPUT = {"channel": "speed_rpm", "curve": "linear", "tau_min": [30.0], "gain": [1e-3], "delay_min": 0.0}
PLAY = {"path": "DTF", "form": "play", "half_width_um": 4.0}


def model(*effects: Effect) -> ThermalModel:
    """The published model with effects, through its file."""
    made = dataclasses.replace(QUILL, effects=effects)
    return parse_model(dump_model(made).encode(), source="written")


def run(engine: Engine, first: int = 0, last: int = N) -> list[Estimate]:
    return [
        engine.step(float(T_Q[k]), float(AT[k]), channels={"speed_rpm": float(SPEED[k])}) for k in range(first, last)
    ]


def started(made: ThermalModel) -> Engine:
    engine = Engine(made)
    engine.set_reference(float(T_Q[0]), float(AT[0]))
    return engine


def added_um2(*effects: Effect) -> np.ndarray:
    """Variance that the rows of some effects add to that of the model, by sample."""
    stated = np.array([e.y_std_um**2 for e in run(started(model(*effects)))])
    silent = [dataclasses.replace(effect, std_factor=()) for effect in effects]
    return stated - np.array([e.y_std_um**2 for e in run(started(model(*silent)))])


def test_a_gain_states_its_share_of_the_path_and_nothing_at_rest() -> None:
    effect = effect_from("gain", {**GAIN, "std_factor": [[0.03], [-0.04]]})
    dtf = np.array([e.y_dtf_um for e in run(started(model(effect)))])
    assert np.ptp(dtf) > 20.0
    np.testing.assert_allclose(added_um2(effect), (0.05 * dtf) ** 2, atol=1e-9)


def test_a_time_constant_states_what_another_one_would_change() -> None:
    """A row moves searched parameters, too: its share is that of a model with those."""
    effect = effect_from("input", {**INPUT, "std_factor": [[12.0, 4e-4, 0.0]]})
    moved = effect_from("input", {**INPUT, "tau_min": [42.0], "gain": [1.4e-3]})
    difference = np.array(
        [a.y_um - b.y_um for a, b in zip(run(started(model(moved))), run(started(model(effect))), strict=True)]
    )
    assert np.ptp(difference) > 1.0
    np.testing.assert_allclose(added_um2(effect), difference**2, atol=1e-9)


def test_rows_of_one_place_belong_together() -> None:
    """What one effect has too much and the other makes up for is no error; in rows of their own it would be."""
    one = effect_from("gain", {**GAIN, "std_factor": [[0.05]]})
    other = effect_from("gain", {**GAIN, "change": -0.02, "std_factor": [[-0.05]]})
    apart = effect_from("gain", {**GAIN, "change": -0.02, "std_factor": [[], [-0.05]]})
    np.testing.assert_allclose(added_um2(one, other), 0.0, atol=1e-9)
    dtf = np.array([e.y_dtf_um for e in run(started(model(one)))])
    np.testing.assert_allclose(added_um2(one, apart), 2.0 * (0.05 * dtf) ** 2, atol=1e-9)


def test_rows_never_change_the_offset() -> None:
    rows = effect_from("hysteresis", {**PLAY, "std_factor": [[1.5]]})
    silent = dataclasses.replace(rows, std_factor=())
    for a, b in zip(run(started(model(rows))), run(started(model(silent))), strict=True):
        assert (a.y_um, a.y_rate_um_per_min) == (b.y_um, b.y_rate_um_per_min)


@pytest.mark.parametrize(
    "effect",
    [
        effect_from("input", {**INPUT, "std_factor": [[12.0, 4e-4, 0.0], [], [-3.0, 1e-5, 0.0]]}),
        effect_from("hysteresis", {**PLAY, "std_factor": [[1.5]]}),
    ],
    ids=["input", "play"],
)
def test_a_snapshot_continues_with_the_same_bits(effect: Effect) -> None:
    engine = started(model(effect))
    run(engine, 0, 130)
    state = engine.snapshot()
    expected = run(engine, 130)
    again = Engine(model(effect))
    again.restore(state)
    assert run(again, 130) == expected


def test_rows_stand_in_the_model_file() -> None:
    effect = effect_from("input", {**INPUT, "std_factor": [[], [12.0, 4e-4, 0.0]]})
    assert model(effect).effects == (effect,)
    assert model(effect).effects[0].std_factor == ((), (12.0, 4e-4, 0.0))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([[1.0]], "row 1: 1 numbers, expected 3"),
        ([[], [1.0, 2.0, 3.0, 4.0]], "row 2: 4 numbers, expected 3"),
        ([[-31.0, 0.0, 0.0]], "row 1: .*tau_min"),
        ([[0.0, 0.0, -1.0]], "row 1: .*delay_min"),
        ([[0.0, math.nan, 0.0]], "std_factor"),
        ([0.0, 1.0, 0.0], "std_factor"),
        ([[0.0, 1.0, 0.0]] * 65, "65 rows, expected at most 64"),
    ],
)
def test_rows_that_no_effect_may_have_are_refused(rows: list[list[float]], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        effect_from("input", {**INPUT, "std_factor": rows})
