"""Curves keep their peaks and their gaps, pictures their own names."""

import dataclasses
import html
import json
import re

import numpy as np
import pytest

from compensator.report.drawing import svg
from compensator.report.figure import Bar, Figure, Line, thinned
from compensator.report.page import Page, Table, write_page


def drawn(x, y, **changes):
    return svg(Figure(title="t", x_label="x", y_label="y", lines=(Line("one", x, y),), **changes), "p")


def test_a_short_curve_is_kept_whole():
    assert thinned(np.arange(1400.0), np.zeros(1400)).tolist() == list(range(1400))
    assert thinned(np.arange(50_000.0), np.sin(np.arange(50_000))).size < 2500


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_every_peak_is_kept_wherever_it_stands(sign):
    y = np.sin(np.arange(20_000) / 900.0)
    peaks = np.arange(7, 20_000, 501)
    y[peaks] += 10.0 * sign
    keep = thinned(np.arange(20_000.0), y)
    assert set(peaks.tolist()) <= set(keep.tolist())
    assert {0, 19_999} <= set(keep.tolist())
    assert np.all(np.diff(keep) > 0)


def test_a_gap_of_one_sample_is_kept():
    y = np.zeros(20_000)
    y[12_345] = np.nan
    assert 12_345 in thinned(np.arange(20_000.0), y)


def test_a_curve_of_nothing_but_gaps_is_drawn_as_nothing():
    assert "<svg" in drawn(np.arange(5000.0), np.full(5000, np.nan))


def test_the_same_picture_is_the_same_text():
    x = np.arange(50.0)
    assert drawn(x, x) == drawn(x, x)


def test_label_for_those_who_do_not_see_it():
    x = np.arange(5.0)
    text = svg(Figure(title='a "b" <c>', x_label="x", y_label="y", lines=(Line("one", x, x),), note="n & m"), "p")
    assert re.search(r'<svg role="img" aria-label="a &quot;b&quot; &lt;c&gt;\. n &amp; m"', text)


def test_text_stays_text():
    assert ">residual, µm<" in svg(
        Figure(title="t", x_label="h", y_label="residual, µm", lines=(Line("one", np.arange(5.0), np.arange(5.0)),)),
        "p",
    )


def test_every_variable_the_page_uses_is_defined_in_light_dark_and_print(tmp_path):
    x = np.arange(5.0)
    lines = tuple(Line(str(i), x, x + i) for i in range(6))
    blocks = [Figure(title="same", x_label="x", y_label="y", lines=lines)] * 2 + [Table(head=["a"], rows=[["1"]])]
    text = write_page(tmp_path / "p.html", Page(title="t", verdict="v", blocks=blocks, tone="bad")).read_text("utf-8")
    schemes = re.findall(r":root\s*\{(.*?)\}", text, re.S)
    assert len(schemes) == 3
    assert "prefers-color-scheme: dark" in text and "@media print" in text
    used = set(re.findall(r"var\((--[\w-]+)\)", text))
    assert {"--line-0", "--line-4", "--ink", "--grid", "--bad"} <= used
    for scheme in schemes:
        assert used <= set(re.findall(r"(--[\w-]+)\s*:", scheme))
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids)) > 10
    assert "✗ Failed" in text


def test_figures_below_each_other_line_up():
    """Whatever the numbers at their y axes are."""
    lefts = []
    for size in (1.0, 0.09, 400.0):
        x = np.linspace(0.0, 24.0, 50)
        figure = Figure(title="t", x_label="time, h", y_label="µm", lines=(Line("a", x, size * np.sin(x)),))
        plot = json.loads(html.unescape(re.search(r'data-plot="([^"]*)"', svg(figure, "f"))[1]))
        lefts.append(plot["panels"][0]["box"][0])
    assert max(lefts) - min(lefts) < 1.0


def test_only_a_waterfall_joins_its_bars():
    bars = (Bar("a", "1", 0.0, 1.0), Bar("b", "2", 0.0, 2.0))
    alone = tuple(dataclasses.replace(bar, joined=False) for bar in bars)
    joined, apart = (
        svg(Figure(title="t", x_label="min", y_label="", bars=some), "f").count("LineCollection")
        for some in (bars, alone)
    )
    assert (joined, apart) == (1, 0)
