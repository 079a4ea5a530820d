"""One page of every kind, made as its command makes it, from little data."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from compensator.cli import main
from compensator.identify.coefficients import Row
from compensator.recording.reading import recordings
from compensator.report.demonstration import MachineDay, page_of
from compensator.report.page import Table, write_page
from compensator.report.ten_days import days_page
from tests.audit.made import CONFIG, MACHINE, Service, other_model, readings
from tests.audit.test_command import tampered
from tests.cli.test_loop import LOOP, TOLD, recorded
from tests.demo.made import SHOP_DAY
from tests.demo.test_ten_days import made
from tests.identify.quill_runs import CALIBRATION_W, published

NAMES = (
    "demo",
    "demo-loop",
    "identify",
    "diagnose",
    "loop",
    "replay",
    "replay-found",
    "replay-model",
    "report",
    "results",
)


def paths(folder: Path) -> dict[str, Path]:
    """Where the pages are; their names stand for the commands."""
    pages = {name: folder / name / "report.html" for name in NAMES}
    pages["identify"] = folder / "identify" / "model-calibration.html"
    return pages


def make(folder: Path) -> dict[str, Path]:
    """Make the pages."""
    pages = paths(folder)
    for path in pages.values():
        path.parent.mkdir()
    rec = _recordings(folder)
    run = folder / "run with a rather long name, of a spindle on a day in the winter.csv"
    _run(run)
    model = pages["identify"].with_name("model.toml")
    assert (
        main(
            [
                "identify",
                str(run),
                "--out",
                str(model),
                "--order",
                "2",
                "2",
                "1",
                "--kind",
                "direct",
                "--fit-until",
                "9",
                "--reference",
                "quill",
            ]
        )
        == 0
    )
    assert main(["diagnose", str(run), "--model", str(model), "--out", str(pages["diagnose"].parent)]) == 0
    assert main(["report", str(rec), "--out", str(pages["report"])]) == 0
    assert main(["replay", str(rec), "--page", str(pages["replay"])]) == 0
    assert main(["replay", str(rec), "--model", "quill", "--page", str(pages["replay-model"])]) == 0
    tampered(recordings(rec, MACHINE)[0])
    assert main(["replay", str(rec), "--page", str(pages["replay-found"])]) == 3
    _demo(pages["demo"])
    write_page(pages["demo-loop"], days_page([made(), made(name="probes", is_probed=True)]))
    assert (
        main(
            ["loop", str(recorded(folder / "live", 400, config=CONFIG + LOOP, told=TOLD)), "--page", str(pages["loop"])]
        )
        == 0
    )
    assert main(["report", str(pages["diagnose"].parent), "--out", str(pages["results"])]) == 0
    return pages


def _recordings(folder: Path) -> Path:
    service = Service(folder / "rec", model=other_model())
    for i, values in enumerate(readings(600)):
        if i == 400:
            service.command("hold")
        service.take({**values, "t_q_degc": math.nan} if 200 <= i < 240 else values, lost=300 <= i < 320)
    service.stop()
    return service.folder


def _run(path: Path) -> None:
    """The published machine, with a channel that acts on Y."""
    _, ambient, difference, y, _, _ = published(CALIBRATION_W, 1)
    rng = np.random.default_rng(3)
    coolant = 20.0 + 2.0 * (np.arange(y.size) // 120 % 2) + 0.02 * rng.normal(size=y.size)
    y = y + 4.0 * (coolant - 20.0)
    rows = zip(60.0 * np.arange(y.size), 21.0 + ambient + difference, 21.0 + ambient, y, coolant, strict=True)
    text = "\n".join(",".join(f"{value:.5f}" for value in row) for row in rows)
    path.write_text(f"t_s,t_q_degc,at_degc,y_um,coolant_degc\n{text}\n", encoding="utf-8")


def _demo(path: Path) -> None:
    t = np.arange(240) / 60.0
    errors = {"t_h": t, "without": 90.0 * np.sin(t), "followed": np.sin(9.0 * t)}
    figures = {key: {"rms_um": 1.0, "peak_to_peak_um": 9.0} for key in ("without", "held", "followed")}
    days = [
        MachineDay(name=name, figures=figures, errors=errors, heat=(t, t, t, t)) for name in ("conduction", "published")
    ]
    loop = {
        "second_day_rms_um": {"without": 38.3, "first": 6.3, "extended": 1.2},
        "found": ["hysteresis DTF"],
        "verdict": "explained",
        "drawn": "hysteresis DTF",
        "adopted": True,
        "offset_changes": True,
        "adopted_after_h": 1.0,
    }
    paper = [Row(path="TTF", figure="gain at rest, K/W", found=0.25, std=0.01, reference=0.25)]
    second_day = dict.fromkeys(("first", "extended"), (t, errors["followed"]))
    table = Table(head=["machine", "", "rms µm"], rows=[["conduction", "no compensation", "62.74"]])
    write_page(path, page_of(days, table, loop, second_day, SHOP_DAY, paper))
