"""What a table's time and its missing temperatures are said to be."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.codes import Remark
from compensator.data.measurement import measurements, read, runs_in
from compensator.data.runs import runs_of
from compensator.data.screening import screen
from compensator.errors import DataError
from compensator.report.identification import _averaged

ROWS = 240


def remarks(path: Path, rows: list[str]) -> list[Remark]:
    path.write_text("t_s,t_q_degc,at_degc,y_um\n" + "\n".join(rows) + "\n")
    return list(read(path).at_period(60.0).remarks)


def row(i: int, *, t_s: float | None = None, t_q: bool = True, at: bool = True, y: bool = True) -> str:
    values = (20.0 + 0.01 * i if t_q else "", 20.0 if at else "", 0.1 * i if y else "")
    return ",".join(map(str, (60.0 * i if t_s is None else t_s, *values)))


def test_a_table_in_order_has_no_remark(tmp_path: Path) -> None:
    assert remarks(tmp_path / "a.csv", [row(i) for i in range(ROWS)]) == []


@pytest.mark.parametrize("second_s", [60.0, 30.0])
@pytest.mark.parametrize("jitter_s", [0.001, 0.05])
def test_a_clock_that_jitters_loses_no_sample(jitter_s: float, second_s: float) -> None:
    """Whether the median of its steps is a little below or above the period, or the first row half a minute early."""
    for seed in range(4):
        late_s = np.abs(np.random.default_rng(seed).normal(0.0, jitter_s, ROWS - 1))
        t_s = np.concatenate(([0.0], second_s + 60.0 * np.arange(ROWS - 1) + late_s))
        measured = read({"t_s": t_s, "t_q_degc": 0.01 * np.arange(ROWS), "at_degc": np.zeros(ROWS)})
        [record] = measured.at_period(60.0).records
        assert np.array_equal(record.columns["t_q_degc"], 0.01 * np.arange(ROWS))


def test_rows_with_equal_times_are_counted_and_the_first_is_named(tmp_path: Path) -> None:
    rows = [row(i, t_s=6000.0 if 100 <= i <= 103 else None) for i in range(ROWS)]
    found = remarks(tmp_path / "a.csv", rows)
    assert [one.code for one in found if one.code == "times_equal"] == ["times_equal"]
    # The header is row 1, so the second row of 6000 s is row 103.
    assert "row 103: 3 row(s) with the time of another" in str(next(one for one in found if one.code == "times_equal"))


@pytest.mark.parametrize(("every", "percent"), [(2, "50 %"), (4, "25 %"), (20, "")])
def test_a_sparse_temperature_is_said_with_its_share(tmp_path: Path, every: int, percent: str) -> None:
    found = remarks(tmp_path / "a.csv", [row(i, t_q=i % every != 1) for i in range(ROWS)])
    assert [one.code for one in found] == (["temperature_sparse"] if percent else ["gap_bridged"])
    assert percent in str(found[:1])


def test_rows_that_are_further_apart_than_the_samples_are_said_once_and_real_gaps_beside(tmp_path: Path) -> None:
    found = remarks(tmp_path / "a.csv", [row(i) for i in range(0, 3 * ROWS, 3) if not 300 <= i < 330])
    assert [one.code for one in found] == ["rows_apart", "gap_bridged"]
    assert "its rows are 180 s apart, samples 60 s" in found[0] and "gap of 32 sample(s) from t_s = 17880" in found[1]


def test_many_gaps_are_said_in_one_remark(tmp_path: Path) -> None:
    found = remarks(tmp_path / "a.csv", [row(i) for i in range(ROWS) if i % 20 not in (7, 8)])
    assert [one.code for one in found] == ["gap_bridged"] and "12 gaps of up to 2 sample(s) from t_s = 420" in found[0]


@pytest.mark.parametrize("every", [2, 4])
def test_every_row_of_a_log_with_rows_further_apart_counts(every: int) -> None:
    """Although Y is known in fewer than half of the samples."""
    i = np.array([one for one in range(0, 1440, every) if one % 200 >= 3 * every])
    heat = lfilter([0.02], [1.0, -0.98], np.repeat([0.0, 1.0, 0.3, 0.0], 360))[i]
    noise = np.random.default_rng(1).normal(0.0, 0.2, i.size)
    table = {
        "t_s": 60.0 * i,
        "t_q_degc": 20.0 + 12.0 * heat,
        "at_degc": 20.0 + np.sin(i / 200.0),
        "y_um": 60.0 * heat + noise,
    }
    runs, _ = runs_in(measurements(table, "log"))
    assert np.sum(np.isfinite(runs[0].y_um)) < runs[0].y_um.size / 2
    screen("log", runs, 60.0, needs_heat=False)
    runs, _ = runs_in(measurements(table | {"y_um": np.where(i > 300, np.nan, table["y_um"])}, "log"))
    with pytest.raises(DataError, match="expected at least half"):
        screen("log", runs, 60.0, needs_heat=False)


def test_a_long_gap_is_said_once(tmp_path: Path) -> None:
    found = remarks(tmp_path / "a.csv", [row(i, t_q=not 60 <= i < 160) for i in range(ROWS)])
    assert [one.code for one in found] == ["temperature_missing"]


def test_short_holes_of_the_temperatures_are_said_in_one_line(tmp_path: Path) -> None:
    """In the middle and at the start; Y that is empty now and then is no gap."""
    rows = [row(i, t_q=i not in (0, 1, 70), at=i != 90, y=i != 80) for i in range(ROWS)]
    [said] = remarks(tmp_path / "a.csv", rows)
    assert said.code == "gap_bridged"
    assert "t_q_degc in 3 sample(s), first at t_s = 0; at_degc in 1 sample(s), first at t_s = 5400" in said


def test_rows_and_cells_that_are_missing_make_one_gap(tmp_path: Path) -> None:
    """Each of them alone would be bridged."""
    rows = [row(i, t_q=not 100 <= i < 140) for i in range(ROWS) if not 60 <= i < 100]
    [said] = remarks(tmp_path / "a.csv", rows)
    assert said.code == "gap_splits" and "gap of 80 sample(s) from t_s = 3600" in said


@pytest.mark.parametrize("row_s", [15.0, 60.0])
def test_the_time_between_rows_stays_known_and_the_page_says_what_was_averaged(tmp_path: Path, row_s: float) -> None:
    path = tmp_path / "a.csv"
    rows = [row(i, t_s=row_s * i) for i in range(ROWS)]
    path.write_text("\n".join(["t_s,t_q_degc,at_degc,y_um", *rows]) + "\n", encoding="utf-8")
    (record,) = read(path).at_period(60.0).records
    assert record.row_s == row_s
    (run,) = runs_of("a", record)
    words = _averaged(SimpleNamespace(runs=[run], model=SimpleNamespace(period_s=60.0)))  # type: ignore[arg-type]
    assert words == (" Rows every 15 s are averaged to samples of 60 s." if row_s == 15.0 else " Samples of 60 s.")
