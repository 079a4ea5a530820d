"""Machines that are no transfer function: how often the effect is named, and what is left of it on another day.

The conduction machine is calibrated by `identify` on a run without any effect; then an effect drawn by a seed acts for
36 h of another duty, and the model that the diagnosis writes runs on a day that nothing saw. Excess: mean square over
the noise and the calibration's own error, left of what the first model leaves; where the effect can be deployed.
"""

import dataclasses
import time

import numpy as np

from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.search import Search
from compensator.identify.calibration import calibrate, predict
from compensator.identify.settings import Settings
from sim_hardware.physics import Duty, QuillMachine, World, draw_effect, usual_sensors
from tests.bench.figures import Figure, told
from tests.identify.quill_runs import runs_from

#: About how much the effects move Y, µm standard deviation.
SIZES_UM = (5.0, 2.5, 1.2)
LASTING = ("input", "gain", "dynamics", "nonlinear", "scheduled", "hysteresis")
HOURS = 36.0


def runs(duty, seed, effects=(), heat=False):
    sensors = usual_sensors(duty.extra_names, heat_known=heat, temperature_noise_k=0.02)
    columns = World(QuillMachine(effects=effects), duty, sensors, seed).record(60.0)
    columns.pop("t_s")
    return runs_from(columns)


def calibrated():
    """The first model, as the command writes it."""
    data = runs(Duty.working_day(5, hours=48.0), 11, heat=True)
    calibration = calibrate(data, Settings(), period_s=60.0, name="conduction")
    return calibration.model, calibration.folds_rms_um


def one(model, own_um, seed, size_um):
    """Return what acted, what was named, the excess left (NaN where nothing can be deployed), and seconds."""
    effects = [draw_effect(seed, size_um, HOURS)] if size_um else []
    evidence = evidence_of(model, runs(Duty.working_day(200 + seed, hours=HOURS), 300 + seed, effects))
    began = time.perf_counter()
    terms = Search(evidence).run().fit.terms
    seconds = time.perf_counter() - began
    named = [term.hypothesis.place for term in terms]
    if not effects:
        return None, named, np.nan, seconds
    truth = effects[0].reveal().describe()
    place = tuple(str(truth.get(key) or "") for key in ("kind", "path", "channel"))
    if place[0] not in LASTING:
        return place, named, np.nan, seconds
    tables = [term.effect for term in terms if term.effect.deployable]
    fresh = runs(Duty.working_day(700 + seed, hours=24.0), 800 + seed, effects)[0]

    def error(candidate):
        return float(np.var(fresh.y_um - predict(candidate, fresh)))

    before = error(model) - own_um**2
    if before < 0.5 * own_um**2:
        return place, named, np.nan, seconds
    return place, named, (error(dataclasses.replace(model, effects=tuple(tables))) - own_um**2) / before, seconds


def report(first=1000, count=26):
    """Yield a figure for each size, and one without an effect."""
    model, own_um = calibrated()
    for size in (*SIZES_UM, 0.0):
        results = [one(model, own_um, seed, size) for seed in range(first, first + count)]
        seconds = [r[3] for r in results]
        took = f"{np.median(seconds):.1f} ({max(seconds):.1f}) s a search"
        if not size:
            none = sum(not r[1] for r in results)
            yield told(
                Figure(
                    what="diagnosis, conduction machine, no effect",
                    wanted="nothing",
                    found=f"nothing found in {none} of {count}; {took}",
                )
            )
            continue
        named, alone = sum(r[0] in r[1] for r in results), sum(r[1] == [r[0]] for r in results)
        left = [100.0 * r[2] for r in results if np.isfinite(r[2])]
        yield told(
            Figure(
                what=f"diagnosis, conduction machine, effects about {size} µm: named (alone); "
                "excess left, median (90 %)",
                found=f"{named} ({alone}) of {count}; {np.median(left):.0f} ({np.quantile(left, 0.9):.0f}) %; {took}",
                wanted="90 %; 10 (30) %",
            )
        )


if __name__ == "__main__":
    list(report(1000, 39))
