"""An effect that began within the record is looked for in the time since then."""

import dataclasses

import numpy as np
import pytest

import compensator as tc
from compensator.diagnose.began import began_within, explains_better
from compensator.diagnose.change import changed_at
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import draw, record

QUILL = load_model("quill")
#: As `identify` states it: a base whose paths miss 0.6 µm.
BASE = dataclasses.replace(QUILL, held_out_rms_um=0.6)
BEGAN_H = 8.3


def changed_on_the_way(scenarios, hours=24.0, began_h=BEGAN_H):
    """Columns of a day in which effects begin after some hours."""
    columns, _, _ = record([], 60, hours)
    since, _, _ = record(scenarios, 60, hours)
    hour = np.arange(columns["y_um"].size) / 60.0
    return {"t_s": 3600.0 * hour, **columns, "y_um": np.where(hour < began_h, columns["y_um"], since["y_um"])}


@pytest.fixture(scope="module")
def columns():
    return changed_on_the_way([draw("gain DTF", 2, 8.0)])


@pytest.fixture(scope="module")
def whole(columns):
    return tc.diagnose(QUILL, columns, whole=True)


@pytest.fixture(scope="module")
def why(columns):
    return tc.diagnose(QUILL, columns)


def test_it_is_named_alone_and_when_it_began_is_said(columns, why):
    assert why.verdict == "explained" and [(e.kind, e.path) for e in why.effects] == [("gain", "DTF")]
    said = why.to_dict()
    assert said["warning_codes"] == ["began_within"] and BEGAN_H < said["since_h"] < BEGAN_H + 1.0
    assert f"Something began {said['since_h']:.1f} h after the start" in why.summary()
    # Only what has been searched is shown and scored.
    known = np.flatnonzero(np.isfinite(why.diagnosis.residual_after))
    assert known[0] == round(60.0 * said["since_h"])
    (searched,) = why.free_run
    assert searched.samples == columns["y_um"].size - known[0]
    assert searched.scores["extended model"].rms_about_mean_um < 0.1 * searched.scores["base model"].rms_about_mean_um


def test_the_whole_of_such_a_record_names_more_than_acts(whole):
    assert "unobserved" in [effect.kind for effect in whole.effects] and "since_h" not in whole.to_dict()


def test_what_no_change_could_show_is_searched_as_a_whole(whole, why):
    found = whole.diagnosis
    assert began_within(found) is not None
    for other in (
        why.diagnosis,  # explained well
        dataclasses.replace(found, verdict="explained", effects=()),  # by what cannot be deployed
        of_runs(found, [dataclasses.replace(run, recording=i) for i, run in enumerate(2 * found.evidence.runs)]),
        of_runs(found, [dataclasses.replace(run, y_um=run.y_um[::-1]) for run in found.evidence.runs], back=True),
    ):
        assert began_within(other) is None


def of_runs(found, runs, *, back=False):
    """A diagnosis of other runs, whose residual may be the same backwards: an effect that ended."""
    step = -1 if back else 1
    evidence = dataclasses.replace(found.evidence, runs=tuple(runs), residual=found.evidence.residual[::step])
    return dataclasses.replace(found, evidence=evidence)


@pytest.mark.parametrize(("part", "is_better"), [(0.5, True), (0.7, False)])
def test_it_must_explain_itself_clearly_better(whole, why, part, is_better):
    later = dataclasses.replace(why.diagnosis, held_out_after=part * why.diagnosis.held_out_before)
    assert explains_better(later, whole.diagnosis) is is_better
    # Not with something that cannot be deployed, and not by a remainder alone.
    others = whole.diagnosis.effects
    assert not all(effect.deployable for effect in others)
    assert not explains_better(dataclasses.replace(later, effects=others), whole.diagnosis)
    assert not explains_better(dataclasses.replace(later, effects=()), whole.diagnosis)


def test_an_input_that_began_takes_no_source_in_its_place():
    why = tc.diagnose(BASE, changed_on_the_way([draw("input", 3, 8.0)]))
    assert [(e.kind, e.channel) for e in why.effects] == [("input", "spindle_rpm")] and why.verdict == "explained"


def test_a_change_to_less_is_no_beginning():
    minutes = np.arange(2000.0)
    residual = np.where(minutes < 1200, 5.0, 0.1) * np.sin(minutes / 50.0)
    assert changed_at(60.0 * minutes, residual, 0.1) is not None
    assert changed_at(60.0 * minutes, residual, 0.1, quiet=0.5) is None
    assert changed_at(60.0 * minutes, residual[::-1], 0.1, quiet=0.5) == 60.0 * 780  # the block in which it is
