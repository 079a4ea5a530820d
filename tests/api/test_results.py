"""Results show, draw, and save what they found."""

from __future__ import annotations

import dataclasses
import html
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import compensator as tc
from compensator.api.simulation_result import SimulationResult
from compensator.display import with_std
from compensator.model.free_run import TITLE
from tests.api.tables import arrays, frame, write_run
from tests.identify.quill_runs import CALIBRATION_W, VALIDATION_W

matplotlib.use("Agg")
pytestmark = pytest.mark.usefixtures("equal_pictures_once")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("data") / "run.csv", CALIBRATION_W, 1)


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("data") / "other.csv", VALIDATION_W, 2)


@pytest.fixture(scope="module")
def found(run: Path, other: Path):  # type: ignore[no-untyped-def]
    return tc.identify([frame(run)], validate=frame(other), order=(2, 2, 2))


def shown(result: object) -> bytes:
    """What a notebook draws of a figure."""
    figure = result.plot()  # type: ignore[attr-defined]
    assert isinstance(figure, Figure)
    data = figure._repr_png_()
    assert data.startswith(b"\x89PNG")
    return data


def test_an_identification_shows_draws_and_writes_itself(tmp_path: Path, found: object) -> None:
    assert repr(found) == found.summary()
    page = found._repr_html_()
    for words in ("dtf_gain_um_per_w", "held out", "± ", "[validity_range]"):
        assert words in page
    assert len(shown(found)) > 10_000
    for name in ("page.html", "page.pdf", "page.png"):
        assert found.page(tmp_path / name).stat().st_size > 1000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html", "page.pdf", "page.png"]
    with pytest.raises(tc.CompensatorError, match=r"page.txt: expected a name that ends in .html, .pdf or .png"):
        found.page(tmp_path / "page.txt")


def test_terminal_notebook_and_page_show_the_same_tables(tmp_path: Path, found: object) -> None:
    page = found.page(tmp_path / "page.html").read_text(encoding="utf-8")
    tables = found.tables()
    assert [table.title for table in tables] == [
        "Gains and time constants",
        TITLE,
        "Errors of the fit: zero from the data",
    ]
    for shown in (page, found._repr_html_(), found.summary()):
        for table in tables:
            assert all(html.escape(cell) in shown for row in table.rows for cell in row)


def test_a_model_shows_its_gains_as_its_file_does(tmp_path: Path, found: object) -> None:
    gain, std = found.params["dtf_gain_um_per_w"], found.std_errors["dtf_gain_um_per_w"]
    text = found.save(tmp_path / "model.toml").read_text(encoding="utf-8")
    assert f"Gain at rest {gain:.5g} +- {std:.2g} um/W (one standard error)" in text
    for model in (found.model, tc.load_model(tmp_path / "model.toml")):
        assert model.dtf.gain_std == std
        assert f"<td>{with_std(gain, std)}</td><td>µm/W</td>" in model._repr_html_()


def test_what_the_data_do_not_determine_has_no_standard_error(found: object) -> None:
    first, *paths = found.criticism.paths
    wide = dataclasses.replace(first, gain_std=228246.0)
    poor = dataclasses.replace(found, criticism=dataclasses.replace(found.criticism, paths=(wide, *paths)))
    assert np.isnan(poor.std_errors["ttf_gain_k_per_w"]) and np.isfinite(poor.params["ttf_gain_k_per_w"])
    assert "228246" not in poor.summary() and "(not determined)" in poor.summary()


def test_the_predictions_are_those_that_the_errors_were_computed_of(found: object) -> None:
    table = found.predictions
    assert isinstance(table, pd.DataFrame)
    held_out = table[table["part"] == "held out"]
    assert np.sqrt(np.mean(held_out["residual_um"] ** 2)) == pytest.approx(found.to_dict()["parts"][1]["rms_um"])
    assert set(table["data"]) == {"data 1", "validate"} or set(table["data"]) == {"data", "validate"}


def test_what_was_fitted_cannot_judge_wherever_it_was_copied_to(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.csv"
    copy.write_bytes(run.read_bytes())
    for data, validate in ((run, copy), (frame(run), frame(run)), (tc.read(arrays(run)), arrays(run))):
        with pytest.raises(tc.CompensatorError, match="is used for the fit"):
            tc.identify(data, validate=validate)


def test_a_diagnosis_shows_draws_and_writes_itself(tmp_path: Path, run: Path) -> None:
    slow = dataclasses.replace(tc.load_model("quill"), y_std_um=0.1)
    why = tc.diagnose(slow, frame(run))
    assert why.verdict == "adequate" and why.effects == ()
    assert repr(why) == why.summary() and "adequate" in why._repr_html_()
    assert len(shown(why)) > 5_000
    assert why.page(tmp_path / "why.html").exists()


def test_a_free_run_shows_and_draws_itself(run: Path) -> None:
    out = tc.simulate("quill", arrays(run))
    assert isinstance(out, SimulationResult)
    assert "720 samples" in repr(out) and "about zero" in out._repr_html_()
    assert len(shown(out)) > 5_000
    without = {name: values for name, values in arrays(run).items() if name != "y_um"}
    alone = tc.simulate("quill", without)
    assert alone.scores is None and "residual_um" not in alone and "rms_um" not in alone.to_dict()
    # A logger writes the column of a sensor that is not connected, too.
    empty = tc.simulate("quill", without | {"y_um": np.full(arrays(run)["y_um"].size, np.nan)})
    assert empty.scores is None and empty.nothing is None and "rms_um" not in empty.to_dict()
    np.testing.assert_array_equal(alone["y_pred_um"], out["y_pred_um"])
    assert len(shown(alone)) > 5_000
    # Two runs are one after another; a column that only one of them has is missing in the other.
    both = tc.simulate("quill", [arrays(run), without])
    assert both.records == 2 and np.isnan(both["residual_um"][720:]).all()
    assert both.scores == out.scores


def test_a_comparison_scores_all_on_the_same_samples(tmp_path: Path, found: object, run: Path, other: Path) -> None:
    ours = tc.compare({"quill": "quill", "found": found.model}, frame(other), from_h=4.0)
    assert list(ours.scores) == ["quill", "found", "no compensation", "persistence"]
    free = tc.simulate(found.model, other)
    late = free["t_s"] >= 4.0 * 3600.0
    y, error = free["y_um"][late], free["residual_um"][late]
    first = np.flatnonzero(late)[0]
    wanted = {"found": error, "no compensation": y, "persistence": y - free["y_um"][first - 1]}
    for name, residual in wanted.items():
        score = ours.scores[name]
        assert score.rms_um == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-12)
        assert score.peak_to_peak_um == pytest.approx(np.ptp(residual), rel=1e-12)
        assert score.fit_pct == pytest.approx(
            100.0 * (1.0 - np.linalg.norm(residual) / np.linalg.norm(y - y.mean())), rel=1e-9
        )
    assert ours.samples == int(late.sum()) == ours.to_dict()["samples"]
    assert list(ours.table.index) == list(ours.scores)
    assert "persistence" in ours.summary() and repr(ours) == ours.summary()
    assert "<td>found</td>" in ours._repr_html_()
    assert len(shown(ours)) > 5_000
    for name in ("ours.html", "ours.png"):
        assert ours.page(tmp_path / name).stat().st_size > 1000
    several = tc.compare({"quill": "quill"}, [arrays(run), arrays(other)])
    assert several.samples == 720 + 960 and several.table["name"] == ["quill", "no compensation", "persistence"]
    assert (np.diff(several.t_h) >= 0).all()


def test_what_cannot_be_compared_is_refused(run: Path) -> None:
    with pytest.raises(tc.CompensatorError, match="no models, expected one at least"):
        tc.compare({}, run)
    with pytest.raises(tc.CompensatorError, match="no y_um from 400 h on"):
        tc.compare({"quill": "quill"}, run, from_h=400.0)
    with pytest.raises(tc.CompensatorError, match="no column y_um"):
        tc.compare({"quill": "quill"}, {name: values for name, values in arrays(run).items() if name != "y_um"})
