"""Several recordings: whole ones are held out."""

import dataclasses

import numpy as np
import pytest

import compensator as tc
from compensator.diagnose.choice.held_out import how_held_out, left_of_block, zeros_known
from compensator.diagnose.diagnosis import diagnose
from compensator.diagnose.fitting.points import Points
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.findings import findings_of
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import draw, record
from tests.identify.quill_runs import runs_from

QUILL = load_model("quill")


def logged(columns):
    """Columns with two channels: each is searched in all recordings, and again without each of them."""
    return {name: columns[name] for name in ("t_q_degc", "at_degc", "y_um", "spindle_rpm", "coolant_degc")}


def recordings(*hours):
    effect = draw("gain DTF", 3)
    tables = [logged(record([effect], 300 + i, h)[0]) for i, h in enumerate(hours)]
    runs = [dataclasses.replace(run, recording=i) for i, t in enumerate(tables) for run in runs_from(t)]
    return tables, runs


def test_recordings_are_held_out_whole_and_small_ones_together():
    evidence = evidence_of(QUILL, recordings(10.0, 8.0, 6.0, 3.0)[1])
    sizes = [record.size for record in evidence.signals]
    ends = np.cumsum(sizes)
    held = [{int(np.searchsorted(ends, i, side="right")) for i in np.flatnonzero(mask)} for mask in evidence.blocks(3)]
    assert held == [{0}, {1}, {2, 3}]
    assert sum(int(mask.sum()) for mask in evidence.blocks(3)) == evidence.count


def test_a_short_recording_beside_a_long_one_is_no_judge():
    evidence = evidence_of(QUILL, recordings(20.0, 2.0)[1])
    assert not evidence.holds_out_recordings
    first = next(evidence.blocks(3))
    assert 0.3 < first.sum() / evidence.count < 0.4


def test_a_recording_without_y_is_no_block():
    """Nothing of it could be predicted, and a search without it has seen all that the blocks are predicted from."""
    runs = recordings(10.0, 8.0, 6.0)[1]
    runs[2] = dataclasses.replace(runs[2], y_um=np.full(runs[2].y_um.size, np.nan))
    evidence = evidence_of(QUILL, runs)
    assert [int(mask.sum()) for mask in evidence.blocks(3)] == [600, 480]
    assert how_held_out(evidence).startswith("each of 2 recordings")
    alone = evidence_of(QUILL, [runs[0], runs[2]])
    assert not alone.holds_out_recordings and len(list(alone.blocks(3))) == 3


def test_recordings_of_probes_are_held_out_whole_and_the_likelihood_decides():
    runs = [
        dataclasses.replace(run, y_um=np.where(np.arange(run.y_um.size) % 30 == 29, run.y_um, np.nan), y_std_um=1.0)
        for run in recordings(24.0, 24.0)[1]
    ]
    evidence = evidence_of(QUILL, runs)
    assert evidence.is_sparse and [np.flatnonzero(mask)[0] for mask in evidence.blocks(3)] == [29, 1469]
    words = how_held_out(evidence)
    assert words.startswith("each of 2 recordings") and "decided by the likelihood of all values" in words
    assert "likelihood" in how_held_out(evidence_of(QUILL, runs[:1]))
    assert "likelihood" not in how_held_out(evidence_of(QUILL, recordings(10.0)[1]))


def test_a_recording_does_not_foretell_itself():
    """Whatever Y is in the one that is held out, the same is predicted for it."""
    _, runs = recordings(10.0, 8.0, 9.0)
    evidence = evidence_of(QUILL, runs)
    mask = list(evidence.blocks(3))[1]
    predicted = findings_of(evidence.without(mask)).whole
    disturbed = dataclasses.replace(evidence, residual=np.where(mask, 3.0 * evidence.residual, evidence.residual))
    assert findings_of(disturbed.without(mask)).whole == pytest.approx(predicted, abs=1e-9)
    # Its zero is its own mean, and no shift of it counts.
    shifted = dataclasses.replace(evidence, residual=evidence.residual + 50.0 * mask)
    known = zeros_known(Points(evidence.without(mask)))
    assert sum(known) == 2
    left, other = (left_of_block(each, mask, known, predicted) for each in (evidence, shifted))
    assert left == pytest.approx(other, abs=1e-6) and abs(left.mean()) < 1e-6


def test_a_block_behind_a_gap_is_foretold_by_what_is_known_of_the_state_there():
    """Two hours of the run behind the gap are seen: its slow modes are not, and are expected to be near rest."""
    columns, _, _ = record([draw("input", 3)], 80, 36.0)
    gap = slice(1252, 1366)
    for name in ("t_q_degc", "at_degc"):
        columns[name][gap] = np.nan
    found = diagnose(QUILL, runs_from(logged(columns)))
    assert [effect.place for effect in found.effects] == [("input", "", "spindle_rpm")]
    assert found.verdict == "explained" and found.after.rms_um < 0.6 * found.before.rms_um


@pytest.mark.parametrize("start", [688, 1359])
def test_a_run_of_which_a_few_samples_are_seen_is_about_its_own_mean(start):
    """Its last eight minutes make no point, nor does a single sample; the zero of Y is 100 µm away."""
    columns, _, _ = record([], 80, 36.0)
    for name in ("t_q_degc", "at_degc"):
        columns[name][start : start + 120] = np.nan
    columns["y_um"] += 100.0
    found = diagnose(QUILL, runs_from(columns))
    assert found.before.rms_um < 10.0


def test_the_python_face_knows_recordings_by_their_files_and_says_how_it_was_measured():
    tables, _ = recordings(10.0, 8.0, 9.0)
    why = tc.diagnose(QUILL, [{"t_s": np.arange(t["y_um"].size) * 60.0, **t} for t in tables])
    assert [effect.place for effect in why.effects] == [("gain", "DTF", "")]
    assert why.to_dict()["held_out"].startswith("each of 3 recordings")
    assert why.diagnosis.after.rms_um < 0.2 * why.diagnosis.before.rms_um
