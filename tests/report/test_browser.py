"""Every page in a real browser, narrow and wide, light and dark: nothing sticks out, nothing is complained about."""

from __future__ import annotations

import html
from pathlib import Path

import pytest

from tests.report.chromium import seen_in

WIDTHS = (360, 1400)
#: Puts each page into a frame of each width, opens what can be opened, and tells what sticks out.
HARNESS = """<!doctype html><meta charset="utf-8"><body>%s<pre id="seen"></pre><script>
addEventListener("load", () => {
  const seen = [...document.querySelectorAll("iframe")].map(frame => {
    const page = frame.contentDocument, view = frame.contentWindow;
    const closed = page.documentElement.scrollWidth;
    const letters = [...page.querySelectorAll("svg text")].filter(one => one.textContent.trim() && one.getScreenCTM() && !one.closest("details"))
      .map(one => parseFloat(view.getComputedStyle(one).fontSize) * Math.hypot(one.getScreenCTM().a, one.getScreenCTM().b));
    const unsaid = [...page.querySelectorAll(".scroll")].filter(one => one.scrollWidth > one.clientWidth + 1).filter(one => {
      const said = () => view.getComputedStyle(one, "::before").content.includes("scroll"), script = said();
      one.removeAttribute("data-scrolls");
      return !(script && said());
    }).map(one => one.outerHTML.slice(0, 90));
    page.querySelectorAll("details").forEach(one => one.open = true);
    const out = [...page.querySelectorAll("main *")].filter(one => !one.parentElement.closest(".scroll, svg"))
      .filter(one => one.getBoundingClientRect().right > view.innerWidth + 0.5).map(one => one.outerHTML.slice(0, 90));
    const scrolls = [...page.querySelectorAll(".scroll")].filter(one => one.scrollWidth > one.clientWidth + 1)
      .map(one => one.getAttribute("aria-label") || "picture");
    const style = view.getComputedStyle(page.body);
    return {name: frame.title, width: view.innerWidth, closed, opened: page.documentElement.scrollWidth, out, scrolls,
      letters: Math.min(99, ...letters), unsaid, paper: style.backgroundColor, ink: style.color,
      curve: view.getComputedStyle(page.querySelector("svg path[style*=line-]") || page.body).stroke};
  });
  document.getElementById("seen").textContent = JSON.stringify(seen);
});
</script></body>"""  # noqa: E501
#: Smallest letters of a picture, px.
SMALLEST = 8.5


def seen(pages: dict[str, Path], folder: Path, *options: str) -> list[dict]:
    frames = "".join(
        f'<iframe title="{name}" width="{width}" height="900" style="border:0" '
        f'srcdoc="{html.escape(path.read_text(encoding="utf-8"))}"></iframe>'
        for name, path in pages.items()
        for width in WIDTHS
    )
    page, words = HARNESS % frames, "pages were not looked at in a browser"
    return seen_in(page, folder, "--window-size=1500,1000", *options, budget_ms=20000, otherwise=words)


@pytest.mark.parametrize(
    ("scheme", "paper"), [(1, "rgb(255, 255, 255)"), (0, "rgb(22, 24, 28)")], ids=("light", "dark")
)
def test_nothing_sticks_out(pages: dict[str, Path], tmp_path: Path, scheme: int, paper: str) -> None:
    looked = seen(pages, tmp_path, f"--blink-settings=preferredColorScheme={scheme}")
    assert len(looked) == len(pages) * len(WIDTHS)
    for one in looked:
        assert one["out"] == [], (one["name"], one["width"])
        assert max(one["closed"], one["opened"]) <= one["width"], one["name"]
        # On a desk no table has to be moved sideways to be read, opened or not.
        assert one["width"] < 1400 or one["scrolls"] == [], (one["name"], one["scrolls"])
        assert one["paper"] == paper and one["ink"] != paper
        # A wide picture keeps letters that can be read and says that it scrolls, with the script and without.
        assert one["letters"] >= SMALLEST, (one["name"], one["width"], one["letters"])
        assert one["unsaid"] == [], (one["name"], one["width"])
    # On a phone some are: the measure sees it.
    assert any(one["scrolls"] for one in looked if one["width"] == 360)
    # Pictures follow the scheme, too.
    curves = {one["curve"] for one in looked if one["name"] == "report"}
    assert curves == {"rgb(213, 94, 0)" if scheme else "rgb(240, 144, 60)"}
