"""What a table's time and its missing temperatures are said to be."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from compensator.codes import Remark
from compensator.data.measurement import read
from compensator.data.runs import runs_of
from compensator.report.identification import _averaged

ROWS = 240


def remarks(path: Path, rows: list[str]) -> list[Remark]:
    path.write_text("t_s,t_q_degc,at_degc,y_um\n" + "\n".join(rows) + "\n")
    return list(read(path).at_period(60.0).remarks)


def row(i: int, *, t_s: float | None = None, t_q: bool = True) -> str:
    return f"{60.0 * i if t_s is None else t_s},{20.0 + 0.01 * i if t_q else ''},20.0,{0.1 * i}"


def test_a_table_in_order_has_no_remark(tmp_path: Path) -> None:
    assert remarks(tmp_path / "a.csv", [row(i) for i in range(ROWS)]) == []


def test_rows_with_equal_times_are_counted_and_the_first_is_named(tmp_path: Path) -> None:
    rows = [row(i, t_s=6000.0 if 100 <= i <= 103 else None) for i in range(ROWS)]
    found = remarks(tmp_path / "a.csv", rows)
    assert [one.code for one in found if one.code == "times_equal"] == ["times_equal"]
    # The header is row 1, so the second row of 6000 s is row 103.
    assert "row 103: 3 row(s) with the time of another" in str(next(one for one in found if one.code == "times_equal"))


@pytest.mark.parametrize(("every", "percent"), [(2, "50 %"), (4, "25 %"), (20, "")])
def test_a_sparse_temperature_is_said_with_its_share(tmp_path: Path, every: int, percent: str) -> None:
    found = remarks(tmp_path / "a.csv", [row(i, t_q=i % every != 1) for i in range(ROWS)])
    assert [one.code for one in found] == (["temperature_sparse"] if percent else [])
    assert percent in str(found[:1])


def test_a_long_gap_is_said_once(tmp_path: Path) -> None:
    found = remarks(tmp_path / "a.csv", [row(i, t_q=not 60 <= i < 160) for i in range(ROWS)])
    assert [one.code for one in found] == ["temperature_missing"]


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
