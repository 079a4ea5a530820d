"""The measured spindle, through the commands: calibrate two inputs, diagnose, run what comes out on hours not seen.

Beside it: no compensation, persistence (the last measured value stands), and a ridge regression (`ridge.py`).
"""

import contextlib
import csv
import io
import json
import tempfile
from pathlib import Path

import numpy as np

from compensator.cli import main
from tests.bench.figures import Figure, rows, told
from tests.bench.ridge import ridge

FILE = Path(__file__).resolve().parents[3] / "shared/data/measured-spindle/spindle-15s.csv"
#: Hours of the fit, hours that judge.
SPLITS = (((0, 12), (12, 32)), ((0, 16), (16, 32)), ((0, 20), (20, 32)), ((0, 24), (24, 32)), ((0, 28), (28, 32)))
ROWS_PER_H = 240


def quietly(*words):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert main([str(word) for word in words]) == 0


def column(path, name):
    with path.open(encoding="utf-8") as file:
        return np.array([float(row[name] or "nan") for row in csv.DictReader(file)])


def cut(folder, last_h):
    """Write the hours of the fit; the probes other than Y stay in, as they would in a log."""
    rows = FILE.read_text(encoding="utf-8").splitlines()
    path = folder / "fit.csv"
    path.write_text("\n".join(rows[: 1 + last_h * ROWS_PER_H]) + "\n", encoding="utf-8")
    return path


def by_ridge(y, used):
    """Predict by every temperature and the speed behind lags."""
    with FILE.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = [name for name in rows[0] if name.endswith(("_degc", "_rpm"))]
    every_15_s = (np.array([float(r[n]) for r in rows])[: 4 * y.size] for n in names)
    return ridge([channel.reshape(-1, 4).mean(axis=1) for channel in every_15_s], y, used)


def one(probe, fit_h, judge_h):
    """Return rms and mean absolute errors on the hours that judge, µm, by name, and what was found."""
    roles = ["--column", "t_q_degc=t5_degc", "--column", "at_degc=t16_degc", "--column", f"y_um=ch{probe}_um"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = cut(folder, fit_h[1])
        quietly("identify", data, *roles, "--out", folder / "two.toml")
        quietly("diagnose", data, *roles, "--model", folder / "two.toml", "--out", folder / "d")
        predicted = {}
        for label, model in (("two inputs", folder / "two.toml"), ("extended", folder / "d/model.toml")):
            quietly("simulate", FILE, *roles, "--model", model, "--out", folder / "p.csv")
            predicted[label] = column(folder / "p.csv", "y_pred_um")
            y = column(folder / "p.csv", "y_um")
        found = json.loads((folder / "d/diagnosis.json").read_text(encoding="utf-8"))["effects"]
    judged = slice(judge_h[0] * 60, judge_h[1] * 60)
    used = np.zeros(y.size, dtype=bool)
    used[fit_h[0] * 60 : fit_h[1] * 60] = True
    predicted |= {"none": np.zeros(y.size), "persistence": np.full(y.size, y[judge_h[0] * 60 - 1])}
    predicted["ridge, all"] = by_ridge(y, used)
    errors = {
        label: (
            float(np.sqrt(np.nanmean((y - p)[judged] ** 2))),
            float(np.nanmean(np.abs((y - p)[judged]))),
        )
        for label, p in predicted.items()
    }
    return errors, " + ".join(f"{e['channel']} ({e['form']})" for e in found) or "nothing"


def report():
    """Yield a figure for each probe, fitted on 20 h; every split is printed."""
    if not FILE.exists():
        yield told(Figure(what="measured spindle", found="the data is not here"))
        return
    names = ("none", "persistence", "two inputs", "ridge, all", "extended")
    body, figures = [], []
    for probe in range(1, 6):
        for fit_h, judge_h in SPLITS:
            errors, found = one(probe, fit_h, judge_h)
            cells = [f"{errors[name][0]:.1f} ({errors[name][1]:.1f})" for name in names]
            body.append([f"ch{probe}", f"{fit_h[0]}-{fit_h[1]}", f"{judge_h[0]}-{judge_h[1]}", *cells, found])
            if fit_h == (0, 20):
                beside = ", ".join(f"{name} {errors[name][0]:.1f}" for name in names[:-1])
                what = f"measured spindle ch{probe}, fitted on 20 h, run on the 12 after them: {found}"
                figures.append(Figure(what=what, found=f"{errors['extended'][0]:.1f} µm rms", beside=beside))
    rows(
        "measured spindle, free run on hours that nothing saw, µm rms (mean absolute)",
        ["probe", "fit, h", "judged, h", *names, "found"],
        body,
    )
    yield from map(told, figures)


if __name__ == "__main__":
    list(report())
