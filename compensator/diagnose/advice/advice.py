"""What to measure and to test next, where something acts that no channel shows, or explanations stay close.

What is left unexplained (how large, how slow, when, with which event of the machine it goes), which logged channels
come nearest to it and where the next sensor should sit, which test decides between close explanations or shows the
source again, and what was seen only once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.advice.ceiling import SHORT_PCT
from compensator.diagnose.advice.deciding import DECIDES, Deciding, PlannedTest
from compensator.diagnose.advice.nearest import Near, course_evidence, may_be_near_the_cause, nearest
from compensator.diagnose.advice.switched import DAY, GoesWith, Time, follows_day, goes_with, steepest
from compensator.diagnose.advice.trials import Trials
from compensator.diagnose.fitting.fit import Fit, Term, fit_terms, response
from compensator.diagnose.search.findings import Findings
from compensator.model.effects.hypothesis import DEGC
from compensator.model.effects.regression import AMBIENT
from compensator.model.effects.seen import roughly
from compensator.model.effects.unobserved import Unobserved

#: Channels and times that are listed.
LISTED, TIMES = 5, 12
#: An effect whose driver went up or down no more often than this was seen once: one heating, one cooling.
ONCE_SWINGS = 2
#: Two times meet within this: samples, a share of the time constant, and at most, min.
MEET_SAMPLES, MEET_SHARE, MEET_MIN = 3.0, 0.2, 10.0
#: Time constants below which a source is near its heat, and in a housing, min.
NEAR_MIN, HOUSING_MIN = 15.0, 90.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Unexplained:
    """What no named effect explains.

    Parameters
    ----------
    kind : {"unobserved", "remainder", "residual"}
        A source that is switched and that no channel shows; what the channels explain and no named effect does; or what
        nothing explains.
    rms_um, peak_to_peak_um : float
        Its size, µm; `rms_um` without the noise of Y.
    tau_min : float
        Its time constant, min.
    times : tuple of (int, float)
        When it is switched, or moves fastest: number of the run and time in it, h.
    goes_with : GoesWith or None
        The event of the machine that it goes with.
    sensor_evidence : float
        What a channel that shows it would add to the logarithm of the evidence.
    """

    kind: Literal["unobserved", "remainder", "residual"]
    rms_um: float
    peak_to_peak_um: float
    tau_min: float
    times: tuple[Time, ...]
    goes_with: GoesWith | None
    sensor_evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenOnce:
    """An effect that rests on one event of the record, and the test that repeats it.

    Parameters
    ----------
    label : str
        Kind and place of the effect.
    driver : str
        What happened once: a channel that moved, `heat`, `at_degc`.
    test : PlannedTest
        The test; it decides whether the effect is there at all.
    """

    label: str
    driver: str
    test: PlannedTest


@dataclass(frozen=True, slots=True, kw_only=True)
class Advice:
    """What to measure and to test next.

    Parameters
    ----------
    unexplained : Unexplained or None
        What is left; None where nothing is hidden.
    nearest : tuple of Near
        Logged channels that come nearest to it (where nothing is hidden: to what a named temperature explains).
    sensor : str
        Where the next sensor should sit; empty where nothing is left, or less than the noise of Y.
    tests : tuple of PlannedTest
        Tests to run, the next one first.
    seen_once : tuple of SeenOnce
        Effects that rest on one event.
    """

    unexplained: Unexplained | None = None
    nearest: tuple[Near, ...] = ()
    sensor: str = ""
    tests: tuple[PlannedTest, ...] = ()
    seen_once: tuple[SeenOnce, ...] = ()


def advice_of(
    found: Findings,
    deciding: Deciding,
    *,
    between_rivals: Sequence[PlannedTest],
    explained_pct: float | None,
    is_explained: bool,
) -> Advice:
    """Return the advice for what was found.

    Parameters
    ----------
    found : Findings
        Effects and remainder.
    deciding : Deciding
        Tests of this machine.
    between_rivals : sequence of PlannedTest
        The best test between each effect and each rival, most important first.
    explained_pct : float or None
        What the named effects explain of what the channels can, %; None where that is not known.
    is_explained : bool
        Whether what effects and remainder leave is noise.
    """
    fit = found.selection.fit
    unexplained = _unexplained(found, explained_pct=explained_pct, is_explained=is_explained)
    near: tuple[Near, ...] = ()
    if unexplained is not None or between_rivals or any(map(may_be_near_the_cause, fit.terms)):
        near = nearest(fit, found.selection.before.rest)[:LISTED]
    # A test that decides comes before one that would not.
    tests = sorted(between_rivals, key=lambda test: not test.decides)
    # For what a single reading of Y does not show nobody places a sensor, or makes a test.
    wanted = unexplained if unexplained and unexplained.rms_um >= found.search.evidence.probe_um else None
    if wanted is not None and wanted.kind != "remainder":
        tests.insert(0, _shown_again(wanted, fit, deciding))
    return Advice(
        unexplained=unexplained,
        nearest=near,
        sensor=_sensor(wanted, near) if wanted else "",
        tests=tuple(tests),
        seen_once=tuple(_seen_once(fit, deciding)),
    )


# ---------------------------------------------------------------------- what is left


def _unexplained(found: Findings, *, explained_pct: float | None, is_explained: bool) -> Unexplained | None:
    evidence, fit = found.search.evidence, found.selection.fit
    source = next((t for t in fit.terms if not t.hypothesis.effect.observed), None)
    if source is not None:
        course = response(evidence, source)
        effect = source.effect
        assert isinstance(effect, Unobserved)
        return _described("unobserved", found, course, effect.tau_min, list(effect.times))
    falls_short = explained_pct is not None and explained_pct < SHORT_PCT
    if found.remainder is not None and not found.is_own_error and (falls_short or not evidence.free_paths):
        course = found.remainder.added - found.own_paths
        return _described("remainder", found, course, _memory_min(course, evidence.context.period_min), [])
    if not is_explained:
        course = np.where(evidence.used, evidence.left(found.whole + found.left_in_um), np.nan)
        left = _described("residual", found, course, fit.rest.tau_min, [])
        return left if left.rms_um > 0.0 else None
    return None


def _described(
    kind: Literal["unobserved", "remainder", "residual"],
    found: Findings,
    course: Vector,
    tau_min: float,
    switched: list[Time],
) -> Unexplained:
    evidence = found.search.evidence
    used = course[evidence.used]
    noise_um = evidence.probe_um if kind == "residual" else 0.0
    times = sorted(switched or steepest(evidence, course, TIMES))
    tolerance = max(MEET_SAMPLES * evidence.context.period_min, min(MEET_SHARE * tau_min, MEET_MIN))
    event = goes_with(evidence, times, tolerance if switched else MEET_MIN)
    if event is None and follows_day(evidence, course):
        event = GoesWith(event=DAY)
    return Unexplained(
        kind=kind,
        rms_um=float(np.sqrt(max(float(np.var(used)) - noise_um**2, 0.0))),
        peak_to_peak_um=float(np.ptp(used)),
        tau_min=tau_min,
        times=tuple((run, float(at) / 60.0) for run, at in times[:TIMES]),
        goes_with=event,
        sensor_evidence=course_evidence(found.selection.fit, found.selection.before.rest, course),
    )


def _memory_min(course: Vector, period_min: float) -> float:
    """Return after which time a course no longer resembles itself: where its autocorrelation falls below 1/e, min."""
    centred = course - course.mean()
    size = 2 * centred.size
    power = np.fft.irfft(np.abs(np.fft.rfft(centred, size)) ** 2, size)[: centred.size]
    below = np.flatnonzero(power < power[0] / np.e)
    return float(below[0] if below.size else centred.size) * period_min


def _sensor(unexplained: Unexplained, near: Sequence[Near]) -> str:
    """Return where the next sensor should sit."""
    tau = roughly(unexplained.tau_min)
    if unexplained.tau_min < NEAR_MIN:
        where = f"at the source of heat or force itself, a small mass ({tau} min is fast)"
    elif unexplained.tau_min < HOUSING_MIN:
        where = f"in the housing around the source, a mass that follows in {tau} min"
    else:
        where = f"in the structure (column, bed) or the air or floor around it, which follow in {tau} min"
    alike = resembling(near)
    if not alike:
        return f"Place the next sensor {where}; no logged channel resembles it."
    first = alike[0]
    if first.lag_min < 0.0 and not first.channel.endswith(DEGC):
        # A speed or a switch follows nothing: it is commanded.
        return f"Place the next sensor {where}; it acts before {first.channel} changes."
    if first.lag_min < 0.0:
        return (
            f"Place the next sensor {where}; {first.channel} follows it, so closer to the cause than {first.channel}."
        )
    names = " and ".join(one.channel for one in alike[:2])
    return f"Place the next sensor {where}, near {names}."


def resembling(near: Sequence[Near]) -> list[Near]:
    """Return the channels that come near by more than chance."""
    return [one for one in near if one.evidence >= DECIDES + one.by_chance]


# ---------------------------------------------------------------------- tests


def _shown_again(unexplained: Unexplained, fit: Fit, deciding: Deciding) -> PlannedTest:
    """Return the test in which what is unexplained acts again."""
    observed = [term for term in fit.terms if term.hypothesis.effect.observed]
    sources = [term for term in fit.terms if not term.hypothesis.effect.observed]
    others = fit_terms(fit.likelihood, [term.start for term in observed], evaluations=1)
    switchings = sum(len(term.amplitudes) for term in sources) or max(1, len(unexplained.times))
    size_um = float(np.median(np.abs(sources[0].amplitudes))) if sources else unexplained.peak_to_peak_um / 2.0
    minutes = sum(record.size * record.period_min for record in deciding.trials.evidence.signals)
    return deciding.shown_again(
        others,
        size_um=size_um,
        tau_min=unexplained.tau_min,
        event=unexplained.goes_with.event if unexplained.goes_with else "",
        wait_h=minutes / 60.0 / switchings,
    )


def _seen_once(fit: Fit, deciding: Deciding) -> Iterator[SeenOnce]:
    """Yield the effects whose driver moved once, with the test that moves it again."""
    for i, term in enumerate(fit.terms):
        driver = _driver(term, deciding.trials)
        if not driver or deciding.trials.swings(driver) > ONCE_SWINGS:
            continue
        without = fit_terms(fit.likelihood, fit.starts(i), evaluations=1)
        test = deciding.best(fit, without, (term.label, "nothing"), drivers=(driver,))
        if test is not None:
            yield SeenOnce(label=term.label, driver=driver, test=test)


def _driver(term: Term, trials: Trials) -> str:
    _, path, channel = term.hypothesis.place
    if channel:
        return trials.mover(channel)
    return {"DTF": trials.heating, "TTF": trials.heating, "TDTF": AMBIENT}.get(path, "")
