"""Unusual machines and shops that are in order pass; a refusal names file and column."""

import numpy as np
import pytest

from compensator.data.screening import screen
from compensator.errors import DataError
from tests.identify.quill_runs import CALIBRATION_W, published, runs_from


def columns(**changes):
    heat, ambient, difference, y, _, _ = published(CALIBRATION_W, 1)
    at = 21.0 + ambient
    return {"t_q_degc": at + difference, "at_degc": at, "y_um": y, "heat_w": heat} | changes


BASE = columns()
RISE = BASE["t_q_degc"] - BASE["at_degc"]


@pytest.mark.parametrize(
    "changes",
    [
        {"at_degc": BASE["at_degc"] - 16.0, "t_q_degc": BASE["t_q_degc"] - 16.0},
        {"at_degc": BASE["at_degc"] + 20.0, "t_q_degc": BASE["t_q_degc"] + 20.0},
        {"t_q_degc": BASE["at_degc"] + 3.0 * RISE},
        {"t_q_degc": BASE["t_q_degc"] + 12.0},
        {"t_q_degc": BASE["t_q_degc"] - 3.0},
        {"y_um": -BASE["y_um"]},
        {"y_um": 0.1 * BASE["y_um"]},
        {"y_um": 10.0 * BASE["y_um"] + 5000.0},
        {"heat_w": 30.0 * BASE["heat_w"]},
        {"y_um": np.where(np.arange(720) % 5 < 3, BASE["y_um"], np.nan)},
    ],
    ids=[
        "a cold shop",
        "a hot shop",
        "a hot spindle",
        "begins warm",
        "cooled below the air",
        "shrinks",
        "hardly grows",
        "grows much, odd zero",
        "a strong heater",
        "y seldom measured",
    ],
)
def test_good_data_of_unusual_machines(changes):
    screen("good.csv", runs_from(columns(**changes)), 60.0, needs_heat=True)


def test_only_what_is_needed_is_asked_for():
    screen("x.csv", runs_from(columns(heat_w=np.full(720, 90.0))), 60.0, needs_heat=False)
    without = columns()
    del without["heat_w"]
    screen("x.csv", runs_from(without), 60.0, needs_heat=False)
    with pytest.raises(DataError, match=r"x\.csv: no column heat_w.*--kind direct"):
        screen("x.csv", runs_from(without), 60.0, needs_heat=True)


def test_several_short_runs_count_together():
    c = columns()
    c["at_degc"][70:300] = np.nan
    c = {name: values[:370] for name, values in c.items()}
    runs = runs_from(c)
    assert [run.t_s.size for run in runs] == [70, 70]
    screen("two.csv", runs, 60.0, needs_heat=False)
    with pytest.raises(DataError, match=r"two\.csv: 70 min of complete samples"):
        screen("two.csv", runs[:1], 60.0, needs_heat=False)


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("at_degc", np.full(720, 21.0)),
        ("t_q_degc", np.full(720, 21.0)),
        ("y_um", BASE["y_um"] * 1e-3),
        ("heat_w", BASE["heat_w"] * 1e-3),
        ("at_degc", BASE["at_degc"] * 1.8 + 32.0),
    ],
)
def test_one_line_that_names_file_and_column(column, values):
    with pytest.raises(DataError) as refusal:
        screen("bad.csv", runs_from(columns(**{column: values})), 60.0, needs_heat=True)
    said = str(refusal.value)
    assert said.startswith("bad.csv: ")
    assert column in said
    assert "\n" not in said
