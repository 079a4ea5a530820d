"""The notebook over the measured spindle: on its data where that is here, on a simulated spindle everywhere."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from compensator.cli import main
from compensator.model.model_file import load_model
from tests.examples.notebook import run_notebook

NOTEBOOK = Path(__file__).resolve().parents[2] / "deploy/examples/measured_spindle.ipynb"
#: Beside the clone, where whoever has the data puts it; it is no part of the project.
SPINDLE = Path(__file__).resolve().parents[3] / "shared/data/measured-spindle/spindle-15s.csv"

matplotlib.use("Agg")


def test_the_notebook_is_small_and_names_no_machine() -> None:
    text = NOTEBOOK.read_text(encoding="utf-8")
    assert len(text) < 20_000 and "image/png" not in text
    assert 'DATA = Path(\\"spindle-15s.csv\\")' in text and "/home" not in text and "/work" not in text


@pytest.mark.skipif(not SPINDLE.exists(), reason="the measured spindle is not here")
def test_the_measured_spindle_lacks_its_speed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(SPINDLE, tmp_path / "spindle-15s.csv")
    names, outputs = run_notebook(NOTEBOOK)
    assert "spindle_rpm" in [effect.channel for effect in names["why"].effects]
    rms = {name: scores.rms_um for name, scores in names["after"].scores.items()}
    assert rms["no compensation"] > 12.0
    assert rms["extended"] < 0.3 * rms["two inputs"]
    assert rms["extended"] < 0.15 * rms["no compensation"]
    assert rms["extended"] < 0.25 * rms["persistence"]
    assert outputs.count("PNG") == 3
    assert (tmp_path / "spindle-out/diagnosis/report.html").exists()


def test_a_simulated_spindle_goes_the_same_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    simulated_spindle().to_csv("spindle-15s.csv", index=False)
    names, outputs = run_notebook(NOTEBOOK)
    effects = names["why"].effects
    assert (effects[0].kind, effects[0].channel) == ("input", "spindle_rpm")
    rms = {name: scores.rms_um for name, scores in names["after"].scores.items()}
    assert rms["extended"] < 0.5 * rms["two inputs"] < 0.5 * rms["no compensation"]
    assert outputs.count("PNG") == 3 and "<td>extended</td>" in "".join(outputs)
    assert "Input: spindle_rpm" in "".join(outputs)
    out = tmp_path / "spindle-out"
    assert load_model(out / "diagnosis/model.toml").effects
    assert json.loads((out / "diagnosis/diagnosis.json").read_text(encoding="utf-8"))["verdict"] != "unexplained"
    assert {path.name for path in out.iterdir()} == {"two-inputs.toml", "diagnosis", "comparison.html", "extended.csv"}
    assert len(pd.read_csv(out / "extended.csv")) == 32 * 60


def simulated_spindle() -> pd.DataFrame:
    """32 h of the published machine at changing speeds and loads; the speed also bends it, which T_Q does not show."""
    rng = np.random.default_rng(4)
    n, quill = 32 * 60, load_model("quill")
    assert quill.ttf is not None and quill.tdtf is not None
    rpm = np.repeat(rng.choice([0.0, 2000.0, 4000.0, 6000.0], 32), 60)
    rpm[:60] = 0.0
    load = np.repeat(rng.choice([0.0, 0.5, 1.0], 32), 60)
    heat, air = np.where(rpm > 0.0, 100.0 * load, 0.0), 1.5 * np.sin(2.0 * np.pi * np.arange(n) / 1440.0)
    bent = np.zeros(n)
    for i in range(1, n):
        bent[i] = bent[i - 1] + (0.004 * rpm[i] - bent[i - 1]) / 10.0
    y = quill.dtf.sampled.response(heat) + quill.tdtf.sampled.response(air) + bent

    def logged(values: np.ndarray, noise: float) -> np.ndarray:
        return np.repeat(values, 4) + rng.normal(0.0, noise, 4 * n)

    columns = {"t_s": np.arange(4 * n) * 15.0, "spindle_rpm": np.repeat(rpm, 4)}
    columns |= {f"ch{i}_um": logged(y, 0.3) for i in (1, 2)}
    at = 21.0 + air
    columns |= {f"t{i}_degc": logged(at, 0.05) for i in (1, 2, 5, 16)}
    columns["t5_degc"] = logged(at + quill.ttf.sampled.response(heat), 0.05)
    return pd.DataFrame(columns).round(4)


def test_the_example_for_users_of_matlab_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    table = simulated_spindle().iloc[: 24 * 240 : 4]
    roles = {"t_s": "t_s", "t_q_degc": "t5_degc", "at_degc": "t16_degc", "y_um": "ch1_um", "spindle_rpm": "spindle_rpm"}
    savemat("run.mat", {role: table[name].to_numpy()[:, None] for role, name in roles.items()})
    page = (NOTEBOOK.parent / "MATLAB.md").read_text(encoding="utf-8")
    exec(page.partition("```python\n")[2].partition("```")[0], {})
    said = capsys.readouterr().out
    assert "persistence" in said and "explained" in said and "spindle_rpm" in said
    assert {path.name for path in tmp_path.iterdir()} >= {"spindle.toml", "report.html", "spindle.png"}
    assert main(["simulate", "run.mat", "--model", "spindle.toml", "--out", "predicted.csv"]) == 0
