"""Tables as people have them: spreadsheets with semicolons and decimal commas, other encodings and units of time."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import compensator as tc
from compensator.cli import main
from compensator.errors import DataError
from tests.api.tables import arrays, write_run
from tests.identify.quill_runs import CALIBRATION_W
from tests.reference.kept import KEPT

RECORDINGS = KEPT / "recordings/plain"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "run.csv", CALIBRATION_W, 1)


def rewritten(run: Path, path: Path, *, separator: str, encoding: str = "utf-8", first: str = "") -> Path:
    text = run.read_text(encoding="utf-8").replace(",", separator)
    if separator == ";":
        text = text.replace(".", ",")
    path.write_bytes((first + text.replace("heat_w", "heat_w").replace("\n", "\r\n")).encode(encoding))
    return path


@pytest.mark.parametrize(
    ("separator", "encoding", "first"),
    [(";", "utf-8-sig", ""), (";", "cp1252", "sep=;\r\n"), ("\t", "utf-8", "")],
)
def test_a_table_of_a_spreadsheet_is_read_to_the_last_digit(
    run: Path, tmp_path: Path, separator: str, encoding: str, first: str
) -> None:
    path = rewritten(run, tmp_path / "excel.csv", separator=separator, encoding=encoding, first=first)
    wanted, found = tc.read(run).table, tc.read(path).table
    np.testing.assert_array_equal(wanted.t_s, found.t_s)
    assert wanted.columns.keys() == found.columns.keys()
    for name, values in wanted.columns.items():
        np.testing.assert_array_equal(values, found.columns[name])


def test_names_in_windows_1252_are_read(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(run.read_text(encoding="utf-8").replace("t_q_degc", "Spindel_\u00b0C").encode("cp1252"))
    found = tc.read(path, columns={"t_q_degc": "Spindel_\u00b0C"})
    np.testing.assert_array_equal(found.table.columns["t_q_degc"], tc.read(run).table.columns["t_q_degc"])


@pytest.mark.parametrize("column", ["t_q_degc", "T Spindel", "coolant_degc"])
def test_one_word_among_numbers_is_named_with_its_row(run: Path, tmp_path: Path, column: str) -> None:
    lines = run.read_text(encoding="utf-8").replace("t_q_degc", column).splitlines()
    index = lines[0].split(",").index(column)
    cells = lines[401].split(",")
    cells[index] = "#NV"
    lines[401] = ",".join(cells)
    (tmp_path / "run.csv").write_text("\n".join(lines), encoding="utf-8")
    columns = {"t_q_degc": column} if column == "T Spindel" else {}
    with pytest.raises(DataError, match=f"row 402: {column} = '#NV', expected a number, or an empty cell"):
        tc.read(tmp_path / "run.csv", columns=columns)


def test_a_column_of_words_is_left_out(run: Path, tmp_path: Path) -> None:
    lines = run.read_text(encoding="utf-8").splitlines()
    table = [f"{lines[0]},program", *(f"{line},{'O1234' if i % 3 else 7}" for i, line in enumerate(lines[1:]))]
    (tmp_path / "run.csv").write_text("\n".join(table), encoding="utf-8")
    found = tc.read(tmp_path / "run.csv")
    assert "program" not in found.table.columns
    (remark,) = found.remarks
    assert remark.code == "column_left_out" and "row 3: program = 'O1234' (480 like it): no number" in remark


def test_a_column_without_a_name_is_left_out(run: Path, tmp_path: Path) -> None:
    """The index that pandas writes; and what stands behind the last separator of a spreadsheet."""
    lines = run.read_text(encoding="utf-8").splitlines()
    table = [f",{lines[0]},,", *(f"{i},{line},,{7 if i == 3 else ''}" for i, line in enumerate(lines[1:]))]
    (tmp_path / "run.csv").write_text("\n".join(table), encoding="utf-8")
    found = tc.read(tmp_path / "run.csv")
    assert found.table.columns.keys() == tc.read(run).table.columns.keys()
    assert [remark.code for remark in found.remarks] == ["column_unnamed"] * 2
    assert "column 1 has no name" in found.remarks[0] and "to_csv(FILE, index=False)" in found.remarks[0].marked
    strange = arrays(run) | {" ": np.arange(720.0), "T\nS": np.arange(720.0), "a\u202eb": np.arange(720.0)}
    assert tc.read(strange).table.columns.keys() == found.table.columns.keys()


def test_a_value_marked_bad_is_not_used(run: Path, tmp_path: Path) -> None:
    lines = run.read_text(encoding="utf-8").splitlines()
    marks = {100: "stuck", 101: "Over_Range", 300: ""}
    rows = [f"{lines[0]},at_degc_quality", *(f"{line},{marks.get(i, 'good')}" for i, line in enumerate(lines[1:]))]
    (tmp_path / "run.csv").write_text("\n".join(rows), encoding="utf-8")
    wanted, found = tc.read(run).table.columns["at_degc"].copy(), tc.read(tmp_path / "run.csv")
    wanted[[100, 101]] = np.nan
    np.testing.assert_array_equal(found.table.columns["at_degc"], wanted)
    (remark,) = found.remarks
    assert remark.code == "marked_bad" and "row 102: at_degc is marked 'stuck'; 2 value(s)" in remark
    named = tc.read(tmp_path / "run.csv", columns={"t_q_degc": "at_degc"}).table.columns["t_q_degc"]
    np.testing.assert_array_equal(named, wanted)


@pytest.mark.parametrize(
    ("column", "code"),
    [("t_q_degc", 850.0), ("at_degc", 999.0), ("y_um", -9999.0), ("heat_w", 65535.0), ("spindle_rpm", -999.0)],
)
def test_a_fault_code_is_refused_before_it_is_averaged(run: Path, column: str, code: float) -> None:
    table = arrays(run)
    table["spindle_rpm"] = np.linspace(0.0, 9000.0, table["t_s"].size) % 400.0
    table[column] = table[column].copy()
    table[column][[50, 51, 400]] = code
    words = f"data: row 50: {column} = {code:g}, 3 row.s. like it: a fault's code"
    with pytest.raises(DataError, match=words):
        tc.read(table).at_period(120.0)


def test_a_large_number_among_others_is_no_fault_code(run: Path) -> None:
    table = arrays(run)
    table["spindle_rpm"] = np.where(np.arange(table["t_s"].size) % 2, 9999.0, 0.0)
    table["program"] = np.where(np.arange(table["t_s"].size) % 90, 12.0, 9999.0)
    table["furnace_degc"] = np.linspace(20.0, 850.0, table["t_s"].size)
    assert tc.read(table).at_period(60.0).records[0].columns["furnace_degc"].max() == 850.0


@pytest.mark.parametrize(("factor", "words"), [(3600.0, "hours"), (60.0, "minutes")])
def test_a_time_in_hours_or_minutes_is_asked_about(run: Path, factor: float, words: str) -> None:
    table = arrays(run)
    # A day of work: T_Q goes up and down by many kelvins within hours.
    hours = np.arange(table["t_s"].size) / 60.0
    table["t_q_degc"] = table["at_degc"] + 12.0 * (1.0 - np.cos(hours))
    wanted = tc.simulate("quill", table)["y_pred_um"]
    table["t_s"] = np.round(table["t_s"] / factor, 4)
    named = f"time_{'h' if factor == 3600.0 else 'min'}"
    with pytest.raises(DataError, match=rf"{words}\? expected seconds; .* --column {named}=NAME"):
        tc.simulate("quill", table)
    answered = tc.read(table, columns={named: "t_s"})
    np.testing.assert_array_equal(tc.simulate("quill", answered)["y_pred_um"], wanted)
    renamed = {named if name == "t_s" else name: values for name, values in table.items()}
    np.testing.assert_array_equal(tc.simulate("quill", renamed)["y_pred_um"], wanted)
    table["t_s"] = table["t_s"] * factor
    assert np.isfinite(tc.simulate("quill", table)["y_pred_um"]).all()


def test_a_workbook_is_read_or_refused_with_the_way_to_a_csv(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.xlsx"
    shutil.copy(run, path)

    def without_openpyxl(*arguments: object, **options: object) -> None:
        raise ImportError("Missing optional dependency 'openpyxl'")

    with monkeypatch.context() as patch:
        patch.setattr(pd, "read_excel", without_openpyxl)
        with pytest.raises(DataError, match=r"run.xlsx: an Excel workbook, .*save the sheet as CSV"):
            tc.read(path)
    with monkeypatch.context() as patch:
        patch.setattr(pd, "read_excel", lambda *arguments, **options: pd.DataFrame(arrays(run)))
        np.testing.assert_array_equal(tc.read(path).table.columns["y_um"], tc.read(run).table.columns["y_um"])
    pytest.importorskip("openpyxl")
    with pytest.raises(DataError, match=r"not a workbook that can be read .*save the sheet as CSV"):
        tc.read(path)
    pd.DataFrame(arrays(run)).to_excel(path, index=False)
    np.testing.assert_allclose(tc.read(path).table.columns["y_um"], tc.read(run).table.columns["y_um"], rtol=1e-12)


def test_a_folder_of_recordings_is_exported_and_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    files = sorted(map(str, RECORDINGS.glob("*.mcap")))
    for name, given in (("folder", [str(RECORDINGS)]), ("files", files)):
        assert main(["export", *given, "--out", str(tmp_path / f"{name}.csv")]) == 0
    assert (tmp_path / "folder.csv").read_bytes() == (tmp_path / "files.csv").read_bytes()
    assert main(["export", str(tmp_path), "--out", str(tmp_path / "e.csv")]) == 2
    assert "no recordings in it" in capfd.readouterr().err
    assert tc.read(RECORDINGS).table.t_s.size == tc.read(files[0]).table.t_s.size or len(files) > 1


def test_exported_y_has_the_zero_of_the_prediction_beside_it(tmp_path: Path) -> None:
    out = tmp_path / "e.csv"
    tc.export(RECORDINGS, out)
    table = pd.read_csv(out)
    known = table["residual_um"].notna()
    assert known.sum() > 10
    residual = table["y_um"] - table["y_ref_um"] - table["y_pred_um"]
    np.testing.assert_allclose(residual[known], table["residual_um"][known], atol=1e-9)
    # What is exported is read again as a measurement, without what the service computed.
    assert "y_ref_um" not in tc.read(out).table.columns


def test_a_diagnosis_keeps_its_curves(run: Path, tmp_path: Path) -> None:
    found = tc.diagnose("quill", run)
    found.save(tmp_path / "d")
    series = pd.read_csv(tmp_path / "d" / "series.csv")
    diagnosis = json.loads((tmp_path / "d" / "diagnosis.json").read_text(encoding="utf-8"))
    assert len(series) == 720
    rms = np.sqrt(np.mean(series["held_out_before_um"] ** 2))
    assert rms == pytest.approx(diagnosis["before"]["rms_um"], rel=1e-6)
    assert {f"effect_{i}_um" for i in range(1, len(diagnosis["effects"]) + 1)} <= set(series.columns)
    assert {"run", "t_s", "y_um", "residual_before_um", "residual_after_um", "held_out_after_um"} <= set(series.columns)


def test_a_spreadsheet_without_a_time_is_told_its_names(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Whatever the separator is: decimal commas must not be taken for it."""
    (tmp_path / "de.csv").write_text("Zeit [h];T_Q;AT\n0,0;20,1;20,0\n0,1;20,2;20,0\n", encoding="utf-8")
    assert main(["compare", str(tmp_path / "de.csv"), "--model", "quill"]) == 2
    assert "the header has: Zeit [h], T_Q, AT" in capfd.readouterr().err
