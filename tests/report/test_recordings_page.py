"""`compensator report`: what recordings tell, in little memory, and the pages of a folder with results."""

from __future__ import annotations

import html
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from compensator.cli import main
from compensator.codes import explain
from compensator.recording.reading import recordings
from compensator.report.envelope import COLUMNS, Envelope, Stretches
from compensator.report.gathering import _Reader, read_history
from compensator.report.history import NO_RECORDING, History, Period
from compensator.report.page import Page, codes_of, html_of, write_page
from compensator.report.recordings import page_of, verdict
from tests.audit.made import CONFIG, MACHINE, Service, readings
from tests.service.simulated import START_NS

START_S = START_NS / 1e9


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirty hours over two days: T_Q lost for a short and a long time, a hold, half an hour without the service."""
    service = Service(tmp_path_factory.mktemp("made") / "rec")
    for i, values in enumerate(readings(1800)):
        lost = 200 <= i < 205 or 500 <= i < 540
        if i == 900:
            service.command("hold")
        if i == 960:
            service.command("resume")
        service.take({**values, "t_q_degc": math.nan} if lost else values, lost=1000 <= i < 1030)
    service.stop()
    return service.folder


@pytest.fixture(scope="module")
def history(folder: Path) -> History:
    return read_history(sorted(folder.glob("*.mcap")))


@pytest.fixture(scope="module")
def text(history: History) -> str:
    return html.unescape(html_of(page_of(history)))


def test_time_is_counted_once_and_wholly(history: History) -> None:
    seconds = history.whole.seconds
    assert sum(seconds.values()) == pytest.approx(1800 * 60.0)
    assert seconds[NO_RECORDING] == pytest.approx(30 * 60.0)
    # The long loss is predicted for 10 min and held for 30; the operator holds an hour.
    assert seconds["hold"] == pytest.approx((30 + 60) * 60.0)
    assert history.reason_seconds["operator_hold"] == pytest.approx(3600.0)
    assert sum(sum(day.seconds.values()) for day in history.days.values()) == pytest.approx(1800 * 60.0)
    assert list(history.days) == ["2026-01-05", "2026-01-06"]


def test_its_last_line_names_the_recordings(folder: Path, text: str) -> None:
    names = [path.name for path in sorted(folder.glob("*.mcap"))]
    assert len(names) == 2 and f"data: {names[0]}, {names[1]}." in text


def test_what_was_lost_is_no_value_and_is_counted(history: History) -> None:
    t, y = history.curves["channel t_q_degc"].points()
    at = (t - START_S) / 60.0
    assert np.all(np.isnan(y[(at > 500) & (at < 539)])) and np.isfinite(y[at < 199]).all()
    # Where nothing was recorded the curve is broken, too.
    assert np.isnan(y[(at > 1000) & (at < 1029)]).any()
    missed = history.channels["t_q_degc"]
    assert (missed.missing, missed.samples) == (45, 1770)
    assert missed.qualities == {"device_timeout": 45}


def test_the_figures_are_those_of_the_samples(history: History, folder: Path, tmp_path: Path) -> None:
    offsets, left = [], []
    for path in recordings(folder, MACHINE):
        out = tmp_path / "day.csv"
        main(["export", str(path), "--out", str(out)])
        rows = [line.split(",") for line in out.read_text().splitlines()]
        column = rows[0].index("y_offset_um")
        offsets += [float(row[column]) for row in rows[1:]]
        left += [float(row[rows[0].index("residual_um")] or "nan") for row in rows[1:]]
    assert abs(history.whole.offset.peak) == pytest.approx(np.max(np.abs(offsets)))
    assert history.whole.residual.rms == pytest.approx(np.sqrt(np.nanmean(np.square(left))))


def test_every_state_and_reason_stands_with_its_sentences(history: History, text: str) -> None:
    codes = codes_of(page_of(history).blocks)
    assert {"ok", "degraded", "hold", "t_q_missing", "operator_hold", "device_timeout"} <= set(codes)
    for code in codes:
        means, do = explain(code) or ("", "")
        assert f'<div id="word-{code}">' in text and f'href="#word-{code}"' in text
        assert means in text and do in text


def test_the_verdict_says_how_long_the_machine_was_followed(history: History) -> None:
    share = 100.0 * (1800 - 30 - 90) / 1800
    assert f"for {share:.1f} % of 30.0 h" in verdict(history)
    assert "µm rms, of which" in verdict(history)
    assert page_of(history).tone == "warn"


@pytest.mark.parametrize(
    ("seconds", "measured", "left", "tone"),
    [
        ({"ok": 1e5}, 9.0, 1.0, "good"),
        ({"ok": 1e5, "hold": 60.0}, 9.0, 1.0, "warn"),
        ({"ok": 1.0}, 1.0, 2.0, "bad"),
        ({"ok": 8e4, "degraded": 2e4}, 9.0, 1.0, "warn"),
        ({"ok": 8e4, "starting": 2e4}, 9.0, 1.0, "bad"),
        ({"ok": 9e4, "fault": 60.0}, 9.0, 1.0, "bad"),
        ({"ok": 9e4, NO_RECORDING: 60.0}, 9.0, 1.0, "warn"),
    ],
)
def test_the_tone(seconds: dict[str, float], measured: float, left: float, tone: str) -> None:
    whole = Period(samples=1)
    whole.seconds.update(seconds)
    whole.measured.add(measured, 0.0)
    whole.left.add(left, 0.0)
    whole.offset.add(-measured, 0.0)
    states = {}
    for state in seconds:
        states[state] = Stretches()
        states[state].add(0.0, 60.0)
    history = History(machine="m", whole=whole, states=states, curves={"heat": Envelope()})
    assert page_of(history).tone == tone
    # "All" is said only where nothing is missing.
    assert ("for all of" in verdict(history)) == (set(seconds) <= {"ok", "degraded"})


@pytest.mark.parametrize(("left", "stated", "beyond"), [(0.57, 0.28, False), (6.4, 0.28, True), (6.4, 0.0, False)])
def test_what_is_left_is_held_against_what_the_service_states(left: float, stated: float, beyond: bool) -> None:
    whole = Period(samples=1)
    whole.seconds.update({"ok": 8.64e4})
    whole.measured.add(62.7, 0.0)
    whole.left.add(left, 0.0)
    whole.offset.add(-62.7, 0.0)
    whole.std.add(stated, 0.0)
    states = {"ok": Stretches()}
    states["ok"].add(0.0, 60.0)
    page = page_of(History(machine="m", whole=whole, states=states, curves={"heat": Envelope()}))
    assert page.tone == ("warn" if beyond else "good")
    assert ("left_beyond_stated" in codes_of(page.blocks)) == beyond
    assert ("23 times the standard deviation of 0.28 µm" in page.verdict) == beyond
    assert ("states a standard deviation of 0.28 µm" in page.verdict) == (not beyond and stated > 0.0)


def test_two_effects_of_one_kind_have_a_share_each_and_the_probes_what_is_theirs() -> None:
    reader = _Reader()
    table = "".join(f'[[effect]]\nkind = "input"\nchannel = "oil_degc"\ncurve = "{curve}"\n' for curve in "ab")
    contents: Any = SimpleNamespace(metadata={}, attachments={"model.toml": SimpleNamespace(data=table.encode())})
    reader._opening(contents)
    reader.history.probes_count = 1
    values = {"y_dtf_um": 10.0, "y_tdtf_um": 1.0, "y_effects_um": [4.0, 3.0]}
    values |= {"y_base_um": 2.0 - 3.5, "level_um": 3.5, "y_pred_um": 20.0}
    missing = dict.fromkeys(("y_um", "residual_um", "heat_w"))
    estimate: Any = SimpleNamespace(time_utc_ns=START_NS, seq=1, **values, **missing)
    reader._estimate(estimate)
    shares = {name: value for name, (_, (value,)) in reader._buffers.items() if name.startswith("share ")}
    assert shares["share input oil_degc"] == 4.0 and shares["share input oil_degc 2"] == 3.0
    assert shares["share at the zero"] == -2.0 and shares["share level"] == 3.5
    assert shares["share probes"] == pytest.approx(0.5) and sum(shares.values()) == pytest.approx(20.0)


def test_an_episode_over_a_clock_that_was_set_back_has_its_length() -> None:
    reader = _Reader()
    offset = {"y_offset_um": 1.0, "y_offset_std_um": 1.0, "model_sha256": "a", "state": "hold", "reasons": ["hold"]}
    for i in range(180):
        back_s = 3 * 3600 if i >= 120 else 0
        one: Any = SimpleNamespace(seq=i, time_utc_ns=START_NS + (60 * i - back_s) * 10**9, **offset)
        reader._offset(one)
    reader._close()
    (episode,) = reader.history.episodes
    assert episode.seconds == pytest.approx(reader.history.whole.seconds["hold"]) == pytest.approx(180 * 60.0, abs=61.0)


def test_a_minute_is_not_rounded_away() -> None:
    whole = Period(samples=1)
    whole.seconds.update({"ok": 1e8, "hold": 60.0})
    assert "99.9 %" in verdict(History(whole=whole))


def test_a_recording_without_a_probe_says_so(tmp_path: Path) -> None:
    config = re.sub(rb'\[\[channel\]\]\nname = "y_um"\n.*?(?=\[\[)', b"", CONFIG, flags=re.S)
    service = Service(tmp_path / "rec", config=config)
    for values in readings(90):
        service.take({name: value for name, value in values.items() if name != "y_um"})
    service.stop()
    history = read_history(sorted((tmp_path / "rec").glob("*.mcap")))
    shown = html.unescape(html_of(page_of(history)))
    assert "Y was not measured" in shown and "nan" not in shown.lower().replace("nano", "")
    assert f"it reached {history.whole.offset.peak:+.1f} µm".replace("-", "−") in shown


def test_a_torn_and_a_damaged_file_are_shown_up_to_there(tmp_path: Path) -> None:
    service = Service(tmp_path / "rec").run(90)
    service.kill()
    data = recordings(tmp_path / "rec", MACHINE)[0].read_bytes()
    middle = data.rindex(b'{"schema":', 0, len(data) // 2) - 31  # the record begins before its payload
    for name, changed, end in (
        ("torn", data[: len(data) // 2], "open"),
        ("damaged", data[:middle] + b"\xff" * 4000, "damaged from byte"),
    ):
        broken = tmp_path / f"{name}.mcap"
        broken.write_bytes(changed)
        history = read_history([broken])
        assert 0 < history.whole.samples < 90
        assert history.files[0].end.startswith(end)


def test_the_command(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.csv").write_text("t_s,y_um\n0,1.5\n")
    assert main(["report", str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["report"] == "rec-report.html" and (tmp_path / "rec-report.html").stat().st_size > 10_000
    assert (found["machine"], found["samples"], found["minutes"]["hold"]) == (MACHINE, 1770, 90.0)
    for arguments, expected in (
        (["none.mcap"], "none.mcap: No such file"),
        (["x.csv"], "x.csv: not an MCAP file, expected a recording"),
        ([str(folder), "--out", "page.txt"], "--out page.txt: expected a name that ends in .html, .pdf or .png"),
        ([str(folder), "--out", "none/page.html"], "--out none/page.html: no such folder"),
        ([str(tmp_path / "empty")], "empty: contains neither recordings (*.mcap) nor pages"),
    ):
        (tmp_path / "empty").mkdir(exist_ok=True)
        assert main(["report", *arguments]) == 2, arguments
        assert expected in capsys.readouterr().err


def test_recordings_of_two_machines_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.mcap"
    # Eight letters for eight, so that every length stays what it is.
    other.write_bytes(recordings(folder, MACHINE)[0].read_bytes().replace(b"vmc-07", b"vmc-08"))
    assert main(["report", str(recordings(folder, MACHINE)[0]), str(other), "--out", str(tmp_path / "p.html")]) == 2
    assert "recordings of vmc-07, vmc-08; expected those of one machine" in capsys.readouterr().err


def test_a_folder_with_results_leads_to_its_pages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inner = tmp_path / "demo out" / "calibration"
    inner.mkdir(parents=True)
    found = {"verdict": "partly_explained", "warning_codes": [], "noise_floor_um": 0.1}
    found |= {"effects": [{"kind": "drift", "path": None, "channel": None}]}
    found |= {"before": {"rms_um": 4.0}, "after": {"rms_um": 1.0}}
    (inner.parent / "diagnosis.json").write_text(json.dumps(found), encoding="utf-8")
    part = '{ name = "a", role = "fitted", rms_um = 0.4, no_compensation_rms_um = 9.0, fit_pct = 95.0 }'
    model = f'name = "The <spindle>"\n[provenance]\nfolds_rms_um = 0.5\nparts = [{part}]\n'
    (inner / "model.toml").write_text(model, encoding="utf-8")
    for folder in (inner.parent, inner):
        write_page(folder / "report.html", Page(title="a page", verdict="of ours"))
    (inner / "other.html").write_text("<h1>not ours</h1>")
    assert main(["report", str(inner.parent), "--out", str(tmp_path / "all.html")]) == 0
    said = capsys.readouterr().out
    assert (
        "Drift. Some of the missing effects were found; part of the residual remains unexplained." in said
        and "0.50 µm rms in free run (9.0 without compensation)" in said
    )
    page = (tmp_path / "all.html").read_text(encoding="utf-8")
    assert re.findall(r'<a href="([^"]*)"', page) == ["demo%20out/report.html", "demo%20out/calibration/report.html"]
    assert '<p class="verdict warn"><b>⚠ Caution</b>Drift. Some of the missing' in page and "not ours" not in page
    assert "Calibration: The &lt;spindle&gt;" in page


@pytest.mark.parametrize(
    ("name", "data"), [("diagnosis.json", "[]"), ("diagnosis.json", '{"axes": []}'), ("model.toml", "axis = 3\n")]
)
def test_a_file_beside_a_page_that_says_nothing_ends_no_report(
    tmp_path: Path, name: str, data: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text(data, encoding="utf-8")
    write_page(tmp_path / "report.html", Page(title="a page", verdict="of ours"))
    assert main(["report", str(tmp_path), "--out", str(tmp_path / "all.html")]) == 0
    assert capsys.readouterr().err == ""


# ---------------------------------------------------------------------------- memory


def test_a_year_is_as_small_as_a_day_and_keeps_every_peak() -> None:
    rng, curve = np.random.default_rng(1), Envelope()
    t = START_S + 60.0 * np.arange(525_600)
    y = rng.normal(size=t.size)
    y[300_000:310_000] = np.nan
    peaks = rng.choice(t.size, 40, replace=False)
    peaks = peaks[np.isfinite(y[peaks])]
    y[peaks] = 50.0 * np.where(np.arange(peaks.size) % 2, 1.0, -1.0)
    keep = np.ones(t.size, bool)
    keep[400_000:403_000] = False
    for part in np.array_split(np.flatnonzero(keep), 300):
        curve.add(t[part], y[part])
        assert sum(a.size for a in curve._t) <= 8 * COLUMNS + 5000
    at, values = curve.points()
    assert at.size < 6 * COLUMNS
    kept = dict(zip(at.tolist(), values.tolist(), strict=True))
    seen = [i for i in peaks if keep[i]]
    assert all(kept[t[i]] == y[i] for i in seen)
    assert np.isnan(values[(at > t[300_500]) & (at < t[309_500])]).all()
    assert np.isnan(values[(at > t[400_000]) & (at < t[403_000])]).any()


def test_points_out_of_order_make_the_same_curve() -> None:
    t, y = 60.0 * np.arange(3000), np.sin(np.arange(3000.0))
    one, other = Envelope(), Envelope()
    one.add(t, y)
    other.add(t[1500:], y[1500:])
    other.add(t[:1500], y[:1500])
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one.points(), other.points(), strict=True))


def test_a_state_that_flickers_for_a_year_takes_no_memory() -> None:
    strip = Stretches()
    for i in range(0, 200_000, 2):
        strip.add(60.0 * i, 60.0 * (i + 1))
        assert len(strip.pieces) <= 1001
    assert strip.count == 100_000
    assert strip.pieces[0][0] == 0.0 and strip.pieces[-1][1] == 60.0 * 199_999


def test_over_a_long_time_means_stand_between_the_lowest_and_the_highest() -> None:
    rng, curve = np.random.default_rng(2), Envelope()
    t = START_S + 60.0 * np.arange(200_000)
    y = np.sin(np.arange(t.size) / 3000.0) + rng.normal(size=t.size)
    y[50_000:60_000] = np.nan
    keep = np.ones(t.size, bool)
    keep[100_000:120_000] = False
    for part in np.array_split(np.flatnonzero(keep), 97):
        curve.add(t[part], y[part])
    columns = curve.columns()
    assert columns is not None
    at, mean, low, high = columns
    known = np.isfinite(mean)
    assert np.array_equal(known, np.isfinite(low)) and np.all((low <= mean) & (mean <= high) | ~known)
    width = np.median(np.diff(at))
    for i in np.flatnonzero(known)[5:-5:40]:
        inside = keep & (t >= at[i] - width / 2) & (t < at[i] + width / 2)
        assert (mean[i], low[i], high[i]) == pytest.approx(
            (np.nanmean(y[inside]), np.nanmin(y[inside]), np.nanmax(y[inside]))
        )
    for first, last in ((51_000, 59_000), (101_000, 119_000)):
        assert not known[(at > t[first]) & (at < t[last])].any()
    assert (~known).any()


def test_a_day_is_drawn_point_by_point() -> None:
    curve = Envelope()
    curve.add(START_S + 60.0 * np.arange(1440), np.arange(1440.0))
    assert curve.columns() is None
