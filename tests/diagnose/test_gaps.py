"""What a record does not have: T_Q for some minutes, a channel for hours, the time before it began."""

import dataclasses
import functools

import numpy as np
import pytest

import compensator as tc
from compensator.data.measurement import read
from tests.diagnose.scenarios import draw, record
from tests.diagnose.test_sparse_y import STD_UM, probed
from tests.diagnose.test_warm_start import diagnosed, warm

HOURS = 44.0


def frame(columns, **changes):
    return {"t_s": 60.0 * np.arange(columns["y_um"].size)} | columns | changes


def without(values, first, last):
    values = np.array(values)
    values[first:last] = np.nan
    return values


def found_in(why):
    return [(effect.kind, effect.path, effect.channel) for effect in why.effects]


@functools.cache
def with_an_input(hours=HOURS):
    """Return the record of a machine with an input, and its diagnosis."""
    columns, _, _ = record([draw("input", 3, 5.0)], 7, hours)
    return columns, tc.diagnose("quill", frame(columns))


@pytest.mark.parametrize(("first", "minutes"), [(1500, 30), (480, 45), (900, 300)])
def test_an_unknown_heat_while_t_q_is_missing_is_no_effect(first, minutes):
    """A line between its ends is no course of the heat; what it leaves in Y looked like a step or a hidden source."""
    columns, _, _ = record([draw("none", 1)], 6, HOURS)
    why = tc.diagnose("quill", frame(columns, t_q_degc=without(columns["t_q_degc"], first, first + minutes)))
    assert why.verdict == "adequate" and not why.effects


def test_the_effect_beside_such_a_hole_is_found():
    columns, _, _ = record([draw("gain DTF", 2, 5.0)], 6, HOURS)
    holes = without(without(columns["t_q_degc"], 700, 745), 1500, 1530)
    whole, why = (tc.diagnose("quill", frame(columns, **more)) for more in ({}, {"t_q_degc": holes}))
    assert found_in(why) == found_in(whole) == [("gain", "DTF", None)]
    assert why.effects[0].effect.change == pytest.approx(whole.effects[0].effect.change, rel=0.05)


def test_y_counts_from_one_zero_before_and_after_t_q_was_missing_for_hours():
    """As two records, each about its own mean, they showed a slope of each and half of the drift."""
    columns, _, _ = record([draw("drift", 2, 4.0)], 6, HOURS)
    why = tc.diagnose("quill", frame(columns, t_q_degc=without(columns["t_q_degc"], 900, 1200)))
    assert why.verdict == "explained" and found_in(why) == [("drift", None, None)]
    assert [remark.code for remark in why.remarks] == ["temperature_missing"]
    assert "t_q_degc is missing for 5.0 h from t_s = 54000; Y is left out there" in why.remarks[0]
    # Without Y in between nobody knows whether it still counts from the same zero.
    beside = tc.diagnose(
        "quill", frame(columns, **{name: without(columns[name], 900, 1200) for name in ("t_q_degc", "y_um")})
    )
    assert "the record is split there" in beside.remarks[0] and beside.diagnosis.evidence.zeros.shape[1] == 2


@pytest.mark.parametrize(("first", "count"), [(5, 0), (1500, 2)])
def test_a_zero_whose_probes_all_lie_in_a_hole_shows_nothing(first, count):
    """The mean of none as its level ended the search with an error."""
    columns = probed("none", 1, every=15)
    measured = read(columns | {"t_q_degc": without(columns["t_q_degc"], first, first + 50)})
    zeros_s = [60.0 * at + 20.0 for at in (first - 1, first + 50) if at > 5]
    measured = dataclasses.replace(measured, table=dataclasses.replace(measured.table, zeros_s=tuple(zeros_s)))
    why = tc.diagnose("quill", measured, y_std_um=STD_UM)
    assert why.verdict == "adequate" and why.diagnosis.evidence.zeros.shape[1] == max(count, 1)


def test_probes_that_are_alone_about_a_zero_are_counted():
    measured = read(columns := probed("none", 1, every=15))
    at_s = columns["t_s"][np.isfinite(columns["y_um"])]
    measured = dataclasses.replace(
        measured, table=dataclasses.replace(measured.table, zeros_s=tuple(at_s[:10] - 400.0))
    )
    why = tc.diagnose("quill", measured, y_std_um=STD_UM)
    (remark,) = [remark for remark in why.remarks if remark.code == "zeros_left_out"]
    assert "9 probe(s) left out" in remark


@pytest.mark.parametrize(("first", "last"), [(0, 300), (400, 700)])
def test_a_channel_that_is_missing_for_hours_is_not_searched_and_said(first, last):
    """A line through such a gap is another channel than the service has."""
    columns, found = with_an_input(20.0)
    (channel,) = [effect.channel for effect in found.effects]
    why = tc.diagnose("quill", frame(columns, **{channel: without(columns[channel], first, last)}))
    assert channel not in [effect.channel for effect in why.effects]
    (remark,) = [remark for remark in why.remarks if remark.code == "column_missing"]
    assert f"{channel} is missing for {(last - first) / 60.0:.1f} h" in remark


@pytest.mark.parametrize(("first", "last"), [(0, 300), (900, 1500), (2340, 2640)])
def test_while_a_channel_of_the_model_is_missing_y_says_nothing(first, last):
    """What its effect adds is not known; a right model lacked a source that no channel shows."""
    machine = [draw("input", 3, 5.0)]
    base = with_an_input()[1].model
    (channel,) = base.channels
    columns, _, _ = record(machine, 8, HOURS)
    why = tc.diagnose(base, frame(columns, **{channel: without(columns[channel], first, last)}))
    assert why.verdict == "adequate" and not why.effects
    assert not why.diagnosis.evidence.used[first:last].any()


def test_a_record_that_begins_warm_may_lack_the_channel_by_which_the_model_is_scheduled():
    columns, base = warm("scheduled")[1], diagnosed("scheduled").model
    (channel,) = base.channels
    why = tc.diagnose(base, frame(columns, **{channel: without(columns[channel], 600, 720)}))
    assert why.diagnosis.evidence.count < columns["y_um"].size - 119


def test_a_channel_that_one_of_several_recordings_lacks_is_said():
    columns, found = with_an_input(20.0)
    channel = found.effects[0].channel
    other = {name: values for name, values in record([draw("input", 3, 5.0)], 8, 12.0)[0].items() if name != channel}
    why = tc.diagnose("quill", [frame(columns), frame(other)])
    (remark,) = [remark for remark in why.remarks if remark.code == "column_missing"]
    assert f"{channel} is missing for 12.0 h" in remark


@pytest.mark.parametrize("begin", [480, 900])
def test_a_right_model_with_an_effect_that_counts_from_rest_lacks_nothing_where_a_record_begins_warm(begin):
    """Its effect, counted from a warm start, is another one: a gain of +21 % was deployed for it."""
    machine = [draw("nonlinear", 2, 4.0)]
    columns, _, _ = record(machine, 5, 36.0)
    base = tc.diagnose("quill", frame(columns)).model
    assert [effect.kind for effect in base.effects] == ["nonlinear"]
    warm = {name: values[begin:] for name, values in record(machine, 6, HOURS)[0].items()}
    why = tc.diagnose(base, frame(warm, y_um=warm["y_um"] - warm["y_um"][0]))
    assert why.model.effects == base.effects and not why.effects


def test_the_held_out_error_of_a_warm_start_has_not_seen_what_was_held_out():
    """What the initial state is, each search without a block finds by itself."""
    warm = {name: values[480:] for name, values in record([draw("nonlinear", 2, 4.0)], 6, HOURS)[0].items()}
    why = tc.diagnose("quill", frame(warm, y_um=warm["y_um"] - warm["y_um"][0]))
    assert why.diagnosis.evidence.has_initial_state and [effect.kind for effect in why.effects] == ["nonlinear"]
    # 0.61 with what all data say of it; noise is 0.3.
    assert why.diagnosis.after.rms_um > 1.0
