"""Records become runs: gaps, wild readings, noise, reference, other channels."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.data.cleaning import cleaned, without_outliers
from compensator.data.record import SHORT_GAP_SAMPLES, SampledRecord
from compensator.data.runs import SHORTEST_RUN, is_noise, noise_of, noise_std, runs_of, walk_std

N = 600


def columns(seed=0):
    rng = np.random.default_rng(seed)
    heat = np.where((np.arange(N) >= 60) & (np.arange(N) < 300), 90.0, 0.0)
    at = 21.0 + 0.5 * np.sin(np.arange(N) / 200.0) + rng.normal(0.0, 0.02, N)
    rise = np.where(np.arange(N) >= 60, 10.0 * (1.0 - np.exp(-(np.arange(N) - 60) / 40.0)), 0.0)
    t_q = at + 1.5 + rise + rng.normal(0.0, 0.02, N)
    return {"t_q_degc": t_q, "at_degc": at, "y_um": 4.0 * rise + rng.normal(0.0, 0.3, N), "heat_w": heat}


def runs(c, name="day.csv"):
    return list(runs_of(name, SampledRecord(t_s=np.arange(N) * 60.0, columns=c)))


@pytest.mark.parametrize("column", ["t_q_degc", "at_degc", "heat_w"])
def test_the_longest_gap_that_is_bridged(column):
    c = columns()
    c[column] = c[column].copy()
    c[column][200 : 200 + SHORT_GAP_SAMPLES] = np.nan
    (run,) = runs(c)
    assert run.name == "day.csv"
    assert run.t_s.size == N
    assert np.isfinite(run.difference_k).all() and np.isfinite(run.ambient_k).all()
    c[column][200 : 201 + SHORT_GAP_SAMPLES] = np.nan
    parts = list(runs(c))
    assert [run.name for run in parts] == ["day.csv part 1", "day.csv part 2"]
    assert [run.t_s.size for run in parts] == [200, N - 201 - SHORT_GAP_SAMPLES]
    assert parts[1].t_s[0] == (201 + SHORT_GAP_SAMPLES) * 60.0


def test_a_bridge_is_straight():
    c = columns()
    c["heat_w"] = np.linspace(0.0, 599.0, N)
    c["heat_w"][100:150] = np.nan
    (run,) = runs(c)
    assert run.heat_w == pytest.approx(np.arange(N), abs=1e-9)


def test_every_part_has_its_own_reference():
    c = columns()
    c["at_degc"][300:400] = np.nan
    c["at_degc"][400:] += 3.0
    first, second = runs(c)
    assert second.reference[1] - first.reference[1] > 2.0
    assert abs(first.ambient_k[0]) < 0.1 and abs(second.ambient_k[0]) < 0.1


def test_absolute_temperatures_come_back():
    c = columns()
    (run,) = runs(c)
    assert run.t_q_degc == pytest.approx(c["t_q_degc"], abs=1e-9)
    assert run.at_degc == pytest.approx(c["at_degc"], abs=1e-9)


def test_missing_ends_and_crumbs_are_left_out():
    c = columns()
    c["t_q_degc"][:70] = np.nan
    c["t_q_degc"][-5:] = np.nan
    (run,) = runs(c)
    assert (run.t_s[0], run.t_s.size) == (70 * 60.0, N - 75)
    c = columns()
    c["at_degc"][SHORTEST_RUN - 1 : 200] = np.nan
    (run,) = runs(c)
    assert run.t_s[0] == 200 * 60.0


def test_nothing_measured_gives_no_run():
    c = columns()
    c["at_degc"] = np.full(N, np.nan)
    assert runs(c) == []


def test_the_reference_ends_where_the_heat_begins():
    c = columns()
    c["heat_w"] = np.where(np.arange(N) >= 10, 90.0, 0.0)
    (run,) = runs(c)
    assert run.reference[0] == pytest.approx(np.mean(c["t_q_degc"][:10]), abs=1e-12)


def test_other_channels_come_along_and_the_roles_do_not():
    c = columns() | {"spindle_rpm": np.arange(float(N))}
    c["spindle_rpm"][5] = np.nan
    (run,) = runs(c)
    assert set(run.channels) == {"spindle_rpm"}
    assert run.channels["spindle_rpm"][5] == pytest.approx(5.0)


def test_heat_is_never_cleaned():
    c = columns()
    c["heat_w"][450] = 90.0
    (record,), remarks = cleaned("day.csv", [SampledRecord(t_s=np.arange(N) * 60.0, columns=c)])
    assert record.columns["heat_w"][450] == 90.0
    assert remarks == ()


@pytest.mark.parametrize("size", [4.0, -4.0])
def test_wild_readings_of_either_sign_go(size):
    values = np.random.default_rng(1).normal(0.0, 0.05, 400)
    values[[50, 120, 300]] += size
    cleaned, count = without_outliers(values)
    assert count == 3
    assert np.flatnonzero(np.isnan(cleaned)).tolist() == [50, 120, 300]
    assert not np.isnan(values).any()


def test_a_step_a_ramp_and_a_pulse_of_two_samples_stay():
    noise = np.random.default_rng(2).normal(0.0, 0.05, 400)
    step, ramp, pulse = noise.copy(), noise + np.arange(400) * 0.1, noise.copy()
    step[200:] += 20.0
    pulse[200:202] += 20.0
    for values in (step, ramp, pulse):
        assert without_outliers(values)[1] == 0


def test_two_wild_readings_in_a_row_go_where_a_signal_is_slow():
    """One disturbance in two samples: −58 K and −20 K in T_Q. Three in a row are something that happens."""
    c = columns()
    c["t_q_degc"] = 25.0 + np.random.default_rng(2).normal(0.0, 0.02, N)
    c["t_q_degc"][200:202] -= [58.0, 20.0]
    c["t_q_degc"][300:303] -= 20.0
    (record,), [remark] = cleaned("day.csv", [SampledRecord(t_s=np.arange(N) * 60.0, columns=c)])
    assert np.flatnonzero(np.isnan(record.columns["t_q_degc"])).tolist() == [200, 201]
    assert "t_q_degc: 2 outlier(s)" in remark


@pytest.mark.parametrize("tau_min", [1.0, 2.5])
def test_a_couple_that_is_heated_for_two_minutes_is_no_disturbance(tau_min):
    heat = np.zeros(4 * 7200)  # four readings a minute, whose means are the record
    for first in range(400, heat.size, 661):
        heat[first : first + 8] = 15.0
    keep = np.exp(-0.25 / tau_min)
    means = lfilter([1.0 - keep], [1.0, -keep], heat).reshape(-1, 4).mean(axis=1)
    values = 20.0 + means + np.random.default_rng(5).normal(0.0, 0.02, 7200)
    assert without_outliers(values, in_a_row=2)[1] == without_outliers(values)[1]
    assert without_outliers(values, first=True, last=True, in_a_row=2)[1] == without_outliers(values)[1]


def test_two_readings_between_gaps_are_no_disturbance():
    apart = 20.0 + np.random.default_rng(6).normal(0.0, 0.02, 600)
    apart[200:300] = apart[302:400] = np.nan
    apart[300:302] = 25.0
    assert without_outliers(apart, in_a_row=2)[1] == 0


def test_every_reading_that_is_left_out_counts_once():
    values = np.zeros(1000)
    values[500:502] = [50.0, 1000.0]
    assert without_outliers(values, in_a_row=2)[1] == 2


def test_a_signal_full_of_spikes_is_a_signal():
    values = np.random.default_rng(3).normal(0.0, 0.01, 400)
    values[10::15] += 5.0
    assert without_outliers(values)[1] == 0


def test_a_wild_reading_beside_a_gap_does_not_hide():
    values = np.random.default_rng(4).normal(0.0, 0.05, 400)
    values[100:110] = np.nan
    values[110] = 6.0
    cleaned, count = without_outliers(values)
    assert count == 1
    assert np.isnan(cleaned[110])


def test_noise_is_that_of_the_samples_whatever_the_signal_does():
    rng = np.random.default_rng(5)
    noise = rng.normal(0.0, 0.3, 4000)
    slow = 60.0 * np.sin(np.arange(4000) / 300.0)
    steps = np.repeat(rng.normal(0.0, 50.0, 40), 100)
    wild = np.zeros(4000)
    wild[::97] = 30.0
    for signal in (slow, steps, wild):
        assert noise_std(noise + signal) == pytest.approx(0.3, rel=0.1)


def test_noise_under_a_converter_s_steps():
    rng = np.random.default_rng(6)
    slow = np.sin(np.arange(4000) / 300.0)
    for quantum in (0.01, 0.05):
        measured = np.round((slow + rng.normal(0.0, 0.05, 4000)) / quantum) * quantum
        assert noise_std(measured) == pytest.approx(np.hypot(0.05, quantum / np.sqrt(12)), rel=0.12)
    # A coarse converter hardly ever changes: its noise is neither nothing nor more than its step.
    assert 0.0 < noise_std(np.round(slow / 0.02) * 0.02) < 0.02


def test_noise_skips_what_is_missing_and_of_nothing_is_nothing():
    noise = np.random.default_rng(7).normal(0.0, 0.3, 4000)
    noise[::9] = np.nan
    assert noise_std(noise) == pytest.approx(0.3, rel=0.1)
    assert noise_std(np.full(100, 3.0)) == 0.0
    assert noise_std(np.arange(5.0)) == 0.0


def test_noise_of_runs_is_that_of_the_noisiest_recording_and_noise_alone_is_seen():
    quiet, loud = columns(), columns(1)
    loud["y_um"] = loud["y_um"] + np.random.default_rng(9).normal(0.0, 2.0, N)
    both = [dataclasses.replace(run, recording=i) for i, c in enumerate((quiet, loud)) for run in runs(c)]
    noise = noise_of(both)
    assert noise["y_um"] == noise_std(both[1].y_um) == pytest.approx(2.0, rel=0.15)
    assert noise["t_q_degc"] == max(noise_std(run.t_q_degc) for run in both)
    assert is_noise(np.random.default_rng(10).normal(0.0, 1.0, 500)) and not is_noise(quiet["y_um"])


def test_many_short_runs_of_a_recording_have_the_noise_of_all():
    """That of the least lucky of 40 runs was half as much again, and "adequate" so much more lenient."""
    rng = np.random.default_rng(4)
    (run,) = runs(columns())
    parts = [dataclasses.replace(run, y_um=rng.normal(0.0, 0.3, 40)) for _ in range(40)]
    assert max(noise_std(part.y_um) for part in parts) > 0.4
    assert noise_of(parts)["y_um"] == pytest.approx(0.3, rel=0.1)
    assert noise_of([dataclasses.replace(part, y_std_um=1.5) for part in parts])["y_um"] == 1.5


def test_what_a_long_gap_of_a_channel_hides_is_not_known():
    c = columns() | {"oil_degc": np.linspace(20.0, 30.0, N)}
    for first, last in ((0, 30), (100, 160), (300, 361)):
        c["oil_degc"][first:last] = np.nan
    oil = runs(c)[0].channels["oil_degc"]
    assert np.flatnonzero(np.isnan(oil)).tolist() == list(range(300, 361))
    assert oil[100:160] == pytest.approx(np.linspace(20.0, 30.0, N)[100:160]) and oil[0] == oil[30]


@pytest.mark.parametrize(("every", "holes"), [(1, [(100, 110), (300, 340)]), (10, [(91, 110), (191, 210), (291, 340)])])
def test_holes_are_gaps_that_are_longer_than_usual(every, holes):
    c = columns()
    for name in ("t_q_degc", "at_degc"):
        c[name] = np.where(np.arange(N) % every == 0, c[name], np.nan)
    c["t_q_degc"][100:110], c["t_q_degc"][200:205], c["at_degc"][300:340] = np.nan, np.nan, np.nan
    assert list(runs(c)[0].holes) == holes


def test_walk_is_told_apart_from_noise_and_does_not_cross_runs():
    rng = np.random.default_rng(8)
    walks = [1000.0 * i + np.cumsum(rng.normal(0.0, 0.2, 5000)) for i in range(2)]
    measured = [walk + rng.normal(0.0, 0.1, 5000) for walk in walks]
    assert walk_std(measured, 0.1) == pytest.approx(0.2, rel=0.05)
    assert walk_std([rng.normal(0.0, 0.1, 5000)], 0.2) == 0.0
