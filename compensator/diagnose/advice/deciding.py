"""By how much a test would decide between two explanations, and which test decides soonest."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.advice.record_with_test import HOURS, RecordWithTest, values_within
from compensator.diagnose.advice.switched import DAY, HEAT
from compensator.diagnose.advice.trials import REST_H, Trial, Trials
from compensator.diagnose.fitting.fit import Fit
from compensator.diagnose.fitting.points import Points
from compensator.model.effects.blocks import Lag
from compensator.model.effects.seen import roughly

#: A change of the logarithm of the evidence that decides: odds of about 150 to 1.
DECIDES = 5.0
#: The explanations between which a test decides that shows a hidden source again.
SHOWN = ("a source that the new sensor shows", "no source")
#: Where probes as often as in the record do not decide, they are made this often in a test, min.
PROBED_MIN = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedTest:
    """A test to run, and by how much it would decide.

    Parameters
    ----------
    words : str
        What is done.
    driver : str
        What is changed: a channel, `heat`, `at_degc`, or nothing.
    hours : float
        The shortest duration that decides, or the longest that was looked at, h.
    expected_evidence : float
        Expected change of the logarithm of the evidence at that duration.
    between : tuple of str
        The two explanations.
    every_min : float
        Where Y is measured now and then: time between two probes, min; 0 elsewhere.
    """

    words: str
    driver: str
    hours: float
    expected_evidence: float
    between: tuple[str, str]
    every_min: float = 0.0

    @property
    def decides(self) -> bool:
        """Whether it is expected to decide."""
        return self.expected_evidence >= DECIDES

    @property
    def probes(self) -> int:
        """Number of probes in it; 0 where Y is measured all the time."""
        return int(values_within(np.array(self.hours), self.every_min)) if self.every_min else 0

    @property
    def sentence(self) -> str:
        """What to do, how long, and by how much it decides."""
        change = f"expected change of the log evidence {roughly(self.expected_evidence)}; {DECIDES:g} decides"
        if self.probes:
            change = f"{self.probes} more probes, one each {self.every_min:g} min; {change}"
        if self.decides:
            return f"{self.words}; {self.hours:g} h are enough, the first {REST_H:g} h at rest ({change})."
        words = self.words[:1].lower() + self.words[1:]
        return f"No test of up to {HOURS[-1]:g} h decides; the best: {words} for {self.hours:g} h ({change})."


class Deciding:
    """Looks for the test that decides between fits.

    Parameters
    ----------
    trials : Trials
        Tests of the machine.
    """

    def __init__(self, trials: Trials) -> None:
        self.trials = trials
        self._joint: dict[tuple[int, float], RecordWithTest] = {}
        #: Time between two probes of a test, min: as in the record, or less where that does not decide. 0: always.
        self._every_min: tuple[float, ...] = (0.0,)
        if trials.evidence.is_sparse:
            every = Points(trials.evidence).period_min
            self._every_min = (every, PROBED_MIN) if every > PROBED_MIN else (every,)

    def best(
        self, first: Fit, second: Fit, between: tuple[str, str], *, drivers: tuple[str, ...] = ()
    ) -> PlannedTest | None:
        """Return the test that decides soonest, or the one that is expected to decide most.

        Parameters
        ----------
        first, second : Fit
            The explanations, with everything else that acts.
        between : tuple of str
            Their names.
        drivers : tuple of str
            Only tests that change one of these; empty: what moves either explanation. Where one acts by time alone,
            to leave the machine at rest is a test of it.

        Returns
        -------
        PlannedTest or None
            None where no test changes any of the drivers.
        """
        drivers = drivers or self._movers(first, second)
        channels = dict.fromkeys(t.hypothesis.place[2] for fit in (first, second) for t in fit.terms)
        trials = [
            trial
            for trial in self.trials.of(filter(None, (*channels, *drivers)))
            if not drivers or trial.driver in drivers
        ]
        planned: list[PlannedTest] = []
        for every_min in self._every_min:
            for by_itself in (False, True):
                if not any(test.decides for test in planned):
                    some = [trial for trial in trials if trial.by_itself is by_itself]
                    planned += [self._planned(trial, first, second, between, every_min) for trial in some]
        # Of tests that decide equally soon, the surer one.
        return max(planned, key=_soonest, default=None)

    def _movers(self, first: Fit, second: Fit) -> tuple[str, ...]:
        """Return what moves either of two explanations and not the other fit as well; empty: anything may."""
        places = first.places ^ second.places
        movers = [self.trials.movers(place) for place in places]
        alone = [""] if not all(movers) else []
        return tuple(sorted(frozenset[str]().union(*movers, alone))) if any(movers) else ()

    def shown_again(self, others: Fit, *, size_um: float, tau_min: float, event: str, wait_h: float) -> PlannedTest:
        """Return the test in which a source that no channel shows acts again, with a sensor that shows it.

        Parameters
        ----------
        others : Fit
            What else acts.
        size_um, tau_min : float
            How far the source moves Y when it is switched, µm, and its lag, min.
        event : str
            The channel, `heat` or `day` that it goes with; empty: it is waited for.
        wait_h : float
            How long it takes until it acts by itself, h.
        """
        # Nobody can drive the day: it is waited for.
        driver = "" if event == DAY else event
        trials = [trial for trial in self.trials.of([driver]) if driver and trial.driver == driver]
        planned = []
        for trial in trials or [trial for trial in self.trials.of(()) if not trial.driver]:
            joint = self._of(trial, self._every_min[0])
            lag = Lag(tau_min, trial.signals.period_min)
            level: Vector = (
                _level(trial) if trials else np.asarray(trial.signals.minutes > 60.0 * REST_H, dtype=np.float64)
            )
            course = size_um * lag.filter(level)
            planned.append(self._test(trial, joint.change_by(others, course), SHOWN, joint.every_min))
        best = max(planned, key=_soonest)
        if trials:
            return best
        words = "Repeat the work of this record with the new sensor until the source acts again"
        if event == DAY:
            words = "Record a whole day again with the new sensor"
        hours = max(24.0 if event == DAY else 0.0, math.ceil(2.0 * (wait_h + best.hours)) / 2.0)
        return dataclasses.replace(best, words=words, hours=hours)

    def _planned(
        self, trial: Trial, first: Fit, second: Fit, between: tuple[str, str], every_min: float
    ) -> PlannedTest:
        joint = self._of(trial, every_min)
        return self._test(trial, joint.change(first, second), between, joint.every_min)

    def _of(self, trial: Trial, every_min: float) -> RecordWithTest:
        key = id(trial), every_min
        if key not in self._joint:
            self._joint[key] = RecordWithTest(self.trials.evidence, trial, every_min)
        return self._joint[key]

    @staticmethod
    def _test(trial: Trial, change: Vector, between: tuple[str, str], every_min: float) -> PlannedTest:
        # A test that ends before its driver is moved is none of it.
        change = np.where(np.array(HOURS) > trial.moves_from_h, change, -np.inf)
        enough = np.flatnonzero(change >= DECIDES)
        at = int(enough[0]) if enough.size else int(np.argmax(change))
        return PlannedTest(
            words=trial.words_of(HOURS[at]),
            driver=trial.driver,
            hours=HOURS[at],
            expected_evidence=float(change[at]),
            between=between,
            every_min=every_min,
        )


def _soonest(test: PlannedTest) -> tuple[bool, float]:
    """Return the rank of a test: one that decides soon, or else one that changes most. Simple ones come first."""
    return test.decides, -test.hours if test.decides else test.expected_evidence


def _level(trial: Trial) -> Vector:
    """Return how far the driver of a test has been changed, as a share."""
    signals = trial.signals
    values = signals.drive if trial.driver == HEAT else signals.channels[trial.driver]
    change = values - values[0] if trial.driver != HEAT else values
    return np.asarray(change / max(float(np.abs(change).max()), 1e-12))
