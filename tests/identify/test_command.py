"""`compensator identify` as its user runs it."""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from compensator.cli import main
from compensator.demo.calibration import write_table
from compensator.model.model_file import load_model
from tests.api.tables import write_run
from tests.identify.quill_runs import CALIBRATION_W, VALIDATION_W, published

pytestmark = pytest.mark.usefixtures("without_pictures")

SPINDLE = Path(__file__).resolve().parents[3] / "shared/data/measured-spindle/spindle-15s.csv"


@pytest.fixture
def calibration(tmp_path):
    return write_run(tmp_path / "run.csv", CALIBRATION_W, 1)


def test_model_page_and_summary(tmp_path, calibration, capsys):
    other = write_run(tmp_path / "other.csv", VALIDATION_W, 2)
    out = tmp_path / "out" / "model.toml"
    arguments = ["identify", str(calibration), "--validate", str(other), "--out", str(out), "--order", "3", "3", "2"]
    assert main([*arguments, "--reference", "quill"]) == 0
    printed = capsys.readouterr().out
    assert "time constants" in printed
    assert re.search(r"other.csv +held out", printed)
    model = load_model(out)
    assert model.ttf.in_s().dc_gain == pytest.approx(0.2512, rel=0.01)
    assert model.provenance["data"][0]["sha256"] == hashlib.sha256(calibration.read_bytes()).hexdigest()
    assert model.dtf.covariance is not None
    assert model.validity["heat_w"][1] > 90.0
    page = (out.parent / "model-calibration.html").read_text(encoding="utf-8")
    for words in (
        "step response",
        "poles and zeros",
        "autocorrelation",
        "Comparison with the reference model",
        model.sha256,
    ):
        assert words in page
    assert main(["simulate", str(other), "--model", str(out), "--out", str(tmp_path / "s.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["fit_pct"] > 90.0


def test_json_and_a_direct_model_where_nobody_knows_the_heat(tmp_path, capsys):
    heat, ambient, difference, y, _, _ = published(CALIBRATION_W, 1)
    columns = {
        "t_s": np.arange(heat.size) * 60.0,
        "warm": 21.0 + ambient + difference,
        "air": 21.0 + ambient,
        "y_um": y,
    }
    write_table(tmp_path / "run.csv", columns)
    out = tmp_path / "model.toml"
    names = ["--column", "t_q_degc=warm", "--column", "at_degc=air"]
    assert main(["identify", str(tmp_path / "run.csv"), *names, "--out", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["kind"] == "direct"
    assert set(result["paths"]) == {"DTF", "TDTF"}
    assert load_model(out).kind == "direct"
    assert result["model_sha256"] == load_model(out).sha256


def test_two_models_in_a_folder_have_a_page_each(tmp_path, calibration, capsys, without_pictures):
    (tmp_path / "report.html").write_text("a page of another command")
    for name in ("first", "second"):
        assert (
            main(["identify", str(calibration), "--out", str(tmp_path / f"{name}.toml"), "--order", "1", "1", "1"]) == 0
        )
    pages = {name: (tmp_path / f"{name}-calibration.html").read_text(encoding="utf-8") for name in ("first", "second")}
    assert all(name in page for name, page in pages.items()) and pages["first"] != pages["second"]
    assert (tmp_path / "report.html").read_text() == "a page of another command"
    capsys.readouterr()
    (tmp_path / "report.html").unlink()
    assert main(["report", str(tmp_path), "--out", str(tmp_path / "all.html"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["pages"]
    assert [page["title"] for page in found] == ["Calibration: first", "Calibration: second"]


def test_the_pdf_is_named_as_well(tmp_path, calibration, capsys, without_pictures):
    out, page = tmp_path / "model.toml", tmp_path / "p.pdf"
    assert main(["identify", str(calibration), "--out", str(out), "--order", "1", "1", "1", "--page", str(page)]) == 0
    assert capsys.readouterr().out.endswith(f"page: {tmp_path / 'model-calibration.html'}\npage: {page}\n")
    assert page.read_bytes().startswith(b"%PDF-")


def test_bad_data_gives_one_line_and_no_model(tmp_path, capsys):
    bad = write_run(tmp_path / "bad.csv", CALIBRATION_W, 1, y_um=np.zeros(720))
    out = tmp_path / "model.toml"
    assert main(["identify", str(bad), "--out", str(out)]) == 2
    assert not out.exists()
    said = capsys.readouterr().err
    assert "bad.csv" in said
    assert said.count("\n") == 1


def test_a_run_cannot_judge_what_it_made(tmp_path, calibration):
    arguments = ["identify", str(calibration), "--validate", str(calibration), "--out", str(tmp_path / "m.toml")]
    assert main(arguments) == 2


@pytest.mark.skipif(not SPINDLE.exists(), reason="the measured spindle is not here")
def test_the_measured_spindle(tmp_path, capsys):
    roles = {"t_q_degc": "t5_degc", "at_degc": "t16_degc", "y_um": "ch3_um"}
    columns = [word for role, name in roles.items() for word in ("--column", f"{role}={name}")]
    arguments = ["identify", str(SPINDLE), *columns, "--fit-until", "20", "--out", str(tmp_path / "m.toml"), "--json"]
    assert main(arguments) == 0
    fitted, held_out = json.loads(capsys.readouterr().out)["parts"]
    assert (fitted["samples"], held_out["samples"]) == (1200, 720)
    assert held_out["rms_um"] < held_out["persistence_rms_um"] < held_out["no_compensation_rms_um"]
