"""A channel of the measured spindle is hidden: does the advice name its neighbour first or second?

The source of the data does not say where each sensor sits. Neighbours are those temperatures that correlate most with
the hidden one over the record: the most alike, and all above 0.95.

in turn, alone    Y is what a two-input model says, the response of the hidden channel behind a lag of 20 min (a fifth of
                  Y's spread) and 0.5 µm of noise; temperatures and speed as measured.
in turn, probe    the same, but the hidden channel acts on a measured probe, with all that moves it.
"""

import dataclasses
from pathlib import Path

import numpy as np

import compensator as tc
from compensator.data.measurement import measurements, runs_in
from compensator.diagnose.evidence import evidence_of
from compensator.diagnose.findings import findings_of
from compensator.diagnose.nearest import nearest
from compensator.identify.calibration import predict
from tests.bench.figures import Figure, rows, told
from tests.diagnose.scenarios import lag

FILE = Path(__file__).resolve().parents[3] / "shared/data/measured-spindle/spindle-15s.csv"
ALIKE = 0.95
LAG_MIN, SHARE, NOISE_UM, OWN_UM = 20.0, 0.2, 0.5, 0.5


def measured(probe):
    """Return the spindle's columns at 60 s with roles, one probe as Y."""
    table = np.genfromtxt(FILE, delimiter=",", names=True)
    columns = {
        name: table[name].reshape(-1, 4).mean(axis=1) for name in table.dtype.names if not name.startswith("ch")
    }
    columns["t_s"] = columns["t_s"] - columns["t_s"][0]
    columns["t_q_degc"], columns["at_degc"] = columns.pop("t5_degc"), columns.pop("t16_degc")
    return columns | {"y_um": table[f"ch{probe}_um"].reshape(-1, 4).mean(axis=1)}


def neighbours(columns, hidden):
    """Return the other temperatures by how alike they are, and the set that counts as near."""
    others = [name for name in columns if name.endswith("_degc") and name != hidden]
    alike = {name: np.corrcoef(columns[name], columns[hidden])[0, 1] for name in others}
    ranked = sorted(others, key=lambda name: -alike[name])
    return ranked, {ranked[0], *(name for name in ranked if alike[name] > ALIKE)}


def one(base, columns, hidden, *, known):
    """Return the nearest channels with one hidden that acts on Y, and what was named."""
    rng = np.random.default_rng(sum(map(ord, hidden)))
    logged = {name: values for name, values in columns.items() if name != hidden}
    spread = np.std(columns["y_um"])
    if known:
        run = runs_in(measurements(logged, "data", None, needed=True), base.period_s)[0][0]
        logged["y_um"] = predict(base, run) + rng.normal(0.0, NOISE_UM, run.t_s.size)
        base = dataclasses.replace(base, held_out_rms_um=OWN_UM)
    course = lag(columns[hidden], LAG_MIN)
    logged["y_um"] = logged["y_um"] + SHARE * spread * course / np.std(course)
    runs, _ = runs_in(measurements(logged, "data", None, needed=True), base.period_s)
    found = findings_of(evidence_of(base, runs))
    near = nearest(found.selection.fit, found.selection.before.rest)
    return [n.channel for n in near], [" ".join(filter(None, t.hypothesis.place)) for t in found.terms]


def table(probe, *, known, channels=None):
    """Return rows of: hidden, most alike, named, nearest, the most alike is first or second, one of the near is."""
    columns = measured(probe)
    base = tc.identify(columns).model
    found = []
    for hidden in channels or [name for name in columns if name[0] == "t" and name[1].isdigit()]:
        ranked, close = neighbours(columns, hidden)
        near, named = one(base, columns, hidden, known=known)
        first = near[:2]
        found.append([hidden, ranked[0], " + ".join(named), ", ".join(near[:3]), ranked[0] in first, bool(close & {*first})])
        print(found[-1], flush=True)
    return found


def report():
    """Yield the share of hidden channels whose neighbour comes first or second."""
    head = ["hidden", "most alike", "named", "nearest", "most alike in two", "a neighbour in two"]
    for probe, known in ((1, True), (3, True)):
        body = table(probe, known=known)
        what = f"measured spindle, Y of a two-input model for ch{probe} and a hidden channel"
        rows(what, head, [[*row[:4], *("yes" if hit else "no" for hit in row[4:])] for row in body])
        strict, near = (sum(row[i] for row in body) for i in (4, 5))
        yield told(
            Figure(
                what=f"{what}: its neighbour is first or second",
                found=f"{near} of {len(body)} (the most alike {strict})",
                wanted="9 of 10",
            )
        )


if __name__ == "__main__":
    list(report())
