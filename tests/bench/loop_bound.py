"""What nothing can surpass that judges by the loop's measure: the true effect, adopted in the minute it is shown.

Each effect of a machine-week is taken alone, the others are as if known. From its first minute on the calibrated model
is compared with one that knows the effect: the calibrated model where the effect does not act, with the same noise and
troubles. The comparison is that of the loop, with its likelihood and what it leaves out; the effect is *shown* in the
minute of the first verdict for it. No diagnosis can name it by this measure before, for a diagnosis has to learn its
parameters from the same values. From that minute on its error is gone, and its end is known at once.

A diagnosis, and the hours in shadow on later data, come on top: the loop must be later.
"""

import numpy as np

from compensator.demo.offline import run_alone
from compensator.events import ComparisonVerdict
from compensator.service.loop.compared import Compared
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.state import InShadow
from compensator.service.loop.trust import all_suspect_a_sensor, is_contradicted
from tests.bench.loop_week import PERIOD_S, error_of, samples_of


class Bound:
    """The bound of a machine-week.

    Parameters
    ----------
    week : MachineWeek
        The week.
    config : Config
        Its configuration.
    base : ThermalModel
        The calibrated model.

    Attributes
    ----------
    best : numpy.ndarray, shape (n,)
        Error of the calibrated model by minute where no effect acts, µm; NaN where the service does not run.
    error : numpy.ndarray, shape (n,)
        Error with each true effect from when it is shown, µm.
    parts : list of numpy.ndarray, shape (n,)
        What each effect adds to the error of the calibrated model, µm.
    shown_h : list of (float or None)
        How long after its beginning each effect is shown, h; None if it never is.
    """

    def __init__(self, week, config, base):
        healthy = run_alone(config, base, samples_of(week, week.healthy, week.healthy_um))
        self.best = error_of(healthy, week.healthy_um)
        self.error, self.parts, self.shown_h = self.best.copy(), [], []
        for spell, (columns, true_um) in zip(week.spells, week.alone, strict=True):
            acted = run_alone(config, base, samples_of(week, columns, true_um))
            shown = shown_at(acted, healthy, spell, config)
            self.shown_h.append((shown - spell.from_min) / 60.0 if shown is not None else None)
            unknown = np.arange(week.minutes) < (shown if shown is not None else week.minutes)
            self.parts.append(error_of(acted, true_um) - self.best)
            self.error += np.where(unknown, self.parts[-1], 0.0)


def shown_at(acted, healthy, spell, config):
    """Return the first minute in which a spell is shown; None if it is not while it acts."""
    place = InShadow(sha256="", effects=[], role="candidate", since_utc_ns=0)
    compared = Compared(place, config.loop, PERIOD_S, ErrorBlocks())
    for present, other in zip(acted, healthy, strict=True):
        minute = present.sample.seq
        if not spell.from_min <= minute < spell.to_min:
            continue
        if is_contradicted(present.offset.reasons) or all_suspect_a_sensor([present, other]):
            compared.add_suspected(other)
        elif compared.add(present, other) and place.verdict.verdict == ComparisonVerdict.BETTER:
            return minute
    return None
