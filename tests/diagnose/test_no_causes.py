"""Channels that are no cause of Y: without values, copies of others, measurements of Y itself."""

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.data.measurement import measurements, runs_in
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.residual.no_causes import no_causes
from compensator.model.model_file import load_model
from tests.data.test_cleaning import N, machine


def day(**channels):
    """Return a day of a machine with its coolant, which moves Y, and further channels."""
    table, rng = machine(), np.random.default_rng(11)
    coolant = 22.0 + 3.0 * np.sin(np.arange(N) / 90.0)
    table["y_um"] = table["y_um"] + 2.0 * (coolant - 22.0)
    table["coolant_degc"] = coolant + rng.normal(0.0, 0.03, N)
    added = {name: make(table, rng) for name, make in channels.items()}
    return runs_in(measurements(table | added, "day"))[0]


MEASURES = {
    "probe2": lambda table, rng: 0.3 * table["y_um"] + rng.normal(0.0, 0.05, N),
    "ch4": lambda table, rng: -0.8 * table["y_um"] + 0.4 * table["t_q_degc"] + rng.normal(0.0, 0.05, N),
    "tip": lambda table, rng: 2.0 * (table["y_um"] + 7.0),
}


@pytest.mark.parametrize("name", MEASURES)
def test_a_second_measurement_of_y_is_no_cause(name):
    runs = day(**{name: MEASURES[name]})
    found = no_causes("day", runs)
    assert [(channel, remark.code) for channel, remark in found.items()] == [(name, "follows_y")]
    assert "a second measurement of Y, not a cause" in found[name]
    channels = evidence_of(load_model("quill"), runs).context.channels
    assert "coolant_degc" in channels and name not in channels


@pytest.mark.parametrize(("rows", "digit"), [(240, 0.0), (240, 1.0), (N, 1.0)])
def test_a_scale_that_is_y_to_the_digit_measures_it_whatever_its_noise(rows, digit):
    """In four hours, and with readings of a whole micrometre, no noise shows it."""
    table = machine()
    if digit:
        table["y_um"] = np.round(table["y_um"] / digit) * digit
    table |= {"scale_mm": np.round(table["y_um"] / 1000.0 + 5.0, 6), "scale_mm2": 0.4 * table["y_um"]}
    table["power_w"] = np.round(40.0 * table["y_um"] + np.random.default_rng(1).normal(0.0, 400.0, N))
    runs = runs_in(measurements({name: values[:rows] for name, values in table.items()}, "day"))[0]
    found = no_causes("day", runs)
    assert {name: str(remark.code) for name, remark in found.items()} == {
        "scale_mm": "follows_y",
        "scale_mm2": "follows_y",
    }


def test_a_count_is_no_cause_and_a_temperature_that_rises_may_be_one():
    runs = day(
        row=lambda table, rng: np.arange(N, dtype=float),
        parts=lambda table, rng: np.floor(np.arange(N) / 13.0),
        energy_kwh=lambda table, rng: np.cumsum(rng.random(N) * (np.arange(N) // 60 % 2)),
        stairs_rpm=lambda table, rng: 200.0 * (np.arange(N) // 40),
        humidity=lambda table, rng: 40.0 + 20.0 * (1.0 - np.exp(-np.arange(N) / 200.0)),
        floor_degc=lambda table, rng: 20.0 + np.arange(N) / 500.0,
        switched=lambda table, rng: 1.0 * (np.arange(N) > 300),
        ramp_rpm=lambda table, rng: np.abs(np.arange(N) - 700.0),
    )
    found = no_causes("day", runs)
    assert {name: str(remark.code) for name, remark in found.items()} == dict.fromkeys(
        ("row", "parts", "energy_kwh"), "column_counts"
    )


def test_causes_with_and_without_delay_and_noise_stay():
    rpm = machine()["spindle_rpm"]
    runs = day(
        column_degc=lambda table, rng: 20.0 + 0.1 * table["y_um"].mean() + 0.3 * np.sin(np.arange(N) / 100.0),
        speed_rpm=lambda table, rng: rpm + rng.normal(0.0, 3.0, N),
        housing_degc=lambda table, rng: table["t_q_degc"] * 0.7 + rng.normal(0.0, 0.03, N),
        pump_on=lambda table, rng: 1.0 * (rpm > 2000.0),
    )
    assert no_causes("day", runs) == {}


def test_a_power_that_is_switched_as_often_as_a_programme_does_is_a_cause():
    """Y bends at every switching: second differences of both are largest there, and that is no noise."""
    rng = np.random.default_rng(12)
    on = np.repeat(rng.permuted(np.arange(N // 2 + 1) % 2), 2)[:N] * (np.arange(N) // 240 % 2)
    power_w = 3000.0 * on * (1.0 + 0.02 * rng.normal(size=N)) + rng.normal(0.0, 10.0, N)
    table = machine() | {"spindle_power_w": power_w}
    table["y_um"] = table["y_um"] + lfilter([0.1], [1.0, -0.9], 12.0 * on)
    assert no_causes("day", runs_in(measurements(table, "day"))[0]) == {}


def test_smooth_signals_without_noise_are_not_taken_for_measurements_of_y():
    table = machine(noise_k=0.0)
    table["y_um"] = 3.0 * (table["t_q_degc"] - table["at_degc"])
    table["housing_degc"] = 20.0 + 0.5 * (table["t_q_degc"] - table["at_degc"])
    assert no_causes("day", runs_in(measurements(table, "day"))[0]) == {}


def test_of_copies_the_first_is_searched_and_an_empty_channel_is_said():
    runs = day(
        coolant2_degc=lambda table, rng: table["coolant_degc"].copy(),
        t_q2_degc=lambda table, rng: table["t_q_degc"].copy(),
        open_degc=lambda table, rng: np.full(N, np.nan),
        off=lambda table, rng: np.zeros(N),
        off_too=lambda table, rng: np.zeros(N),
    )
    found = no_causes("day", runs)
    assert {name: str(remark.code) for name, remark in found.items()} == {
        "coolant2_degc": "column_copy",
        "t_q2_degc": "column_copy",
        "open_degc": "column_empty",
    }
    assert "coolant2_degc has the values of coolant_degc" in found["coolant2_degc"]
    assert set(evidence_of(load_model("quill"), runs).context.channels) == {"coolant_degc", "spindle_rpm"}
