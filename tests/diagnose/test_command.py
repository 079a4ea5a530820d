"""`compensator diagnose` as its user runs it."""

import contextlib
import dataclasses
import io
import json

import numpy as np
import pytest

import compensator as tc
from compensator.cli import main
from compensator.demo.calibration import write_table
from compensator.model.model_file import load_model, read_model_bytes
from compensator.model.model_writer import dump_model, write_model
from tests.diagnose.scenarios import draw, record

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    columns, _, _ = record([draw("scheduled", 3), draw("drift", 3)], 77, 24.0)
    path = tmp_path_factory.mktemp("data") / "run.csv"
    write_table(path, {"t_s": np.arange(columns["y_um"].size) * 60.0, **columns})
    return path


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """The published model, which states hardly an error of its own."""
    path = tmp_path_factory.mktemp("base") / "base.toml"
    write_model(path, dataclasses.replace(load_model("quill"), y_std_um=0.05))
    return path


@pytest.fixture(scope="module")
def first(tmp_path_factory, table, base):
    """Folder of its diagnosis, and what that prints."""
    out = tmp_path_factory.mktemp("first") / "diagnosis"
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["diagnose", str(table), "--model", str(base), "--out", str(out)]) == 0
    return out, printed.getvalue()


def test_json_model_and_page(first, base):
    out, printed = first
    # Every effect is named in the first sentence, not the largest alone.
    assert "Scheduled: DTF fan_rpm; Drift. On held-out data" in printed.splitlines()[0]
    found = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "explained"
    assert [(e["kind"], e["path"], e["channel"]) for e in found["effects"]] == [
        ("scheduled", "DTF", "fan_rpm"),
        ("drift", None, None),
    ]
    assert [e["deployable"] for e in found["effects"]] == [True, False]
    for effect in found["effects"]:
        assert effect["rms_after_um"] < effect["rms_before_um"]
        for value in effect["parameters"].values():
            assert 0.0 < value["std"] < abs(value["value"])
    assert found["after"]["rms_um"] < found["before"]["rms_um"] and "refused" not in found
    assert found["held_out"].endswith("; after: also with drift, which no model can have")
    assert all({"kind", "channel", "rms_after_um", "how_to_tell_apart"} <= set(rival) for rival in found["rivals"])
    model = load_model(out / "model.toml")
    assert [effect.kind for effect in model.effects] == ["scheduled"]
    assert model.provenance["diagnosis"]["base_model_sha256"] == load_model(base).sha256
    page = (out / "report.html").read_text(encoding="utf-8")
    for words in ("before and after", "Errors on held-out data", "ranked", model.sha256):
        assert words in page


def test_the_model_states_the_verdict_that_a_run_that_took_no_part_leaves(tmp_path):
    """What was found acts in the data that were searched, and not in the other run."""
    searched, other = (
        {"t_s": np.arange(columns["y_um"].size) * 60.0, **columns}
        for columns, _, _ in (record([draw("input", 4)], 79, 10.0), record([], 80, 10.0))
    )
    found = tc.diagnose("quill", searched, validate=other)
    assert (found.diagnosis.verdict, found.verdict) == ("explained", "partly_explained")
    found.save(tmp_path)
    said = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))["verdict"]
    assert said == load_model(tmp_path / "model.toml").provenance["diagnosis"]["verdict"] == "partly_explained"


def test_the_extended_model_is_a_base_like_any_other(tmp_path, table, first, capsys):
    out = first[0]
    # The drift is of the measurement: what the service states is the error on the machine.
    _, drifted, _ = record([draw("scheduled", 3), draw("drift", 3)], 77, 24.0)
    _, scheduled, _ = record([draw("scheduled", 3)], 77, 24.0)
    assert load_model(out / "model.toml").y_std_um < 0.1 * np.std(drifted - scheduled)
    again = tmp_path / "second"
    assert main(["diagnose", str(table), "--model", str(out / "model.toml"), "--out", str(again), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [e["kind"] for e in found["effects"]] == ["drift"]
    assert main(["simulate", str(table), "--model", str(out / "model.toml"), "--out", str(tmp_path / "s.csv")]) == 0


def test_a_model_that_lacks_nothing_is_written_as_its_own_file(tmp_path, capsys):
    columns, _, _ = record([], 78, 14.0)
    path = tmp_path / "run.csv"
    write_table(path, {"t_s": np.arange(columns["y_um"].size) * 60.0, **columns})
    assert main(["diagnose", str(path), "--model", "quill", "--out", str(tmp_path / "d"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "adequate" and found["model_sha256"] == load_model("quill").sha256
    # With its comments, and without an entry of a diagnosis that added nothing.
    written = tmp_path / "d" / "model.toml"
    assert written.read_bytes() == read_model_bytes("quill")
    assert "data: run.csv" in (tmp_path / "d" / "report.html").read_text(encoding="utf-8")
    assert list(found["free_run"][0]["scores"]) == ["base model", "no compensation", "persistence"]
    # The published model states 2.3 µm; on a machine that it describes exactly less is left, which is no trouble.
    assert "deviation_contradicted" not in found["warning_codes"]
    # One that states less than the data show is remarked on. A model that no file holds is written as usual.
    model = dataclasses.replace(load_model("quill"), y_std_um=0.002)
    again = tc.diagnose(model, path)
    assert "deviation_contradicted" in again.to_dict()["warning_codes"]
    [said] = [one for one in map(str, again.diagnosis.warnings) if one.startswith("The model states 0.00 µm")]
    assert 0.0 < float(said.partition("these data show ")[2].split()[0]) < 0.3
    again.save(tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_text(encoding="utf-8") == dump_model(model)


def test_a_reversed_y_is_no_effect_of_the_machine(tmp_path, capsys):
    """Deployed, the gains that reverse both paths would double the error of the part."""
    columns, _, _ = record([], 80, 12.0)
    path, out = tmp_path / "run.csv", tmp_path / "d"
    write_table(path, {"t_s": np.arange(columns["y_um"].size) * 60.0, **columns, "y_um": -columns["y_um"]})
    assert main(["diagnose", str(path), "--model", "quill", "--out", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "unexplained" and "path_reversed" in found["warning_codes"]
    assert load_model(out / "model.toml").effects == ()
    # What model.toml has not is not deployable, and the errors after are those of model.toml.
    assert found["effects"] and not any(effect["deployable"] for effect in found["effects"])
    assert all("Not deployed: a path would act the other way round." in one["explanation"] for one in found["effects"])
    assert found["after"] == found["before"] and found["refused"]["rms_um"] < 0.7 * found["before"]["rms_um"]
    assert found["refused"]["why"] == "a path would act the other way round"


def test_data_without_y_is_refused(tmp_path, capsys):
    columns, _, _ = record([], 79, 6.0)
    del columns["y_um"]
    path = tmp_path / "run.csv"
    write_table(path, {"t_s": np.arange(360) * 60.0, **columns})
    assert main(["diagnose", str(path), "--model", "quill", "--out", str(tmp_path / "d")]) == 2
    assert "y_um" in capsys.readouterr().err
