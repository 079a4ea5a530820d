"""A channel of the measured spindle is hidden: does the advice name its neighbour first or second?

The source of the data does not say where each sensor sits. Neighbours of the hidden one are the temperature that
correlates most with it over the record, and all that correlate above 0.95.

Y is what a two-input model makes of the measured temperatures, the response of the hidden channel behind a lag of
20 min (a fifth of Y's spread), and 0.5 µm of noise. Beside it, the channel that matters most for the measured probes,
t4_degc, is hidden from the diagnosis of those.
"""

import dataclasses
from pathlib import Path

import numpy as np

import compensator as tc
from compensator.data.measurement import measurements, runs_in
from compensator.diagnose.advice.nearest import nearest
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.findings import findings_of
from compensator.identify.calibration import predict
from tests.bench.figures import Figure, rows, told
from tests.diagnose.scenarios import lag

FILE = Path(__file__).resolve().parents[3] / "shared/data/measured-spindle/spindle-15s.csv"
ALIKE = 0.95
LAG_MIN, SHARE, NOISE_UM, OWN_UM = 20.0, 0.2, 0.5, 0.5


def measured(probe):
    """Return the spindle's columns at 60 s with roles, one probe as Y."""
    table = np.genfromtxt(FILE, delimiter=",", names=True)
    columns = {name: table[name].reshape(-1, 4).mean(axis=1) for name in table.dtype.names if not name.startswith("ch")}
    columns["t_s"] = columns["t_s"] - columns["t_s"][0]
    columns["t_q_degc"], columns["at_degc"] = columns.pop("t5_degc"), columns.pop("t16_degc")
    return columns | {"y_um": table[f"ch{probe}_um"].reshape(-1, 4).mean(axis=1)}


def neighbours(columns, hidden):
    """Return the other temperatures by how alike they are, and the set that counts as near."""
    others = [name for name in columns if name.endswith("_degc") and name != hidden]
    alike = {name: np.corrcoef(columns[name], columns[hidden])[0, 1] for name in others}
    ranked = sorted(others, key=lambda name: -alike[name])
    return ranked, {ranked[0], *(name for name in ranked if alike[name] > ALIKE)}


def nearest_to(base, logged, *, free=False):
    """Return the nearest channels, and what is named."""
    runs, _ = runs_in(measurements(logged, "data", None, needed=True), base.period_s)
    evidence = evidence_of(base, runs)
    found = findings_of(evidence.with_free_paths() if free else evidence)
    near = nearest(found.selection.fit, found.selection.before.rest)
    return [n.channel for n in near], [t.label for t in found.terms]


def acting(base, columns, hidden):
    """Return what is logged if a hidden channel acts beside a two-input model."""
    rng = np.random.default_rng(sum(map(ord, hidden)))
    logged = {name: values for name, values in columns.items() if name != hidden}
    run = runs_in(measurements(logged, "data", None, needed=True), base.period_s)[0][0]
    course = lag(columns[hidden], LAG_MIN)
    moved = SHARE * np.std(columns["y_um"]) * course / np.std(course)
    return logged | {"y_um": predict(base, run) + moved + rng.normal(0.0, NOISE_UM, course.size)}


def row(columns, hidden, near, named):
    """Return hidden, most alike, named, nearest; is the most alike, and any neighbour, first or second."""
    ranked, close = neighbours(columns, hidden)
    hits = ranked[0] in near[:2], bool(close & {*near[:2]})
    return [hidden, ranked[0], " + ".join(named), ", ".join(near[:3]), *hits]


def in_turn(probe):
    """Return a row for each temperature."""
    columns = measured(probe)
    base = tc.identify(columns).model
    known = dataclasses.replace(base, held_out_rms_um=OWN_UM)
    names = [name for name in columns if name[0] == "t" and name[1].isdigit()]
    return [row(columns, hidden, *nearest_to(known, acting(base, columns, hidden))) for hidden in names]


def measured_probe(probe, hidden="t4_degc"):
    """Return the row of a channel that is hidden from the diagnosis of a measured probe."""
    columns = measured(probe)
    base = tc.identify(columns).model
    logged = {name: values for name, values in columns.items() if name != hidden}
    return row(columns, hidden, *nearest_to(base, logged, free=True))


def report():
    """Yield the share of hidden channels whose neighbour comes first or second."""
    if not FILE.exists():
        yield told(Figure(what="measured spindle, hidden channels", found="the data is not here"))
        return
    head = ["hidden", "most alike", "named", "nearest", "most alike in two", "a neighbour in two"]
    turns = [one for probe in range(1, 6) for one in in_turn(probe)]
    probes = [measured_probe(probe) for probe in (1, 3, 4, 5)]
    for what, body in (("Y of a two-input model", turns), ("t4_degc hidden from a measured probe", probes)):
        rows(f"measured spindle, {what}", head, [[*r[:4], *("yes" if hit else "no" for hit in r[4:])] for r in body])
        alike, near = (sum(r[i] for r in body) for i in (4, 5))
        found = f"{near} of {len(body)} (the most alike {alike})"
        what = f"hidden channel of the measured spindle, {what}: its neighbour is nearest or second"
        yield told(Figure(what=what, found=found, wanted="9 of 10"))


if __name__ == "__main__":
    list(report())
