"""The live page in a browser, narrow and wide, light and dark, open and closed: nothing sticks out of it."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from pathlib import Path
from typing import Any

import pytest

from compensator.clock import NS
from compensator.watch import server as server_module
from compensator.watch.server import PageServer, page
from compensator.watch.shop import Shop
from tests.watch.heard import LOOP, START_NS, Clock, estimate, event, offset, sample, status
from tests.watch.test_page import STATUS, drawn

#: Shows the page to itself in frames of each width, opens what can be opened, and tells what is wider than its frame.
#: What scrolls in its own box may be.
PROBE = """if (top === window) {
  const frames = [360, 1400].map((width) => {
    const frame = document.createElement("iframe");
    frame.width = width; frame.height = 900; frame.src = `/?framed${location.hash}`;
    document.body.append(frame);
    return frame;
  });
  setTimeout(() => {
    const seen = frames.map((frame) => {
      const page = frame.contentDocument, view = frame.contentWindow;
      page.querySelectorAll("details").forEach((one) => { one.open = true; });
      const out = [...page.querySelectorAll("main *")].filter((one) => !one.parentElement.closest(".scroll, svg"))
        .filter((one) => one.getBoundingClientRect().right > view.innerWidth + 0.5).map((one) => one.outerHTML.slice(0, 90));
      return {width: frame.width, wide: page.documentElement.scrollWidth, out, verdict: page.getElementById("verdict").textContent,
        paper: view.getComputedStyle(page.body).backgroundColor,
        unreachable: page.querySelectorAll(".scroll:not([tabindex])").length};
    });
    document.body.dataset.seen = JSON.stringify(seen);
  }, 3000);
}"""  # noqa: E501
LONG = "a_name_without_any_blank_that_is_much_longer_than_a_narrow_window_is_wide_0123456789"


WANTED = {
    "probe_wanted": True,
    "wanted_by_ns": START_NS,
    "wanted_why": "probe_outlier",
    "wanted_std_um": 1.2,
    "wanted_tolerance_um": 3.0,
}


def shop_in_trouble() -> Shop:
    clock = Clock()
    shop = Shop(clock)
    states: dict[str, dict[str, Any]] = {
        "ok": {},
        "degraded": {"reasons": ["predicting", "t_q_missing"]},
        "hold": {"reasons": [LONG, "operator_hold"]},
        "fault": {"reasons": ["t_q_at_exchanged"], "y_offset_um": None},
        "starting": {"reasons": ["no_zero"], "y_offset_um": None},
        "silent": {},
    }
    for i in range(90):
        for name, changes in states.items():
            if name == "silent" and i > 60:
                continue
            key, t, state = f"shop/{name}/thermal/", START_NS + i * 60 * NS, "ok" if name == "silent" else name
            shop.receive(key + "y/offset", offset(i, t, **({"machine": name, "state": state} | changes)))
            shop.receive(key + "sample", sample(i, t, quality="open_circuit" if name == "hold" else "good"))
            shop.receive(key + "estimate", estimate(i, t))
            shop.receive(key + "status", status(i, t, devices={"couples": LONG}, recording=LONG, loop=LOOP, **WANTED))
        clock.advance(60)
    shop.receive("shop/hold/thermal/event", event(3, text=LONG, ok=False))
    shop.receive("shop/hold/thermal/y/offset", b"nonsense")
    return shop


@pytest.mark.parametrize(
    ("where", "said", "scheme"),
    [
        ("", "Attention6 machines", 0),
        ("", "Attention6 machines", 1),
        ("hold", "Do not cut to sizeAn operator has frozen", 0),
        ("hold", "Do not cut to sizeAn operator has frozen", 1),
        ("starting", "Do not cut to sizeNo zero", 1),
        ("silent", "Do not cut to sizeThe last offset", 0),
    ],
)
def test_nothing_sticks_out(
    where: str, said: str, scheme: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body, policy = page()
    known = base64.b64encode(hashlib.sha256(PROBE.encode()).digest()).decode()
    probed = body.replace(b"</body>", f"<script>{PROBE}</script></body>".encode())
    allowed = policy.replace("script-src ", f"frame-src 'self'; script-src 'sha256-{known}' ")
    allowed = allowed.replace("frame-ancestors 'none'", "frame-ancestors 'self'")
    monkeypatch.setattr(server_module, "page", lambda: (probed, allowed))
    with PageServer(shop_in_trouble(), lambda: STATUS, 0) as served:
        address = served.address + (f"#m=shop%2F{where}" if where else "")
        text, console = drawn(address, tmp_path, 1500, scheme=scheme)
    assert console == ""
    found = re.search(r'data-seen="([^"]*)"', text)
    assert found is not None
    seen = json.loads(html.unescape(found[1]))
    assert [one["width"] for one in seen] == ["360", "1400"]
    for one in seen:
        assert said in one["verdict"]
        assert one["out"] == [] and one["wide"] <= int(one["width"]), one
        assert one["unreachable"] == 0 and one["paper"] == ("rgb(255, 255, 255)" if scheme else "rgb(22, 24, 28)")


#: Zooms with the mouse and with keys, reads a value, and writes down what the first and the last plot then show.
ZOOM = """addEventListener("load", () => setTimeout(() => {
  const plots = () => [...document.querySelectorAll("#pictures svg[tabindex]")];
  const label = (i) => plots().at(i).getAttribute("aria-label").replace(/.*; /, ""), seen = [label(0)];
  const drag = (share) => {
    const box = plots()[0].getBoundingClientRect(), x = box.left + share * box.width;
    return {clientX: x, clientY: box.top + 50, button: 0, pointerId: 1, bubbles: true};
  };
  const send = (kind, share) => plots()[0].dispatchEvent(new PointerEvent(kind, drag(share)));
  SVGElement.prototype.setPointerCapture = () => {};
  send("pointerdown", 0.5); send("pointermove", 0.6); send("pointermove", 0.75);
  seen.push(document.querySelectorAll(".stretch").length);
  send("pointerup", 0.75);
  seen.push(label(0), label(-1), document.querySelectorAll(".stretch").length);
  const key = (name) => document.activeElement.dispatchEvent(new KeyboardEvent("keydown", {key: name}));
  plots()[1].focus();
  key("ArrowRight");
  seen.push(plots()[1].parentNode.querySelector("output").textContent);
  key("-"); key("-"); key("-");
  seen.push(label(0), plots().indexOf(document.activeElement));
  document.body.dataset.seen = JSON.stringify(seen);
}, 2500));"""


def test_plots_are_zoomed_together_and_read_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body, policy = page()
    known = base64.b64encode(hashlib.sha256(ZOOM.encode()).digest()).decode()
    probed = body.replace(b"</body>", f"<script>{ZOOM}</script></body>".encode())
    allowed = policy.replace("script-src ", f"script-src 'sha256-{known}' ")
    monkeypatch.setattr(server_module, "page", lambda: (probed, allowed))
    with PageServer(shop_in_trouble(), lambda: STATUS, 0) as served:
        text, console = drawn(f"{served.address}#m=shop%2Fok", tmp_path, 1000)
    assert console == ""
    found = re.search(r'data-seen="([^"]*)"', text)
    assert found is not None
    whole, boxes, zoomed, other, left, value, again, focused = json.loads(html.unescape(found[1]))
    assert whole == again == "in the last 1.5 h." and (boxes, left, focused) == (1, 0, 1)
    first, last = (int(hour) * 60 + int(minute) for hour, minute in re.findall(r"(\d\d):(\d\d)", zoomed))
    assert zoomed == other and 20 <= last - first <= 26
    assert re.fullmatch(r"\d\d:\d\d:\d\d · DTF \(heat\) [+−][\d.]+ µm · TDTF \(air\) .*", value)
