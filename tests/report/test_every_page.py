"""What holds for the page of every command, whoever reads it and on whatever: no browser is needed to see that."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from compensator.cli import main
from compensator.codes import WORDS
from compensator.report.cursor import script
from tests.report.gallery import NAMES

STYLE = resources.files("compensator.report").joinpath("style.css").read_text(encoding="utf-8")
SCHEMES = [
    dict(re.findall(r"(--[\w-]+): (#[0-9a-f]{6})", scheme)) for scheme in re.findall(r":root \{(.*?)\}", STYLE, re.S)
]
#: Axes that have no unit.
NO_UNIT = {
    "correlation",
    "day of the run, 1 to 10",
    "mode",
    "model",
    "real part",
    "imaginary part",
    "state, reason",
    "outcome",
}
UNIT = re.compile(r", (h|min|UTC|µm|W|K|°C|samples|1/min|1/h|%)$|^(µm|K)/(W|K)( per sample)?$|^degrees$")


@dataclass
class Element:
    tag: str
    attributes: dict[str, str]
    above: tuple[str, ...]
    text: list[str] = field(default_factory=list)


class Tree(HTMLParser):
    """Every element of a page with what stands above it and the words in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[Element] = []
        self.elements: list[Element] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = Element(tag, {key: value or "" for key, value in attrs}, tuple(e.tag for e in self.open))
        self.elements.append(element)
        if tag != "meta":
            self.open.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag != "meta":
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop().tag == tag

    def handle_data(self, data: str) -> None:
        for element in self.open:
            element.text.append(data)

    def all(self, *tags: str) -> list[Element]:
        return [element for element in self.elements if element.tag in tags]


@pytest.fixture(scope="module", params=NAMES)
def tree(request: pytest.FixtureRequest, pages: dict[str, Path]) -> Tree:
    return Tree(pages[request.param].read_text(encoding="utf-8"))


def test_the_verdict_is_one_sentence_with_a_number_and_stands_first(tree: Tree) -> None:
    (main,) = tree.all("main")
    inside = [e for e in tree.elements if e.above and e.above[-1] == "main"]
    assert [e.tag for e in inside[:2]] == ["h1", "p"] and inside[1].attributes["class"].startswith("verdict ")
    assert re.search(r"\d", "".join(inside[1].text)) and "".join(inside[1].text).endswith(".")
    # Then the picture that carries it; only a page that leads to others has none.
    if tree.all("svg"):
        assert inside[2].tag == "figure"
    assert not re.search(r"\b(nan|inf|None)\b", "".join(main.text))


def test_headings_go_down_by_one(tree: Tree) -> None:
    levels = [int(e.tag[1]) for e in tree.all("h1", "h2", "h3", "h4", "h5", "h6")]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


def test_identifiers_are_unique_and_every_link_leads_somewhere(tree: Tree) -> None:
    ids = [e.attributes["id"] for e in tree.elements if "id" in e.attributes]
    assert len(ids) == len(set(ids))
    for link in tree.all("a"):
        target = link.attributes["href"]
        assert target[1:] in ids if target.startswith("#") else re.fullmatch(r"[\w%./-]+\.html", target), target


def test_nothing_is_loaded_and_no_other_script_runs(tree: Tree) -> None:
    assert not tree.all("link", "img", "iframe", "object", "embed", "video", "audio")
    # Only the script of the plots, which test_cursor.py follows.
    assert ["".join(e.text) for e in tree.all("script")] in ([], [script()])
    assert not any(
        key in ("src", "srcset", "action") or key.startswith("on") for e in tree.elements for key in e.attributes
    )
    styles = "".join("".join(e.text) for e in tree.all("style"))
    assert "@import" not in styles and "url(" not in styles


def test_pictures_speak(tree: Tree) -> None:
    for figure in tree.all("figure"):
        assert figure.text
    for picture in tree.all("svg"):
        assert picture.attributes["role"] == "img" and len(picture.attributes["aria-label"]) > 5
    descriptions = ["".join(e.text) for e in tree.all("desc")]
    assert len(descriptions) == len(tree.all("svg"))
    for words in descriptions:
        axes = re.match(r"x: (.*?); y: (.*?)\.( |$)", words)
        assert axes
        for label in axes.groups()[:2]:
            assert label in NO_UNIT or UNIT.search(label), label


def test_tables_have_heads_that_say_what_they_head(tree: Tree) -> None:
    assert all(e.attributes.get("scope") in ("col", "row") for e in tree.all("th"))
    for table in tree.all("table"):
        assert "tbody" in {e.tag for e in tree.elements if "table" in e.above} and table.text
    regions = [e for e in tree.elements if e.attributes.get("role") == "region"]
    assert all(e.attributes["aria-label"] and e.attributes["tabindex"] == "0" for e in regions)
    assert all(e.above[-1] == "details" for e in tree.all("summary"))


def test_every_code_has_its_sentences_on_the_page(tree: Tree) -> None:
    explained = {"".join(e.text) for e in tree.all("code") if "dt" in e.above}
    linked = {"".join(e.text).split(":")[0] for e in tree.all("code") if "a" in e.above}
    assert linked == explained
    text = "".join(tree.all("main")[0].text)
    # Commands between backticks are elements of their own.
    assert all(sentence.replace("`", "") in text for code in explained for sentence in WORDS[code])
    # No state or reason stands there without a way to its sentences; `state` is a kind of event, too.
    cells = {"".join(e.text) for e in tree.all("td")} & set(WORDS) - {"state"}
    assert cells <= linked


def test_warnings_and_alarms_are_met_in_the_gallery(pages: dict[str, Path]) -> None:
    linked = {name: set(re.findall(r'href="#word-(\w+)"', path.read_text("utf-8"))) for name, path in pages.items()}
    assert "validity_range" in linked["identify"] and "altered" in linked["replay-found"]
    assert {"hold", "degraded", "t_q_missing", "operator_hold"} <= linked["report"]


@pytest.mark.parametrize(
    "command",
    [["demo"], ["identify", "none.csv", "--out", "m.toml"], ["diagnose", "none.csv", "--model", "quill", "--out", "d"]],
)
def test_a_page_of_another_format_is_refused_before_the_work(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--page", "page.doc"]) == 2
    assert "--page page.doc: expected a name that ends in .html, .pdf or .png" in capsys.readouterr().err


# ---------------------------------------------------------------------------- colours


def linear(colour: str) -> np.ndarray:
    value = np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def contrast(one: str, other: str) -> float:
    """WCAG 2: (L1 + 0.05) / (L2 + 0.05)."""
    bright, dark = sorted((float(linear(c) @ (0.2126, 0.7152, 0.0722)) for c in (one, other)), reverse=True)
    return (bright + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("scheme", SCHEMES, ids=("light", "dark", "print"))
def test_letters_and_curves_stand_out(scheme: dict[str, str]) -> None:
    paper = scheme["--paper"]
    assert all(contrast(scheme[name], paper) >= 4.5 for name in ("--ink", "--good", "--warn", "--bad", "--link"))
    assert all(contrast(scheme[f"--line-{i}"], paper) >= 3.0 for i in range(5))


#: Machado, Oliveira and Fernandes 2009, severity 1, on linear RGB.
BLINDNESS = {
    "protan": ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    "deutan": ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
}


@pytest.mark.parametrize("kind", BLINDNESS)
@pytest.mark.parametrize("scheme", SCHEMES, ids=("light", "dark", "print"))
def test_the_first_two_curves_differ_for_the_colour_blind(scheme: dict[str, str], kind: str) -> None:
    """More than two differ by their dashes alone, as on a grey print."""
    one, other = (np.array(BLINDNESS[kind]) @ linear(scheme[f"--line-{i}"]) for i in (0, 1))
    assert np.linalg.norm(one - other) > 0.25
