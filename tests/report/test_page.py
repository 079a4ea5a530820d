"""Pages stand alone, hold together and hide nothing."""

import itertools
import re
from html.parser import HTMLParser
from importlib import resources

import numpy as np
import pytest

from compensator.report.drawing import COLOURS, LINES, svg
from compensator.report.figure import thinned
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
)

X = np.arange(5000.0)
VOID = {"meta"}
#: The only addresses on a page: names of namespaces, which nothing loads.
NAMESPACES = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}


def figure(title="a picture"):
    y = np.sin(X / 300.0)
    y[2000:2300] = np.nan
    return Figure(
        title=title,
        x_label="time, h",
        y_label="Y, µm",
        lines=(Line("one", X, y, band=(y - 0.1, y + 0.1)),),
        marks=(Marks("poles", np.array([0.9]), np.array([0.0])),),
        spans=(Span("held out", 10.0, 90.0),),
        stems=(Stems("bars", X[:5], X[:5]),),
        limits=(0.5,),
        note="a <note>",
    )


def written(folder, *blocks, **page):
    options = {"title": "a page", "verdict": "it works"} | page
    return write_page(folder / "p.html", Page(blocks=blocks, **options)).read_text(encoding="utf-8")


def curves(text):
    """Paths of at least two points that are strokes of data, by colour, in the order drawn."""
    found = re.findall(r'<path d="([^"]+)"[^>]*style="fill: none; ([^"]+)"', text)
    return [(d, style) for d, style in found if "--line-" in style]


def one_curve(y, x=X, **options):
    text = svg(Figure(title="t", x_label="x", y_label="y", lines=(Line("one", x, y),), **options), "p")
    return curves(text)[0][0]


@pytest.fixture
def page(tmp_path):
    return written(
        tmp_path,
        figure(),
        Row(figures=(figure(), figure("another <b>"))),
        Table(title="errors", head=["data", "rms µm", "part"], rows=[["a & b", "1.0", "held out"], ["", "<i>", "x"]]),
        Words(title="Warnings", lines=["mind <this>"], kind="warning"),
        Section(
            title="more",
            blocks=[
                Details(title="to open", blocks=[figure(), Table(head=["", ""], rows=[["a", "b"]])]),
            ],
        ),
        Details(title="at the end", blocks=[Words(title="in words", lines=["plain"])]),
        title='<script>alert("1")</script>',
        verdict="it is & works",
    )


class Tree(HTMLParser):
    """Checks that tags close in the order they were opened, and collects what was met."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags = [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs), tuple(self.open)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs), tuple(self.open)))

    def handle_endtag(self, tag):
        assert self.open, f"{tag} closes nothing"
        assert self.open.pop() == tag


def test_words_are_escaped(page):
    assert "<script" not in page
    assert "<title>&lt;script&gt;" in page
    assert "<h1>&lt;script&gt;" in page
    for words in (
        "mind &lt;this&gt;",
        "a &lt;note&gt;",
        "a &amp; b",
        "&lt;i&gt;",
        "another &lt;b&gt;",
        "is &amp; works",
    ):
        assert words in page
    assert not {"i", "b", "this", "note"} & {tag for tag, attrs, above in Tree(page).tags if "figure" in above}


def test_names_of_curves_are_words_and_not_formulas(tmp_path):
    name = r'run <1> & "2" $\undefined$.csv'
    text = written(tmp_path, Figure(title="t", x_label="a $x$", y_label="y", lines=(Line(name, X, X),)))
    assert r"run &lt;1&gt; &amp; " in text
    assert r"$\undefined$.csv" in text
    assert "a $x$" in text


def test_nothing_is_loaded_from_anywhere(page):
    assert set(re.findall(r"[a-z]+://[^\"'\s<)]+", page)) <= NAMESPACES
    assert not re.search(r"<(script|link|img|iframe|object|embed)\b", page)
    assert not re.search(r"\b(src|srcset|on[a-z]+)=", page)
    assert "@import" not in page
    assert all(target.startswith("#") for target in re.findall(r'href="([^"]*)"', page))
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)", page))


def test_identifiers_are_unique(page):
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    targets = re.findall(r'(?:href="#|url\(#)([^")]+)', page)
    assert targets
    assert set(targets) <= set(ids)


def test_every_colour_is_defined_in_every_scheme(page):
    style = resources.files("compensator.report").joinpath("style.css").read_text(encoding="utf-8")
    schemes = re.findall(r":root \{(.*?)\}", style, re.S)
    assert len(schemes) == 3
    used = set(re.findall(r"var\((--[a-z0-9-]+)\)", page)) | set(COLOURS.values())
    for scheme in schemes:
        assert used <= set(re.findall(r"(--[a-z0-9-]+):", scheme))


def test_no_colour_is_fixed_in_a_picture(page):
    assert not re.search(r"#[0-9a-f]{6}\b", page[page.index("<main>") :])


def test_tags_are_balanced(page):
    tree = Tree(page)
    assert tree.open == []
    assert [tag for tag, _, _ in tree.tags].count("svg") == 4


def test_headings_come_in_order(page, tmp_path):
    words = Words(title="in words", lines=["plain"])
    for text in (page, written(tmp_path, Details(title="to open", blocks=[words]))):
        levels = [int(tag[1]) for tag, _, _ in Tree(text).tags if re.fullmatch("h[1-6]", tag)]
        assert levels[0] == 1
        assert levels.count(1) == 1
        assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


def test_every_heading_is_escaped(tmp_path):
    title = "<u>&"
    blocks = [Words(title=title, lines=[title]), Table(title=title, head=[title], rows=[[title]], note=title)]
    text = written(tmp_path, Section(title=title, blocks=blocks), Details(title=title, blocks=blocks))
    assert "<u>" not in text
    assert text.count("&lt;u&gt;&amp;") == 2 + 2 * (2 + 5)


def test_what_is_deep_keeps_a_heading_that_exists(tmp_path):
    block = Words(title="deepest", lines=["a"])
    for i in range(8):
        block = Section(title=f"level {i}", blocks=[block])
    assert max(int(tag[1]) for tag, _, _ in Tree(written(tmp_path, block)).tags if re.fullmatch(r"h\d", tag)) == 6


def test_details_open_without_a_script(page):
    tags = Tree(page).tags
    assert [above[-1] for tag, _, above in tags if tag == "summary"] == ["details", "details"]
    assert any(tag == "svg" and "details" in above for tag, _, above in tags)


def test_a_reader_without_eyes_is_told(page):
    tags = Tree(page).tags
    assert ("html", {"lang": "en"}, ()) in tags
    pictures = [attrs for tag, attrs, _ in tags if tag == "svg"]
    assert all(attrs["role"] == "img" for attrs in pictures)
    assert pictures[0]["aria-label"] == "a picture. a <note>"
    heads = [attrs["scope"] for tag, attrs, _ in tags if tag == "th"]
    # Nothing is headed by an empty cell.
    assert heads == ["col", "col", "col", "row", "row"]


@pytest.mark.parametrize(("tone", "sign"), [("good", "✓"), ("warn", "⚠"), ("bad", "✗")])
def test_a_verdict_comes_first_and_bears_a_sign(tmp_path, tone, sign):
    text = written(tmp_path, figure(), tone=tone, verdict="take this away")
    assert re.search(rf'<h1>[^<]*</h1><p class="verdict {tone}"><b>{sign} \w+</b>take this away</p>', text)


def test_a_warning_bears_a_sign_and_plain_words_none(tmp_path):
    warned = written(tmp_path, Words(title="mind", lines=["a"], kind="warning"))
    assert "⚠" in warned
    assert "⚠" not in written(tmp_path, Words(title="mind", lines=["a"]))


def test_numbers_stand_right_and_words_left(tmp_path):
    rows = [
        ["a", "1.018 ± 0.0021", "held out", "12.3", "0a3f"],
        ["b", "−3e-5", "fitted", "unstable", "77bc"],
        ["c", "169 (not determined)", "", "", "12"],
        ["d", "", "", "0.4", ""],
    ]
    text = written(tmp_path, Table(head=["name", "value", "part", "rms", "hash"], rows=rows))
    kinds = [[attrs.get("class") for tag, attrs, _ in Tree(row).tags] for row in re.findall(r"<tr>(.*?)</tr>", text)]
    assert kinds == [["text", None, "text", None, "text"]] * 5
    style = resources.files("compensator.report").joinpath("style.css").read_text(encoding="utf-8")
    assert re.search(r"th, td \{[^}]*text-align: right", style) and re.search(r"\.text \{ text-align: left", style)


def test_a_gap_is_not_drawn_over():
    y = np.sin(X / 100.0)
    y[2000:2300] = np.nan
    assert one_curve(y).count("M") == 2
    assert one_curve(y[1500:2500], X[1500:2500]).count("M") == 2


@pytest.mark.parametrize("shift", range(0, 20, 3))
def test_two_gaps_close_together_are_both_seen(shift):
    y = np.sin(X / 100.0)
    y[2000 + shift : 2011 + shift] = np.nan
    y[2020 + shift : 2031 + shift] = np.nan
    assert one_curve(y).count("M") == 3


def test_samples_lost_here_and_there_leave_the_curve():
    y = np.sin(X / 100.0)
    y[np.random.default_rng(1).random(X.size) < 0.05] = np.nan
    y[4000:4400] = np.nan
    assert one_curve(y).count("M") == 2


def test_a_curve_of_nothing_is_an_empty_picture(tmp_path):
    nothing = np.full(5000, np.nan)
    for options in ({}, {"y_log": True}, {"x_log": True}):
        lines = (Line("none", X, nothing, band=(nothing, nothing)), Line("empty", X[:0], X[:0]))
        written(tmp_path, Figure(title="t", x_label="x", y_label="y", lines=lines, **options))


def test_one_peak_in_many_samples_is_seen():
    for peak in (0, 3210, 4999):
        for sign in (1.0, -1.0):
            y = np.sin(X)
            y[peak] = 10.0 * sign
            keep = thinned(X, y)
            assert peak in keep
            assert keep.size < 1500


def test_an_infinite_value_hides_no_peak():
    y = np.zeros(5000)
    y[3210], y[3211] = 1.0, np.inf
    assert 3210 in thinned(X, y)


def test_a_logarithmic_axis_keeps_its_low_end():
    x = np.linspace(1e-4, 10.0, 50_000)
    y = 1.0 / np.hypot(1.0, 1000.0 * x)
    keep = thinned(x, y, x_log=True)
    assert keep.size < 1500
    between = np.exp(np.interp(np.log(x), np.log(x[keep]), np.log(y[keep])))
    assert np.allclose(between, y, rtol=0.02)


def test_a_band_keeps_its_own_peak():
    wide = np.ones(5000)
    wide[3210] = 50.0
    text = svg(Figure(title="t", x_label="x", y_label="y", lines=(Line("a", X, 0 * X, band=(-wide, wide)),)), "p")
    narrow = svg(Figure(title="t", x_label="x", y_label="y", lines=(Line("a", X, 0 * X, band=(0 * X, 0 * X)),)), "p")
    assert "−40" in text
    assert "−40" not in narrow


def test_curves_differ_in_more_than_their_colour():
    lines = tuple(Line(f"{i}", X[:9], X[:9] + i) for i in range(len(LINES) + 3))
    text = svg(Figure(title="t", x_label="x", y_label="y", lines=lines), "p")
    styles = [style for _, style in curves(text)][: len(lines)]
    assert len(set(styles)) == len(lines)
    dashes = [re.search(r"stroke-dasharray: ([^;]*)", style) for style in styles[: len(LINES)]]
    assert len({found and found[1] for found in dashes}) == len(LINES)


def test_long_names_leave_the_axes_their_width():
    def width(name):
        lines = tuple(Line(f"{name} {i}", X[:9], X[:9]) for i in range(4))
        text = svg(Figure(title="t", x_label="x", y_label="y", lines=lines), "p", 4.8)
        xs = [float(x) for x in re.findall(r"[ML] ([\d.]+) ", curves(text)[0][0])]
        return max(xs) - min(xs)

    # Labels of the other axis may differ by a digit.
    long = width("a name that is rather long, of a file in a folder with a long name, too")
    assert long == pytest.approx(width("a"), rel=0.05)


def test_spans_of_one_name_share_an_entry():
    spans = (Span("held out", 0.0, 1.0), Span("held out", 2.0, 3.0), Span("rest", 4.0, 5.0))
    text = svg(Figure(title="t", x_label="x", y_label="y", spans=spans), "p")
    assert (text.count(">held out<"), text.count(">rest<")) == (1, 1)


def test_the_unit_circle_is_round():
    text = svg(
        Figure(
            title="t",
            x_label="x",
            y_label="y",
            unit_circle=True,
            marks=(Marks("poles", np.array([3.0]), np.array([0.1])), Marks("zeros", X[:1], X[:1], marker="o")),
        ),
        "p",
    )
    circle = max(re.findall(r'<path d="([^"]+)"', text), key=len)
    points = np.array([[float(v) for v in pair] for pair in re.findall(r"[ML] ([\d.-]+) ([\d.-]+)", circle)])
    assert np.ptp(points[:, 0]) == pytest.approx(np.ptp(points[:, 1]), rel=0.01)


def test_the_same_page_is_the_same_file(tmp_path):
    assert written(tmp_path, figure()) == written(tmp_path, figure())
