"""All figures of the project, in one table at the end: `make bench`. Nothing passes or fails here.

python -m tests.bench                    everything but what takes long: `drawn`, `loop`, `one_log`, `axes_effects`
python -m tests.bench speed diagnosis    some of it
python -m tests.bench drawn --help       drawn machines, with options of their own
python -m tests.bench loop --help        the loop over machine-weeks, too
python -m tests.bench one_log --help     drawn machines of which there is one log and no calibration, too
"""

import sys

from compensator.blas import in_one_thread
from compensator.commands.stopping import stoppable
from tests.bench import (
    audit,
    axes,
    axes_effects,
    diagnosis,
    drawn,
    faults,
    hidden,
    identification,
    loop,
    machines,
    one_log,
    probe_calibration,
    probe_naming,
    probes,
    sensor_faults,
    shop,
    speed,
    spindle,
    warm,
)
from tests.bench.figures import surroundings, table

AREAS = {
    "speed": speed.report,
    "calibration": identification.report,
    "diagnosis": diagnosis.report,
    "machines": machines.report,
    "drawn": drawn.report,
    "loop": loop.report,
    "probe_calibration": probe_calibration.report,
    "probe_naming": probe_naming.report,
    "spindle": spindle.report,
    "hidden": hidden.report,
    "warm": warm.report,
    "probes": probes.report,
    "faults": faults.report,
    "sensor_faults": sensor_faults.report,
    "audit": audit.report,
    "axes": axes.report,
    "axes_effects": axes_effects.report,
    "shop": shop.report,
}
#: Not made without being asked for.
LONG = ("drawn", "loop", "axes_effects")


def main(chosen):
    own = {"drawn": drawn, "loop": loop, "one_log": one_log}
    if chosen and chosen[0] in own and (chosen[0] == "one_log" or (chosen[1:2] and chosen[1].startswith("-"))):
        own[chosen[0]].main(chosen[1:])
        return
    unknown = set(chosen) - set(AREAS)
    if unknown:
        sys.exit(f"unknown: {', '.join(sorted(unknown))}; expected some of: {', '.join(AREAS)}")
    where = surroundings()
    print(where + "\n", flush=True)
    figures = []
    try:
        for name in chosen or [name for name in AREAS if name not in LONG]:
            figures.extend(AREAS[name]())
    finally:  # what was measured in an hour is not lost with what goes wrong after it
        print(f"\n{where}\n\n{table(figures)}")


if __name__ == "__main__":
    stoppable()
    in_one_thread(main, sys.argv[1:])
