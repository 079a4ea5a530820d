"""Which logged channel comes nearest to what the named effects leave.

A sensor near a cause shows nearly what acts on Y, or the same a little earlier or later. So each channel alone goes
through a filter bank, of lags behind it and of shorter ones ahead of it (a sensor that follows the cause), with
regularised gains of one learned size. Channels are ranked by what that adds to the evidence.

Where a source was found that no channel shows, it is what is to be explained. Else it is what the named effects leave
with what they explain by temperatures: a temperature may only be near the cause, while a speed or a flow is a cause
itself and stays explained.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fitting.fit import Fit, Term, fit_terms
from compensator.diagnose.fitting.likelihood import Likelihood, RandomColumns, learned_rest
from compensator.diagnose.fitting.points import Points, SlowRest
from compensator.diagnose.search.background import LAGS_MIN, RECENT_MIN
from compensator.model.effects.blocks import FilterBank
from compensator.model.effects.hypothesis import DEGC
from compensator.model.effects.regression import AMBIENT
from compensator.model.effects.signals import RecordSignals

#: Sizes of a channel's gains that are tried, as shares of the deformation's spread.
SIZES = np.geomspace(0.01, 3.0, 6)
#: How many of the nearest channels are run backwards to see what is chance, and where each begins, as shares.
CHECKED, BEGINNINGS = 5, (0.0, 0.17, 0.33, 0.5, 0.67, 0.83)
#: Name of the base's own temperature of the heat source among the channels; that of the ambient is `AMBIENT`.
T_Q = "t_q_degc"


@dataclass(frozen=True, slots=True, kw_only=True)
class Near:
    """A logged channel that resembles what is to be explained.

    Parameters
    ----------
    channel : str
        The channel; `t_q_degc` and `at_degc` are among them.
    evidence : float
        What it adds to the logarithm of the evidence, alone.
    lag_min : float
        Single lag that suits it best, min: what is to be explained comes later than the channel, or earlier where it is
        negative.
    by_chance : float
        The most that any of the nearest channels adds when it runs backwards, from several beginnings: signals as slow
        as these resemble each other so far by chance.
    """

    channel: str
    evidence: float
    lag_min: float
    by_chance: float = 0.0


def may_be_near_the_cause(term: Term) -> bool:
    """Return whether an effect acts by a temperature: that of a channel, or those that drive the base's paths."""
    _, path, channel = term.hypothesis.place
    return channel.endswith(DEGC) if channel else bool(path)


def nearest(fit: Fit, unexplained: SlowRest) -> tuple[Near, ...]:
    """Rank the logged channels by how near they come to what a fit leaves and what temperatures explain in it.

    Parameters
    ----------
    fit : Fit
        All effects found.
    unexplained : SlowRest
        The rest where no effect explains anything: where the search of it begins.

    Returns
    -------
    tuple of Near
        Nearest first; only those that add to the evidence.
    """
    observed = [term for term in fit.terms if term.hypothesis.effect.observed]
    if len(observed) == len(fit.terms):
        observed = [term for term in observed if not may_be_near_the_cause(term)]
    base = fit_terms(fit.likelihood, [term.start for term in observed], evaluations=1)
    ranking = _Ranking(base, unexplained)
    points = fit.likelihood.points
    signals = _signals(points)
    found = [ranking.of(name, _columns(points, values)) for name, values in signals.items()]
    found = sorted((near for near in found if near.evidence > 0.0), key=lambda near: -near.evidence)
    backwards = [
        ranking.evidence(_columns(points, [np.roll(u[::-1], round(share * u.size)) for u in signals[near.channel]]))
        for near in found[:CHECKED]
        for share in BEGINNINGS
    ]
    by_chance = max(backwards, default=0.0)
    return tuple(dataclasses.replace(near, by_chance=by_chance) for near in found)


def course_evidence(fit: Fit, unexplained: SlowRest, course: Vector) -> float:
    """Return what a channel with exactly some course would add to the evidence of what a fit leaves without it.

    Parameters
    ----------
    fit : Fit
        All effects found.
    unexplained : SlowRest
        The rest where no effect explains anything.
    course : numpy.ndarray, shape (n,)
        On every sample, µm.
    """
    observed = [t.start for t in fit.terms if t.hypothesis.effect.observed]
    base = fit_terms(fit.likelihood, observed, evaluations=1)
    points = fit.likelihood.points
    return _Ranking(base, unexplained).evidence(_unit(points, points.averaged(course[:, None])))


class _Ranking:
    """The evidence of single channels beside a fit, with the rest that is most probable without any of them.

    A smaller rest would take what a channel does not explain for more than it is, and rank by that.
    """

    def __init__(self, base: Fit, unexplained: SlowRest) -> None:
        self._points = base.likelihood.points
        start = dataclasses.replace(unexplained, own_um=base.rest.own_um)
        self._likelihood = likelihood = Likelihood(
            self._points, learned_rest(self._points, base.columns, base.fixed, start)
        )
        self._kept, self._target = base.projected(likelihood)
        self._alone = RandomColumns(self._kept, self._target).surprise

    def of(self, name: str, columns: Matrix) -> Near:
        """Return how near a channel comes, given what it would be behind and ahead of all lags."""
        white = self._whitened(columns)
        return Near(channel=name, evidence=self._added(white), lag_min=_single_lag(white, self._target))

    def evidence(self, columns: Matrix) -> float:
        """Return what columns of any kind add to the evidence."""
        return self._added(self._whitened(columns))

    def _whitened(self, columns: Matrix) -> Matrix:
        return self._likelihood.projected(columns * self._points.spread_um)

    def _added(self, white: Matrix) -> float:
        sizes = (SIZES / math.sqrt(white.shape[1])).tolist()
        tables = [np.column_stack([self._kept, white * size]) for size in sizes]
        return self._alone - min(RandomColumns(table, self._target).surprise for table in tables)


def _single_lag(white: Matrix, target: Vector) -> float:
    """Return the lag of the one column that explains most, min; negative ahead of the channel."""
    squares = np.einsum("ij,ij->j", white, white)
    gains = (white.T @ target) ** 2 / (1.0 + squares)
    return (*LAGS_MIN, *(-lag for lag in RECENT_MIN[1:]))[int(np.argmax(gains))]


def _signals(points: Points) -> dict[str, list[Vector]]:
    """Return every channel over the records, the base's own temperatures among them."""
    evidence = points.evidence
    names = list(evidence.context.channels)
    names += [T_Q, *([AMBIENT] if evidence.context.has_ambient else [])]
    references = [run.difference_k + run.ambient_k for run in evidence.runs]

    def signal(name: str, record: RecordSignals, t_q_k: Vector) -> Vector:
        return t_q_k if name == T_Q else record.ambient_k if name == AMBIENT else record.channels[name]

    records = list(zip(evidence.signals, references, strict=True))
    return {name: [signal(name, record, t_q_k) for record, t_q_k in records] for name in names}


def _columns(points: Points, values: Sequence[Vector]) -> Matrix:
    """Return the columns of size 1 of a channel."""
    return _unit(points, points.averaged(_bank(values, points.evidence.context.period_min)))


def _bank(values: Sequence[Vector], period_min: float) -> Matrix:
    """Return the lags behind a channel and ahead of it over several records, shape (n, lags)."""
    behind = FilterBank(LAGS_MIN, [(1.0,) * len(LAGS_MIN)], period_min)
    ahead = FilterBank(RECENT_MIN[1:], [(1.0,) * len(RECENT_MIN[1:])], period_min)
    parts = [np.column_stack([behind.columns(u - u[0]), ahead.columns((u - u[-1])[::-1])[::-1]]) for u in values]
    return np.concatenate(parts)


def _unit(points: Points, table: Matrix) -> Matrix:
    """Return columns about their means, of standard deviation 1; 0 where a column is constant."""
    table = table - table.mean(axis=0)
    spread = np.std(table, axis=0)
    return np.asarray(table / np.where(spread > 1e-9, spread, np.inf))
