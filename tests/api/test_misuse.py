"""A slip in a notebook: one line that says what was expected, and results that survive a pickle."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import compensator as tc
from compensator.codes import Remark, SampleQuality
from compensator.model.effects.input import Input
from tests.api.tables import frame, write_run
from tests.identify.quill_runs import VALIDATION_W


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    return frame(write_run(tmp_path_factory.mktemp("data") / "run.csv", VALIDATION_W, 3))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"drive": "x"}, "drive 'x', expected one of: ttf, known"),
        ({"kind": "foo"}, "kind 'foo', expected one of"),
        ({"method": "V"}, "method 'V', expected one of"),
        ({"order": 3}, "order 3, expected three integers"),
        ({"order": (2, 2)}, "expected three integers"),
        ({"order": "222"}, "expected three integers"),
        ({"tdtf": 10.0, "method": "I"}, "expected two numbers"),
        ({"folds": 0}, "folds 0, expected at least 2"),
        ({"name": "a\nb"}, "expected at most 300 printable"),
        ({"columns": ["t_q_degc"]}, "columns: list, expected names by role"),
        *(
            ({"method": "I", "tdtf": (gain, 10.0)}, f"gain {gain:g} µm/K, expected at most ±1000")
            for gain in (1e308, -1e300, np.inf, np.nan)
        ),
        *(
            ({"method": "I", "tdtf": (1.0, tau_min)}, f"time constant {tau_min:g} min, expected from 0.01 to 100000")
            for tau_min in (5e-324, 0.0, 1e308, np.nan)
        ),
        *(({"fit_until_h": hour}, f"fit until {hour:g} h: expected more than 0, at most") for hour in (np.inf, np.nan)),
        ({"etve_end_h": np.inf}, "ETVE end inf h, expected more than 0, at most"),
    ],
)
def test_a_wrong_option_is_named(table: pd.DataFrame, options: dict[str, object], words: str) -> None:
    with pytest.raises(tc.CompensatorError, match=re.escape(words)) as raised:
        tc.identify(table, **options)  # type: ignore[arg-type]
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("nothing", [[], None])
def test_no_data_is_refused(nothing: object) -> None:
    for verb in (tc.identify, lambda data: tc.simulate("quill", data), lambda data: tc.diagnose("quill", data)):
        with pytest.raises(tc.CompensatorError, match="empty, expected a path"):
            verb(nothing)


def test_data_without_a_channel_that_an_effect_needs_are_refused(table: pd.DataFrame) -> None:
    """Without the channel the effect would stay at zero, with the same stated deviation: 11 µm wrong without a word."""
    coolant = Input(channel="coolant_degc", curve="linear", tau_min=(30.0,), gain=(2.0,), delay_min=0.0)
    model = dataclasses.replace(tc.load_model("quill"), effects=(coolant,), sha256="")
    calls = (
        lambda: tc.simulate(model, table),
        lambda: tc.diagnose(model, table),
        lambda: tc.compare({"extended": model}, table),
    )
    for call in calls:
        with pytest.raises(tc.CompensatorError, match="no column coolant_degc, which an effect of model quill needs"):
            call()
    assert np.isfinite(tc.simulate(model, table.assign(coolant_degc=20.0))["y_pred_um"]).all()


def test_a_clock_that_was_set_back_is_refused_and_single_rows_are_sorted(table: pd.DataFrame) -> None:
    """Sorted, rows of two hours would stand between each other."""
    back = table.assign(t_s=np.where(np.arange(len(table)) < 300, table["t_s"], table["t_s"] - 3600.0))
    with pytest.raises(tc.CompensatorError, match="row 300: 59 min occur twice"):
        tc.simulate("quill", back)
    for order in (np.arange(len(table))[::-1], np.random.default_rng(1).permutation(len(table))):
        assert tc.simulate("quill", table.iloc[order])["t_s"].size == len(table)


def test_what_is_no_model_is_refused(table: pd.DataFrame) -> None:
    for call in (lambda: tc.simulate(table, "quill"), lambda: tc.simulate(3, table), lambda: tc.diagnose(None, table)):
        with pytest.raises(tc.CompensatorError, match="expected a model, a result, a path"):
            call()
    for models in (["quill"], "quill", {}):
        with pytest.raises(tc.CompensatorError):
            tc.compare(models, table)  # type: ignore[arg-type]


def test_a_result_stands_for_its_model(table: pd.DataFrame) -> None:
    found = tc.identify(table, order=(2, 2, 2))
    same = tc.simulate(found, table)["y_pred_um"].equals(tc.simulate(found.model, table)["y_pred_um"])
    assert same and found.criticism.warnings
    for again in (pickle.loads(pickle.dumps(found)), copy.deepcopy(found)):
        assert again.to_dict() == found.to_dict()
        assert [w.code for w in again.criticism.warnings] == [w.code for w in found.criticism.warnings]


def test_a_remark_survives_a_copy() -> None:
    remark = Remark(SampleQuality.STUCK, "t_q_degc = 20 in every row.")
    again = pickle.loads(pickle.dumps(remark))
    assert (again, again.code, again.marked) == (remark, remark.code, remark.marked)


def test_shuffled_rows_are_sorted(table: pd.DataFrame) -> None:
    shuffled = table.sample(frac=1.0, random_state=1)
    out, wanted = tc.simulate("quill", shuffled), tc.simulate("quill", table)
    assert np.array_equal(out["y_pred_um"], wanted["y_pred_um"])
    assert any(remark.code == "rows_sorted" for remark in out.remarks)


@pytest.mark.parametrize("zone", [None, "UTC"])
def test_times_come_out_with_the_zone_that_came_in(table: pd.DataFrame, zone: str | None) -> None:
    timed = table.drop(columns="t_s").set_index(pd.date_range("2026-03-28", periods=len(table), freq="min", tz=zone))
    timed["y_pred_um"] = tc.simulate("quill", timed)["y_pred_um"]
    assert timed["y_pred_um"].notna().all()


def test_a_broken_mat_file_is_named(tmp_path: Path) -> None:
    from scipy.io import savemat

    path = tmp_path / "run.mat"
    savemat(path, {"t_s": np.arange(100.0), "t_q_degc": np.full(100, 20.0)})
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(tc.CompensatorError, match=r"run\.mat: not a MAT file that can be read"):
        tc.read(path)


def test_a_folder_that_does_not_exist_is_refused_and_not_made(table: pd.DataFrame, tmp_path: Path) -> None:
    found = tc.identify(table, order=(2, 2, 2))
    for save in (tc.simulate("quill", table).save, found.save, found.page):
        for name in ("model.toml", "out.html"):
            with pytest.raises(tc.CompensatorError, match=r"absent/\S+: (no such folder|expected a name)"):
                save(tmp_path / "absent" / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda run: tc.identify(run, folds="x"), "folds = 'x', expected an integer"),
        (lambda run: tc.identify(run, folds=2.5), "folds = 2.5, expected an integer"),
        (lambda run: tc.identify(run, etve_end_h="x"), "etve_end_h = 'x', expected a number"),
        (lambda run: tc.identify(run, axis=5), "--axis 5: expected the name of an axis"),
        (lambda run: tc.identify(run, name=5), "name = 5, expected a text"),
        (lambda run: tc.read(run, name=5), "name = 5, expected a text"),
        (lambda run: tc.diagnose("quill", run, fit_until_h="x"), "fit_until_h = 'x', expected a number"),
        (lambda run: tc.compare({"a": "quill"}, run, from_h="x"), "from_h = 'x', expected a number"),
        (lambda run: tc.compare({}, run), "compare: no models, expected one at least"),
        (lambda run: tc.simulate("quill", {}), "data: no columns, expected t_s or time_utc"),
        (lambda run: tc.export([], "out.csv"), "recordings: empty, expected a recording"),
        (lambda run: tc.simulate("quill", run).result.save("/proc/out.csv"), "/proc/out.csv: No such file"),
        (lambda run: tc.simulate("quill", run).result.save("/proc"), "/proc: not a regular file"),
        (lambda run: tc.compare({"a": "quill"}, run).save("/proc"), "/proc: not a regular file"),
        (lambda run: tc.compare({"a": "quill"}, run).page("/proc/out.html"), "/proc/out.html: No such file"),
        (lambda run: tc.identify(run, order=(2, 2, 2)).save("/proc"), "/proc: not a regular file"),
    ],
)
def test_what_python_or_the_system_refuses_is_said_as_the_commands_do(
    table: pd.DataFrame, call: Callable[[pd.DataFrame], object], words: str
) -> None:
    with pytest.raises(tc.CompensatorError, match="^" + re.escape(words)):
        call(table)
