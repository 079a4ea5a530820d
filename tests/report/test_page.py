"""Pages stand alone, hold together and hide nothing."""

import re
from html.parser import HTMLParser
from importlib import resources

import numpy as np
import pytest

from compensator.report.figure import COLOURS, svg, thinned
from compensator.report.page import (
    Details,
    Figure,
    Line,
    Marks,
    Page,
    Row,
    Section,
    Span,
    Stems,
    Table,
    Words,
    write_page,
)  # fmt: skip

X = np.arange(5000.0)
VOID = {"meta", "br", "img", "link", "use", "path", "defs", "rect", "line", "circle"}


def figure(title="a picture"):
    y = np.sin(X / 300.0)
    y[2000:2300] = np.nan
    return Figure(
        title=title, x_label="time, h", y_label="Y, µm", lines=(Line("one", X, y, (y - 0.1, y + 0.1)),),
        marks=(Marks("poles", np.array([0.9]), np.array([0.0])),), spans=(Span("held out", 10.0, 90.0),),
        stems=(Stems("bars", X[:5], X[:5]),), limits=(0.5,), note="a <note>",
    )  # fmt: skip


@pytest.fixture
def page(tmp_path):
    blocks = [
        figure(), Row(figures=(figure(), figure("another"))),
        Table(title="errors", head=["data", "rms µm"], rows=[["a & b", "1.0"]]),
        Words(title="Warnings", lines=["mind <this>"], kind="warning"),
        Section(title="more", blocks=[Details(title="to open", blocks=[figure()])]),
    ]  # fmt: skip
    path = write_page(
        tmp_path / "p.html", Page(title="<script>alert(1)</script>", verdict="it is & works", blocks=blocks)
    )
    return path.read_text(encoding="utf-8")


def test_words_are_escaped(page):
    assert "<script" not in page
    assert "mind &lt;this&gt;" in page
    assert "a &lt;note&gt;" in page


def test_nothing_is_loaded_from_anywhere(page):
    urls = set(re.findall(r"https?://[^\"'\s<)]+", page))
    assert all(
        "w3.org" in url or "purl.org" in url or "creativecommons" in url or "matplotlib.org" in url for url in urls
    )
    assert not re.search(r"<(script|link|img|iframe)\b", page)
    assert "@import" not in page


def test_identifiers_are_unique(page):
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    for target in re.findall(r'(?:href="#|url\(#)([^")]+)', page):
        assert target in ids


def test_every_colour_is_defined_in_every_scheme():
    style = resources.files("compensator.report").joinpath("style.css").read_text(encoding="utf-8")
    schemes = re.findall(r":root \{(.*?)\}", style, re.S)
    assert len(schemes) == 3
    for scheme in schemes:
        for variable in (*COLOURS.values(), "--paper", "--good", "--warn", "--bad"):
            assert f"{variable}:" in scheme


def test_placeholder_colours_do_not_survive(page):
    assert not any(colour in page for colour in COLOURS)


def test_tags_are_balanced(page):
    class Checker(HTMLParser):
        def __init__(self):
            super().__init__()
            self.open = []

        def handle_starttag(self, tag, attrs):
            if tag not in ("meta",):
                self.open.append(tag)

        def handle_startendtag(self, tag, attrs):
            pass

        def handle_endtag(self, tag):
            assert self.open.pop() == tag

    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    assert "<details><summary>to open</summary>" in page


def test_a_gap_is_not_drawn_over():
    y = np.sin(X / 100.0)
    y[2000:2300] = np.nan
    keep = thinned(X, y)
    assert np.isnan(y[keep]).any()
    text = svg(Figure(title="gap", x_label="x", y_label="y", lines=(Line("one", X, y),)), "p")
    curve = max(re.findall(r'<path d="([^"]+)"', text), key=len)
    assert curve.count("M") >= 2


def test_one_peak_in_many_samples_is_seen():
    y = np.zeros(5000)
    y[3210] = 1.0
    assert 3210 in thinned(X, y)
