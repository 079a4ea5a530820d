"""Data that no model can come from is refused with its reason; runs are put right before."""

import numpy as np
import pytest

from compensator.data.cleaning import cleaned, without_outliers
from compensator.data.record import SampledRecord
from compensator.data.runs import noise_std
from compensator.data.screening import screen, screen_temperatures
from compensator.errors import DataError
from tests.identify.quill_runs import CALIBRATION_W, published, runs_from


def columns(n=720):
    heat, ambient, difference, y, _, _ = published(CALIBRATION_W, 1)
    at = 21.0 + ambient
    return {"t_q_degc": (at + difference)[:n], "at_degc": at[:n], "y_um": y[:n], "heat_w": heat[:n].copy()}


def fahrenheit(values):
    return values * 1.8 + 32.0


def spoil(name):
    c = columns()
    change = {
        "heat constant": lambda: c.update(heat_w=np.full(720, 90.0)),
        "T_Q constant": lambda: c.update(t_q_degc=np.full(720, 25.0)),
        "y constant": lambda: c.update(y_um=np.zeros(720)),
        "y in mm": lambda: c.update(y_um=c["y_um"] / 1000.0),
        "y in nm": lambda: c.update(y_um=c["y_um"] * 1000.0),
        "heat in kW": lambda: c.update(heat_w=c["heat_w"] / 1000.0),
        "heat in mW": lambda: c.update(heat_w=c["heat_w"] * 1000.0),
        "AT in F": lambda: c.update(at_degc=fahrenheit(c["at_degc"])),
        "both in F": lambda: c.update(at_degc=fahrenheit(c["at_degc"]), t_q_degc=fahrenheit(c["t_q_degc"])),
        "T_Q in F": lambda: c.update(t_q_degc=fahrenheit(c["t_q_degc"])),
        "kelvin": lambda: c.update(at_degc=c["at_degc"] + 273.15, t_q_degc=c["t_q_degc"] + 273.15),
        "millidegrees": lambda: c.update(t_q_degc=c["t_q_degc"] * 1000.0),
        "kilodegrees": lambda: c.update(at_degc=c["at_degc"] / 1000.0),
        "y missing": lambda: c["y_um"].__setitem__(slice(0, 500), np.nan),
        "one sensor twice": lambda: c.update(t_q_degc=c["at_degc"]),
        "y is noise": lambda: c.update(y_um=np.random.default_rng(0).normal(0, 0.5, 720)),
        "T_Q dead from 400 on": lambda: c["t_q_degc"].__setitem__(slice(400, None), c["t_q_degc"][400]),
        "y dead for two hours": lambda: c["y_um"].__setitem__(slice(400, 520), c["y_um"][400]),
        "a fault's code": lambda: c["at_degc"].__setitem__(slice(300, 330), -9999.0),
        "T_Q and AT exchanged": lambda: c.update(t_q_degc=c["at_degc"], at_degc=c["t_q_degc"]),
        "T_Q far away": lambda: c.update(t_q_degc=c["at_degc"] + np.random.default_rng(1).normal(0, 0.1, 720)),
    }
    change[name]()
    return c


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("heat constant", "heat_w = 90 in every row"),
        ("T_Q constant", "t_q_degc = 25 in every row"),
        ("y constant", "y_um = 0 in every row"),
        ("y in mm", "millimetres"),
        ("y in nm", "nanometres"),
        ("heat in kW", "kilowatts"),
        ("heat in mW", "milliwatts"),
        ("AT in F", "°F"),
        ("both in F", "°F"),
        ("T_Q in F", "°F"),
        ("kelvin", "kelvin"),
        ("millidegrees", "thousandths"),
        ("kilodegrees", "thousands"),
        ("y missing", "y_um is missing"),
        ("one sensor twice", "the same in every row"),
        ("y is noise", "noise"),
        ("T_Q far away", "near the heat source"),
        ("T_Q dead from 400 on", "from t_s = 24000 to 43140"),
        ("y dead for two hours", "y_um = .* in every sample from t_s = 24000 to 31140"),
        ("a fault's code", "at_degc = -9999 at t_s = 18000, 30 sample"),
        ("T_Q and AT exchanged", "exchanged"),
    ],
)
def test_bad_data(name, words):
    with pytest.raises(DataError, match=words):
        screen("bad.csv", runs_from(spoil(name)), 60.0, needs_heat=True)


def test_too_short():
    with pytest.raises(DataError, match="at least 120 min"):
        screen("short.csv", runs_from(columns(100)), 60.0, needs_heat=True)


def test_good_data_passes():
    screen("good.csv", runs_from(columns()), 60.0, needs_heat=True)


def test_a_rest_without_noise_or_of_a_coarse_converter_is_no_dead_sensor():
    c = columns()
    quiet = np.concatenate((np.full(120, 21.0), 21.0 + 2.0 * np.sin(np.arange(600) / 200.0)))
    warm = np.concatenate((np.zeros(120), 15.0 * (1.0 - np.exp(-np.arange(600) / 90.0))))
    screen_temperatures("quiet.csv", runs_from(c | {"at_degc": quiet, "t_q_degc": quiet + warm}))
    coarse = np.round((c["at_degc"] - 21.0) * 0.2 + 21.0, 1)
    screen_temperatures("coarse.csv", runs_from(c | {"at_degc": coarse}))


def test_an_ambient_that_never_moves_is_let_pass_where_nothing_is_fitted_to_it():
    runs = runs_from(columns() | {"at_degc": np.full(720, 21.0)})
    screen_temperatures("quiet.csv", runs, quiet_air=True)
    with pytest.raises(DataError, match="at_degc = 21 in every row"):
        screen_temperatures("quiet.csv", runs)


def test_a_short_gap_is_bridged_and_a_long_one_splits():
    c = columns()
    c["t_q_degc"][100:130] = np.nan
    c["at_degc"][300:400] = np.nan
    runs = runs_from(c)
    assert [run.t_s.size for run in runs] == [300, 320]
    assert np.isfinite(runs[0].difference_k).all()
    assert runs[0].difference_k[115] == pytest.approx(
        (runs[0].difference_k[99] + runs[0].difference_k[130]) / 2, abs=0.3
    )


def test_a_gap_in_y_stays_a_gap():
    c = columns()
    c["y_um"][50:60] = np.nan
    assert np.isnan(runs_from(c)[0].y_um[50:60]).all()


def test_a_wild_reading_goes_and_a_step_stays():
    rng = np.random.default_rng(0)
    values = rng.normal(0.0, 0.05, 400)
    values[200:] += 5.0
    values[77] += 4.0
    cleaned, count = without_outliers(values)
    assert count == 1
    assert np.isnan(cleaned[77])
    assert np.isnan(cleaned).sum() == 1


def test_remarks_name_the_column():
    c = columns()
    c["y_um"][400] += 60.0
    _, said = cleaned("day.csv", [SampledRecord(np.arange(720) * 60.0, c)])
    assert [one.code for one in said] == ["wild_readings"] and "day.csv: y_um: 1 outlier(s) left out" in said[0]


def test_noise_is_told_apart_from_steps_and_converter_steps():
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, 0.04, 3000)
    steps = np.repeat([0.0, 10.0, -5.0, 20.0, 3.0], 600)
    assert noise_std(noise + steps) == pytest.approx(0.04, rel=0.1)
    coarse = np.round(np.linspace(0, 3, 3000) / 0.02) * 0.02
    assert 0.0 < noise_std(coarse) < 0.02


def test_the_reference_is_the_mean_of_the_rest():
    run = runs_from(columns())[0]
    assert abs(np.mean(run.difference_k[:30])) < 0.03
    assert abs(run.difference_k[0]) > 1e-6


def test_an_ambient_that_moves_ends_the_rest():
    c = columns()
    c["at_degc"] = 21.0 + 0.05 * np.arange(720)
    c["t_q_degc"] = c["at_degc"] + np.where(np.arange(720) > 100, 5.0, 0.0)
    assert abs(runs_from(c)[0].ambient_k[0]) < 0.15
