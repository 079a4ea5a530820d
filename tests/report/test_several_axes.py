"""What people see of a machine of several axes: table, page, watch, the service's line, and the check."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

from compensator.clock import SystemClock
from compensator.commands.run import status
from compensator.data.export import export
from compensator.data.measurement import read
from compensator.messages_axes import OFFSETS
from compensator.model.effects import effect_from
from compensator.report.gathering import read_history
from compensator.report.recordings import figures, page_of
from compensator.watch.machine import WatchedMachine
from compensator.watch.shop_recorder import ShopRecorder
from compensator.watch.terminal import detail, line
from drivers.reading import Quality, Reading
from tests.service.several import AXES, SLOPE, TILT, SeveralAxes, by_axis, config_text, model_text, part

PREFIX = "shop/vmc-07"


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> SeveralAxes:
    found = SeveralAxes(
        tmp_path_factory.mktemp("axes"),
        config_text(AXES, TILT, SLOPE),
        model_text("y", "x", "z", "low", "high", "y_slope"),
    )
    found.run(90)
    return found


def watched(machine: SeveralAxes, *, without: str = "") -> tuple[WatchedMachine, int]:
    """A watch that has received what was published, but nothing under one name."""
    seen = WatchedMachine(PREFIX)
    now_ns = machine.outcomes[-1].offset.time_utc_ns + 1_000_000_000
    for name, data in machine.published:
        if name != without:
            seen.update(name, data, now_ns, 0.0)
    return seen, now_ns


def test_a_table_has_the_columns_of_every_axis(machine: SeveralAxes, tmp_path: Path) -> None:
    out = tmp_path / "run.csv"
    export(machine.recordings, out)
    rows = list(csv.DictReader(out.read_text(encoding="utf-8").splitlines()))
    last, outcome = rows[-1], machine.outcomes[-1]
    offsets, values = by_axis(outcome), outcome.estimate.axes  # type: ignore[attr-defined]
    assert float(last["z_offset_um"]) == offsets["z"].y_offset_um
    assert float(last["a_offset_rate_urad_per_min"]) == offsets["a"].y_offset_rate_um_per_min
    assert float(last["y_slope_um_per_m"]) == offsets["y"].y_slope_um_per_m
    assert float(last["y_slope_pred_um_per_m"]) == values["y_slope_pred_um_per_m"]
    assert (last["z_state"], last["state"], last["x_reasons"]) == ("ok", "ok", "")
    assert float(last["y_offset_um"]) == offsets["y"].y_offset_um
    # A diagnosis of the table must not find that the prediction explains the deformation.
    used = read(out)
    assert set(used.table.columns) == {"t_q_degc", "at_degc", "y_um", "coolant_degc", "x_um", "z_um"}
    # As measured, less its value at the zero, less the prediction.
    z = float(last["z_um"]) - float(last["z_ref_um"]) - float(last["z_pred_um"])
    assert z == pytest.approx(float(last["z_residual_um"]), abs=1e-9)


def test_a_recording_of_a_shop_has_every_axis_and_gives_the_same_table(machine: SeveralAxes, tmp_path: Path) -> None:
    keys = {"offset": "y/offset", **{f"{axis}_offset": f"{axis}/offset" for axis in "xza"}}
    with ShopRecorder(tmp_path / "shop", "shop", SystemClock()) as recorder:
        for name, data in machine.published:
            recorder.receive(f"{PREFIX}/thermal/{keys.get(name, name)}", data)
    assert recorder.missed() == {}
    tables = []
    for given, prefix in ((recorder.files, PREFIX), (machine.recordings, "")):
        export(given, tmp_path / "table.csv", prefix)
        tables.append(list(csv.DictReader((tmp_path / "table.csv").read_text(encoding="utf-8").splitlines())))
    assert tables[0] == tables[1]


def test_the_page_has_figures_and_a_picture_of_every_axis(machine: SeveralAxes) -> None:
    history = read_history(machine.recordings)
    assert list(history.axes) == ["x", "z", "a", "y_slope"]
    offsets = np.array([by_axis(outcome)["z"].y_offset_um for outcome in machine.outcomes])
    measured = np.array([outcome.estimate.axes["z_um"] for outcome in machine.outcomes])  # type: ignore[attr-defined]
    found = figures(history)["axes"]
    assert isinstance(found, dict)
    assert abs(found["z"]["largest_offset"]) == pytest.approx(np.abs(offsets).max(), abs=1e-3)
    assert found["z"]["left_rms"] == pytest.approx(math.sqrt(np.mean((measured + offsets) ** 2)), abs=1e-3)
    assert found["z"]["left_rms"] < 0.2 * found["z"]["measured_rms"]
    assert (found["a"]["unit"], found["y_slope"]["unit"], found["a"]["left_rms"]) == ("µrad", "µm/m", None)
    assert f"; Z: {found['z']['measured_rms']:.1f} µm rms, of which" in page_of(history).verdict
    (table,) = [block for block in page_of(history).blocks if getattr(block, "title", "") == "Further axes"]
    limited = sum(by_axis(outcome)["a"].reasons == ["rate_limited"] for outcome in machine.outcomes)
    cells = {row[0]: row[-1] for row in table.rows}  # type: ignore[union-attr]
    assert cells["tilt A"] == (f"rate_limited {limited}" if limited else "none")
    titles = [getattr(block, "title", "") for block in page_of(history).blocks]
    assert {"Further axes", "Offset: Z", "Offset: tilt A", "Offset: slope of Y"} <= set(titles)


def test_where_an_axis_was_in_another_state_than_y_the_page_says_so(tmp_path: Path, machine: SeveralAxes) -> None:
    effect = effect_from(
        "input", {"channel": "coolant_degc", "curve": "linear", "tau_min": [9.0], "gain": [2.0], "delay_min": 0.0}
    )
    lost = SeveralAxes(tmp_path, config_text(AXES), model_text("y", "x", parts={"z": part("z", effect)}))

    def without_coolant() -> None:
        lost.device.replaced[3] = Reading.bad(Quality.OPEN, "open")

    lost.run(90, {30: without_coolant, 50: lost.device.replaced.clear})
    history = read_history(lost.recordings)
    apart = [(axis, state, stretches.count) for (axis, state), stretches in history.apart.items()]
    assert apart == [("z", "degraded", 1)] and history.apart_seconds["z", "degraded"] == 20 * 60.0
    assert figures(history)["axes"]["z"]["minutes_unlike_y"] == {"degraded": 20.0}  # type: ignore[index]
    page = page_of(history)
    (table,) = [b for b in page.blocks if getattr(b, "title", "") == "Where an axis was in another state than Y"]
    assert [row[0] for row in table.rows] == ["Z"] and table.rows[0][2:4] == ["20", "1"]  # type: ignore[union-attr]
    (band,) = [b for b in page.blocks if getattr(b, "title", "") == "States and reasons"]
    assert "Z: degraded" in [strip.name for strip in band.strips]  # type: ignore[union-attr]
    assert "did not follow" not in page.verdict
    # A machine whose axes go together shows none of it.
    alike = page_of(read_history(machine.recordings))
    assert not read_history(machine.recordings).apart and "another state than Y" not in str(alike.blocks)
    # An axis that stood while Y followed is in the verdict.
    history.apart_seconds["x", "hold"] = 720.0
    assert "; X did not follow for 12 min of it" in page_of(history).verdict
    assert page_of(history).tone == "bad"


def test_the_watch_shows_every_axis(machine: SeveralAxes) -> None:
    seen, now_ns = watched(machine)
    snapshot = seen.snapshot(now_ns, 1.0)
    offsets = by_axis(machine.outcomes[-1])
    assert [(one["axis"], one["unit"]) for one in snapshot["axes"]] == [
        ("x", "µm"),
        ("y", "µm"),
        ("z", "µm"),
        ("a", "µrad"),
    ]
    assert snapshot["axes"][2]["offset"] == offsets["z"].y_offset_um
    assert snapshot["axes"][1]["slope_um_per_m"] == offsets["y"].y_slope_um_per_m
    console = Console(width=120, height=60, record=True)
    console.print(detail(snapshot, seen.history.columns(), 120, now_ns))
    text = console.export_text()
    assert "µrad" in text
    assert "µm/m" in text
    assert f"Z {offsets['z'].y_offset_um:+.2f} µm".replace("-", "−") in line(snapshot)


def test_the_worst_axis_is_the_machine_s_state(machine: SeveralAxes) -> None:
    seen, now_ns = watched(machine)
    last = by_axis(machine.outcomes[-1])
    for axis, held in (("x", last["x"]), ("y", last["y"])):
        later = msgspec.structs.replace(held, seq=held.seq + 1, time_utc_ns=now_ns)
        if axis == "x":
            later = msgspec.structs.replace(later, state="degraded", reasons=["rate_limited"])
        seen.update("offset" if axis == "y" else "x_offset", msgspec.json.encode(later), now_ns, 0.0)
    snapshot = seen.snapshot(now_ns, 1.0)
    assert snapshot["shown"] == "degraded"
    assert [one["code"] for one in snapshot["reasons"]] == ["rate_limited"]
    assert [one["state"] for one in snapshot["axes"]] == ["degraded", "ok", None, None]


def test_an_axis_that_is_not_received_has_no_old_value(machine: SeveralAxes) -> None:
    seen, now_ns = watched(machine, without="z_offset")
    z = seen.snapshot(now_ns, 1.0)["axes"][2]
    assert (z["axis"], z["offset"], z["state"]) == ("z", None, None)


@pytest.mark.parametrize("payload", [b"nonsense", b'{"axes":1}', b"{}", b'{"axes":["z"],"axis":"z"}', b"\xff"])
def test_no_payload_of_an_axis_ends_a_watch(machine: SeveralAxes, payload: bytes) -> None:
    seen, now_ns = watched(machine)
    assert not seen.update("z_offset", payload, now_ns, 0.0)
    assert not seen.update("offset", payload, now_ns, 0.0)
    assert seen.snapshot(now_ns, 1.0)["malformed"] == 2


def test_the_line_of_the_service_names_every_axis(machine: SeveralAxes) -> None:
    offsets = by_axis(machine.outcomes[-1])
    further = {axis: one for axis, one in offsets.items() if axis != "y"}
    text = status(offsets["y"], further)
    assert f"Z {offsets['z'].y_offset_um:+.2f} µm" in text
    assert f"A {offsets['a'].y_offset_um:+.2f} µrad" in text


def test_each_axis_has_a_class_of_its_own() -> None:
    assert len({kind.__name__ for kind in OFFSETS.values()}) == 5
