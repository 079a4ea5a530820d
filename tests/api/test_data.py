"""DATA as a path, a dict, a DataFrame, a MAT file, or a list of them; what is refused, and in which words."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot
from matplotlib.axes import Axes
from scipy.io import savemat

import compensator as tc
from compensator.api.diagnosis import _is_unseen
from compensator.data import files, mat_reader
from compensator.data.measurement import measurements
from tests.api.tables import START, arrays, by_time, frame, write_run
from tests.identify.quill_runs import CALIBRATION_W

SMALL = {"t_s": [0.0, 60.0, 120.0], "t_q_degc": [20.0, 21.0, 22.0], "at_degc": [20.0, 20.0, 20.1]}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("data") / "run.csv", CALIBRATION_W, 1)


def records(data: object, **options: object) -> list[dict[str, np.ndarray]]:
    return [{"t_s": r.t_s, **r.columns} for r in tc.read(data, **options).at_period(60.0).records]


def same(found: list[dict[str, np.ndarray]], wanted: list[dict[str, np.ndarray]]) -> None:
    assert [list(one) for one in found] == [list(one) for one in wanted]
    for one, other in zip(found, wanted, strict=True):
        for name, values in other.items():
            np.testing.assert_array_equal(one[name], values)


def test_a_dict_a_dataframe_and_a_datetime_index_are_what_the_file_is(run: Path) -> None:
    wanted = records(run)
    same(records(arrays(run)), wanted)
    same(records({name: values.tolist() for name, values in arrays(run).items()}), wanted)
    same(records(frame(run)), wanted)
    same(records(frame(run).set_index("t_s")), [{name: one[name] for name in one} for one in wanted])
    same(records(by_time(run)), wanted)
    same(records(by_time(run).tz_localize(None)), wanted)


def test_times_in_text_and_in_zones_are_utc_in_a_file_and_in_memory(tmp_path: Path) -> None:
    # The night in which Central Europe loses an hour: a time without a zone is UTC and nothing is missing.
    times = pd.date_range("2026-03-29T00:30:00", periods=120, freq="min")
    t_q = 20.0 + np.arange(120) / 10.0
    table = pd.DataFrame({"time_utc": times, "t_q_degc": t_q, "at_degc": 20.0})
    table.to_csv(tmp_path / "night.csv", index=False)
    wanted = records(tmp_path / "night.csv")
    assert [one["t_s"][-1] for one in wanted] == [119 * 60.0]
    same(records(table), wanted)
    zoned = table.assign(time_utc=times.tz_localize("UTC").tz_convert("Europe/Berlin"))
    same(records(zoned), wanted)
    same(records(table.assign(time_utc=[t.isoformat() + "Z" for t in times])), wanted)
    same(records({"time_utc": times.to_numpy(), "t_q_degc": t_q, "at_degc": np.full(120, 20.0)}), wanted)
    same(records({"time_utc": times.to_pydatetime().tolist(), "t_q_degc": t_q, "at_degc": [20.0] * 120}), wanted)


def test_missing_values_of_every_make_are_missing() -> None:
    nullable = pd.DataFrame(SMALL).assign(y_um=pd.array([1, None, 3], dtype="Int64"), fan=[None, 1.0, "2"], note="warm")
    ((record,),) = [records(nullable)]
    np.testing.assert_array_equal(record["y_um"], [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(record["fan"], [np.nan, 1.0, 2.0])
    assert "note" not in record
    masked = np.ma.masked_equal([1.0, -9999.0, 3.0], -9999.0)
    np.testing.assert_array_equal(records(SMALL | {"y_um": masked})[0]["y_um"], [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(records(SMALL | {"y_um": [1, None, ""]})[0]["y_um"], [1.0, np.nan, np.nan])


def test_columns_give_roles_in_files_and_in_memory(tmp_path: Path) -> None:
    renamed = pd.DataFrame(SMALL).rename(columns={"t_q_degc": "t5", "at_degc": "room"})
    renamed.to_csv(tmp_path / "run.csv", index=False)
    columns = {"t_q_degc": "t5", "at_degc": "room"}
    for data in (tmp_path / "run.csv", str(tmp_path / "run.csv"), renamed, renamed.to_dict("list")):
        assert set(tc.read(data, columns=columns).table.columns) == {"t_q_degc", "at_degc"}
    with pytest.raises(tc.CompensatorError, match=r"^data: --column t_q_degc=t9: no such column, expected one of: t5"):
        tc.read(renamed, columns={"t_q_degc": "t9"})


def test_the_time_may_have_another_name(tmp_path: Path) -> None:
    wanted = records(SMALL)
    renamed = pd.DataFrame(SMALL).rename(columns={"t_s": "clock"})
    renamed.to_csv(tmp_path / "run.csv", index=False)
    savemat(tmp_path / "run.mat", renamed.to_dict("list"))
    columns = {"t_s": "clock"}
    for data in (tmp_path / "run.csv", tmp_path / "run.mat", renamed, renamed.to_dict("list")):
        same(records(data, columns=columns), wanted)
        with pytest.raises(tc.CompensatorError, match=r"no .* t_s or time_utc; "):
            tc.read(data)
    same(records(renamed.set_index("clock"), columns=columns), wanted)
    # A time that is named is used, whatever else looks like one.
    same(records(renamed.assign(t_s=[5.0, 4.0, 3.0], time_utc="never"), columns=columns), wanted)
    with pytest.raises(tc.CompensatorError, match=r"^data: --column t_s=watch: no such column, expected one of: clock"):
        tc.read(renamed, columns={"t_s": "watch"})


@pytest.mark.parametrize("as_index", [False, True])
def test_a_date_and_time_of_another_name_gives_results_by_time(run: Path, as_index: bool) -> None:
    by_date = by_time(run)
    stamped = by_date.rename_axis("stamp") if as_index else by_date.rename_axis("stamp").reset_index()
    columns = {"time_utc": "stamp"}
    same(records(stamped, columns=columns), records(run))
    assert tc.simulate("quill", stamped, columns=columns).index[0] == START
    local = stamped.tz_localize(None) if as_index else stamped.assign(stamp=stamped["stamp"].dt.tz_localize(None))
    assert tc.simulate("quill", local, columns=columns).index[0] == START.tz_localize(None)


def test_a_temperature_that_is_missing_for_long_splits_the_record_as_missing_rows_do() -> None:
    n = 1200
    table = {"t_s": 60.0 * np.arange(n), "t_q_degc": 20.0 + np.arange(n) / 50.0, "at_degc": np.full(n, 20.0)}
    for first, last in ((100, 160), (200, 290), (400, 461)):  # the first is bridged
        table["t_q_degc"][first:last] = np.nan
    data = tc.read(table).at_period(60.0)
    assert [remark.code for remark in data.remarks] == ["temperature_missing", "gap_bridged"]
    assert "t_q_degc is missing for 2.5 h from t_s = 12000, 24000; the record is split there" in data.remarks[0]
    assert "empty: t_q_degc in 60 sample(s), first at t_s = 6000; bridged" in data.remarks[1]
    found = tc.simulate("quill", table)
    assert "temperature_missing" in [remark.code for remark in found.remarks]
    kept = np.ones(n, dtype=bool)
    kept[200:290] = kept[400:461] = False
    without = tc.simulate("quill", {name: values[kept] for name, values in table.items()})
    assert found.records == without.records == 3
    np.testing.assert_array_equal(found["t_s"], without["t_s"])
    np.testing.assert_array_equal(found["y_pred_um"], without["y_pred_um"])


def test_a_run_shows_itself() -> None:
    table = pd.DataFrame(SMALL | {"y_um": [1.0, np.nan, 2.0]})
    table.loc[3] = {"t_s": 720.0, "t_q_degc": 22.0, "at_degc": 20.0, "y_um": 2.0}
    run = tc.read(table, name="<press>")
    said = repr(run)
    for words in ("<press>", "0.20 h", "4 of 60 s", "t_q_degc, at_degc, y_um (25 % missing)", "gap of 9 sample(s)"):
        assert words in said
    page = run._repr_html_()
    assert "&lt;press&gt;" in page and "<press>" not in page and "0.20 h" in page


def test_a_list_is_several_runs_and_recordings_of_it_are_one(run: Path) -> None:
    found = measurements([frame(run), run, tc.read(arrays(run), name="mine")], "data")
    assert [one.label for one in found] == ["data 1", "run.csv", "mine"]
    assert measurements((), "etve") == [] == measurements(None, "etve")
    with pytest.raises(tc.CompensatorError, match="2 tables, expected one"):
        tc.read([run, run])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (7, "data: int, expected a path, a DataFrame, a dict of arrays, or a list of those"),
        (np.zeros((3, 3)), "data: ndarray, expected a path"),
        ([SMALL, 7], "data 2: int, expected a path"),
        ({"y_um": [1.0]}, "data: no column t_s or time_utc; it has: y_um"),
        ({"t_s": [], "y_um": []}, "data: no rows in it"),
        (SMALL | {"y_um": [1.0]}, "data: y_um has 1 values, t_s 3, expected equally many"),
        (SMALL | {"y_um": np.zeros((3, 2))}, "data: y_um has the shape (3, 2), expected one value for each row"),
        (SMALL | {"y_um": [1.0, 2.0, "x"]}, "data: row 2: y_um = 'x', expected a number"),
        (SMALL | {"y_um": [1.0, np.inf, 2.0]}, "data: row 1: y_um = inf, expected a finite number"),
        (SMALL | {"t_s": [0.0, np.nan, 120.0]}, "data: row 1: time is missing"),
        ({"time_utc": ["soon"], "y_um": [1.0]}, "data: row 0: time_utc = 'soon', expected a time such as 2025"),
        ({"time_utc": [1.76e9], "y_um": [1.0]}, "data: row 0: time_utc = '1760000000.0', expected a time such as 2025"),
        (pd.DataFrame([[0.0, 1.0, 1.0]], columns=["t_s", "y_um", "y_um"]), "data: column 'y_um' is there twice"),
        ("absent.csv", "absent.csv: No such file"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_no_data_is_refused_in_one_line(data: object, words: str) -> None:
    with pytest.raises(tc.CompensatorError) as refused:
        measurements(data, "data")
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_the_rows_of_a_file_are_counted_as_an_editor_does(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t_s,y_um\n0,1\n\n60,x\n")
    with pytest.raises(tc.CompensatorError, match=r"row 4: y_um = 'x', expected a number"):
        tc.read(path)
    path.write_text("t_s,y_um\n\n")
    with pytest.raises(tc.CompensatorError, match="no rows in it"):
        tc.read(path)


@pytest.mark.parametrize("as_struct", [False, True])
def test_vectors_and_structs_of_matlab_are_tables(tmp_path: Path, run: Path, as_struct: bool) -> None:
    wanted = {name: values[:, None] for name, values in arrays(run).items()}
    path = tmp_path / "run.mat"
    savemat(path, {"run": wanted} if as_struct else {**wanted, "Ts": 60.0, "note": "a scalar and a text beside them"})
    same(records(path), records(run))


@pytest.mark.parametrize(("place", "value"), [(144, 109), (145, 255)], ids=["class", "flags"])
def test_a_damaged_file_of_matlab_ends_its_reader_alone(tmp_path: Path, place: int, value: int) -> None:
    """A byte that scipy's reader believes: it ends its process, or has no words for it."""
    path = tmp_path / "run.mat"
    savemat(path, SMALL)
    data = bytearray(path.read_bytes())
    data[place] = value
    path.write_bytes(data)
    with pytest.raises(tc.CompensatorError, match=r"not a MAT file that can be read \("):
        tc.read(path)


@pytest.mark.parametrize(
    ("limit", "said"),
    [("READ_BYTES = 99_999", "more than 99999 bytes of values"), ("MEMORY_BYTES = 2**26", "(memory|allocate)")],
)
def test_a_packed_file_of_matlab_takes_bounded_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, said: str
) -> None:
    path, script = tmp_path / "run.mat", tmp_path / "reader.py"
    savemat(path, SMALL | {"zeros": np.zeros(30_000_000, dtype=np.uint8)}, do_compression=True)
    assert path.stat().st_size < 100_000
    assert tc.read(path).remarks[0].code == "variables_left_out"
    where = [str(Path(tc.__file__).parents[1]), *sys.path]
    code = f"import sys; sys.path += {where}\nfrom compensator.data import mat_reader as m\nimport scipy.io.matlab\n"
    script.write_text(f"{code}m.{limit}\nm.main()")
    monkeypatch.setattr(mat_reader, "__file__", str(script))
    with pytest.raises(tc.CompensatorError, match=rf"(?i)can be read \(.*{said}"):
        tc.read(path)


def test_a_file_of_matlab_that_is_read_for_ever_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, script = tmp_path / "run.mat", tmp_path / "reader.py"
    savemat(path, SMALL)
    script.write_text("import threading; threading.Event().wait()")
    monkeypatch.setattr(mat_reader, "__file__", str(script))
    monkeypatch.setattr(files, "_MAT_S", 0.5)
    with pytest.raises(tc.CompensatorError, match="its reader had not ended after 0 s"):
        tc.read(path)


def test_matrices_among_vectors_are_left_out_with_a_remark(tmp_path: Path) -> None:
    others = {"A": np.eye(3), "frames": np.zeros((3, 2, 2)), "b": [1.0, 2.0], "Ts": 60.0}
    savemat(tmp_path / "run.mat", SMALL | others)
    found = tc.read(tmp_path / "run.mat")
    assert set(found.table.columns) == {"t_q_degc", "at_degc"}
    assert [remark.code for remark in found.remarks] == ["variables_left_out"]
    assert "3 rows: A (3 × 3), frames (3 × 2 × 2), b (2)." in found.remarks[0]
    savemat(tmp_path / "run.mat", SMALL | {"y_um": np.eye(3)})
    with pytest.raises(tc.CompensatorError, match=r"y_um has the shape \(3, 3\), expected one value for each row"):
        tc.read(tmp_path / "run.mat")
    savemat(tmp_path / "run.mat", SMALL | {"A": np.eye(3)})
    with pytest.raises(tc.CompensatorError, match=r"A has the shape \(3, 3\)"):
        tc.read(tmp_path / "run.mat", columns={"y_um": "A"})


def test_suffixes_may_be_in_capitals(tmp_path: Path) -> None:
    savemat(tmp_path / "RUN.mat", SMALL)
    (tmp_path / "RUN.mat").rename(tmp_path / "RUN.MAT")
    pd.DataFrame(SMALL).to_csv(tmp_path / "RUN.CSV", index=False)
    same(records(tmp_path / "RUN.MAT"), records(SMALL))
    same(records(tmp_path / "RUN.CSV"), records(SMALL))


def test_matlab_s_times_in_text_are_read(tmp_path: Path) -> None:
    times = [f"2026-01-01T00:{minute:02}:00Z" for minute in range(3)]
    for cells in (np.array(times), np.array(times, dtype=object)):
        savemat(tmp_path / "run.mat", {"time_utc": cells, "y_um": [1.0, 2.0, 3.0]})
        assert records(tmp_path / "run.mat")[0]["t_s"].tolist() == [0.0, 60.0, 120.0]


def test_what_matlab_alone_reads_is_refused_with_the_way_out(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + b"\0" * 8 + b"\x00\x02IM"
    path.write_bytes(head.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n" + b"\0" * 512)
    with pytest.raises(tc.CompensatorError, match=r"run.mat: a MAT file of version 7.3 .* writetable"):
        tc.read(path)
    for content in (b"", b"no MAT file at all, whatever its name", path.read_bytes()[:100]):
        path.write_bytes(content)
        with pytest.raises(tc.CompensatorError, match=r"run\.mat: "):
            tc.read(path)
    savemat(path, {"gain": 3.0})
    with pytest.raises(tc.CompensatorError, match=r"no vector t_s or time_utc; it has: gain.*table2struct.*writetable"):
        tc.read(path)
    path.rename(tmp_path / "run.csv")
    with pytest.raises(tc.CompensatorError, match=r"name it FILE.mat"):
        tc.read(tmp_path / "run.csv")


def test_tables_of_results_are_dataframes_where_one_came_in(run: Path) -> None:
    out = tc.simulate("quill", by_time(run))
    assert isinstance(out, pd.DataFrame)
    assert out.index[0] == START and out.index[-1] == START + pd.Timedelta(719, "min")
    assert isinstance(tc.simulate("quill", frame(run)).index, pd.RangeIndex)
    assert isinstance(out["y_pred_um"].to_numpy(), np.ndarray) and type(out.head()) is pd.DataFrame
    plain = tc.simulate("quill", arrays(run))
    assert isinstance(plain["y_pred_um"], np.ndarray)
    assert list(plain) == list(out.columns) and plain.scores == out.scores
    assert isinstance(tc.compare({"quill": "quill"}, frame(run)).table, pd.DataFrame)


def test_the_plot_of_a_frame_is_that_of_the_result_and_with_arguments_that_of_pandas(run: Path) -> None:
    matplotlib.use("Agg")
    out = tc.simulate("quill", frame(run))
    assert [axes.get_ylabel() for axes in out.plot().axes] == ["Y, µm", "residual, µm"]
    for axes in (out.plot(y="y_pred_um", legend=False), out.plot.line(y="y_pred_um", legend=False)):
        assert isinstance(axes, Axes) and len(axes.lines) == 1
        pyplot.close(axes.figure)
    assert type(out.head().plot).__module__.startswith("pandas"), "a slice is a plain DataFrame"


@pytest.mark.parametrize(
    ("known", "unseen"),
    [("first", (False, True)), ("validated", (True, False)), ("nothing", (False, False)), ("a text", (False, False))],
)
def test_whether_a_model_has_seen_the_data_is_known_by_their_hash(known: str, unseen: tuple[bool, bool]) -> None:
    both = [SMALL, SMALL | {"t_q_degc": [20.0, 21.0, 23.0]}]
    first, second = (measurements(one, "data", None, needed=True) for one in both)
    one, other = ({"role": "fit", "sha256": each[0].origins[0].sha256} for each in (first, second))
    validated = [one | {"role": "validation"}, other]
    data = {"first": [one, 1], "validated": validated, "nothing": [], "a text": "first"}[known]
    model = dataclasses.replace(tc.load_model("quill"), provenance={"data": data})
    assert (_is_unseen(model, first), _is_unseen(model, second)) == unseen


def test_a_record_with_further_columns_has_been_seen(tmp_path: Path) -> None:
    """A calibration is given the columns that it needs, the diagnosis of the same hours every channel."""
    more = SMALL | {"y_um": [0.0, 1.0, 2.0], "coolant_degc": [18.0, 18.1, 18.2]}
    rows = "\n".join(",".join(map(str, row)) for row in [more, *zip(*more.values(), strict=True)])
    (tmp_path / "more.csv").write_text(rows + "\n", encoding="utf-8")
    other = more | {"t_q_degc": [20.0, 21.0, 22.1]}
    (calibrated,) = measurements(SMALL | {"y_um": [0.0, 1.0, 2.0]}, "data", None, needed=True)
    source = {"role": "fit"} | calibrated.origins[0].provenance()
    model = dataclasses.replace(tc.load_model("quill"), provenance={"data": [source]})
    for data, unseen in ((more, False), (tmp_path / "more.csv", False), (other, True)):
        assert _is_unseen(model, measurements(data, "data", None, needed=True)) is unseen
