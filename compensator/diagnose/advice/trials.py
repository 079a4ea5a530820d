"""Tests that a machine can be put through, as the signals that they would give.

What is commanded (heat, speeds, flows, pressures) and the air are set; temperatures that followed these in the record
follow them in the test, by a regularised regression over lags. A temperature that did not follow anything, such as that
of a coolant with a chiller of its own, can be set as well.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.data.runs import Run
from compensator.diagnose.advice.switched import HEAT, swings
from compensator.diagnose.residual.base_run import signals_of
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.background import LAGS_MIN
from compensator.model.effects.blocks import FilterBank, Lag
from compensator.model.effects.hypothesis import DEGC, Place
from compensator.model.effects.input import unit_of
from compensator.model.effects.regression import AMBIENT, DRIVE
from compensator.model.effects.seen import roughly, unit_of_channel
from compensator.model.effects.signals import RecordSignals

#: Longest test, the rest that it begins with and that shows its zero and initial state, and how long each level of one
#: with several lasts, h.
LONGEST_H, REST_H, LEVEL_H = 24.0, 1.0, 2.0
#: The air changes at least by this, within this time; a set temperature changes with this lag.
LEAST_AMBIENT_K, AIR_H, SET_MIN = 2.0, 1.0, 15.0
#: A temperature follows what is commanded if that explains this share of its variance.
FOLLOWS = 0.7
#: And if each half of the record leaves less than this share of the variance in the other.
FORETOLD = 0.5
#: Weight that keeps the gains of that, behind `LAGS_MIN`, near zero.
RIDGE = 1e-3
#: T_Q − AT of a model without known heat, among what is set or follows.
_DIFFERENCE = DRIVE["direct"]
_UNITS = {"k": "K", "rpm": "1/min", "lpm": "l/min", "w": "W", "pct": "%"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A test.

    Parameters
    ----------
    words : str
        What is done, as an instruction.
    driver : str
        What is changed: a channel, `heat`, `at_degc`, or nothing.
    signals : RecordSignals
        What it would give.
    by_itself : bool
        Whether it changes by itself what only followed other things in the record, which takes a heater or a cooler.
    first_level : str
        The same instruction for a test that ends within the first of several levels; empty where there is one.
    moves_from_h : float
        When the driver is moved first, h.
    """

    words: str
    driver: str
    signals: RecordSignals
    by_itself: bool = False
    first_level: str = ""
    moves_from_h: float = REST_H

    def words_of(self, hours: float) -> str:
        """Return the instruction for a test of this length, h: none of a level that it does not reach."""
        return self.first_level if self.first_level and hours <= REST_H + LEVEL_H else self.words


class Trials:
    """Makes tests of a machine from what a record showed of it.

    Parameters
    ----------
    evidence : Evidence
        The record.
    """

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        context = evidence.context
        self.period_min = context.period_min
        samples = np.arange(round(LONGEST_H * 60.0 / self.period_min), dtype=np.float64)
        #: Time from the first change, h.
        self._t_h: Vector = samples * self.period_min / 60.0 - REST_H
        self._known: dict[str, list[Trial]] = {}
        self._commanded = [name for name in context.channels if not name.endswith(DEGC)]
        self._temperatures = [name for name in context.channels if name.endswith(DEGC)]

    def of(self, channels: Iterable[str]) -> Iterator[Trial]:
        """Yield the tests that may tell apart what acts by some channels: those of heat, air and rest, and their own.

        Parameters
        ----------
        channels : iterable of str
            Channels that the explanations name.
        """
        for name in dict.fromkeys(("", self.heating, AMBIENT, *channels)):
            if name not in self._known:
                self._known[name] = list(self._trials(name))
            yield from self._known[name]

    @cached_property
    def heating(self) -> str:
        """What heats the machine: the heat itself, or what T_Q − AT follows most in a model without known heat."""
        if not self._commanded or _DIFFERENCE not in self._followers:
            return HEAT
        gains = self._followers[_DIFFERENCE]
        shares = {name: float(np.ptp(self._bank(name) @ gains[name])) for name in self._commanded}
        return max(shares, key=lambda name: shares[name])

    def size(self, name: str) -> float:
        """Return by how much something is changed in a test: to the end of what was seen that is further away."""
        values = self._recorded(name)
        low, high = np.quantile(values, [0.05, 0.95]).tolist()
        if name == AMBIENT:
            return float(max(high - low, LEAST_AMBIENT_K))
        if name == HEAT:
            return float(high - low)
        start = self._start(name)
        return float(high - start if high - start >= start - low else low - start)

    def movers(self, place: Place) -> frozenset[str]:
        """Return what moves the cause of an effect: its channel, what drives its path; nothing for time alone."""
        _, path, channel = place
        paths = {"DTF": self.heating, "TTF": self.heating, "TDTF": AMBIENT}
        # What follows the heating can be moved by itself, too.
        return frozenset(filter(None, (paths.get(path, ""), channel, channel and self.mover(channel))))

    def mover(self, name: str) -> str:
        """Return what is changed so that something changes: itself, or the heating that it follows."""
        return self.heating if name in self._followers else name

    def swings(self, name: str) -> int:
        """Return how often something went up or down by much of its span in all runs."""
        return sum(swings(part) for part in self._by_run(name))

    # ------------------------------------------------------------------ tests

    def _trials(self, name: str) -> Iterator[Trial]:
        if not name:
            yield self._trial("Leave the machine at rest", "", {})
            return
        if name != AMBIENT and self.size(name) == 0.0:
            return
        size, by = self.size(name), self._in_words(name)
        hold, cycle = np.ones(self._t_h.size), 1.0 * ((self._t_h // LEVEL_H) % 2.0 == 0.0)
        sizes = np.array([0.5, 1.0, 0.5, 0.0])[(self._t_h // LEVEL_H).astype(int) % 4]
        if name == AMBIENT:
            ramp = np.minimum(self._t_h / AIR_H, 1.0)
            yield self._trial(f"Change the ambient temperature by {by} with the machine at rest", name, {name: ramp})
            return
        # A temperature is no input of the machine: something warms or cools what its sensor is in.
        act, means = ("Warm", "heater") if size > 0.0 else ("Cool", "cooler")
        if name in self._followers:
            words = f"{act} {name} by {by} by itself, with a {means} of its own, and hold it"
            yield dataclasses.replace(self._trial(words, name, {name: hold}), by_itself=True)
            return
        label = "the heat" if name == HEAT else name
        is_set = name in self._temperatures
        step = f"{act} {label} by {by}" if is_set else f"Step {label} by {by}"
        switch = f"{step} and back" if is_set else f"Switch {label} by {by} on and off"
        step = f"{step} and hold it, all else steady"
        yield self._trial(step, name, {name: hold})
        words = f"{switch} every {LEVEL_H:g} h, all else steady"
        yield self._trial(words, name, {name: cycle}, first_level=step)
        if name == self.heating or name not in self._temperatures:
            words = f"Step {label} by half of {by}, all of it, half and none, {LEVEL_H:g} h each"
            half = f"Step {label} by half of {by} and hold it, all else steady"
            yield self._trial(words, name, {name: sizes}, first_level=half)
        if name != self.heating and size:
            heating, above = "the heat" if self.heating == HEAT else self.heating, self._in_words(self.heating)
            words = f"{switch} every {LEVEL_H:g} h while {heating} stays {above} above its start"
            step = f"Step {heating} by {above} and hold it, all else steady"
            courses = {name: 1.0 - cycle, self.heating: hold}
            both = self._trial(words, name, courses, first_level=step)
            yield dataclasses.replace(both, moves_from_h=REST_H + LEVEL_H)

    def _trial(self, words: str, driver: str, courses: Mapping[str, Vector], *, first_level: str = "") -> Trial:
        begun = self._t_h >= 0.0
        changes = {name: self.size(name) * course * begun for name, course in courses.items()}
        for name, course in changes.items():
            if name in self._temperatures:
                changes[name] = Lag(SET_MIN, self.period_min).filter(course)
        return Trial(words=words, driver=driver, signals=self._signals(changes), first_level=first_level)

    def _signals(self, changes: Mapping[str, Vector]) -> RecordSignals:
        """Return the signals of a test in which some things change and all else follows or stays."""
        still = np.zeros(self._t_h.size)
        model, context = self.evidence.model, self.evidence.context

        def change(name: str) -> Vector:
            if name in changes:
                return changes[name]
            if name not in self._followers:
                return still
            gains = self._followers[name]
            parts = [self._filtered(changes[c]) @ gains[c] for c in gains if c in changes]
            return np.asarray(sum(parts, still))

        heat = change(HEAT)
        if context.has_ttf and model.ttf is not None:
            difference_k = model.ttf.sampled.response(heat)
        else:
            difference_k = self._warmed(heat) if HEAT in changes else change(_DIFFERENCE)
        run = Run(
            name="test",
            t_s=np.asarray((self._t_h + REST_H) * 3600.0),
            difference_k=difference_k,
            ambient_k=change(AMBIENT),
            y_um=np.full(self._t_h.size, np.nan),
            heat_w=None,
            reference=self.evidence.runs[0].reference,
            # A fluid that stayed as warm as it was is no channel to look for, but an effect may need it.
            channels={name: self._start(name) + change(name) for name in self.evidence.signals[0].channels},
        )
        return signals_of(model, run, len(self.evidence.signals))

    def _warmed(self, heat: Vector) -> Vector:
        """Return T_Q − AT where it is set by a heat that nothing shows: with the lag of half an hour."""
        return np.asarray(Lag(2.0 * SET_MIN, self.period_min).filter(heat))

    # ------------------------------------------------------------------ the record

    def _recorded(self, name: str) -> Vector:
        """Return what was seen of something, all runs one after another."""
        if name == AMBIENT:
            return np.concatenate([record.ambient_k for record in self.evidence.signals])
        if name in (HEAT, _DIFFERENCE):
            return np.concatenate([record.drive for record in self.evidence.signals])
        return np.concatenate([record.channels[name] for record in self.evidence.signals])

    def _start(self, name: str) -> float:
        """Return where something is in the rest that a test begins with: what can be off is off, all else as it was."""
        if name in self._commanded and name in self.evidence.context.zeroed:
            return 0.0
        return float(self.evidence.signals[0].channels[name][0])

    def _in_words(self, name: str) -> str:
        unit = unit_of(name)
        if name == HEAT:
            unit = "w" if self.evidence.context.has_ttf else "k"
        elif not unit_of_channel(name):
            unit = ""
        # What is warmed or cooled says its sign by that.
        size = abs(self.size(name)) if name in self._temperatures else self.size(name)
        what = " of T_Q − AT" if name == HEAT and unit == "k" else ""
        return f"{roughly(size)} {_UNITS.get(unit, unit)}{what}".strip()

    def _filtered(self, values: Vector) -> Matrix:
        return FilterBank(LAGS_MIN, [(1.0,) * len(LAGS_MIN)], self.period_min).columns(values)

    def _bank(self, name: str) -> Matrix:
        """Return what something would be behind every lag, each run about its start."""
        return np.concatenate([self._filtered(u - u[0]) for u in self._by_run(name)])

    def _by_run(self, name: str) -> list[Vector]:
        values = self._recorded(name)
        return [values[run] for run in self.evidence.samples_of_runs()]

    @cached_property
    def _followers(self) -> Mapping[str, Mapping[str, Vector]]:
        """Temperatures that follow what is commanded and the air, with the gains of each behind every lag."""
        has_ttf = self.evidence.context.has_ttf
        causes = [*([HEAT] if has_ttf else []), AMBIENT, *self._commanded]
        stride = max(1, self.evidence.used.size // 400)
        table = np.concatenate([self._bank(name)[::stride] for name in causes], axis=1)
        begin = np.cumsum([0, *[record.size for record in self.evidence.signals]])
        which = np.searchsorted(begin, np.arange(self.evidence.used.size)[::stride], side="right")
        levels = (which[:, None] == np.arange(1, begin.size)).astype(float)
        scale = np.maximum(np.std(table, axis=0), 1e-12)
        solve = _regression(table / scale, levels)
        half = np.arange(which.size) < which.size / 2
        foretell = [(_regression(table[of] / scale, levels[of]), ~of) for of in (half, ~half)]
        found = {}
        for name in [*self._temperatures, *([] if has_ttf else [_DIFFERENCE])]:
            values = self._recorded(name)[::stride]
            gains, explained = solve(values)
            # Enough lags explain any slow course; each half of the record foretells the other only where it follows.
            left = sum(
                _sum_of_squares(values[to] - table[to] / scale @ by(values[of])[0], levels[to])
                for (by, to), of in zip(foretell, (half, ~half), strict=True)
            )
            whole = sum(_sum_of_squares(values[of], levels[of]) for of in (half, ~half))
            if explained > FOLLOWS and left < FORETOLD * whole:
                found[name] = dict(zip(causes, (gains / scale).reshape(-1, len(LAGS_MIN)), strict=True))
        return found


def _sum_of_squares(values: Vector, levels: Matrix) -> float:
    left = values - levels @ np.linalg.lstsq(levels, values, rcond=None)[0]
    return float(left @ left)


def _regression(table: Matrix, levels: Matrix) -> Callable[[Vector], tuple[Vector, float]]:
    """Return what regresses values on a table and a level for each run: gains, and the share that they explain."""

    def centred(columns: Matrix) -> Matrix:
        return np.asarray(columns - levels @ np.linalg.lstsq(levels, columns, rcond=None)[0])

    inputs = centred(table)
    gram = inputs.T @ inputs + RIDGE * table.shape[0] * np.eye(table.shape[1])

    def solve(values: Vector) -> tuple[Vector, float]:
        target = centred(values[:, None])[:, 0]
        gains = np.linalg.solve(gram, inputs.T @ target)
        left = target - inputs @ gains
        return gains, 1.0 - float(left @ left) / max(float(target @ target), 1e-12)

    return solve
