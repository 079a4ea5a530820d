"""`simulate --correct`: each row uses the measured Y of earlier rows, and nothing else changes."""

import contextlib
import csv
import dataclasses
import io
import json

import numpy as np
import pytest

import compensator as tc
from compensator.cli import main
from compensator.codes import DataRemark
from compensator.model.correction import ProbeCorrection
from compensator.model.effects.gain import Gain
from compensator.model.engine import Engine
from tests.diagnose.scenarios import record

HOURS, STD_UM = 24.0, 1.5


@pytest.fixture(scope="module")
def machine():
    """A machine that moves by 10 % more than the published model says, probed each hour."""
    columns, true, _ = record([], 31, HOURS)
    true = 1.1 * true
    noise = np.random.default_rng(5).normal(0.0, STD_UM, true.size)
    table = {"t_s": np.arange(true.size) * 60.0, "t_q_degc": columns["t_q_degc"], "at_degc": columns["at_degc"]}
    probed = np.where(np.arange(true.size) % 60 == 30, true + noise, np.nan)
    return table | {"y_um": probed}, true, true + noise


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def run(*words):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as errors:
        code = main([str(word) for word in words])
    return code, out.getvalue(), errors.getvalue()


def write(path, table):
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(
            ["" if np.isnan(v) else repr(float(v)) for v in row] for row in zip(*table.values(), strict=True)
        )
    return path


def test_it_is_nearer_to_the_truth_and_states_how_near(machine):
    table, true, _ = machine
    free = tc.simulate("quill", table)
    found = tc.simulate("quill", table, correct=True, y_std_um=STD_UM)
    after = np.arange(true.size) > 30
    error = (true - found["y_pred_um"])[after]
    assert rms(error) < 0.4 * rms((true - found["y_free_um"])[after])
    assert rms(error) < 1.25 * rms(found["y_std_um"][after])
    np.testing.assert_array_equal(found["y_free_um"], free["y_pred_um"])
    np.testing.assert_array_equal(found["heat_w"], free["heat_w"])


def test_a_row_uses_earlier_rows_alone(machine):
    table, *_ = machine
    row = 30 + 60 * 9
    changed = table["y_um"].copy()
    changed[row:] += 7.0
    one, other = (
        tc.simulate("quill", table | {"y_um": y}, correct=True, y_std_um=STD_UM) for y in (table["y_um"], changed)
    )
    for name in ("y_pred_um", "y_std_um"):
        np.testing.assert_array_equal(one[name][: row + 1], other[name][: row + 1])
        assert one[name][row + 1] != other[name][row + 1] or name == "y_std_um"


def test_before_the_first_measured_value_it_runs_free(machine):
    table, *_ = machine
    found, free = tc.simulate("quill", table, correct=True, y_std_um=STD_UM), tc.simulate("quill", table)
    for name in ("y_pred_um", "y_std_um"):
        np.testing.assert_array_equal(found[name][:31], free[name][:31])
    assert found["y_std_um"][31] < free["y_std_um"][31]


def test_it_is_what_the_service_computes_sample_by_sample(machine):
    table, *_ = machine
    found = tc.simulate("quill", table, correct=True, y_std_um=STD_UM)
    engine = Engine(tc.load_model("quill"))
    engine.set_reference(float(table["t_q_degc"][0]), float(table["at_degc"][0]))
    correction = ProbeCorrection(engine.contribution_names)
    for i, y in enumerate(table["y_um"].tolist()):
        estimate = engine.step(float(table["t_q_degc"][i]), float(table["at_degc"][i]))
        shares = estimate.contributions_um
        assert sum(shares) == pytest.approx(estimate.y_um)
        correction.step(shares)
        assert found["y_pred_um"][i] == estimate.y_um + correction.correction_um(shares)
        if not np.isnan(y):
            correction = ProbeCorrection.from_dict(json.loads(json.dumps(correction.to_dict())))
            correction.update(y, STD_UM, estimate.y_um, shares)


def test_an_effect_has_a_gain_of_its_own():
    model = tc.load_model("quill")
    engine = Engine(dataclasses.replace(model, effects=(Gain(path="DTF", change=0.1), Gain(path="DTF", change=0.2))))
    assert len(set(engine.contribution_names)) == 4 and engine.contribution_names[:2] == ("DTF", "TDTF")
    engine.set_reference(20.0, 20.0)
    estimate = [engine.step(25.0, 20.5) for _ in range(60)][-1]
    dtf, tdtf, *effects = estimate.contributions_um
    assert (dtf, tdtf) == (estimate.y_dtf_um, estimate.y_tdtf_um) and dtf > 1.0
    assert effects == pytest.approx([0.1 * dtf, 0.2 * dtf])
    assert 0.0 < engine.y_noise_std_um < estimate.y_std_um


def test_dense_y_is_followed_without_its_noise(machine):
    """Its standard deviation is what neighbouring values show."""
    table, true, dense = machine
    found = tc.simulate("quill", table | {"y_um": dense}, correct=True)
    assert rms((true - found["y_pred_um"])[60:]) < 0.5 * STD_UM


def test_faster_rows_are_one_value_with_less_noise(machine):
    """Four values in a minute are averaged: the mean has half their standard deviation."""
    table, _, dense = machine
    fast = {name: np.repeat(values, 4) for name, values in table.items()} | {"y_um": np.repeat(dense, 4)}
    fast["t_s"] = np.arange(fast["t_s"].size) * 15.0
    one = tc.simulate("quill", table | {"y_um": dense}, correct=True, y_std_um=STD_UM / 2.0)
    other = tc.simulate("quill", fast, correct=True, y_std_um=STD_UM)
    np.testing.assert_allclose(other["y_std_um"], one["y_std_um"], rtol=1e-9)


def test_a_chip_is_refused_and_named(machine):
    table, true, _ = machine
    y = table["y_um"].copy()
    row = 30 + 60 * 15
    y[row] += 20.0
    found = tc.simulate("quill", table | {"y_um": y}, correct=True, y_std_um=STD_UM)
    assert found["y_pred_um"][row + 1] == pytest.approx(true[row + 1], abs=4.0)
    (remark,) = [remark for remark in found.remarks if remark.code is DataRemark.Y_REFUSED]
    assert f"1 of 24 measured y_um refused, at t_s = {row * 60:g}" in remark


def test_a_jump_that_stays_is_believed_and_named(machine):
    table, *_ = machine
    y = table["y_um"].copy()
    y[30 + 60 * 15 :] += 60.0
    found = tc.simulate("quill", table | {"y_um": y}, correct=True, y_std_um=STD_UM)
    assert DataRemark.Y_BELIEVED in {remark.code for remark in found.remarks}
    assert abs(found["residual_um"][30 + 60 * 20]) < 8.0


def test_the_table_compares_ways(machine, tmp_path):
    table, *_ = machine
    out = tmp_path / "out.csv"
    words = ["simulate", write(tmp_path / "run.csv", table), "--model", "quill", "--correct", "--y-std", STD_UM]
    code, text, _ = run(*words, "--out", out)
    assert code == 0
    for name in ("no compensation", "last measured Y held", "model alone", "model corrected"):
        assert name in text
    found = json.loads(run(*words, "--out", out, "--json")[1])
    assert found["rms_um"] < found["beside"]["model alone"]["rms_um"] < found["beside"]["no compensation"]["rms_um"]
    same = tc.simulate("quill", table, correct=True, y_std_um=STD_UM).to_dict()
    assert found == json.loads(json.dumps(same)) | {"out": str(out)}
    with out.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == table["t_s"].size and {"y_pred_um", "y_std_um", "residual_um"} <= rows[0].keys()
    assert sum(bool(row["residual_um"]) for row in rows) == 24


def test_the_deviation_is_asked_for_where_y_cannot_show_it(machine, tmp_path):
    table, *_ = machine
    path = write(tmp_path / "run.csv", table)
    code, _, errors = run("simulate", path, "--model", "quill", "--correct", "--out", tmp_path / "out.csv")
    assert code == 2 and errors.count("\n") == 1 and "--y-std" in errors and "24 value(s) in 1440 samples" in errors
    for wrong in ("0", "-1", "nan", "inf"):
        words = ["--model", "quill", "--correct", f"--y-std={wrong}", "--out", tmp_path / "out.csv"]
        code, _, errors = run("simulate", path, *words)
        assert code == 2 and "above 0" in errors


def test_without_correct_nothing_changes(machine, tmp_path):
    table, *_ = machine
    path = write(tmp_path / "run.csv", table)
    for name, more in (("a.csv", []), ("b.csv", ["--y-std", "1.5"])):
        assert run("simulate", path, "--model", "quill", "--out", tmp_path / name, *more)[0] == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert "y_free_um" not in (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()[0]


def test_without_y_there_is_nothing_to_correct_by(machine):
    table, *_ = machine
    inputs = {name: values for name, values in table.items() if name != "y_um"}
    with pytest.raises(tc.CompensatorError, match="no column y_um"):
        tc.simulate("quill", inputs, correct=True, y_std_um=1.5)


def test_a_single_measured_value_is_the_zero_and_judges_nothing(machine):
    table, *_ = machine
    first = np.flatnonzero(np.isfinite(table["y_um"]))[0]
    one = table | {"y_um": np.where(np.arange(table["t_s"].size) == first, table["y_um"], np.nan)}
    found = tc.simulate("quill", one, correct=True, y_std_um=STD_UM)
    assert found.scores is None and found.beside == {}
    assert "nan" not in found.summary()
    assert "No errors: after the first measured Y" in found.summary()
    assert set(found.to_dict()) == {"samples", "records"}


@pytest.mark.parametrize("y_std_um", [0.0, -1.0, 1e155, float("inf"), float("nan")])
def test_a_deviation_that_cannot_be_meant_is_refused_in_one_line(machine, y_std_um):
    table, *_ = machine
    with pytest.raises(tc.CompensatorError, match=r"--y-std") as refused:
        tc.simulate("quill", table, correct=True, y_std_um=y_std_um)
    assert "\n" not in str(refused.value)
