"""One log of a machine and nothing else, as of the measured spindle: calibrated and diagnosed on its first part.

Drawn machines with physics of their own (`sim_hardware.drawn_machines`): no calibration without the effect, no known
heat. What comes out runs freely over the whole log, and the rest of it judges. Beside it: no compensation, persistence,
the two inputs alone, and a ridge regression over all channels (`ridge.py`).

about zero   rms of measured less predicted Y, which is 0 at the beginning of the log.
about mean   the same about the mean of the hours that judge: the level of a machine that was warm when its log began
             cannot be known from T_Q and AT.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import compensator as tc
from compensator.model.effects.hypothesis import place_in_words
from sim_hardware.drawn_machines import DEVELOPMENT
from tests.bench.cases import judge
from tests.bench.figures import Figure, rows, told
from tests.bench.ridge import ridge

#: Shares of the log that are fitted, and the least of them, h.
SHARES, LEAST_H = (0.5, 0.75), 12.0
#: Not of the machine: what predicts nothing for another time.
OF_Y = ("drift", "step", "period")
METHODS = ("none", "persistence", "two inputs", "ridge", "extended")
FIRST_SEED = 500_000
BEGIN = 10


def errors(predicted, y, judged):
    """Return rms about the zero and about the mean, µm."""
    left = (y - predicted)[judged]
    left = left[np.isfinite(left)]
    return float(np.sqrt(np.mean(left**2))), float(np.std(left))


def judged(case):
    """Return the figures of both parts of a case as dicts that JSON can hold."""
    log = {name: np.asarray(u, float) for name, u in case.draw().record.columns.items() if name != "heat_w"}
    y = log["y_um"] = log["y_um"] - np.nanmedian(log["y_um"][:BEGIN])
    return [_of_share(case, log, y, share) for share in SHARES if share * y.size >= 60.0 * LEAST_H]


def _of_share(case, log, y, share):
    count = int(share * y.size)
    part = {name: u[:count] for name, u in log.items()}
    result = {"family": case.family, "seed": case.seed, "effect": case.effect, "hours": y.size / 60.0, "share": share}
    base = tc.identify(part).model
    why = tc.diagnose(base, part)
    used = np.arange(y.size) < count
    predicted = {
        "none": np.zeros(y.size),
        "persistence": np.full(y.size, y[:count][np.isfinite(y[:count])][-1]),
        "two inputs": tc.simulate(base, log)["y_pred_um"],
        "ridge": ridge([u for name, u in log.items() if name not in ("t_s", "y_um")], y, used),
        "extended": tc.simulate(why.model, log)["y_pred_um"],
    }
    result |= {name: errors(predicted[name], y, ~used) for name in METHODS}
    found = [place_in_words((effect.kind, effect.path, effect.channel)) for effect in why.effects]
    return result | {"verdict": why.verdict, "found": found}


def main(words):
    """Run a set of machines."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench one_log", description=__doc__.splitlines()[0])
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--count", type=int, default=30, help="machines of each family")
    parser.add_argument("--out", type=Path, default=Path("one-log.json"))
    parser.add_argument("--workers", type=int)
    asked = parser.parse_args(words)
    moved = asked.first_seed - DEVELOPMENT[0].seed
    cases = [replace(c, seed=c.seed + moved) for c in DEVELOPMENT if c.family != "transfer" and c.effect not in OF_Y]
    cases = [c for c in cases if c.seed < asked.first_seed + asked.count]
    list(report(cases, asked.out, workers=asked.workers))


def report(cases, out, *, workers=None):
    """Yield the figures; every case is printed."""
    results = []
    for result in judge(cases, judged, out, workers=workers):
        results.append(result)
        sys.stdout.write(f"{len(results)}\r")
        sys.stdout.flush()
    head = ["machine", "effect", "h", "fitted", *METHODS, "verdict", "found"]
    body = [
        [f"{r['family']} {r['seed']}", r["effect"], f"{r['hours']:.0f}", f"{r['share']:.0%}"]
        + [f"{r[name][0]:.2f} ({r[name][1]:.2f})" for name in METHODS]
        + [r["verdict"], " + ".join(r["found"]) or "nothing"]
        for r in sorted(results, key=lambda r: (r["family"], r["seed"], r["share"]))
    ]
    rows("one log of a machine, judged on the rest of it, µm rms about the zero (about the mean)", head, body)
    for i, about in enumerate(("zero", "mean")):
        extended, two, others = (
            np.array([r[name][i] for r in results]) for name in ("extended", "two inputs", "ridge")
        )
        share = extended / others
        found = (
            f"at or below the ridge {np.sum(share <= 1.0)} of {share.size} (two inputs {np.sum(two <= others)}), "
            f"{np.median(share):.2f} of its error (nine of ten {np.quantile(share, 0.9):.2f}); "
            f"worse than two inputs by 5 % {np.sum(extended > 1.05 * two)}, better {np.sum(extended < 0.95 * two)}"
        )
        yield told(Figure(what=f"one log of a machine, about the {about}", found=found, wanted="all"))
