"""A fluid that flows now and then is found by its flow and its temperature, and predicts another day."""

import dataclasses

import numpy as np
import pytest

from compensator.diagnose.diagnosis import diagnose
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.findings import findings_of
from compensator.identify.calibration import predict
from compensator.model.effects import effect_from
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import Scenario, lag, record
from tests.identify.quill_runs import runs_from

QUILL = load_model("quill")
#: Lag of what is wetted, min; where it lies between AT and T_Q; its gain at full flow, µm/K.
TAU_MIN, BETWEEN, GAIN = 25.0, 0.7, 0.6


def wetted(signals):
    """Coolant over the nose while a pump runs, whose speed is logged: a good film, so that a fifth of it is half."""
    flow = signals[1]["fan_rpm"] / 3000.0
    at, difference = signals[1]["ambient_degc"], signals[6]
    heat = flow / (flow + 0.2) * (signals[1]["coolant_degc"] - at - BETWEEN * difference)
    return GAIN * lag(heat - heat[0], TAU_MIN)


@pytest.fixture(scope="module")
def found():
    columns, _, _ = record([Scenario(place=("input", "", "fan_rpm"), act=wetted)], 1400)
    return diagnose(QUILL, runs_from(columns))


def test_it_is_named_by_its_flow_and_its_fluid(found):
    [effect] = found.effects
    assert effect.place == ("input", "", "fan_rpm") and effect.effect.fluid == "coolant_degc"
    assert found.verdict == "explained"
    assert effect.effect.channels == ("fan_rpm", "coolant_degc")
    for words in ("while fan_rpm flows, coolant_degc acts", "differences to T_Q and to the air"):
        assert words in effect.explanation
    (tau_min,) = effect.effect.tau_min
    gain, gain_air = effect.effect.gain[0], effect.effect.gain_air[0]
    assert tau_min == pytest.approx(TAU_MIN, rel=0.1)
    assert gain / (gain + gain_air) == pytest.approx(BETWEEN, abs=0.1)


def test_the_extended_model_predicts_a_day_with_other_flows(found):
    columns, true, _ = record([Scenario(place=("input", "", "fan_rpm"), act=wetted)], 1401)
    (run,) = runs_from(columns)
    errors = [np.std(true - predict(model, run)) for model in (QUILL, found.model)]
    assert errors[0] > 2.0 and errors[1] < 0.15 * errors[0]


def test_a_fluid_whose_temperature_does_not_move_is_one():
    """A large tank stays at 22 °C; what it takes from the machine goes by the pump and by T_Q."""

    def act(signals):
        still = signals[1] | {"coolant_degc": np.full(signals[0], 22.0)}
        return wetted((signals[0], still, *signals[2:]))

    columns, _, _ = record([Scenario(place=("input", "", "fan_rpm"), act=act)], 1402)
    rng = np.random.default_rng(1402)
    columns["coolant_degc"] = 22.0 + rng.normal(0.0, 0.02, columns["y_um"].size)
    unclear = findings_of(evidence_of(QUILL, runs_from(columns)))
    assert all(term.effect.channels != ("fan_rpm", "coolant_degc") for term in unclear.terms)
    columns["coolant_lpm"] = columns.pop("fan_rpm") / 100.0
    found = findings_of(evidence_of(QUILL, runs_from(columns)))
    [term] = found.terms
    assert term.effect.channels == ("coolant_lpm", "coolant_degc")
    # With the noise of 0.3 µm 0.35 is left.
    assert np.hypot(found.rest_um, 0.3) < 0.35


#: Of a surface under a fan: its time constant without it, min, and by which factor the fan outdoes what is behind it.
SURFACE_MIN, TIMES = 120.0, 4.0


def fanned(signals):
    """A surface of the quill, as warm as the quill until a fan cools it; the less is left to cool the longer."""
    fan, warm, below = np.abs(signals[1]["fan_rpm"]) / 3000.0, signals[4], 0.0
    found = []
    for i in range(signals[0]):
        for _ in range(10):
            below += (TIMES * fan[i] * (warm[i] - below) - below) / SURFACE_MIN / 10.0
        found.append(-0.4 * below)
    return np.array(found)


def test_a_fan_that_comes_and_goes_cools_a_surface_that_follows():
    """While it blows the surface follows in 24 min, and when it stops in 120: no filter of fixed lags does both."""
    model = dataclasses.replace(QUILL, held_out_rms_um=0.3)  # forms are approximate, as on a real machine
    scenario = [Scenario(place=("scheduled", "DTF", "fan_rpm"), act=fanned)]
    columns, _, _ = record(scenario, 1410, 36.0)
    found = diagnose(model, runs_from(columns))
    assert found.effects[0].place == ("scheduled", "DTF", "fan_rpm") and found.effects[0].form == "film"
    columns, true, _ = record(scenario, 1411, 36.0)
    (run,) = runs_from(columns)
    errors = [np.std(true - predict(one, run)) for one in (model, found.model)]
    assert errors[0] > 2.0 and errors[1] < 0.1 * errors[0]


@pytest.mark.parametrize(("channel", "name"), [("a_rpm", "_rpm"), ("a_l_per_min", "_l_per_min"), ("coolant_flow", "")])
def test_the_flow_for_half_is_named_with_the_unit_of_the_flow(channel, name):
    table = {"form": "flow", "channel": channel, "fluid": "b_degc", "span": 8.0, "half": 0.25}
    effect = effect_from("input", table | {"tau_min": [20.0], "gain": [0.5], "gain_air": [0.2]})
    assert effect.named({})[f"half_flow{name}"] == 2.0
