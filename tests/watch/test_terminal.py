"""What stands in the terminal fits it, and what needs somebody stands first."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator

import pytest
from rich.console import Console

from compensator.clock import NS
from compensator.watch.shop import Shop
from compensator.watch.terminal import line, view
from tests.watch.heard import LOOP, START_NS, Clock, estimate, event, offset, sample, status

STATES = {"vmc-01": ("ok", []), "vmc-02": ("hold", ["operator_hold"]), "vmc-03": ("degraded", ["t_q_missing"])}


def shown(shop: Shop, width: int, height: int = 50, *, connected: bool = True) -> str:
    console = Console(file=io.StringIO(), width=width, height=height)
    with console.capture() as captured:
        console.print(view(shop, prefix="shop", where="tcp/127.0.0.1:7447", connected=connected, console=console))
    return captured.get()


def filled(*names: str) -> tuple[Shop, Clock]:
    clock = Clock()
    shop = Shop(clock)
    for i in range(3):
        for name in names:
            state, reasons = STATES.get(name, ("ok", []))
            key, t = f"shop/{name}/thermal/", START_NS + i * 60 * NS
            shop.receive(key + "y/offset", offset(i, t, machine=name, state=state, reasons=reasons))
            shop.receive(key + "sample", sample(i, t))
            shop.receive(key + "estimate", estimate(i, t))
            shop.receive(key + "status", status(i, t))
        clock.advance(60)
    return shop, clock


@pytest.mark.parametrize("width", [60, 80, 120, 200])
@pytest.mark.parametrize("names", [("vmc-01", "vmc-02", "vmc-03"), ("vmc-03",)])
def test_it_fits(width: int, names: tuple[str, ...]) -> None:
    shop, _ = filled(*names)
    shop.receive(f"shop/{names[0]}/thermal/event", event(3, ok=False))
    text = shown(shop, width)
    assert max(len(row.rstrip()) for row in text.splitlines()) <= width
    assert "degraded" in text and "−12.34" in text


def test_those_that_need_somebody_stand_first_and_those_left_out_are_counted() -> None:
    shop, _ = filled("vmc-01", "vmc-02", "vmc-03", *(f"vmc-{i}" for i in range(10, 60)))
    text = shown(shop, 100, height=20)
    assert text.index("shop/vmc-02") < text.index("shop/vmc-03") < text.index("shop/vmc-01")
    assert "53 machines: 1 hold, 1 degraded, 51 ok" in text
    assert "… and 41 more (41 ok)" in text and len(text.splitlines()) <= 20


def test_one_machine_says_why_and_what_to_do() -> None:
    shop, _ = filled("vmc-02")
    text = " ".join(shown(shop, 200).split())
    assert "operator_hold: An operator has frozen the offset. Send the command resume." in text
    assert "gain DTF, µm +1.50" in text and "residual, µm −0.34" in text


def test_one_line_says_whether_a_probe_is_wanted_and_what_for() -> None:
    shop, clock = filled("vmc-01")
    assert "robe wanted" not in shown(shop, 200)
    wanted = {"probe_wanted": False, "wanted_by_ns": clock.now_ns + 3600 * NS, "wanted_why": ""}
    wanted |= {"wanted_std_um": 1.25, "wanted_tolerance_um": 3.0}
    shop.receive("shop/vmc-01/thermal/status", status(3, clock.now_ns, **wanted))
    text = " ".join(shown(shop, 200).split())
    assert "(standard deviation 1.25 µm, tolerance 3.00 µm)" in text and "No probe wanted before" in text
    assert "saves about half of the probes; timing alone saves nothing" in text
    changed = {"probe_wanted": True, "wanted_why": "probe_outlier", "wanted_tolerance_um": None}
    shop.receive("shop/vmc-01/thermal/status", status(4, clock.now_ns, **(wanted | changed)))
    text = " ".join(shown(shop, 200).split())
    assert "Probe wanted (standard deviation 1.25 µm): The probe does not fit the prediction" in text
    one = shop.one("shop/vmc-01")
    assert one is not None and "probe wanted" in line(one)


def test_silence_and_a_lost_connection_are_said() -> None:
    shop, clock = filled("vmc-01")
    clock.advance(600)
    text = " ".join(shown(shop, 120, connected=False).split())
    assert (
        "✗ Do not cut to size" in text
        and "silent for 11 min; the last offset was −12.34 µm" in text
        and "1 machine: 1 silent" in text
    )
    assert "No connection to tcp/127.0.0.1:7447" in text
    one = shop.one("shop/vmc-01")
    assert one is not None and "silent" in line(one) and "11 min old" in line(one)


@pytest.fixture
def tokyo(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("tokyo")
def test_times_are_of_the_viewers_zone_and_lines_for_a_log_of_utc() -> None:
    shop, _ = filled("vmc-02")
    shop.receive("shop/vmc-02/thermal/event", event(3))
    text = shown(shop, 100)
    # 06:00 UTC, and three minutes later.
    assert "2026-01-05 15:03:00 JST (UTC+09:00)" in text
    assert "01-05 15:00:00 device" in text and "15:00 hold for 3 min: operator_hold" in text
    one = shop.one("shop/vmc-02")
    assert one is not None and line(one).startswith("2026-01-05T06:02:00Z")


def test_the_day_has_every_path_and_the_worst_state_of_each_part() -> None:
    shop, clock = filled("vmc-01")
    for i in range(3, 60):
        t, key = START_NS + i * 60 * NS, "shop/vmc-01/thermal/"
        held = {"state": "hold", "reasons": ["operator_hold"]} if i in (30, 31) else {}
        shop.receive(key + "y/offset", offset(i, t, machine="vmc-01", **held))
        shop.receive(key + "estimate", estimate(i, t, y_dtf_um=float(i), y_tdtf_um=-float(i)))
        clock.advance(60)
    text = shown(shop, 70)
    rows = {row.split()[1]: row for row in text.splitlines() if row.startswith("│ ") and len(row.split()) > 2}
    assert "2.0 to 59.0 µm" in rows["DTF"] or "3.0 to 59.0 µm" in rows["DTF"]
    assert "−59.0 to" in rows["TDTF"] and "µm" in rows["effects"] and "°C" not in rows["residual"]
    strip = rows["state"].partition(" ▁ ok")[0]
    assert strip.count("█") == 1 and strip.count("▁") > 20  # two minutes of 60 are one bar of some thirty
    assert "operator_hold" in text and max(map(len, text.splitlines())) <= 70


def test_a_shop_says_what_to_do_as_far_as_there_is_room() -> None:
    shop, _ = filled("vmc-01", "vmc-02", "vmc-03")
    text = shown(shop, 100, height=30)
    assert "✗ shop/vmc-02 hold: Do not cut to size. An operator has frozen the offset. Send the command resume." in text
    assert "⚠ shop/vmc-03 degraded: Cut with care" in text
    assert "vmc-01 ok:" not in text
    for height in range(8, 24):
        assert len(shown(shop, 100, height=height).splitlines()) <= height
    assert "Actions" not in shown(shop, 100, height=11)


@pytest.mark.parametrize("height", [30, 60])
def test_states_of_the_day_are_seen_in_a_terminal_that_is_not_tall(height: int) -> None:
    shop, _ = filled("vmc-03")
    seen = shown(shop, 100, height).splitlines()[:height]
    assert any(row.startswith("│ state") for row in seen) and any("degraded for 3 min" in row for row in seen)
    assert any(row.startswith("│ DTF  ") for row in seen) == (height == 60)


def test_what_is_no_offset_is_no_number() -> None:
    clock = Clock()
    shop = Shop(clock)
    shop.receive(
        "shop/a/thermal/y/offset",
        offset(
            1,
            machine="a",
            state="starting",
            reasons=["no_zero"],
            y_offset_um=None,
            y_offset_rate_um_per_min=None,
            y_offset_std_um=None,
        ),
    )
    assert "starting  no offset, 0 s old" in shown(shop, 80) and "⚠ Do not cut to size" in shown(shop, 80)


def test_a_proposal_is_a_line_with_two_commands() -> None:
    shop, clock = filled("vmc-01")
    assert "Model:" not in shown(shop, 200)
    shop.receive("shop/vmc-01/thermal/status", status(3, clock.now_ns, loop=LOOP))
    text = " ".join(shown(shop, 200).replace("│", "").split())
    assert "one that has shown itself better is proposed" in text and "compensator adopt --candidate" in text
    assert "compensator dismiss" in text
    one = shop.one("shop/vmc-01")
    assert one is not None and "better model proposed" in line(one)
    watching = LOOP | {"phase": "watching", "diagnosing": True}
    shop.receive("shop/vmc-01/thermal/status", status(4, clock.now_ns, loop=watching))
    text = " ".join(shown(shop, 200).replace("│", "").split())
    assert "the service goes back to one with" in text and "A diagnosis is in progress." in text
    assert "adopt --candidate" not in text


def test_a_forged_name_writes_no_lines_and_no_commands_of_a_terminal() -> None:
    forged = "vmc\n\x1b[2J[bold red]✓ Proven[/]\u202e"
    for others in ((), ("vmc-01",)):
        shop, _ = filled(forged, *others)
        shop.receive(f"shop/{forged}/thermal/event", event(3, text=forged))
        text = shown(shop, 200)
        assert "vmc\\n\\x1b[2J[bold red]✓ Proven[/]\\u202e" in text and not set("\x1b\u202e") & set(text)
    assert line(shop.overview()[0]).isprintable()
