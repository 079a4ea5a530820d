"""Ten days of the demo: what happens to the machines, what is counted, and what the page says of it."""

import dataclasses
import html
import math

import numpy as np
import pytest

from compensator.demo import ten_days as demo
from compensator.demo.offline import probe_of, sample_of
from compensator.events import EventKind, LoopAction, LoopData
from compensator.messages import SCHEMA, Event, Offset
from compensator.report.page import html_of
from compensator.report.ten_days import DAYS, MachineDays, days_page, days_table, days_verdict
from compensator.service.loop.run import Diagnosed, OfflineLoop
from sim_hardware.physics import QuillMachine, World, usual_sensors

HOUR_NS = 3_600_000_000_000
T_H = np.arange(DAYS * 24) + 0.5


def decided(t_h, action, **data):
    return Event(
        schema=SCHEMA,
        machine="m",
        seq=1,
        time_utc_ns=round(t_h * HOUR_NS),
        kind=EventKind.LOOP,
        text=f"{action} told",
        data=LoopData(step=action, **data).table(),
    )


def made(**changes):
    acts = np.where(demo.TIMES.first_begins_h <= T_H, 1.0, 0.0)
    found = MachineDays(
        name="sensor",
        is_probed=False,
        times=demo.TIMES,
        start_ns=0,
        t_h=T_H,
        first_um=5.0 * acts,
        loop_um=np.where(T_H > 80.0, 0.5, 5.0) * acts,
        model_sha256=["a"] * T_H.size,
        events=[decided(70.0, LoopAction.SHADOW), decided(80.0, LoopAction.ADOPT, effects=["input:spindle_rpm"])],
    )
    return dataclasses.replace(found, **changes)


def test_the_error_of_a_day_is_that_of_its_samples():
    by_day = made().by_day(made().first_um)
    assert by_day.shape == (DAYS,)
    assert by_day[:2].tolist() == [0.0, 0.0]
    assert by_day[2] == pytest.approx(5.0 * math.sqrt(22 / 24))  # The effect begins at the second hour of day 3.
    assert by_day[3:].tolist() == [5.0] * 7


def test_the_page_names_what_happens_and_what_was_decided():
    text = html.unescape(html_of(days_page([made()])))
    assert "Day 3, hour 2" in text and "the couple of T_Q breaks, for 1 h" in text
    assert "input:spindle_rpm" in text and "nothing was adopted from a broken couple" in text
    assert "Passed" in text
    assert days_table([made()]).text().count("\n") == DAYS + 1
    assert "from 5.0 to" in days_verdict([made()])


def test_a_change_from_a_broken_couple_is_no_success():
    broken_h = demo.TIMES.break_h
    for t_h, began_h, count in ((0.5, -9.0, 1), (2.0, 0.5, 1), (2.0, -9.0, 0), (9.0, 0.5, 0)):
        since_ns = round((broken_h + began_h) * HOUR_NS)
        adopted = made(events=[*made().events, decided(broken_h + t_h, LoopAction.ADOPT, since_utc_ns=since_ns)])
        assert len(adopted.during_break()) == count
        assert ("1 change(s) came from a broken couple" in days_verdict([adopted])) is (count == 1)
        assert days_page([adopted]).tone == ("warn" if count else "good")
    assert days_page([made(loop_um=made().first_um * 1.1)]).tone == "warn"


def test_days_on_which_the_loop_does_harm_are_said():
    worse = made(loop_um=np.where(T_H > 216.0, 6.0, made().loop_um))
    text = days_verdict([worse])
    assert text.endswith("on the machine with a displacement sensor: day 10 (6.0 instead of 5.0 µm).")
    assert days_page([worse]).tone == "warn" and "Worse" not in days_verdict([made()])


def test_the_table_says_when_an_effect_begins_and_ends():
    table = days_table([made()]).text()
    assert "bearing from hour 2 " in table and "bearing until hour 2, fan motor " in table


@pytest.fixture(scope="module")
def short():
    """The record of one day of the demo, with its effects at the hours 6 to 18 and from 12 on."""
    times = dataclasses.replace(
        demo.TIMES, first_begins_h=6.0, second_begins_h=12.0, break_h=20.0, repaired_h=21.0, first_ends_h=18.0
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "TIMES", times)
        patch.setattr(demo, "DAYS", 1)
        yield demo._record(3)


def test_the_effects_act_when_they_are_told_to(short):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "DAYS", 1)
        duty = demo._duty(3)
    world = World(QuillMachine(), duty, usual_sensors(duty.extra_names), 3)
    world.advance_to(24 * 3600.0)
    past = world.history()
    healthy = past["y_um"][1 : 1 + 6 * 1440].reshape(1440, 6).mean(axis=1)
    part = short.true_um - healthy
    np.testing.assert_allclose(part[: 6 * 60], 0.0, atol=1e-9)
    assert np.ptp(part[6 * 60 : 12 * 60]) > 1.0
    read = short.columns["t_q_degc"]
    assert np.isnan(read[20 * 60 : 21 * 60]).all() and np.isfinite(np.delete(read, np.s_[20 * 60 : 21 * 60])).all()


@pytest.mark.parametrize("is_probed", [False, True])
def test_a_machine_runs_with_its_sensor_or_its_probes(short, is_probed):
    config = demo._config("test", is_probed=is_probed)
    samples = demo._samples("test", config, short, is_probed=is_probed, seed=3)
    asked = []

    def diagnose(record, model):
        asked.append(len(record))
        return Diagnosed("adequate", (), None, "nothing")

    from compensator.model.model_file import read_model_bytes

    outcomes, events = demo._looped(OfflineLoop(config, read_model_bytes("quill"), diagnose), samples)
    assert len(outcomes) == 1440
    # 20 h after the start at 06:00 it is 02:00; with probes also 12 h before. And after the effects have shown for 3 h.
    assert asked == ([480, 1200, 1320] if is_probed else [859, 1039, 1200])
    assert {event.kind for event in events} == {"loop", "diagnosis"}
    probes = [probe for outcome in outcomes for probe in outcome.probes]
    assert len(probes) == (23 if is_probed else 0)
    assert ("y_um" in samples[0][0].channels) is not is_probed
    error = demo._error(outcomes, short.true_um)
    assert abs(error[0]) < 1.0 and np.std(error[: 6 * 60]) < 3.0


def test_a_probe_shows_the_deformation_with_the_offset_that_acts():
    offset = Offset(
        schema=SCHEMA, machine="m", seq=1, time_utc_ns=0, valid_for_s=150.0, y_offset_um=-10.0,
        y_offset_rate_um_per_min=-2.0, y_offset_std_um=1.0, state="ok", reasons=[], model_sha256="",
    )  # fmt: skip
    probe = probe_of(12.0, offset, 30_000_000_000)
    assert probe.request.offset_applied_um == pytest.approx(-11.0)
    assert probe.request.measured_um == pytest.approx(1.0)
    assert probe_of(12.0, None, 0) is None


def test_a_broken_couple_is_missing_and_never_zero():
    channel = sample_of("m", 0, 0, {"t_q_degc": math.nan}, period_s=60.0).channels["t_q_degc"]
    assert math.isnan(channel.mean) and not channel.is_good and channel.device_quality == "open_circuit"
