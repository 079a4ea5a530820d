"""What stands in the terminal fits it, and what needs somebody stands first."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from compensator.clock import NS
from compensator.watch.shop import Shop
from compensator.watch.terminal import line, view
from tests.watch.heard import START_NS, Clock, estimate, event, offset, sample, status

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
            shop.take(key + "y/offset", offset(i, t, machine=name, state=state, reasons=reasons))
            shop.take(key + "sample", sample(i, t))
            shop.take(key + "estimate", estimate(i, t))
            shop.take(key + "status", status(i, t))
        clock.advance(60)
    return shop, clock


@pytest.mark.parametrize("width", [60, 80, 120, 200])
@pytest.mark.parametrize("names", [("vmc-01", "vmc-02", "vmc-03"), ("vmc-03",)])
def test_it_fits(width: int, names: tuple[str, ...]) -> None:
    shop, _ = filled(*names)
    shop.take(f"shop/{names[0]}/thermal/event", event(3, ok=False))
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


def test_silence_and_a_lost_connection_are_said() -> None:
    shop, clock = filled("vmc-01")
    clock.advance(600)
    text = " ".join(shown(shop, 120, connected=False).split())
    assert "✗ silent for 11 min; the last offset was −12.34 µm" in text and "1 machine: 1 silent" in text
    assert "No connection to tcp/127.0.0.1:7447" in text
    one = shop.one("shop/vmc-01")
    assert one is not None and "silent" in line(one) and "11 min old" in line(one)
