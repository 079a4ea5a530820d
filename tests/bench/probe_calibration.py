"""What `identify` makes of Y by touch probe: published functions, a working day, T_Q and AT every minute.

Fit of the free run on the dense truth of another day of 24 h, about its mean. z is the error of a gain over its stated
standard error (root mean square; 1 is right), and of the prediction the error over the stated deviation (median).

python -m tests.bench probe_calibration                   the development set
python -m tests.bench.probe_calibration judging           the set that judges: at most twice
"""

import sys
import time

import numpy as np

import compensator as tc
from compensator.blas import in_one_thread
from compensator.identify.calibration import predict
from compensator.model.model_file import load_model
from tests.bench.figures import Figure, rows, told
from tests.diagnose.scenarios import record, signals
from tests.identify.quill_runs import fit_pct, runs_from

STD_UM = 1.5
#: Hours, and minutes between two probes.
PLANS = ((36.0, 10), (72.0, 30))
SETS = {"development": (100, 12), "judging": (880_000, 16)}


def probed(seed, hours, every_min, *, heat):
    """A record with Y in every so many rows."""
    measured, true, _ = record([], seed, hours)
    y, at = np.full(true.size, np.nan), np.arange(every_min - 1, true.size, every_min)
    y[at] = true[at] + np.random.default_rng([seed, 7]).normal(0.0, STD_UM, at.size)
    columns = {"t_s": np.arange(true.size) * 60.0, "y_um": y} | {c: measured[c] for c in ("t_q_degc", "at_degc")}
    return columns | ({"heat_w": signals(seed, hours)[2]} if heat else {})


def one(seed, hours, every_min, *, heat):
    """Return the fit in free run, z of both gains, and the error over the stated deviation."""
    found = tc.identify(probed(seed, hours, every_min, heat=heat), y_std_um=STD_UM)
    measured, true, _ = record([], seed + 500, 24.0)
    fresh = runs_from({"t_q_degc": measured["t_q_degc"], "at_degc": measured["at_degc"], "y_um": true})[0]
    predicted = predict(found.model, fresh)
    error = true - predicted
    quill, main = load_model("quill"), found.calibration.deformation.main
    drive = quill.dtf.sampled.dc_gain / (1.0 if heat else quill.ttf.sampled.dc_gain)
    truth = (drive, quill.tdtf.sampled.dc_gain)
    z = [(main.gain(j)[0] - truth[j]) / main.gain(j)[1] for j in (0, 1)]
    fit = fit_pct(true - true.mean(), predicted - predicted.mean())
    return fit, *z, float(np.std(error)) / found.model.y_std_um


def report(which="development"):
    """Yield the figures; the table is printed."""
    first, count = SETS[which]
    table = []
    for heat in (True, False):
        for hours, every_min in PLANS:
            began = time.perf_counter()
            found = np.array([one(first + i, hours, every_min, heat=heat) for i in range(count)])
            fits, z = found[:, 0], np.sqrt(np.mean(found[:, 1:3] ** 2, axis=0))
            what = f"{'known heat' if heat else 'direct'}, {hours * 60 / every_min:.0f} probes in {hours:g} h"
            figure = f"{np.median(fits):.2f} ({fits.min():.2f}) %"
            seconds = (time.perf_counter() - began) / count
            table.append([what, figure, f"{z[0]:.2f}, {z[1]:.2f}", f"{np.median(found[:, 3]):.2f}", f"{seconds:.1f}"])
            print(table[-1], np.round(fits, 1).tolist(), flush=True)
            title = f"calibration from probes of {STD_UM} µm, {which}, {count} seeds, {what}: fit, median (worst)"
            yield told(Figure(what=title, found=figure, wanted="98.5 (95) %"))
    head = ["", "fit, median (worst)", "z of DTF, TDTF gain", "error / stated", "s each"]
    rows(f"calibration from probes, {which}", head, table)


if __name__ == "__main__":
    in_one_thread(lambda: list(report(*sys.argv[1:])))
