"""Plots are zoomed and read off by a script inside the page, which alone its policy permits."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from pathlib import Path

import numpy as np
import pytest
from dateutil import tz

from compensator.report import cursor
from compensator.report.cursor import script
from compensator.report.drawing import svg
from compensator.report.figure import Figure, Line, Marks, Span, Strip
from compensator.report.page import Page, Table, html_of
from tests.report.chromium import seen_in

HOURS = np.arange(0.0, 24.0001, 1.0 / 60.0)
COURSE = 30.0 * np.sin(HOURS / 3.0)
HOLE = (HOURS > 9.0) & (HOURS < 10.0)


def figure() -> Figure:
    """Two panels, a gap from 9 to 10 h, a band, points, a shaded span, a strip of time."""
    course = np.where(HOLE, np.nan, COURSE)
    below = Figure(title="", x_label="time, h", y_label="temperature, °C", lines=(Line("AT", HOURS, 20.0 + HOURS),))
    strips = Figure(title="", x_label="time, h", y_label="state", strips=(Strip("hold", ((2.0, 3.0),)),))
    return Figure(
        title="residual & effect",
        x_label="time, h",
        y_label="residual, µm",
        lines=(Line('measured "Y"', HOURS, course, band=(course - 1.0, course + 1.0)),),
        marks=(Marks("probes", np.array([12.0]), np.array([3.0])),),
        spans=(Span("held out", 12.0, 24.0),),
        below=(below, strips),
    )


def test_the_policy_permits_the_script_of_the_page_and_nothing_else() -> None:
    text = html_of(Page(title="t", verdict="1.", blocks=[figure()]))
    (written,) = re.findall(r"<script>(.*?)</script>", text, re.S)
    assert written == script() and "</" not in script()
    known = base64.b64encode(hashlib.sha256(written.encode()).digest()).decode()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy and f"; script-src 'sha256-{known}'" in policy[1]
    assert "default-src 'none'" in policy[1] and "unsafe-eval" not in policy[1]
    assert policy[1].count("unsafe-inline") == 1  # of styles


@pytest.mark.parametrize(
    "words", ["eval(", "innerHTML", "fetch(", "XMLHttpRequest", "import(", "document.write", "new Function"]
)
def test_the_script_loads_nothing_and_writes_no_markup(words: str) -> None:
    assert words not in script()


def test_a_page_without_curves_has_no_script() -> None:
    table = Table(head=["a"], rows=[["1"]])
    circle = Figure(title="t", x_label="real part", y_label="imaginary part", unit_circle=True)
    for blocks, options in (([table], {}), ([circle], {}), ([figure()], {"can_zoom": False})):
        text = html_of(Page(title="t", verdict="1.", blocks=blocks), **options)
        assert "<script" not in text and "script-src" not in text


def test_points_of_the_picture_lead_back_to_the_data() -> None:
    text = svg(figure(), "f1")
    found = re.search(r'data-plot="([^"]*)"', text)
    assert found
    plot = json.loads(html.unescape(found[1]))
    for panel, known in zip(plot["panels"][:2], (COURSE, 20.0 + HOURS), strict=True):
        (line,) = panel["lines"]
        path = re.search(rf'<g id="{line["id"]}">\s*<path d="([^"]*)"', text)
        assert path and f'id="{panel["id"]}"' in text
        points = np.array([[float(v) for v in pair] for pair in re.findall(r"[ML] ([\d.]+) ([\d.]+)", path[1])])
        left, top, right, bottom = panel["box"]
        hours = plot["x"][0] + (points[:, 0] - left) / (right - left) * np.diff(plot["x"])
        values = panel["y"][0] + (bottom - points[:, 1]) / (bottom - top) * np.diff(panel["y"])
        assert np.allclose(values, np.interp(hours, HOURS, known), atol=2e-3 * np.ptp(known))
    assert plot["panels"][0]["unit"] == "µm" and plot["panels"][1]["unit"] == "°C" and plot["unit"] == "h"


def test_times_of_day_follow_the_change_to_summer_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cursor, "tzlocal", lambda: tz.gettz("Europe/Prague"))
    day = 1774663200.0 / 86400.0  # 2026-03-28 02:00 UTC; the change is at 01:00 UTC on the 29th
    offsets = cursor._zone(day, day + 2.0)
    assert [round(24.0 * offset) for _, offset in offsets] == [1, 2]
    assert offsets[1][0] * 86400.0 == 1774746000.0


def test_a_time_that_is_far_off_costs_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """One record of the year 2262 among those of a day; every change until then is found."""
    asked: list[int] = []
    monkeypatch.setattr(cursor, "tzlocal", lambda: asked.append(1) or tz.gettz("Europe/Prague"))
    offsets = cursor._zone(20_000.0, 106_000.0)
    assert len(asked) < 30_000
    hours = [time * 24.0 for time, _ in offsets[1:]]
    assert len(hours) > 2 * 12  # until 2037 at least
    for hour, (_, offset) in zip(hours, offsets[1:], strict=True):
        assert round(hour) == hour and cursor._ahead(round(hour)) == offset != cursor._ahead(round(hour) - 1)


HARNESS = """<!doctype html><meta charset="utf-8"><iframe width="1000" height="1400" srcdoc="%s"></iframe>
<pre id="seen"></pre><script>
addEventListener("load", () => {
  const frame = document.querySelector("iframe"), page = frame.contentDocument, view = frame.contentWindow;
  const svg = page.querySelector("svg[data-plot]"), plot = JSON.parse(svg.dataset.plot), seen = {};
  const [left, top, right] = plot.panels[0].box;
  const at = (hours, to = svg.getScreenCTM()) => ({bubbles: true, cancelable: true, button: 0, pointerId: 1,
    clientY: to.f + to.d * (top + 9),
    clientX: to.e + to.a * (left + (hours - plot.x[0]) / (plot.x[1] - plot.x[0]) * (right - left))});
  const pointer = (kind, hours) => svg.dispatchEvent(new view.PointerEvent(kind, at(hours)));
  const key = (name) => svg.dispatchEvent(new view.KeyboardEvent("keydown", {key: name, bubbles: true, cancelable: true}));
  const words = () => page.querySelector(".readout").textContent;
  const shapes = () => [...svg.querySelectorAll("[id*=panel] path")].map((one) => one.getAttribute("d").replace(/\\s+/g, " ").trim())
    .join("|") + [...svg.querySelectorAll("use")].map((one) => Number(one.getAttribute("x"))).join();
  const labels = () => [...svg.querySelectorAll(".own-ticks text")].map((one) => one.textContent);
  svg.setPointerCapture = () => {};
  const before = shapes();
  pointer("pointermove", 6); seen.read = words();
  pointer("pointermove", 9.5); seen.gap = words();
  pointer("pointermove", 6); pointer("pointerdown", 6); pointer("pointermove", 7); pointer("pointermove", 8); pointer("pointerup", 8);
  seen.moved = shapes() !== before; seen.labels = labels();
  pointer("pointermove", 12); seen.zoomed = words();
  const wheel = () => new view.WheelEvent("wheel", {...at(12), deltaY: -1});
  svg.blur(); seen.scrolls = svg.dispatchEvent(wheel());
  svg.focus(); seen.taken = svg.dispatchEvent(wheel()); seen.wheel = labels();
  svg.dispatchEvent(new view.MouseEvent("dblclick", at(12))); seen.restored = shapes() === before; seen.none = labels();
  key("+"); seen.plus = labels(); key("ArrowRight"); seen.arrow = words(); key("0"); seen.zero = labels();
  const touch = (kind, hours) => svg.dispatchEvent(new view.PointerEvent(kind, {...at(hours), pointerType: "touch"}));
  frame.width = 390; view.dispatchEvent(new view.Event("resize"));
  touch("pointerdown", 3); touch("pointermove", 5); touch("pointercancel", 5); seen.swiped = labels();
  svg.blur(); touch("pointerdown", 4); touch("pointerup", 4); touch("pointerleave", 4); seen.tapped = words();
  view.dispatchEvent(new view.Event("beforeprint")); seen.cursors = svg.querySelectorAll(".cursor").length;
  document.getElementById("seen").textContent = JSON.stringify(seen);
});
</script>"""  # noqa: E501


def test_a_plot_is_zoomed_and_read_off(tmp_path: Path) -> None:
    text = html_of(Page(title="t", verdict="1.", blocks=[figure()]))
    seen = seen_in(HARNESS % html.escape(text), tmp_path, budget_ms=5000, otherwise="no plot was zoomed")
    expected = 30.0 * np.sin(2.0)
    value = re.search(r'([\d.]+) h · measured "Y" ([−\d.]+) µm · AT ([\d.]+) °C$', seen["read"])
    assert value and abs(float(value[1]) - 6.0) < 0.05
    assert abs(float(value[2]) - expected) < 0.3 and abs(float(value[3]) - 26.0) < 0.05
    assert 'measured "Y" – µm' in seen["gap"] and "AT 29.5" in seen["gap"], "no value is made up in a gap"
    # The stretch from 6 to 8 h fills the axis: in its middle is 7 h.
    assert seen["moved"] and {"6.0", "7.0", "8.0"} <= {f"{float(one):.1f}" for one in seen["labels"]}
    assert float(seen["zoomed"].split()[0]) == pytest.approx(7.0, abs=0.1)
    assert seen["scrolls"] and not seen["taken"], "a page scrolls past a plot until it is clicked"
    assert seen["wheel"] != seen["labels"]
    assert seen["restored"] and seen["none"] == [] and seen["zero"] == []
    # On a phone a finger scrolls the plot, and what it taps is read off.
    assert seen["swiped"] == [] and re.match(r"(4\.0\d?|3\.9\d) h · ", seen["tapped"]), seen["tapped"]
    assert seen["plus"] and " h · " in seen["arrow"] and seen["cursors"] == 0
