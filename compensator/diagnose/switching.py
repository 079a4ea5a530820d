"""A source that no channel shows: the times at which it was switched, and the lag behind which it acts."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from compensator.diagnose.evidence import Evidence
from compensator.model.effects.hypothesis import Free, lowpass
from compensator.model.effects.unobserved import Unobserved

Vector = npt.NDArray[np.float64]
Matrix = npt.NDArray[np.float64]

#: Most switchings looked for.
MOST = 16
#: Points of time that are tried in a record.
POINTS = 240


def switchings(evidence: Evidence, residual: Vector) -> tuple[Unobserved, tuple[float, ...]] | None:
    """Find steps behind a common lag that a residual may be made of, one after another.

    Parameters
    ----------
    evidence : Evidence
        Where the residual comes from.
    residual : numpy.ndarray, shape (n,)
        What is left so far.

    Returns
    -------
    (Unobserved, values) or None
        A hypothesis with its times, and where the search of its lag begins.
    """
    tau = evidence.setting.tau()
    best: tuple[float, float, list[int]] | None = None
    where = _times(evidence)
    for lag in tau.grid[::2]:
        table = _steps(evidence, where, lag)
        score, chosen = _pursue(table, residual, evidence.count)
        if chosen and (best is None or score < best[0]):
            best = (score, lag, chosen)
    if best is None:
        return None
    times = tuple(sorted(where[i] for i in best[2]))
    hypothesis = Unobserved(
        form="switched", free=(Free(name="tau_min", low=tau.low, high=tau.high, grid=()),),
        amplitudes=tuple(f"size_{i}_um" for i in range(1, len(times) + 1)), times=times,
        order=tuple(id(wave) for wave in evidence.waves),
    )  # fmt: skip
    return hypothesis, (best[1],)


def _times(evidence: Evidence) -> list[tuple[int, float]]:
    result = []
    for record, wave in enumerate(evidence.waves):
        stride = max(1, wave.size // POINTS)
        result += [(record, float(k * wave.period_min)) for k in range(2, wave.size - 2, stride)]
    return result


def _steps(evidence: Evidence, where: list[tuple[int, float]], lag: float) -> Matrix:
    """Return one column for each time: a step behind the lag, of norm 1, nuisances taken out."""
    sizes = [wave.size for wave in evidence.waves]
    begin = np.cumsum([0, *sizes[:-1]])
    period = evidence.setting.period_min
    shapes = [lowpass(np.concatenate(([0.0], np.ones(size))), lag, period)[1:] for size in sizes]
    table = np.zeros((sum(sizes), len(where)))
    for column, (record, at) in enumerate(where):
        first = round(at / period)
        table[begin[record] + first : begin[record] + sizes[record], column] = shapes[record][: sizes[record] - first]
    table[~evidence.used] = 0.0
    table = evidence.without_nuisances(table)
    norm = np.linalg.norm(table, axis=0)
    norm[norm < 1e-9] = np.inf
    return table / norm


def _pursue(table: Matrix, residual: Vector, count: int) -> tuple[float, list[int]]:
    """Take the best step, refit, and go on while each is worth its two parameters (orthogonal matching pursuit)."""
    chosen: list[int] = []
    left, score = residual, count * math.log(float(residual @ residual) + 1e-12)
    first = score
    q = np.zeros((residual.size, 0))
    best: list[int] = []
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
        now = count * math.log(float(left @ left) + 1e-12) + (1 + 2 * len(chosen)) * math.log(count)
        if now < score:
            score, best = now, list(chosen)
        elif len(chosen) > len(best) + 2:
            break
    return (score, best) if score < first else (first, [])
