"""Duties, sensors and the world around them: by seed, in order, from several threads."""

import ast
import threading
from pathlib import Path

import numpy as np
import pytest

import sim_hardware.physics
from sim_hardware.physics import Duty, PublishedQuill, QuillMachine, Sensor, SensorSpec, World


def test_paper_duties_have_the_papers_heat():
    calibration, validation = Duty.paper_calibration(), Duty.paper_validation()
    heat = calibration.columns["heat_w"]
    assert calibration.duration_s == 12 * 3600.0
    assert set(heat) == {0.0, 90.0}
    assert (heat > 0.0).sum() * 10.0 == 6 * 3600.0
    levels = validation.columns["heat_w"]
    assert levels[np.r_[True, np.diff(levels) != 0.0]].tolist() == [0.0, 60.0, 30.0, 90.0, 0.0]
    air = calibration.columns["ambient_degc"]
    assert air[0] == 20.0
    assert 0.5 < np.ptp(air) < 3.0


def test_working_day_is_by_seed_and_plausible():
    day, same, other = Duty.working_day(3), Duty.working_day(3), Duty.working_day(4)
    for name, column in day.columns.items():
        np.testing.assert_array_equal(column, same.columns[name])
        assert not np.array_equal(column, other.columns[name]), name
    assert day.columns["heat_w"].max() <= 90.0
    assert 5 < np.count_nonzero(np.diff(day.columns["heat_w"])) < 60
    assert np.all(day.columns["spindle_rpm"][day.columns["coolant_flow_lpm"] > 0.0] > 0.0)
    assert 14.0 < day.columns["coolant_degc"].min() < day.columns["coolant_degc"].max() < 24.0
    assert 16.0 < day.columns["ambient_degc"].min() < day.columns["ambient_degc"].max() < 23.0


def test_duty_holds_its_inputs_and_its_end():
    duty = Duty.paper_calibration()
    assert duty.at(1799.9).heat_w == 0.0
    assert duty.at(1800.0).heat_w == 90.0
    assert duty.at(1e9).heat_w == 0.0


def test_channels_that_carry_nothing_change_nothing():
    duty = Duty.working_day(5, hours=4.0)
    bare = Duty(duty.duration_s, **{k: v for k, v in duty.columns.items() if k not in duty.extra_names})
    assert duty.extra_names == ["cabinet_degc", "hydraulic_bar"]
    runs = [World(QuillMachine(), d) for d in (duty, bare)]
    for world in runs:
        world.advance_to(duty.duration_s)
    np.testing.assert_array_equal(runs[0].history()["y_um"], runs[1].history()["y_um"])
    assert np.std(runs[0].history()["cabinet_degc"]) > 0.1


def test_sensor_noise_bias_steps():
    sensor = Sensor(SensorSpec(bias=0.3, noise_std=0.05, quantum=0.02), seed=1)
    readings = np.array([sensor.read(20.0) for _ in range(20_000)])
    assert readings.mean() == pytest.approx(20.3, abs=0.002)
    assert readings.std() == pytest.approx(0.05, rel=0.05)
    np.testing.assert_allclose(readings / 0.02, np.round(readings / 0.02), atol=1e-6)


def test_sensor_wild_readings_and_dropouts_are_rare():
    sensor = Sensor(SensorSpec(outlier_share=0.01, outlier_size=50.0, dropout_share=0.02), seed=2)
    readings = np.array([sensor.read(20.0) for _ in range(20_000)])
    assert np.isnan(readings).mean() == pytest.approx(0.02, abs=0.004)
    assert (np.abs(readings - 20.0) > 0.1).mean() == pytest.approx(0.01, abs=0.003)
    assert np.nanmax(np.abs(readings - 20.0)) > 40.0
    many = Sensor(SensorSpec(outlier_share=0.01, outlier_size=50.0, dropout_share=0.02), seed=2)
    rows = many.read_many(np.full(20_000, 20.0), 1.0)
    assert np.isnan(rows).mean() == pytest.approx(0.02, abs=0.004)


def test_sensor_lag():
    sensor = Sensor(SensorSpec(lag_s=10.0))
    assert sensor.read(20.0, 0.0) == 20.0
    assert sensor.read(30.0, 10.0) == pytest.approx(30.0 - 10.0 * np.exp(-1.0))
    with pytest.raises(ValueError, match="time"):
        sensor.read(20.0)


def test_channels_draw_apart_and_by_seed():
    def readings(seed, name):
        sensor = Sensor(SensorSpec(noise_std=1.0), seed, name)
        return [sensor.read(0.0) for _ in range(50)]

    assert readings(1, "t_q_degc") == readings(1, "t_q_degc")
    assert readings(1, "t_q_degc") != readings(2, "t_q_degc")
    assert readings(1, "t_q_degc") != readings(1, "at_degc")


def test_record_is_by_seed_whatever_was_read_before():
    duty = Duty.working_day(1, hours=3.0)
    quiet, read = (World(PublishedQuill(), duty, seed=7) for _ in range(2))
    for _ in range(10):
        read.source("y_um")()
    first, second = quiet.record(), read.record()
    other = World(PublishedQuill(), duty, seed=8).record()
    assert len(first["t_s"]) == 180
    for name, column in first.items():
        np.testing.assert_array_equal(column, second[name])
    assert not np.array_equal(first["y_um"], other["y_um"])


def test_record_averages_its_readings():
    duty = Duty.step(heat_w=0.0, hours=10.0)
    table = World(QuillMachine(), duty, {"y_um": SensorSpec(noise_std=0.6)}, seed=1).record()
    assert table["y_um"].std() == pytest.approx(0.6 / np.sqrt(60.0), rel=0.15)
    gone = World(QuillMachine(), duty, {"y_um": SensorSpec(dropout_share=1.0)}).record(until_s=600.0)
    assert np.isnan(gone["y_um"]).all()
    assert len(gone["y_um"]) == 10


def test_record_can_be_continued():
    duty = Duty.step(hours=3.0)
    exact = {"y_um": SensorSpec()}
    whole = World(PublishedQuill(), duty, exact).record()["y_um"]
    world = World(PublishedQuill(), duty, exact)
    parts = [world.record(until_s=3600.0)["y_um"], world.record()["y_um"]]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_world_goes_forward_only_in_steps_of_ten_seconds():
    world = World(QuillMachine(), Duty.step())
    world.advance_to(3.0)
    world.advance_to(47.0)
    assert world.history()["t_s"].tolist() == [0.0, 3.0, 10.0, 20.0, 30.0, 40.0, 47.0]
    with pytest.raises(ValueError, match=r"47\.0"):
        world.advance_to(46.0)
    with pytest.raises(ValueError, match="nothing_degc"):
        World(QuillMachine(), Duty.step(), {"nothing_degc": SensorSpec()})


def test_inputs_switch_on_time_however_the_world_is_advanced():
    duty = Duty.paper_calibration()
    coarse, fine = World(QuillMachine(), duty), World(QuillMachine(), duty)
    coarse.advance_to(7200.0)
    for k in range(7200):
        fine.advance_to(k + 1.0)
    assert fine.truth("y_um") == pytest.approx(coarse.truth("y_um"), abs=0.05)


def test_sources_read_from_other_threads_see_a_whole_world():
    world = World(QuillMachine(), Duty.step(), {"t_q_degc": SensorSpec(), "y_um": SensorSpec()})
    seen, stop = [], threading.Event()
    source = world.source("t_q_degc")

    def poll():
        while not stop.is_set():
            seen.append(source())

    thread = threading.Thread(target=poll)
    thread.start()
    try:
        for minute in range(1, 61):
            world.advance_to(60.0 * minute)
    finally:
        stop.set()
        thread.join()
    truth = set(world.history()["t_q_degc"].tolist())
    assert seen
    assert set(seen) <= truth
    assert seen == sorted(seen)


def test_the_witness_is_independent():
    for path in Path(sim_hardware.physics.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not {n.split(".")[0] for n in names} & {"drivers", "compensator"}, path
