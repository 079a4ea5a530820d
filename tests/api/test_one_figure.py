"""How good a model is has one figure, in every command and on every page: its free run about the service's zero."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compensator.cli import main
from compensator.demo.calibration import write_table
from tests.api.tables import write_run
from tests.diagnose.scenarios import draw, record
from tests.identify.quill_runs import CALIBRATION_W

#: The figure is a number in words here; no picture is looked at.
pytestmark = pytest.mark.usefixtures("without_pictures", "equal_questions_once")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the published machine, and one with an effect that its model lacks, whose Y has an offset."""
    folder = tmp_path_factory.mktemp("runs")
    write_run(folder / "run.csv", CALIBRATION_W, 1)
    columns, _, _ = record([draw("input", 4)], 79, 10.0)
    y = columns.pop("y_um") + 250.0
    write_table(folder / "effect.csv", {"t_s": np.arange(y.size) * 60.0, "y_um": y, **columns})
    return folder


def run(capfd: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert main([*map(str, words), "--json"]) == 0
    found: dict[str, Any] = json.loads(capfd.readouterr().out)
    return found


def test_the_same_figure_and_words_everywhere(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data, model = folder / "effect.csv", tmp_path / "model.toml"
    identified = run(capfd, "identify", folder / "run.csv", "--validate", data, "--order", 1, 1, 1, "--out", model)
    simulated = run(capfd, "simulate", data, "--model", model, "--out", tmp_path / "out.csv")
    compared = run(capfd, "compare", data, "--model", model, "--model", "quill", "--page", tmp_path / "compared.html")
    diagnosed = run(capfd, "diagnose", data, "--model", model, "--out", tmp_path / "d")

    held_out = next(one for one in identified["free_run"] if one["role"] == "held out")
    (searched,) = diagnosed["free_run"]
    keys = ("rms_um", "rms_about_mean_um", "mean_abs_um", "peak_to_peak_um", "fit_pct")
    wanted = {key: simulated[key] for key in keys}
    assert wanted["rms_um"] > wanted["rms_about_mean_um"] > 0.0
    assert held_out["scores"]["model"] == wanted
    assert searched["scores"]["base model"] == wanted
    assert compared["scores"]["model"] == wanted
    for scores in (held_out["scores"], searched["scores"], compared["scores"]):
        assert scores["no compensation"] == simulated["no_compensation"]

    # Independent of the code above: the first row is the zero.
    with (tmp_path / "out.csv").open(encoding="utf-8") as file:
        residual = np.array([float(row["residual_um"]) for row in csv.DictReader(file)])
    assert residual[0] == 0.0
    assert wanted["rms_um"] == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-6)
    assert wanted["rms_about_mean_um"] == pytest.approx(np.std(residual), rel=1e-6)

    words = re.compile(r"n free run ([\d.]+) µm rms about the zero, ([\d.]+) about the mean")
    shown = (f"{wanted['rms_um']:.2f}", f"{wanted['rms_about_mean_um']:.2f}")
    for page in ("model-calibration.html", "d/report.html"):
        text = (tmp_path / page).read_text(encoding="utf-8")
        assert (found := words.search(text)) is not None and found.groups() == shown, page
    assert main(["simulate", str(data), "--model", str(model), "--out", str(tmp_path / "out.csv")]) == 0
    assert (found := words.search(capfd.readouterr().out)) is not None and found.groups() == shown
    assert all(figure in (tmp_path / "compared.html").read_text(encoding="utf-8") for figure in shown)


def test_both_models_are_validated_on_what_took_no_part(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    data, other = folder / "effect.csv", folder / "run.csv"
    found = run(
        capfd, "diagnose", data, "--model", "quill", "--fit-until", 7, "--validate", other, "--out", tmp_path / "d"
    )
    roles = [(one["name"], one["role"], one["samples"]) for one in found["free_run"]]
    later = "effect.csv from 7 h on"
    assert roles == [("effect.csv", "searched", 420), (later, "held out", 180), ("run.csv", "held out", 720)]
    assert [list(one["scores"]) for one in found["free_run"]] == [
        ["base model", "extended model", "no compensation", "persistence"],
        ["base model", "extended model", "no compensation", "persistence"],
        ["base model", "no compensation", "persistence"],
    ]
    late = run(capfd, "compare", data, "--model", "quill", "--model", tmp_path / "d" / "model.toml", "--from", 7)
    assert found["free_run"][1]["scores"]["base model"] in late["scores"].values()
    assert found["free_run"][1]["scores"]["extended model"] in late["scores"].values()
    assert main(["diagnose", str(data), "--model", "quill", "--validate", str(data), "--out", str(tmp_path / "d")]) == 2
    assert "is used for the fit" in capfd.readouterr().err
    assert main(["diagnose", str(data), "--model", "quill", "--fit-until", "0", "--out", str(tmp_path / "d")]) == 2
    assert "no rows before 0 h" in capfd.readouterr().err


def test_compare_names_models_and_writes_curves(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    same = tmp_path / "same.toml"
    main(["identify", str(folder / "run.csv"), "--order", "1", "1", "1", "--out", str(same), "--name", "quill"])
    capfd.readouterr()
    out = tmp_path / "curves.csv"
    found = run(capfd, "compare", folder / "run.csv", "--model", "quill", "--model", same, "--out", out)
    assert list(found["scores"])[:2] == ["quill", str(same)]
    with out.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 720
    for row in rows[::100]:
        y = float(row["y_um"])
        predictions = [float(value) for name, value in row.items() if name.startswith("y_pred_um")]
        residuals = [float(value) for name, value in row.items() if name.startswith("residual_um")]
        assert len(predictions) == 2
        assert [y - one for one in predictions] == pytest.approx(residuals, abs=1e-6)
    assert main(["compare", str(folder / "run.csv"), "--model", "quill", "--model", "quill"]) == 2
    assert "given 2 times" in capfd.readouterr().err


def refused(capfd: pytest.CaptureFixture[str], *words: object) -> str:
    assert main([*map(str, words)]) == 2
    return capfd.readouterr().err


def test_the_same_values_do_not_count_twice(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Also under another name, and with semicolons."""
    copy = tmp_path / "copy.csv"
    copy.write_text((folder / "run.csv").read_text(encoding="utf-8").replace(",", ";"), encoding="utf-8")
    for words in (
        ["identify", folder / "run.csv", copy, "--out", tmp_path / "m.toml"],
        ["compare", copy, copy, "--model", "quill"],
    ):
        assert "expected each run once" in refused(capfd, *words)


def test_a_wrong_unit_is_no_worse_model(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with (folder / "run.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for column, change, words in (
        ("y_um", lambda v: v / 1000.0, "millimetres"),
        ("t_q_degc", lambda v: v + 273.15, "kelvin"),
    ):
        table = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
        write_table(tmp_path / "wrong.csv", table | {column: change(table[column])})
        assert words in refused(capfd, "compare", tmp_path / "wrong.csv", "--model", "quill")


def test_what_is_said_of_readings_is_said_of_both_records(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """At the end of its range T_Q is refused, another channel is not used there, whatever the record is for."""
    with (folder / "run.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    table = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    cut = tmp_path / "cut.csv"
    common = ["--model", "quill", "--out", tmp_path / "d"]
    for column, share in (("t_q_degc", 0.6), ("y_um", 0.6)):
        low, high = table[column].min(), table[column].max()
        rng = np.random.default_rng(0)
        noisy = table[column] + rng.normal(0.0, 0.002 * (high - low), table[column].size)
        write_table(cut, table | {column: np.minimum(noisy, low + share * (high - low))})
        for words in (["diagnose", cut], ["diagnose", folder / "effect.csv", "--validate", cut]):
            if column == "t_q_degc":
                text = refused(capfd, *words, *common)
                assert "cut.csv: t_q_degc stands at exactly" in text
            else:
                assert main([*map(str, [*words, *common])]) == 0
                assert capfd.readouterr().out.count("cut.csv: y_um stands at exactly") == 1


def test_hours_that_took_no_part_are_named(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["diagnose", folder / "effect.csv", "--model", "quill", "--out", tmp_path / "d", "--fit-until", 7]
    found = run(capfd, *words)
    assert [one["name"] for one in found["free_run"] if one["role"] == "held out"] == ["effect.csv from 7 h on"]


def test_data_that_end_before_validate_nothing(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["diagnose", folder / "effect.csv", "--model", "quill", "--out", tmp_path / "d", "--fit-until", 10]
    assert "the data end after" in refused(capfd, *words)


def spoilt(table: dict[str, np.ndarray], how: str) -> dict[str, np.ndarray]:
    """Return a table with data that are missing, impossible or contradict each other."""
    t_q, size = table["t_q_degc"].copy(), table["t_s"].size
    match how:
        case "every other":
            t_q[::2] = np.nan
        case "half, at random":
            t_q[np.random.default_rng(1).permutation(size)[: size // 2]] = np.nan
        case "hours":
            t_q[300:600] = np.nan
        case "wild":
            t_q[50] = 1e5
        case "hotter than the calibration":
            t_q += np.clip(np.arange(size) - 300, 0, 120) * 0.5
        case "equal times":
            times = table["t_s"].copy()
            times[100:110] = times[100]
            return table | {"t_s": times}
        case "contradicting":
            twice = {name: np.repeat(values, 2) for name, values in table.items()}
            twice["y_um"][1::2] += 50.0
            return twice
    return table | {"t_q_degc": t_q}


@pytest.mark.parametrize(
    ("how", "codes"),
    [
        ("every other", {"temperature_sparse"}),
        ("half, at random", {"temperature_sparse"}),
        ("hours", {"temperature_missing"}),
        ("wild", {"wild_readings"}),
        ("hotter than the calibration", {"outside_validity"}),
        ("equal times", {"times_equal", "gap_bridged"}),
        ("contradicting", {"times_equal"}),
        ("as it was", set()),
    ],
)
def test_compare_says_of_the_data_what_simulate_says(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], how: str, codes: set[str]
) -> None:
    with (folder / "run.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    table = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    data, page = tmp_path / "data.csv", tmp_path / "page.html"
    write_table(data, spoilt(table, how))
    assert main(["simulate", str(data), "--model", "quill", "--out", str(tmp_path / "o.csv")]) == 0
    said = capfd.readouterr().err.splitlines()
    words = ["compare", str(data), "--model", "quill", "--page", str(page)]
    assert main(words) == 0
    text = capfd.readouterr().out
    found = run(capfd, *words)
    assert set(found["remark_codes"]) == codes
    marked = [f"{one} [{code}]" for one, code in zip(found["remarks"], found["remark_codes"], strict=True)]
    assert sorted(marked) == sorted(said)
    assert all(one in text for one in marked)
    written = page.read_text(encoding="utf-8")
    assert ("Remarks on the data" in text) == ("Remarks on the data" in written) == bool(codes)
    assert all(f"<code>{code}</code>" in written for code in codes)
