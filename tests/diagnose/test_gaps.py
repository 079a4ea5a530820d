"""What a record does not have: T_Q for some minutes, a channel for hours, the time before it began."""

import dataclasses
import functools

import numpy as np
import pytest

import compensator as tc
from compensator.data.measurement import measurements, read, screened_runs_in
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.findings import findings_of
from compensator.diagnose.search.initial_state import as_begun
from compensator.model.effects.base import effect_from
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import draw, record
from tests.diagnose.test_sparse_y import STD_UM, probed
from tests.diagnose.test_warm_start import warm

QUILL = load_model("quill")
HOURS = 44.0
#: Machines: an effect is as strong on every day as on the first one.
WITH_AN_INPUT, WITH_A_CURVE = [draw("input", 3, 5.0)], [draw("nonlinear", 2, 4.0)]


def frame(columns, **changes):
    return {"t_s": 60.0 * np.arange(columns["y_um"].size)} | columns | changes


def without(values, first, last):
    values = np.array(values)
    values[first:last] = np.nan
    return values


def without_channels(columns, first=0):
    return {name: columns[name][first:] for name in ("t_q_degc", "at_degc", "y_um")}


def evidence_in(data, base=QUILL, **given):
    """Return the evidence that a diagnosis searches, and the remarks on its data."""
    runs, remarks = screened_runs_in(measurements(data, "data"), whole_y=True, **given)
    return evidence_of(base, runs), remarks


def searched(evidence):
    """Return what a diagnosis finds in all of the data; what held-out blocks say of it is not asked for here."""
    return as_begun(findings_of(evidence), findings_of)


def named(found):
    return [term.hypothesis.place for term in found.terms]


def lacks_nothing(found):
    return found.leaves_noise and not found.terms and found.remainder is None


def with_what_is_named(found):
    return dataclasses.replace(QUILL, effects=tuple(term.effect for term in found.terms), sha256="")


@functools.cache
def with_an_input():
    """Return the record of a machine with an input, its channel, and the model with it."""
    columns, _, _ = record(WITH_AN_INPUT, 7, 20.0)
    base = with_what_is_named(searched(evidence_in(frame(columns))[0]))
    (channel,) = base.channels
    return columns, channel, base


@pytest.mark.parametrize(("first", "minutes"), [(1500, 30), (480, 45), (900, 300)])
def test_an_unknown_heat_while_t_q_is_missing_is_no_effect(first, minutes):
    """A line between its ends is no course of the heat; what it leaves in Y looked like a step or a hidden source."""
    columns, _, _ = record([draw("none", 1)], 6, HOURS)
    evidence, _ = evidence_in(frame(columns, t_q_degc=without(columns["t_q_degc"], first, first + minutes)))
    assert lacks_nothing(searched(evidence))


def test_the_effect_beside_such_a_hole_is_found():
    columns, _, _ = record([draw("gain DTF", 2, 5.0)], 6, HOURS)
    holes = without(without(columns["t_q_degc"], 700, 745), 1500, 1530)
    whole, found = (searched(evidence_in(frame(columns, **more))[0]) for more in ({}, {"t_q_degc": holes}))
    assert named(found) == named(whole) == [("gain", "DTF", "")]
    assert found.terms[0].effect.change == pytest.approx(whole.terms[0].effect.change, rel=0.05)


def test_y_counts_from_one_zero_before_and_after_t_q_was_missing_for_hours():
    """As two records, each about its own mean, they showed a slope of each and half of the drift."""
    columns, _, _ = record([draw("drift", 2, 4.0)], 6, HOURS)
    holes = {name: without(columns[name], 900, 1200) for name in ("t_q_degc", "y_um")}
    evidence, remarks = evidence_in(frame(columns, t_q_degc=holes["t_q_degc"]))
    assert [remark.code for remark in remarks] == ["temperature_missing"]
    assert "t_q_degc is missing for 5.0 h from t_s = 54000; Y is left out there" in remarks[0]
    found = searched(evidence)
    assert named(found) == [("drift", "", "")] and found.search.criterion.leaves_noise(found.selection.fit)
    # Without Y in between nobody knows whether it still counts from the same zero.
    evidence, remarks = evidence_in(frame(columns, **holes))
    assert "the record is split there" in remarks[0] and evidence.zeros.shape[1] == 2


@pytest.mark.parametrize(("first", "count"), [(5, 0), (1500, 2)])
def test_a_zero_whose_probes_all_lie_in_a_hole_shows_nothing(first, count):
    """The mean of none as its level ended the search with an error."""
    columns = probed("none", 1, every=15)
    measured = read(columns | {"t_q_degc": without(columns["t_q_degc"], first, first + 50)})
    zeros_s = [60.0 * at + 20.0 for at in (first - 1, first + 50) if at > 5]
    measured = dataclasses.replace(measured, table=dataclasses.replace(measured.table, zeros_s=tuple(zeros_s)))
    evidence, _ = evidence_in(measured, y_std_um=STD_UM)
    assert evidence.zeros.shape[1] == max(count, 1)
    assert lacks_nothing(searched(evidence))


def test_probes_that_are_alone_about_a_zero_are_counted():
    measured = read(columns := probed("none", 1, every=15))
    at_s = columns["t_s"][np.isfinite(columns["y_um"])]
    measured = dataclasses.replace(
        measured, table=dataclasses.replace(measured.table, zeros_s=tuple(at_s[:10] - 400.0))
    )
    _, remarks = evidence_in(measured, y_std_um=STD_UM)
    (remark,) = [remark for remark in remarks if remark.code == "zeros_left_out"]
    assert "9 probe(s) left out" in remark


@pytest.mark.parametrize(("first", "last"), [(0, 300), (400, 700)])
def test_a_channel_that_is_missing_for_hours_is_not_searched_and_said(first, last):
    """A line through such a gap is another channel than the service has."""
    columns, channel, _ = with_an_input()
    evidence, _ = evidence_in(frame(columns, **{channel: without(columns[channel], first, last)}))
    assert channel not in evidence.context.channels
    assert f"{channel} is missing for 5.0 h; not searched." in evidence.no_causes[channel]
    assert evidence.no_causes[channel].code == "column_missing"


@pytest.mark.parametrize(("first", "last"), [(0, 300), (900, 1500), (2340, 2640)])
def test_while_a_channel_of_the_model_is_missing_y_says_nothing(first, last):
    """What its effect adds is not known; a right model lacked a source that no channel shows."""
    _, channel, base = with_an_input()
    columns, _, _ = record(WITH_AN_INPUT, 8, HOURS)
    evidence, _ = evidence_in(frame(columns, **{channel: without(columns[channel], first, last)}), base)
    assert not evidence.used[first:last].any() and evidence.count > 0.95 * (columns["y_um"].size - last + first)
    assert lacks_nothing(searched(evidence))


def test_a_record_that_begins_warm_may_lack_the_channel_by_which_the_model_is_scheduled():
    columns = warm("scheduled")[1]
    table = {"form": "share", "path": "DTF", "channel": "fan_rpm", "origin": "zero", "span": 3000.0, "change": 0.2}
    base = dataclasses.replace(QUILL, effects=(effect_from("scheduled", table),), sha256="")
    evidence, _ = evidence_in(frame(columns, fan_rpm=without(columns["fan_rpm"], 600, 720)), base)
    assert evidence.context.begins_warm and np.isfinite(evidence.residual).all()
    assert evidence.count < columns["y_um"].size - 119


def test_a_channel_that_one_of_several_recordings_lacks_is_said():
    first, second = (record([], seed, 12.0)[0] for seed in (7, 8))
    first = without_channels(first) | {"coolant_degc": first["coolant_degc"]}
    why = tc.diagnose(QUILL, [frame(first), frame(without_channels(second))])
    assert "coolant_degc" not in why.diagnosis.evidence.context.channels
    (remark,) = [remark for remark in why.remarks if remark.code == "column_missing"]
    assert "coolant_degc is missing for 12.0 h" in remark


@functools.cache
def with_a_curve():
    """Return the model of a machine whose path is not linear, from a record that begins at rest."""
    columns, _, _ = record(WITH_A_CURVE, 5, 36.0)
    return with_what_is_named(searched(evidence_in(frame(without_channels(columns)))[0]))


@pytest.mark.parametrize("begin", [480, 900])
def test_a_right_model_with_an_effect_that_counts_from_rest_lacks_nothing_where_a_record_begins_warm(begin):
    """Its effect, counted from a warm start, is another one: a gain of +21 % was deployed for it."""
    base = with_a_curve()
    assert [effect.kind for effect in base.effects] == ["nonlinear"]
    warm = without_channels(record(WITH_A_CURVE, 6, HOURS)[0], begin)
    evidence, _ = evidence_in(frame(warm, y_um=warm["y_um"] - warm["y_um"][0]), base)
    found = searched(evidence)
    assert not found.terms and found.remainder is None


def test_the_held_out_error_of_a_warm_start_has_not_seen_what_was_held_out():
    """What the initial state is, each search without a block finds by itself."""
    warm = without_channels(record([draw("nonlinear", 2, 4.0)], 6, HOURS)[0], 480)
    why = tc.diagnose(QUILL, frame(warm, y_um=warm["y_um"] - warm["y_um"][0]))
    assert why.diagnosis.evidence.has_initial_state and [effect.kind for effect in why.effects] == ["nonlinear"]
    # 0.61 with what all data say of it; noise is 0.3.
    assert why.diagnosis.after.rms_um > 1.0
