"""Tables of the published machine, on disk and in memory."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pandas as pd

from compensator.demo.calibration import write_table
from tests.identify.quill_runs import published

START = pd.Timestamp("2026-03-28T22:00:00Z")


def write_run(path: Path, heat_w: np.ndarray, seed: int, **changes: np.ndarray) -> Path:
    """Write a run of the published machine with known heat; columns may be changed."""
    heat, ambient, difference, y, _, _ = published(heat_w, seed)
    at = 21.0 + ambient
    columns = {
        "t_s": np.arange(heat.size) * 60.0,
        "t_q_degc": at + difference,
        "at_degc": at,
        "y_um": y,
        "heat_w": heat,
    }
    write_table(path, columns | changes)
    return path


def arrays(path: Path) -> dict[str, np.ndarray]:
    """Read a CSV as a user of numpy would."""
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def frame(path: Path) -> pd.DataFrame:
    """Read a CSV as a user of pandas would."""
    return pd.DataFrame(arrays(path))


def by_time(path: Path) -> pd.DataFrame:
    """The same with a DatetimeIndex in the place of `t_s`."""
    table = frame(path)
    return table.set_index(START + pd.to_timedelta(table.pop("t_s"), unit="s"))
