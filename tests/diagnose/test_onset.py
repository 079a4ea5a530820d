"""An effect that began within the record is looked for in the time since then."""

import dataclasses

import numpy as np
import pytest

import compensator as tc
from compensator.diagnose import diagnosis
from compensator.diagnose.choice.onset import explains_better, onset_in
from compensator.diagnose.fitting.prediction import FOLDS
from compensator.diagnose.residual.change import changed_at
from compensator.diagnose.words.summary import headline
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import draw, record

QUILL = load_model("quill")
#: As `identify` states it: a base whose paths miss 0.6 µm.
BASE = dataclasses.replace(QUILL, held_out_rms_um=0.6)
BEGAN_H = 8.3


def changed_on_the_way(scenarios, channels=(), began_h=BEGAN_H):
    """Columns of a day in which effects begin after some hours, with some channels of it."""
    columns, _, _ = record([], 60, 24.0)
    since, _, _ = record(scenarios, 60, 24.0)
    hour = np.arange(columns["y_um"].size) / 60.0
    logged = {name: columns[name] for name in ("t_q_degc", "at_degc", *channels)}
    return {"t_s": 3600.0 * hour, **logged, "y_um": np.where(hour < began_h, columns["y_um"], since["y_um"])}


@pytest.fixture(scope="module")
def columns():
    return changed_on_the_way([draw("gain DTF", 2, 8.0)])


@pytest.fixture(scope="module")
def all_data(columns):
    return tc.diagnose(QUILL, columns, all_data=True)


@pytest.fixture(scope="module")
def why(columns, all_data):
    """The diagnosis as it is asked for, which begins with that of all data."""
    as_a_whole, whole = diagnosis._as_a_whole, all_data.diagnosis

    def searched(model, runs, *others):
        is_whole = np.array_equal(runs[0].y_um, whole.evidence.runs[0].y_um)
        return whole if is_whole else as_a_whole(model, runs, *others)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnosis, "_as_a_whole", searched)
        return tc.diagnose(QUILL, columns)


def test_it_is_named_alone_and_when_it_began_is_said(columns, why):
    assert why.verdict == "explained" and [(e.kind, e.path) for e in why.effects] == [("gain", "DTF")]
    said = why.to_dict()
    assert said["warning_codes"] == ["began_within"] and BEGAN_H < said["since_h"] < BEGAN_H + 1.0
    assert f"Something began {said['since_h']:.1f} h after the start" in why.summary()
    assert f"Gain: DTF, began within the data: searched from {said['since_h']:.1f} h on." in headline(said)
    # Only what has been searched is shown and scored.
    known = np.flatnonzero(np.isfinite(why.diagnosis.residual_after))
    assert known[0] == round(60.0 * said["since_h"])
    (searched,) = why.free_run
    assert searched.samples == columns["y_um"].size - known[0]
    assert searched.scores["extended model"].rms_about_mean_um < 0.1 * searched.scores["base model"].rms_about_mean_um


def test_all_data_of_such_a_record_name_a_source(all_data):
    assert "unobserved" in [effect.kind for effect in all_data.effects] and "since_h" not in all_data.to_dict()


@pytest.fixture
def found(all_data):
    """The diagnosis of all data, which is searched again."""
    assert onset_in(all_data.diagnosis) is not None
    return all_data.diagnosis


def of_run(found, *, used=None, back=False, **changes):
    """A diagnosis with another run, whose residual may be the same backwards: an effect that ended."""
    evidence, step = found.evidence, -1 if back else 1
    (run,) = evidence.runs
    run = dataclasses.replace(run, **changes)
    used = evidence.used if used is None else used
    evidence = dataclasses.replace(evidence, runs=(run,), residual=evidence.residual[::step], used=used)
    return dataclasses.replace(found, evidence=evidence)


def test_what_is_explained_and_what_ended_is_not_searched_again(found, why):
    assert onset_in(why.diagnosis) is None  # explained well
    assert onset_in(dataclasses.replace(found, verdict="explained", effects=())) is None  # by what is never deployed
    assert onset_in(of_run(found, back=True)) is None


def test_behind_a_gap_no_onset_is_looked_for(found):
    evidence = found.evidence
    parts = dataclasses.replace(evidence, runs=2 * evidence.runs)
    assert onset_in(dataclasses.replace(found, evidence=parts)) is None


def test_it_must_have_been_measured_for_8_h_since(found):
    run = found.evidence.runs[0]
    hours = run.t_s / 3600.0
    assert onset_in(of_run(found, used=found.evidence.used & (hours < BEGAN_H + 10.0))) is not None
    assert onset_in(of_run(found, used=found.evidence.used & (hours < BEGAN_H + 8.0))) is None


def test_hours_count_from_the_start_of_the_data(found):
    (run,) = found.evidence.runs
    first, later = onset_in(found), onset_in(of_run(found, t_s=run.t_s + 3600.0))
    assert later.since_h == first.since_h + 1.0


@pytest.mark.parametrize(("part", "is_better"), [(0.85, True), (0.95, False)])
def test_it_must_explain_itself_better_than_the_base_and_than_all_data_explain_it(all_data, why, part, is_better):
    before = why.diagnosis.held_out_before
    later = dataclasses.replace(why.diagnosis, held_out_after=part * before)
    assert explains_better(later, all_data.diagnosis) is is_better
    # What all data leave of the time before says nothing.
    known = np.isfinite(before)
    of_all = np.where(known, 0.6 * before, 50.0)
    deployed = dataclasses.replace(all_data.diagnosis, model=later.model, held_out_after=of_all)
    assert not explains_better(later, deployed)
    assert explains_better(dataclasses.replace(later, held_out_after=0.5 * before), deployed)


def test_what_no_block_foretells_is_no_better(all_data, why):
    nothing = np.full(why.diagnosis.held_out_before.size, np.nan)
    assert not explains_better(dataclasses.replace(why.diagnosis, held_out_after=nothing), all_data.diagnosis)
    unknown = dataclasses.replace(why.diagnosis, held_out_before=nothing, held_out_after=nothing)
    assert not explains_better(unknown, all_data.diagnosis)


def test_a_level_of_a_block_is_no_error_of_it(all_data, why):
    """Where all data are held out, blocks are longer, so their means are others."""
    later = why.diagnosis
    foretold, level = 0.5 * later.held_out_before, np.zeros(later.held_out_before.size)
    for i, block in enumerate(later.evidence.blocks(FOLDS)):
        level[block] = 20.0 * (-1) ** i
    assert explains_better(dataclasses.replace(later, held_out_after=foretold + level), all_data.diagnosis)


def test_it_must_be_deployed_and_determined(all_data, why):
    later, others = why.diagnosis, all_data.diagnosis.effects
    assert explains_better(later, all_data.diagnosis)
    (effect,) = later.effects
    loose = dataclasses.replace(effect.effect, std={"change": 9.0})
    assert not all(one.deployable for one in others)
    for effects in (others, (dataclasses.replace(effect, effect=loose),)):
        assert not explains_better(dataclasses.replace(later, effects=effects), all_data.diagnosis)
    # A remainder alone foretells as well without a name; nothing deployed foretells nothing.
    assert explains_better(dataclasses.replace(later, effects=()), all_data.diagnosis)
    assert not explains_better(dataclasses.replace(later, model=later.evidence.model), all_data.diagnosis)


def test_names_in_whose_place_all_channels_are_deployed_count_as_deployed(all_data, why):
    later = why.diagnosis
    replaced = dataclasses.replace(later, effects=tuple(dataclasses.replace(e, replaced=True) for e in later.effects))
    assert not any(effect.deployable for effect in replaced.effects)
    assert explains_better(replaced, all_data.diagnosis)


@pytest.mark.parametrize(("kind", "is_better"), [("drift", True), ("periodic", False)])
def test_a_drift_since_takes_the_place_of_what_would_be_deployed(all_data, why, kind, is_better):
    since = tc.diagnose(QUILL, changed_on_the_way([draw(kind, 3, 8.0)], began_h=0.0)).diagnosis
    assert since.verdict == "explained" and [effect.effect.kind for effect in since.effects] == [kind]
    found = why.diagnosis
    hardly = dataclasses.replace(found, held_out_after=0.5 * found.held_out_before)
    assert explains_better(since, hardly) is is_better
    assert not explains_better(since, dataclasses.replace(found, held_out_after=0.0 * found.held_out_before))
    # In the place of a source that no channel shows it is no better name.
    assert not explains_better(since, all_data.diagnosis)


def test_an_input_that_began_takes_no_source_in_its_place():
    why = tc.diagnose(BASE, changed_on_the_way([draw("input", 3, 8.0)], ("spindle_rpm", "coolant_degc")))
    assert [(e.kind, e.channel) for e in why.effects] == [("input", "spindle_rpm")] and why.verdict == "explained"


def test_a_change_to_less_is_no_beginning():
    minutes = np.arange(2000.0)
    residual = np.where(minutes < 1200, 5.0, 0.1) * np.sin(minutes / 50.0)
    assert changed_at(60.0 * minutes, residual, 0.1) is not None
    assert changed_at(60.0 * minutes, residual, 0.1, from_quiet=True) is None
    assert changed_at(60.0 * minutes, residual[::-1], 0.1, from_quiet=True) == 60.0 * 780  # the block in which it is


def test_a_residual_that_stands_still_from_some_time_on_has_changed():
    minutes = np.arange(2000.0)
    residual = np.where(minutes < 1200, np.sin(minutes / 50.0), 0.3)
    assert changed_at(60.0 * minutes, residual, 0.1) == 60.0 * 1200
