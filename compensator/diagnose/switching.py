"""A source that no channel shows: the times at which it was switched, and the lag through which it acts."""

from __future__ import annotations

import math

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Start
from compensator.model.effects.blocks import Lag
from compensator.model.effects.hypothesis import Free, Hypothesis
from compensator.model.effects.unobserved import Unobserved

Time = tuple[int, float]

#: Most switchings looked for.
MOST = 32
#: The lag is no longer than this share of the record: a longer one is a ramp.
LONGEST_SHARE = 0.15
#: Least share of a step's norm that must be left without nuisances and held-out samples.
SEEN_SHARE = 0.05
#: Points of time that are tried in a record.
POINTS = 240


def switchings(evidence: Evidence, residual: Vector) -> Start | None:
    """Find steps through a common lag that a residual may be made of, one after another.

    Parameters
    ----------
    evidence : Evidence
        Where the residual comes from.
    residual : numpy.ndarray, shape (n,)
        What is left so far.

    Returns
    -------
    (Hypothesis, values) or None
        An unobserved source with its times, and where the search of its lag begins.
    """
    tau = evidence.context.tau()
    high = max(evidence.context.minutes * LONGEST_SHARE, 2.0 * tau.low)
    grid = _grid(evidence)
    ranked = []
    for lag in np.geomspace(tau.low, high, 7).tolist():
        score, chosen = _pursue(evidence, _steps(evidence, grid, lag), residual)
        if chosen:
            ranked.append((score, lag))
    refined = [(*_refine(evidence, residual, grid, lag), lag) for _, lag in sorted(ranked)[:2]]
    best = min((one for one in refined if one[1]), key=lambda one: one[0], default=None)
    if best is None:
        return None
    _, times, lag = best
    hypothesis = Hypothesis(
        effect=Unobserved(times=tuple(sorted(times)), sizes_um=(1.0,) * len(times)),
        form="switched",
        free=(Free(name="tau_min", low=tau.low, high=high, grid=()),),
        amplitudes=tuple(f"size_{i}_um" for i in range(1, len(times) + 1)),
    )
    return hypothesis, (lag,)


def _grid(evidence: Evidence) -> list[Time]:
    return [
        (record.number, float(k * record.period_min))
        for record in evidence.signals
        for k in range(2, record.size - 2, _stride(record.size))
    ]


def _stride(size: int) -> int:
    return max(1, size // POINTS)


def _steps(evidence: Evidence, where: list[Time], lag: float) -> Matrix:
    """Return one column for each time: a step through the lag, of norm 1, nuisances projected out."""
    sizes = [record.size for record in evidence.signals]
    begin = np.cumsum([0, *sizes[:-1]])
    period = evidence.context.period_min
    longest = max(sizes)
    shape = Lag(lag, period).filter(np.concatenate(([0.0], np.ones(longest + 1))))[1:]
    table = np.zeros((sum(sizes), len(where)))
    for column, (record, at) in enumerate(where):
        first = int(at / period)
        part = at / period - first
        room = sizes[record] - first
        step = shape[:room].copy()
        # Between two samples, a step is as much of the one before as of the one after.
        step[1:] = (1.0 - part) * shape[1:room] + part * shape[: room - 1]
        step[0] *= 1.0 - part
        table[begin[record] + first : begin[record] + sizes[record], column] = step
    whole = np.linalg.norm(table, axis=0)
    table[~evidence.used] = 0.0
    table = evidence.without_nuisances(table)
    norm = np.linalg.norm(table, axis=0)
    # A step of which next to nothing is left may have any size: leave it out.
    norm[norm < SEEN_SHARE * whole + 1e-9] = np.inf
    return np.asarray(table / norm)


def _pursue(evidence: Evidence, table: Matrix, residual: Vector) -> tuple[float, list[int]]:
    """Choose the best step, refit, and continue while each is worth its parameters (orthogonal matching pursuit)."""
    chosen: list[int] = []
    best: list[int] = []
    left, score = residual, _score(evidence, residual, 0)
    q = np.zeros((residual.size, 0))
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
        left = residual - q @ (q.T @ residual)
        now = _score(evidence, left, len(chosen))
        if now < score:
            score, best = now, list(chosen)
        elif len(chosen) > len(best) + 2:
            break
    return score, best


def _score(evidence: Evidence, left: Vector, steps: int) -> float:
    count = evidence.count
    return count * math.log(float(left @ left) + evidence.noise.allowance + 1e-12) + (1 + 2 * steps) * math.log(count)


def _refine(evidence: Evidence, residual: Vector, grid: list[Time], lag: float) -> tuple[float, list[Time]]:
    """Pursue again, each time moved to where it fits best before the next one is looked for; then thin out."""

    def score_of(times: list[Time]) -> float:
        return _score(evidence, _left(evidence, residual, times, lag), len(times))

    table = _steps(evidence, grid, lag)
    times: list[Time] = []
    best: tuple[float, list[Time]] = (_score(evidence, residual, 0), [])
    left, worse = residual, 0
    while len(times) < MOST and worse < 2:
        times.append(grid[int(np.argmax(np.abs(table.T @ left)))])
        times = _moved(evidence, residual, times, lag, last_only=len(times) % 4 != 0)
        left = _left(evidence, residual, times, lag)
        now = _score(evidence, left, len(times))
        worse = 0 if now < best[0] else worse + 1
        if worse == 0:
            best = (now, list(times))
    score, times = best
    times = _moved(evidence, residual, times, lag, last_only=False) if times else times
    while len(times) > 1:
        fewer = [times[:k] + times[k + 1 :] for k in range(len(times))]
        scores = [score_of(some) for some in fewer]
        score = score_of(times)
        if min(scores) >= score:
            break
        times = fewer[int(np.argmin(scores))]
    return score, times


def _left(evidence: Evidence, residual: Vector, times: list[Time], lag: float) -> Vector:
    q = np.linalg.qr(_steps(evidence, times, lag))[0]
    return np.asarray(residual - q @ (q.T @ residual))


def _moved(evidence: Evidence, residual: Vector, times: list[Time], lag: float, *, last_only: bool) -> list[Time]:
    """Move one time after another by half samples, all sizes refitted, to where it explains most."""
    period = evidence.context.period_min
    times = list(times)
    for k in range(len(times) - 1 if last_only else 0, len(times)):
        record, at = times[k]
        reach = _stride(evidence.signals[record].size)
        last = (evidence.signals[record].size - 3) * period
        near = [(record, min(max(at + d * period, 2 * period), last)) for d in np.arange(-reach, reach + 0.25, 0.5)]
        others = _steps(evidence, times[:k] + times[k + 1 :], lag)
        q = np.linalg.qr(others)[0]
        trial = _steps(evidence, near, lag)
        trial = trial - q @ (q.T @ trial)
        size = np.einsum("ij,ij->j", trial, trial)
        gain = (trial.T @ (residual - q @ (q.T @ residual))) ** 2 / np.maximum(size, 1e-9)
        times[k] = near[int(np.argmax(gain))]
    return list(dict.fromkeys(times))
