"""The page of a calibration shows every run, what was held out, and how good it is."""

import dataclasses
import html
import re

import numpy as np
import pytest

from compensator.identify.calibration import calibrate
from compensator.identify.criticism import criticise
from compensator.identify.settings import Settings
from compensator.identify.summary import errors_of
from compensator.model.simulation import Scores
from compensator.report.identification import _joined, page_of, tone_of
from compensator.report.page import write_page
from tests.identify.quill_runs import CALIBRATION_W, published, runs_from


def run(name, seed):
    _, ambient, difference, y, _, _ = published(CALIBRATION_W, seed)
    return runs_from({"t_q_degc": 21.0 + ambient + difference, "at_degc": 21.0 + ambient, "y_um": y}, name=name)


@pytest.fixture(scope="module")
def calibration():
    settings = Settings(kind="direct", order=(2, 2, 1), folds=2)
    return calibrate(
        run("day <1>.csv", 1),
        settings,
        period_s=60.0,
        name="a & b",
        validation=run("other.csv", 2),
        fit_until_s=9 * 3600.0,
        remarks=["day <1>.csv: gap of 3 sample(s)"],
        provenance={"data": [{"role": "fit", "file": "day <1>.csv", "sha256": "ab" * 32}]},
    )


@pytest.fixture(scope="module")
def page(calibration, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    model = dataclasses.replace(calibration.model, sha256="cd" * 32)
    assert write_page(path, page_of(calibration, criticise(calibration), model)) == path
    return path.read_text(encoding="utf-8")


def test_names_of_files_and_models_are_escaped(page):
    assert "day &lt;1&gt;.csv" in page and "day <1>" not in page
    assert "Calibration: a &amp; b" in page


def test_hashes_warnings_and_remarks_are_there(page, calibration):
    assert "ab" * 32 in page and "cd" * 32 in page
    assert "gap of 3 sample(s)" in page
    for warning in criticise(calibration).warnings:
        # A command is shown as the code that it is.
        words = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(warning))
        assert f'<li>{words} <a href="#word-{warning.code}">' in page
        assert f'<div id="word-{warning.code}">' in page


def test_identifiers_are_unique_over_all_pictures(page):
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids)) > 100
    assert page.count("<svg ") >= 12


def test_every_part_is_a_row_with_its_own_errors(page, calibration):
    assert [part.role for part in calibration.parts] == ["fitted", "held out", "held out"]
    rows = [
        [html.unescape(cell) for cell in re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row)]
        for row in re.findall(r"<tr>(.*?)</tr>", page)
    ]
    for part in calibration.parts:
        figures = (
            part.y_um.size / 60,
            part.model.rms_um,
            part.model.peak_to_peak_um,
            part.model.fit_pct,
            part.nothing.rms_um,
        )
        shown = [f"{value:.{1 if i == 0 else 2}f}" for i, value in enumerate(figures)]
        assert [part.name, part.role, *shown] in rows


def test_without_heat_nothing_is_said_of_a_ttf(page):
    assert "DTF: step response" in page and "TDTF: step response" in page
    assert ">TTF: " not in page


def test_parts_follow_each_other_with_a_gap_between_files(calibration):
    t, y, predicted, spans = _joined(calibration.parts)
    assert t.size == y.size == predicted.size == 720 + 1 + 720
    assert np.all(np.diff(t) >= 0.0)
    assert np.flatnonzero(np.isnan(y)).tolist() == [720]
    assert t[721] - t[719] == pytest.approx(0.5)
    assert y[721:] == pytest.approx(calibration.parts[2].y_um)
    # The end of the fitted file and the whole of the other one took no part; the legend names that once.
    assert [span.name for span in spans] == ["held out", ""]
    assert (spans[0].first, spans[0].last) == pytest.approx((9.0, 12.0 - 1 / 60))
    assert spans[1].last - spans[1].first == pytest.approx(12.0 - 1 / 60)


@pytest.mark.parametrize(("rms", "tone"), [(0.09, "good"), (0.5, "warn"), (1.0, "bad"), (3.0, "bad")])
def test_the_tone_is_that_of_the_worst_held_out_part(calibration, rms, tone):
    def score(value):
        return Scores(fit_pct=0.0, rms_um=value, peak_to_peak_um=0.0)

    fitted, first, second = calibration.parts
    parts = (
        dataclasses.replace(fitted, model=score(100.0), nothing=score(1.0)),
        dataclasses.replace(first, model=score(0.01), nothing=score(1.0)),
        dataclasses.replace(second, model=score(rms), nothing=score(1.0)),
    )
    assert tone_of(errors_of(dataclasses.replace(calibration, parts=parts))) == tone


@pytest.mark.parametrize(("rms", "tone"), [(0.09, "good"), (0.5, "warn"), (1.0, "bad")])
def test_without_held_out_data_the_folds_set_the_tone(calibration, rms, tone):
    fitted = dataclasses.replace(calibration.parts[0], nothing=Scores(fit_pct=0.0, rms_um=2.0, peak_to_peak_um=0.0))
    folds_only = dataclasses.replace(calibration, parts=(fitted,), folds_rms_um=2.0 * rms)
    assert tone_of(errors_of(folds_only)) == tone
