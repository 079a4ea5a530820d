"""A source that no channel shows: the times at which it was switched, and the lag through which it acts."""

from __future__ import annotations

import math

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.diagnose.fitting.fit import Fit, Start
from compensator.diagnose.fitting.likelihood import Likelihood, dense
from compensator.diagnose.fitting.points import SlowRest
from compensator.model.effects.blocks import Lag
from compensator.model.effects.hypothesis import Free, Hypothesis
from compensator.model.effects.unobserved import Unobserved

Time = tuple[int, float]

#: Most switchings looked for.
MOST = 32
#: The lag is no longer than this share of the record: a longer one is a ramp.
LONGEST_SHARE = 0.15
#: Times moved off the grid add up to this many times as much to the evidence.
REFINES = 3.0
#: Least share of a step's norm that must be left without nuisances and held-out samples.
SEEN_SHARE = 0.05
#: Points of time that are tried in a record.
POINTS = 240
#: Steps that are formed at once.
AT_A_TIME = 32
#: A source does not begin within this share of a record: what moves there is the initial state.
START_SHARE = 0.01
#: What is switched once and acts within this many samples is a step.
AT_ONCE = 5.0


def switchings(rest: SlowRest, fit: Fit, rival: float) -> Start | None:
    """Find steps through a common lag that what a fit leaves may be made of, one after another.

    Parameters
    ----------
    rest : SlowRest
        What else there is.
    fit : Fit
        What leaves the residual.
    rival : float
        What the best effect that channels show adds to the evidence: nothing is refined that falls far short of it.

    Returns
    -------
    (Hypothesis, values) or None
        An unobserved source with its times, and where the search of its lag begins.
    """
    return _Pursuit(rest, fit).found(rival)


class _Pursuit:
    """Orthogonal matching pursuit of steps in what a fit leaves, beside a rest."""

    def __init__(self, rest: SlowRest, fit: Fit) -> None:
        points = fit.likelihood.points
        likelihood = Likelihood(points, rest)
        self._evidence, self._averaged = points.evidence, points.averaged
        self._projection = dense(likelihood)
        _, _, self._residual = fit.solved(likelihood)
        #: What a switching more costs: its time may be any, and its size.
        self._cost = math.log(points.count) + 2.0
        context = points.evidence.context
        self._period = context.period_min
        # Between two values measured now and then a lag does not show.
        self._at_once = max(AT_ONCE * self._period, points.period_min if points.evidence.is_sparse else 0.0)
        self._tau = context.tau()
        self._longest = max(context.minutes * LONGEST_SHARE, 2.0 * self._tau.low)
        self._grid: list[Time] = [
            (record.number, float(k * record.period_min))
            for record in points.evidence.signals
            for k in range(max(2, round(START_SHARE * record.size)), record.size - 2, _stride(record.size))
        ]

        self._known: dict[float, dict[Time, Vector]] = {}
        self._least: dict[float, float] = {}

    def found(self, rival: float) -> Start | None:
        """Return the source with the best times and lag."""
        ranked = []
        for lag in np.geomspace(self._tau.low, self._longest, 7).tolist():
            score, chosen = self._pursue(self._steps(self._grid, lag))
            if chosen:
                ranked.append((score, lag, len(chosen)))
        least = self._score(self._residual, 0) - rival / REFINES
        ranked = [one for one in ranked if one[0] < least]
        refined = [(*self._refine(lag, count + 2), lag) for _, lag, count in sorted(ranked)[:2]]
        best = min((one for one in refined if one[1]), key=lambda one: one[0], default=None)
        if best is None:
            return None
        _, times, lag = best
        if len(times) == 1 and lag < self._at_once:
            return None
        hypothesis = Hypothesis(
            effect=Unobserved(times=tuple(sorted(times)), sizes_um=(1.0,) * len(times)),
            form="switched",
            free=(Free(name="tau_min", low=self._tau.low, high=self._longest, grid=()),),
            amplitudes=tuple(f"size_{i}_um" for i in range(1, len(times) + 1)),
        )
        return hypothesis, (lag,)

    def _steps(self, where: list[Time], lag: float) -> Matrix:
        """Return one column for each time: a step through the lag, projected, of norm 1."""
        if lag not in self._known:
            columns, share = self._projected(self._grid, lag)
            # A step of which next to nothing is left may have any size: leave it out.
            self._least[lag] = SEEN_SHARE * float(np.median(share))
            self._known[lag] = dict(zip(self._grid, self._normed(columns, share, lag).T, strict=True))
        known = self._known[lag]
        if new := [time for time in dict.fromkeys(where) if time not in known]:
            known.update(zip(new, self._normed(*self._projected(new, lag), lag).T, strict=True))
        return np.array([known[time] for time in where]).reshape(-1, self._residual.size).T

    def _normed(self, columns: Matrix, share: Vector, lag: float) -> Matrix:
        return np.asarray(columns / np.where(share > self._least[lag], np.linalg.norm(columns, axis=0), np.inf))

    def _projected(self, where: list[Time], lag: float) -> tuple[Matrix, Vector]:
        """Return steps at some times, and which share of the norm of each is left."""
        records = self._evidence.signals
        begin = np.cumsum([0, *[record.size for record in records]])
        longest = max(record.size for record in records)
        # Two zeros before it, so that a step may begin between two samples.
        shape = np.concatenate(([0.0], Lag(lag, self._period).filter(np.concatenate(([0.0], np.ones(longest + 1))))))
        parts = []
        for few in (where[i : i + AT_A_TIME] for i in range(0, len(where), AT_A_TIME)):
            table = np.zeros((len(few), int(begin[-1])))
            for row, (record, at) in zip(table, few, strict=True):
                first = int(at / self._period)
                part, own = at / self._period - first, row[begin[record] : begin[record + 1]]
                room = own.size - first
                own[first:] = (1.0 - part) * shape[2 : 2 + room] + part * shape[1 : 1 + room]
            parts.append(self._averaged(table.T))
        averaged = np.concatenate(parts, axis=1)
        whole = np.linalg.norm(averaged - averaged.mean(axis=0), axis=0)
        columns = self._projection @ averaged
        return columns, np.linalg.norm(columns, axis=0) / (whole + 1e-9)

    def _pursue(self, table: Matrix) -> tuple[float, list[int]]:
        """Choose the best step, refit, and continue while each is worth its cost."""
        chosen: list[int] = []
        best: list[int] = []
        left, score = self._residual, self._score(self._residual, 0)
        q = np.zeros((left.size, 0))
        while len(chosen) < MOST:
            match = np.abs(table.T @ left)
            match[chosen] = 0.0
            i = int(np.argmax(match))
            column = table[:, i] - q @ (q.T @ table[:, i])
            norm = float(np.linalg.norm(column))
            if norm < 1e-6:
                break
            q = np.column_stack((q, column / norm))
            chosen.append(i)
            left = self._residual - q @ (q.T @ self._residual)
            now = self._score(left, len(chosen))
            if now < score:
                score, best = now, list(chosen)
            elif len(chosen) > len(best) + 2:
                break
        return score, best

    def _score(self, left: Vector, steps: int) -> float:
        return 0.5 * float(left @ left) + self._cost * steps

    def _score_of(self, times: list[Time], lag: float) -> float:
        return self._score(self._left(times, lag), len(times))

    def _refine(self, lag: float, most: int) -> tuple[float, list[Time]]:
        """Pursue again, each time moved to where it fits best before the next one is looked for; then thin out."""
        table = self._steps(self._grid, lag)
        times: list[Time] = []
        best: tuple[float, list[Time]] = (self._score(self._residual, 0), [])
        left, worse = self._residual, 0
        while len(times) < min(most, MOST) and worse < 2:
            times.append(self._grid[int(np.argmax(np.abs(table.T @ left)))])
            times = self._moved(times, lag, last_only=len(times) % 4 != 0)
            left = self._left(times, lag)
            now = self._score(left, len(times))
            worse = 0 if now < best[0] else worse + 1
            if worse == 0:
                best = (now, list(times))
        times = self._moved(best[1], lag, last_only=False)
        times = self._thinned(times, lag)
        return self._score_of(times, lag), times

    def _thinned(self, times: list[Time], lag: float) -> list[Time]:
        """Leave out, one after another, the steps that are not worth their cost."""
        while len(times) > 1:
            table = self._steps(times, lag)
            inverse = np.linalg.inv(table.T @ table + 1e-9 * np.eye(len(times)))
            worth = 0.5 * (inverse @ (table.T @ self._residual)) ** 2 / np.diag(inverse)
            least = int(np.argmin(worth))
            if worth[least] >= self._cost:
                break
            times = times[:least] + times[least + 1 :]
        return times

    def _left(self, times: list[Time], lag: float) -> Vector:
        q = np.linalg.qr(self._steps(times, lag))[0]
        return np.asarray(self._residual - q @ (q.T @ self._residual))

    def _moved(self, times: list[Time], lag: float, *, last_only: bool) -> list[Time]:
        """Move one time after another by half samples, all sizes refitted, to where it explains most."""
        times = list(times)
        for k in range(len(times) - 1 if last_only else 0, len(times)):
            record, at = times[k]
            size = self._evidence.signals[record].size
            reach, last = _stride(size), (size - 3) * self._period
            moves = np.arange(-reach, reach + 0.25, max(0.5, reach / 12.0))
            first = max(2, round(START_SHARE * size)) * self._period
            near = [(record, min(max(at + d * self._period, first), last)) for d in moves]
            q = np.linalg.qr(self._steps(times[:k] + times[k + 1 :], lag))[0]
            trial = self._steps(near, lag)
            trial = trial - q @ (q.T @ trial)
            squares = np.einsum("ij,ij->j", trial, trial)
            gain = (trial.T @ (self._residual - q @ (q.T @ self._residual))) ** 2 / np.maximum(squares, 1e-9)
            times[k] = near[int(np.argmax(gain))]
        return list(dict.fromkeys(times))


def _stride(size: int) -> int:
    return max(1, size // POINTS)
