"""Nothing has a name: what the searches for the held-out blocks found credits nothing, and a remainder must help."""

import dataclasses

import numpy as np
import pytest

from compensator.codes import ModelWarning
from compensator.diagnose import diagnosis
from compensator.diagnose.choice import held_out
from compensator.diagnose.diagnosis import diagnose
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search import background
from compensator.diagnose.search.background import Background
from compensator.diagnose.search.findings import findings_of
from compensator.diagnose.words.summary import figures, verdict
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import draw, lag, record
from tests.identify.quill_runs import runs_from

QUILL = load_model("quill")


def wave(size):
    return np.sin(np.arange(size) / 40.0)


def day():
    """A day with a wave that is too small for a name."""
    columns, _, _ = record([], 60, 24.0)
    return runs_from(columns | {"y_um": columns["y_um"] + 0.1 * wave(columns["y_um"].size)})


@pytest.fixture(scope="module")
def searched():
    """Searches all of that day, and all but each of its blocks, once: the tests differ in what is made of it."""
    kept = {}

    def found_in(evidence, grid=None, **given):
        key = evidence.used.tobytes(), *sorted(given.items())
        if key not in kept:
            kept[key] = findings_of(evidence, grid=grid, **given)
        return kept[key]

    return found_in


def search_by(monkeypatch, found_in):
    for module in (diagnosis, held_out):
        monkeypatch.setattr(module, "findings_of", found_in)


def diagnosed(monkeypatch, searched, remainder_um):
    """Diagnose that day with a remainder that is a wave of this size in every search."""

    def found_in(evidence, **given):
        found = searched(evidence, **given)
        assert not found.terms
        points = found.search.points
        fitted = Background(evidence).fitted(points, np.zeros(points.count), found.selection.before.rest)
        remainder = dataclasses.replace(fitted, added=remainder_um * wave(fitted.added.size))
        return dataclasses.replace(found, remainder=remainder, deploys_names=True)

    search_by(monkeypatch, found_in)
    return diagnose(QUILL, day())


def test_a_remainder_that_held_out_blocks_contradict_is_not_deployed(monkeypatch, searched):
    found = diagnosed(monkeypatch, searched, -0.1)
    table = figures(found)
    assert table["remainder"] is None and found.model.effects == ()
    assert table["verdict"] == "adequate" and table["after"] == table["before"]


def test_a_model_that_gets_a_remainder_is_not_called_adequate(monkeypatch, searched):
    table = figures(diagnosed(monkeypatch, searched, 0.1))
    assert table["remainder"]["deployed"] and table["verdict"] == "unexplained"
    assert table["remainder"]["rms_before_um"] == pytest.approx(table["before"]["rms_um"], rel=1e-12)
    assert table["before"]["rms_um"] > table["after"]["rms_um"]
    assert "has no name here" in verdict(table)
    assert table["advice"]["unexplained"]["kind"] == "remainder"


def test_a_base_that_does_not_foretell_the_rest_of_a_record_is_not_called_adequate(monkeypatch, searched):
    """An initial state of its slow modes may take in what acts, as far as the record that it is fitted to goes."""
    held_out_of = diagnosis.held_out_of

    def foretold(*given):
        found = held_out_of(*given)
        return dataclasses.replace(found, nothing=10.0 * found.nothing, ceiling=10.0 * found.ceiling)

    search_by(monkeypatch, searched)
    assert figures(diagnose(QUILL, day()))["verdict"] == "adequate"
    monkeypatch.setattr(diagnosis, "held_out_of", foretold)
    found = diagnose(QUILL, day())
    table = figures(found)
    assert table["verdict"] == "unexplained" and table["effects"] == [] and table["remainder"] is None
    # The loop asks this: an end in which nothing acts any more may be short.
    assert found.shows_nothing
    assert "does not foretell the rest" in verdict(table) and table["advice"]["unexplained"] is None


def test_what_only_the_blocks_named_is_no_error_after(monkeypatch, searched):
    whole = diagnosis.evidence_of(QUILL, day()).count

    def found_in(evidence, **given):
        found = searched(evidence, **given)
        wrong = () if evidence.count == whole else (wave(found.ceiling.size),)
        return dataclasses.replace(found, responses=(*found.responses, *wrong))

    search_by(monkeypatch, found_in)
    table = figures(diagnose(QUILL, day()))
    assert table["effects"] == [] and table["remainder"] is None
    assert table["after"] == table["before"]


def test_a_channel_that_moves_only_in_what_is_held_out_predicts_nothing_there():
    columns, _, _ = record([], 1400, 12.0)
    columns["fan_rpm"] = np.where(np.arange(720) < 75, 3000.0, 0.0)
    evidence = evidence_of(QUILL, runs_from(columns))
    found = findings_of(evidence.without(next(evidence.blocks(3))))
    assert np.ptp(found.ceiling) < 1.0


@pytest.mark.parametrize("minutes", [60, 75, 110])
@pytest.mark.parametrize("approximate", [False, True])
def test_a_record_of_an_hour_is_diagnosed(minutes, *, approximate):
    """Every lag that it can tell is fast."""
    columns = {name: values[:minutes] for name, values in record([draw("input", 3, 5.0)], 80, 24.0)[0].items()}
    model = dataclasses.replace(QUILL, held_out_rms_um=0.6 if approximate else None)
    assert diagnose(model, runs_from(columns)).verdict


def test_of_too_many_channels_those_like_the_residual_are_in_the_ceiling_and_it_says_so(monkeypatch):
    """Of six channels four have room beside the inputs of the base: the last one acts, and is among them."""
    columns, _, _ = record([], 60, 10.0)
    names = [name for name in columns if name not in ("t_q_degc", "at_degc", "y_um")]
    acting = lag(columns["spindle_rpm"] - columns["spindle_rpm"][0], 30.0)
    rest = {name: columns[name] for name in columns if name != "spindle_rpm"}
    y_um = columns["y_um"] + 3.0 * acting / np.std(acting)
    data = runs_from(rest | {"y_um": y_um, "spindle_rpm": columns["spindle_rpm"]})
    all_of_them = Background(evidence_of(QUILL, data)).template.channels
    assert all_of_them[2:8] == tuple(name for name in (*rest, "spindle_rpm") if name in names)
    monkeypatch.setattr(background, "MOST_CHANNELS", 6)
    some = Background(evidence_of(QUILL, data)).template.channels
    assert len(some) == 6 and some[-1] == "spindle_rpm" and list(some) == sorted(some, key=all_of_them.index)
    [words] = [str(one) for one in diagnose(QUILL, data).warnings if one.code == ModelWarning.CEILING_IN_PART]
    assert words.startswith("Only 4 of 6 channels")
