"""What `diagnose` names from two days of hourly probes: 47 values of 1.5 µm on machines with the published functions.

Effects, duties, channels and sizes are those of `sim_hardware.drawn_machines` (published functions, clean data); of
each machine the first 48 h of its record are used, and Y only once an hour, with noise of its own added.

python -m tests.bench probe_naming                   the development set
python -m tests.bench.probe_naming judging           the set that judges: at most twice

Only effects that move the model's residual by at least the noise of one value (rms over the 48 h) are drawn.

named           a right name of the true effect, and no other effect; without an effect: nothing.
undecided       nothing named, verdict `unexplained`: the values show that something acts, or could not have shown it.
false           an effect acts and the verdict is `adequate`.
A source that comes and goes between two probes cannot be named from them: `unexplained` is right there.
"""

import sys
import time

import numpy as np

import compensator as tc
from compensator.blas import in_one_thread
from compensator.data.measurement import runs_in
from compensator.diagnose.residual.evidence import evidence_of
from sim_hardware.drawn_machines import draw
from sim_hardware.drawn_machines.catalogue import EFFECTS
from tests.bench.figures import Figure, rows, told

HOURS, EVERY_MIN, STD_UM = 48, 60, 1.5
SETS = {"development": (20_000, 4), "judging": (550_000, 2)}
#: What may come and go between two probes.
FAST = ("period", "hidden")


def residual_um(columns):
    """What the model's residual is on a table with Y in every row, without initial states and noise, µm rms."""
    evidence = evidence_of(tc.load_model("quill"), runs_in([tc.read(columns)])[0])
    left = evidence.without_nuisances(evidence.residual)[evidence.used]
    return float(np.sqrt(max(np.mean(left**2) - evidence.noise.noise_um**2, 0.0)))


def machine(effect, seed):
    """The first machine from a seed on whose record is long enough and shows the effect, and the size of that, µm."""
    while True:
        found = draw("transfer", seed, effect=effect, shop_floor=False, published=True)
        if found.record.hours >= HOURS:
            columns = {name: values[: HOURS * 60] for name, values in found.record.columns.items()}
            size_um = residual_um(columns)
            if effect == "none" or size_um >= STD_UM:
                return found, size_um
        seed += 1


def probed(found, seed):
    """Two days of a machine's record with Y once an hour."""
    columns = {name: np.array(values[: HOURS * 60], dtype=float) for name, values in found.record.columns.items()}
    y, at = np.full(HOURS * 60, np.nan), np.arange(EVERY_MIN, HOURS * 60, EVERY_MIN)
    y[at] = columns["y_um"][at] + np.random.default_rng(seed).normal(0.0, STD_UM, at.size)
    return columns | {"y_um": y}


def one(effect, seed):
    """Return named, undecided, false all-clear, and what was named with its sizes."""
    found, size_um = machine(effect, seed)
    columns = probed(found, seed)
    why = tc.diagnose("quill", columns, y_std_um=STD_UM).to_dict()
    named = [tuple(each[key] or "" for key in ("kind", "path", "channel")) for each in why["effects"]]
    right = named[:1] == [p for p in found.truth.places if p in named[:1]] and len(named) == 1
    if effect == "none":
        right = not named
    undecided = not named and why["verdict"] == "unexplained" and effect != "none"
    false = effect != "none" and why["verdict"] == "adequate"
    return right, undecided, false, f"{size_um:.1f} µm {why['verdict']} {named}"


def table(which):
    """Rows of: effect, named, undecided, false all-clear, cases, seconds."""
    first, count = SETS[which]
    found = []
    for number, effect in enumerate(EFFECTS["transfer"]):
        began = time.perf_counter()
        results = [one(effect, first + 1000 * number + 30 * i) for i in range(count)]
        for result in results:
            print(
                f"{effect:14} {'named' if result[0] else 'undecided' if result[1] else 'WRONG':10} {result[3]}",
                flush=True,
            )
        counts = [sum(r[i] for r in results) for i in range(3)]
        found.append([effect, *counts, count, (time.perf_counter() - began) / count])
    return found


def report(which="development"):
    """Yield the figures; the table of every effect is printed."""
    found = table(which)
    head = ["effect", "named, nothing else", "undecided", "false all-clear", "of", "s each"]
    rows(
        f"naming from {HOURS - 1} hourly probes, {which}",
        head,
        [[str(c) for c in r[:5]] + [f"{r[5]:.1f}"] for r in found],
    )
    slow = [r for r in found if r[0] not in FAST]
    total = sum(r[4] for r in slow)
    for what, column, some in (
        ("named, nothing else", 1, slow),
        ("undecided, with how many more probes", 2, slow),
        ("false all-clear, all effects", 3, found),
    ):
        of = sum(r[4] for r in some)
        yield told(
            Figure(
                what=f"naming from {HOURS - 1} hourly probes of {STD_UM} µm, {which}: {what}",
                found=f"{sum(r[column] for r in some)} of {of}",
                wanted=f"{0.95 * total:.0f} of {total}" if column == 1 else "none" if column == 3 else "",
            )
        )


if __name__ == "__main__":
    in_one_thread(lambda: list(report(*sys.argv[1:])))
