"""Several axes: an effect of one is looked for on the others, one of a single probe is first suspected in the probe."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import compensator as tc
from compensator.api import diagnosis as api_diagnosis
from compensator.cli import main
from compensator.data.axes import of_axis
from compensator.data.measurement import measurements, runs_in
from compensator.diagnose.across import MachineEffect, Share, across, missing_places
from compensator.diagnose.fitting.fit import Term, response
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.criterion import MARGIN, Criterion
from compensator.model.effects.hypothesis import proposals
from compensator.model.model_file import load_axes
from compensator.model.model_writer import write_axes
from compensator.report.results import pages_in
from tests.cli.test_axes import write
from tests.diagnose.axes_data import machine, models
from tests.shared_folder import search_once

PLACE = ("input", "", "coolant_degc")


@pytest.fixture(scope="module", autouse=True)
def _each_question_once(tmp_path_factory):
    """The same axis in the same data is searched once, whether all axes are asked for, some, or it alone."""
    with pytest.MonkeyPatch.context() as patch:
        search_once(patch, tmp_path_factory)
        yield


def acting():
    """A table of a machine whose coolant moves Y and Z."""
    return machine(1, {"y": 2.0, "z": -4.0}, hours=14.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Its models, which do not know that, and the table."""
    folder = tmp_path_factory.mktemp("axes")
    write(folder / "run.csv", {k: np.asarray(v) for k, v in acting().items()})
    write_axes(folder / "base.toml", models())
    return folder / "base.toml", folder / "run.csv"


@pytest.fixture(scope="module")
def found(files):
    return tc.diagnose(*files)


def test_an_effect_of_two_axes_is_named_with_its_axes(found):
    [effect] = found.machine
    assert effect.place == PLACE and [share.axis for share in effect.seen] == ["z", "y"] and not effect.suspect
    z, y, x = effect.shares
    assert z.moves_um == pytest.approx(-2.0 * y.moves_um, rel=0.1) and y.moves_um > 0.0, "with the coolant, against it"
    assert x.axis == "x" and abs(x.moves_um) < 4.0 * x.std_um < 1.0
    assert "moves Z by −" in effect.sentence and "X not (" in effect.sentence
    assert found.verdict == "explained" and found["x"].verdict == "adequate"


def test_each_axis_gets_its_own_effect_in_one_file(found, files, tmp_path):
    loaded = load_axes(found.save(tmp_path / "model.toml"))
    assert [len(loaded[axis].effects) for axis in ("x", "y", "z")] == [0, 1, 1]
    base, table = files
    before, after = tc.simulate(base, table), tc.simulate(loaded, table)
    for axis in ("y", "z"):
        assert after[axis].scores.rms_about_mean_um < 0.4 * before[axis].scores.rms_about_mean_um, axis


def test_what_is_asked_of_one_axis_is_answered_by_several(found, files):
    named = [(effect["axis"], effect["kind"], effect.channel) for effect in found.effects]
    listed = [(one["axis"], one["kind"], one["channel"]) for one in found.to_dict()["effects"]]
    top, own = found.to_dict(), found["y"].to_dict()
    keys = ("before", "after", "held_out", "noise_floor_um", "remainder", "ceiling")
    assert top["figures_of"] == "y" and all(top[key] == own[key] for key in keys)
    assert named == listed == [("y", "input", "coolant_degc"), ("z", "input", "coolant_degc")]
    base, table = files
    out = tc.simulate(base, table)
    assert out["y_pred_um"] is out["y"]["y_pred_um"] and out["z_pred_um"].size == out["t_s"].size
    assert list(out) == ["x", "y", "z"] and set(out.scores) == set(out)
    with pytest.raises(KeyError):
        out["b_pred_urad"]
    frame = tc.simulate(base, pd.read_csv(table))
    assert isinstance(frame, pd.DataFrame) and list(frame) == list(out.table)
    np.testing.assert_array_equal(frame["z_pred_um"], out["z_pred_um"])
    assert frame.result["z"].scores == out["z"].scores == frame.scores["z"]


def test_progress_goes_on_where_an_axis_is_searched_once_more(files, monkeypatch):
    """Another axis has shown an effect that this one may have, too."""
    told = []

    class StopSearch(Exception):
        pass

    def diagnosed(base, given, validation, words, options, *, progress, **_):
        progress(0, 4)
        progress(4, 4)
        if options.expected:
            raise StopSearch
        return SimpleNamespace(diagnosis=None)

    monkeypatch.setattr(api_diagnosis, "_diagnose_axis", diagnosed)
    monkeypatch.setattr(api_diagnosis, "missing_places", lambda _: {"x": frozenset({PLACE})})
    with pytest.raises(StopSearch):
        tc.diagnose(*files, progress=lambda done, total: told.append((done, total)))
    assert told == [(0, 12), (4, 12), (4, 12), (8, 12), (8, 12), (12, 12), (12, 16), (16, 16)]


def test_a_jump_of_one_axis_is_first_suspected_in_its_probe(tmp_path):
    base, written = tmp_path / "base.toml", tmp_path / "model.toml"
    write_axes(base, models())
    base.write_bytes(b"# of the old machine\n" + base.read_bytes())
    found = tc.diagnose(base, machine(2, {}, step_um={"z": 8.0}, hours=12.0))
    [effect] = found.machine
    assert effect.place[0] == "step" and effect.suspect == "z"
    assert "Only Z shows it" in effect.sentence and "Check the probe of Z first" in effect.sentence
    # Nothing is added to any axis: the file stays.
    assert found.save(written).read_bytes() == base.read_bytes() and found.sha256 == load_axes(base)["y"].sha256


def test_a_probe_is_suspected_only_where_the_others_surely_show_nothing():
    alone, sure, open_ = (
        Share(axis=axis, moves_um=moves, std_um=std, named=axis == "z")
        for axis, moves, std in (("z", 20.0, 1.0), ("y", 0.5, 0.4), ("x", 6.0, 4.0))
    )
    clear, unclear = (MachineEffect(place=PLACE, shares=(alone, other)) for other in (sure, open_))
    assert clear.suspect == "z" and "Y not (0.5 ± 0.4). Only Z shows it." in clear.sentence
    assert not unclear.suspect and unclear.sentence.endswith("X perhaps (6.0 ± 4.0).")
    assert not MachineEffect(place=PLACE, shares=(alone,)).suspect, "nothing to compare with"


@pytest.mark.parametrize("z_has_path", [True, False])
def test_no_probe_is_suspected_where_the_model_of_another_axis_lacks_the_path(z_has_path):
    """Z has no more of the ambient than its model; a model without a TDTF shows nothing of that."""
    bases, table = models(), machine(4, {}, hours=14.0)
    if not z_has_path:
        bases["z"] = dataclasses.replace(bases["z"], tdtf=None)

    def evidence(axis):
        return evidence_of(bases[axis], runs_in(of_axis(measurements(table, "data"), axis))[0])

    gain = next(one for one in proposals(evidence("y").context) if one.place == ("gain", "TDTF", ""))
    term = Term(hypothesis=gain, values=(), amplitudes=(0.5,))
    added = response(evidence("y"), term)
    table["y_um"] = table["y_um"] + added
    effect = SimpleNamespace(place=gain.place, path="TDTF", channel=None, term=term, signal=added)
    diagnoses = {
        "y": SimpleNamespace(effects=(effect,), evidence=evidence("y")),
        "z": SimpleNamespace(effects=(), evidence=evidence("z")),
    }
    [found] = across(diagnoses)
    assert found.shares[0].moves_um == pytest.approx(np.ptp(added), rel=0.2)
    assert found.suspect == ("y" if z_has_path else "")
    assert f"Z {'not' if z_has_path else 'perhaps'} (" in found.sentence
    assert not missing_places(diagnoses)


def test_y_alone_is_diagnosed_as_without_the_other_axes(files):
    table = {name: v for name, v in acting().items() if name not in ("x_um", "z_um")}
    alone, chosen = tc.diagnose(models()["y"], table), tc.diagnose(*files, axis="y")
    assert chosen.to_dict() | {"free_run": []} == alone.to_dict() | {"free_run": []}


def test_what_another_axis_shows_is_no_choice_among_many():
    model = models()["y"]
    [runs] = [runs_in(of_axis(measurements(machine(3, {}), "data"), "y"))[0]]
    evidence = evidence_of(model, runs)
    hypotheses = proposals(evidence.context)
    expected = dataclasses.replace(evidence, expected=frozenset({PLACE}))
    costs = {
        one.place: (Criterion(expected, hypotheses).cost_of(one), Criterion(evidence, hypotheses).cost_of(one))
        for one in hypotheses
    }
    assert costs[PLACE][0] == MARGIN < costs[PLACE][1]
    others = [pair for place, pair in costs.items() if place != PLACE]
    assert others and all(with_it == without for with_it, without in others)


def test_the_command_writes_the_axis_of_each_effect(files, tmp_path, capsys):
    base, table = files
    out = tmp_path / "found"
    arguments = ["diagnose", str(table), "--model", str(base), "--out", str(out)]
    assert main([*arguments, "--axis", "y", "--axis", "z"]) == 0
    assert "coolant_degc (input) moves Z by −" in capsys.readouterr().out
    written = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert [(one["axis"], one["kind"], one["channel"]) for one in written["effects"]] == [
        ("y", "input", "coolant_degc"),
        ("z", "input", "coolant_degc"),
    ]
    assert {one["axis"] for one in written["machine"][0]["axes"]} == {"y", "z"}
    assert (out / "series-z.csv").read_text(encoding="utf-8").splitlines()[0].startswith("run,t_s,z_um")
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "<h2>Axis Z" in page and "What each effect moves" in page
    assert list(load_axes(out / "model.toml")) == ["y", "z"]
    [listed] = pages_in(out)
    assert listed.verdict.startswith("coolant_degc (input) moves Z by −") and listed.tone == "good"
