"""Records that begin on a warm machine: what is not linear in a path counts from where the machine is at rest."""

import functools

import numpy as np
import pytest

import compensator as tc
from compensator.codes import ModelWarning
from compensator.data.record import SampledRecord
from compensator.diagnose.residual.base_run import context_of
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.findings import findings_of
from compensator.diagnose.search.initial_state import as_begun
from compensator.diagnose.search.search import Search
from compensator.identify.calibration import predict
from compensator.model.effects.hypothesis import COOLEST, EQUAL, proposals
from compensator.model.model_file import load_model
from compensator.model.simulation import simulate
from tests.diagnose.scenarios import draw, record
from tests.identify.quill_runs import runs_from

QUILL = load_model("quill")
KINDS = ["nonlinear", "scheduled"]


@functools.cache
def warm(kind, *, size_um=6.0, hours=24.0):
    """A day that begins when the machine has worked for 6 to 12 h and is warm."""
    scenario = draw(kind, 5, size_um)
    columns, _, _ = record([scenario], 1305, hours + 12.0)
    above = columns["t_q_degc"] - columns["at_degc"]
    first = 360 + int(np.argmax(np.convolve(above[360:720], np.ones(5) / 5.0, mode="valid")))
    assert above[first] > 8.0
    return scenario, {name: values[first : first + int(60 * hours)] for name, values in columns.items()}


@functools.cache
def diagnosed(kind):
    """What is found in its first 16 h, with the channel that acts and another one."""
    columns = {name: warm(kind)[1][name] for name in ("t_q_degc", "at_degc", "y_um", "fan_rpm", "coolant_degc")}
    return tc.diagnose("quill", {"t_s": 60.0 * np.arange(columns["y_um"].size), **columns}, fit_until_h=16.0)


@pytest.mark.parametrize("kind", KINDS)
def test_the_effect_alone_is_named_and_holds_on_a_day_that_begins_at_rest(kind):
    scenario, found = warm(kind)[0], diagnosed(kind)
    assert [effect.place for effect in found.effects] == [scenario.place]
    fresh, true, part = record([scenario], 5305, 24.0)
    run = runs_from(fresh)[0]

    def error(model, y):
        e = y - predict(model, run)
        return float(np.mean((e - e.mean()) ** 2))

    possible = error(QUILL, true) - error(QUILL, true - part)
    assert error(QUILL, true) - error(found.model, true) > 0.97 * possible


@pytest.mark.parametrize("kind", KINDS)
def test_the_user_is_told_from_where_the_effect_counts(kind):
    said = [str(one) for one in diagnosed(kind).diagnosis.warnings if one.code == ModelWarning.WARM_START]
    assert len(said) == 1
    assert EQUAL in said[0]


def test_the_free_run_of_the_extended_model_begins_as_warm_as_the_record():
    free_run = diagnosed("nonlinear").free_run
    assert len(free_run) == 2
    for rows in free_run:
        assert rows.scores["extended model"].rms_about_mean_um < 0.5 * rows.scores["base model"].rms_about_mean_um


def test_a_machine_that_was_warmed_from_rest_predicts_the_same_where_all_is_linear():
    columns = warm("nonlinear")[1]
    data = {
        "t_s": 60.0 * np.arange(columns["y_um"].size),
        "t_q_degc": columns["t_q_degc"],
        "at_degc": columns["at_degc"],
    }
    sampled = SampledRecord(t_s=data.pop("t_s"), columns=data)
    cold, warmed = (simulate(QUILL, sampled, from_rest=from_rest)["y_pred_um"] for from_rest in (False, True))
    assert np.ptp(cold) > 50.0
    assert np.max(np.abs(warmed - warmed[0] - cold + cold[0])) < 0.1


def test_couples_that_differ_at_rest_do_not_make_a_record_warm():
    scenario = draw("nonlinear", 5, 6.0)
    columns, _, _ = record([scenario], 1305)
    columns["t_q_degc"] = columns["t_q_degc"] + 5.0
    evidence = evidence_of(QUILL, runs_from(columns))
    assert evidence.context.begins_warm
    terms = Search(evidence).run().fit.terms
    assert [(term.hypothesis.place, term.hypothesis.rest) for term in terms] == [(scenario.place, COOLEST)]


def test_after_a_long_gap_an_effect_counts_from_the_start_before_it():
    scenario = draw("nonlinear", 5, 6.0)
    columns, _, _ = record([scenario], 1305, 26.0)
    above = columns["t_q_degc"] - columns["at_degc"]
    end = 600 + int(np.argmax(above[600:1200]))
    for name in ("t_q_degc", "at_degc", "y_um"):
        columns[name][end - 90 : end] = np.nan
    runs = runs_from(columns)
    assert len(runs) == 2
    assert not evidence_of(QUILL, runs).context.begins_warm
    found = findings_of(evidence_of(QUILL, runs))
    assert [term.hypothesis.place for term in as_begun(found, findings_of).terms] == [scenario.place]


def test_a_record_that_begins_at_rest_has_no_further_hypotheses():
    columns, _, _ = record([draw("nonlinear", 5, 6.0)], 1305)
    evidence = evidence_of(QUILL, runs_from(columns))
    assert not evidence.context.begins_warm
    assert all(record_.begun(rest).begins_at_rest for record_ in evidence.signals for rest in (COOLEST, EQUAL))
    assert {hypothesis.rest for hypothesis in proposals(context_of(QUILL, evidence.signals))} == {COOLEST}
