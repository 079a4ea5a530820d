"""Readings that a sensor cannot have meant: single wrong ones anywhere, and stands at the end of a range."""

import numpy as np
import pytest

import compensator as tc
from compensator.data.cleaning import cleaned, stand_at_limit, without_outliers
from compensator.data.measurement import measurements, runs_in
from compensator.data.record import SampledRecord
from compensator.errors import DataError

N = 1500


def machine(seed=3, noise_k=0.03):
    """Return a day of a machine in minutes: speeds that change, their heat, and an ambient that wanders."""
    rng = np.random.default_rng(seed)
    rpm = np.repeat(rng.choice([0.0, 1500.0, 3000.0, 4500.0, 6000.0], N // 60 + 1), 60)[:N]
    rpm[:60] = 0.0
    heat = np.zeros(N)
    for i in range(1, N):
        heat[i] = heat[i - 1] + (rpm[i] / 150.0 - heat[i - 1]) / 25.0
    at = 21.0 + np.sin(np.arange(N) / 230.0)
    return {
        "t_s": np.arange(N) * 60.0,
        "t_q_degc": at + heat + rng.normal(0.0, noise_k, N),
        "at_degc": at + rng.normal(0.0, noise_k, N),
        "y_um": 3.0 * heat + 2.0 * (at - 21.0) + rng.normal(0.0, 0.15, N),
        "spindle_rpm": rpm,
    }


def said(table):
    (one,) = measurements(table, "day")
    return {remark.code for remark in one.at_period(60.0).remarks}


@pytest.mark.parametrize("row", [0, 700, -1])
@pytest.mark.parametrize(("column", "size"), [("t_q_degc", 30.0), ("at_degc", -15.0), ("y_um", 60.0)])
def test_a_wrong_reading_goes_wherever_it_stands(column, size, row):
    table = machine()
    table[column][row] += size
    (one,) = measurements(table, "day")
    data = one.at_period(60.0)
    assert np.flatnonzero(np.isnan(data.records[0].columns[column])).tolist() == [row % N]
    assert [remark.code for remark in data.remarks] == ["wild_readings"]


def switched(rate=2.5, noise=0.2, seed=4):
    """Return a displacement that rises and falls by turns for half an hour each, and where it turns."""
    turns = np.arange(30, 600, 30)
    slope = np.full(600, rate)
    for at in turns:
        slope[at:] *= -1.0
    return np.cumsum(slope) + np.random.default_rng(seed).normal(0.0, noise, 600), turns


@pytest.mark.parametrize(("rows", "size"), [([310], -14.0), ([345], 14.0), ([315, 316], -25.0)])
def test_a_wrong_reading_on_a_slope_goes_and_the_corners_stay(rows, size):
    """−14 µm where Y moves by 2.5 µm a minute: near what is beside it, and far from the line through that."""
    values, turns = switched()
    assert without_outliers(values, first=True, last=True, in_a_row=2)[1] == 0
    values[rows] += size
    kept, count = without_outliers(values, first=True, last=True, in_a_row=2)
    assert np.flatnonzero(np.isnan(kept)).tolist() == rows
    assert count == len(rows)
    values[turns[3] + 1] += 20.0  # at a corner there is no line, but this is far from both sides
    assert np.isnan(without_outliers(values, first=True, last=True, in_a_row=2)[0][turns[3] + 1])


def test_a_step_on_a_slope_and_a_step_in_two_samples_are_no_wrong_readings():
    for size, samples in ((9.0, 1), (9.0, 2), (-9.0, 1), (-9.0, 2)):
        values, _ = switched()
        values[310:] += size
        values[310 : 310 + samples - 1] -= size / 2.0
        assert without_outliers(values, first=True, last=True, in_a_row=2)[1] == 0


def test_a_wrong_first_reading_is_not_the_zero_of_a_simulation():
    table = machine()
    right = tc.simulate("quill", table)["y_pred_um"]
    table["t_q_degc"][0] += 30.0
    wrong = tc.simulate("quill", table)["y_pred_um"]
    assert np.nanmax(np.abs((right - wrong)[1:])) < 1.0


def test_a_machine_that_is_switched_on_in_the_second_sample_keeps_its_first():
    table = machine()
    for name, size in (("t_q_degc", 12.0), ("y_um", 40.0)):
        table[name][1:] += size
    table["spindle_rpm"][1:60] = 6000.0
    assert "wild_readings" not in said(table)
    # Without a channel that shows it: heat moves a signal on.
    slow = np.full(200, 20.0) + np.random.default_rng(1).normal(0.0, 0.03, 200)
    slow[1:] += 10.0 * (1.0 - np.exp(-np.arange(1, 200) / 2.0))
    assert without_outliers(slow, first=True, last=True)[1] == 0


def test_a_step_that_comes_again_and_one_that_was_computed_are_no_wrong_readings():
    values = np.random.default_rng(1).normal(0.0, 0.03, 400)
    values[1:200] += 6.0
    values[260:] += 6.0
    assert without_outliers(values, first=True, last=True)[1] == 0
    computed = np.full(400, 30.0)
    computed[0] = 20.0
    assert without_outliers(computed, first=True, last=True)[1] == 0


def parts(seed=6):
    """Return channels that are switched by design, in means of a minute: parts of an hour or so, then set-up.

    At a change of parts the coolant, the spindle and the motor stop for less than a minute; a fan runs now and then.
    """
    rng = np.random.default_rng(seed)
    on = np.zeros(6 * N)  # readings of 10 s
    at = 0
    while at < on.size:
        for _ in range(rng.integers(3, 6)):
            run = int(rng.integers(400, 600))
            on[at : at + run] = 1.0
            at += run + int(rng.integers(3, 8))
        at += int(rng.integers(60, 200))
    means = on.reshape(-1, 6).mean(axis=1)
    fan = (np.arange(N) % 500 > 350).astype(float)
    fan[[100, 600, 1200]] = 1.0
    return {
        "coolant_flow_lpm": 12.0 * means,
        "spindle_rpm": 4500.0 * means,
        "motor_load_pct": 80.0 * means * (1.0 + rng.normal(0.0, 0.02, N)),
        "fan_on": fan,
    }


def wild_rows(column, values):
    """Return the rows that are left out of a channel, and what is said."""
    (record,), remarks = cleaned("day", [SampledRecord(np.arange(N) * 60.0, {column: values})])
    return np.flatnonzero(np.isnan(record.columns[column])).tolist(), [remark.code for remark in remarks]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("column", parts())
def test_a_channel_that_is_switched_for_a_minute_has_no_wrong_readings(column, seed):
    assert wild_rows(column, parts(seed)[column]) == ([], [])


@pytest.mark.parametrize(
    ("column", "value"),
    [("coolant_flow_lpm", 40.0), ("spindle_rpm", 65535.0), ("motor_load_pct", 300.0), ("fan_on", 255.0)],
)
def test_a_wrong_reading_of_a_channel_that_is_switched_goes_alone(column, value):
    """Neither the minutes of switching hide it, however many they are, nor does it take them with it."""
    for row in (123, 777, 1350):
        values = parts()[column]
        values[row] = value
        assert wild_rows(column, values) == ([row], ["wild_readings"])


def test_a_level_is_where_a_channel_stays_or_comes_again():
    pump = np.zeros(N)  # a pump that lubricates for a minute an hour has no other minutes to compare
    pump[30::60] = 1.0
    assert wild_rows("lubrication_on", pump) == ([], [])
    once = np.zeros(N)
    once[700] = 1.0
    assert wild_rows("lubrication_on", once) == ([700], ["wild_readings"])
    speed = np.repeat(np.tile([0.0, 3000.0, 6000.0], N // 300 + 1), 100)[:N]
    tool = speed.copy()
    tool[[150, 450, 750, 1050]] = 8000.0  # a tool of one minute in each part
    assert wild_rows("spindle_rpm", tool) == ([], [])
    fault = speed.copy()
    fault[[150, 450, 750, 1050]] = 65535.0  # a code that comes again is farther out than all else reaches
    assert wild_rows("spindle_rpm", fault) == ([150, 450, 750, 1050], ["wild_readings"])


def test_what_does_not_switch_has_wrong_readings_within_its_range_too():
    """A humidity drifts over a range; a coolant is let in colder all at once: heat goes nowhere for a minute."""
    rng = np.random.default_rng(8)
    drift = 50.0 + 10.0 * np.sin(np.arange(N) / 230.0)
    humidity = drift + rng.normal(0.0, 0.1, N)
    humidity[300] -= 12.0
    assert wild_rows("humidity_pct", humidity) == ([300], ["wild_readings"])
    for column in ("coolant_degc", "t_q_degc", "y_um"):
        values = 20.0 + 40.0 * (np.arange(N) >= 900) + rng.normal(0.0, 0.03, N)
        values[300] += 40.0
        assert wild_rows(column, values) == ([300], ["wild_readings"])


def clipped(limit=40.0, **changes):
    table = machine(**changes)
    table["t_q_degc"] = np.minimum(table["t_q_degc"], limit)
    return table


def test_a_temperature_at_the_end_of_its_range_is_refused_with_times_and_share():
    table = clipped()
    count = int(np.sum(table["t_q_degc"] == 40.0))
    assert count > 100
    data = measurements(table, "day")
    with pytest.raises(
        DataError, match=rf"t_q_degc stands at exactly 40, .* in {count} of {N} samples \(.* first from t_s"
    ):
        runs_in(data)
    assert "at_limit" in {remark.code for remark in tc.simulate("quill", table).remarks}


def test_another_channel_at_the_end_of_its_range_is_not_used_there():
    table = machine()
    table["y_um"] = np.minimum(table["y_um"], 50.0)
    (one,) = measurements(table, "day")
    y = one.at_period(60.0).records[0].columns["y_um"]
    assert np.isnan(y[table["y_um"] == 50.0]).all() and np.nanmax(y) < 50.0
    runs_in([one])


@pytest.mark.parametrize(("low", "high"), [(10.0, 50.0), (15.0, 35.0), (5.0, 60.0)])
def test_a_channel_that_is_cut_off_at_both_ends_is_used_at_neither(low, high):
    table = machine()
    table["second_um"] = np.clip(table["y_um"], low, high)
    (one,) = measurements(table, "day")
    data = one.at_period(60.0)
    values = data.records[0].columns["second_um"]
    cut = np.isin(table["second_um"], (low, high))
    assert np.array_equal(np.isnan(values), cut) and 100 < cut.sum() < N
    [said_of_it] = [str(remark) for remark in data.remarks]
    assert f"exactly {low:g} or {high:g}, the ends of what it shows, in {cut.sum()} of {N}" in said_of_it


@pytest.mark.parametrize("step", [0.1, 0.5, 1.0])
def test_a_coarse_sensor_is_not_at_the_end_of_its_range(step):
    for seed in range(5):
        table = machine(seed=seed)
        for name in ("t_q_degc", "at_degc"):
            assert stand_at_limit(np.round(table[name] / step) * step) is None


def test_a_machine_at_rest_a_switch_and_a_speed_are_not_at_the_end_of_their_range():
    rng = np.random.default_rng(0)
    rest = 20.0 + 15.0 * np.exp(-np.arange(N) / 60.0)
    for values in (rest, np.round(rest, 1), np.round(rest + rng.normal(0.0, 0.02, N), 1), np.full(N, 21.0)):
        assert stand_at_limit(values) is None
    assert not said(machine()) & {"at_limit", "wild_readings", "unit_changes"}
    # Readings of 0.1 K, six a minute, of a machine that rests for half of the time.
    table = machine(seed=5)
    fine = np.repeat(np.where(np.arange(N) < N // 2, table["t_q_degc"], table["t_q_degc"][0]), 6)
    means = np.round(fine + rng.normal(0.0, 0.01, fine.size), 1).reshape(-1, 6).mean(axis=1)
    assert stand_at_limit(means) is None


@pytest.mark.parametrize(("unit", "factor", "shift"), [("K", 1.0, 273.15), ("°F", 1.8, 32.0)])
def test_a_unit_that_changes_on_the_way_is_said(unit, factor, shift):
    table = machine()
    coolant = 22.0 + np.sin(np.arange(N) / 90.0) + np.random.default_rng(7).normal(0.0, 0.03, N)
    table["coolant_degc"] = np.where(np.arange(N) < 600, coolant, factor * coolant + shift)
    _, remarks = cleaned("day", [SampledRecord(table.pop("t_s"), table)])
    (one,) = [remark for remark in remarks if remark.code == "unit_changes"]
    assert "coolant_degc jumps" in one and "t_s = 36000" in one and unit in one
