"""The scan: every hypothesis on a grid of its searched parameters against what a fit leaves, as a first ranking."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compensator.arrays import Indices, Matrix, Vector
from compensator.diagnose.fitting.fit import Fit, Start
from compensator.diagnose.fitting.likelihood import Likelihood
from compensator.diagnose.fitting.points import Points, SlowRest
from compensator.model.effects.hypothesis import Hypothesis


@dataclass(frozen=True, slots=True)
class Grid:
    """Columns of hypotheses at every point of their grids: nothing in them depends on what is held out.

    Parameters
    ----------
    first : numpy.ndarray of int, shape (points,)
        First sample of each point of all data.
    columns : mapping of Hypothesis to numpy.ndarray, shape (points, ·)
        Columns of all points of a grid side by side.
    """

    first: Indices
    columns: Mapping[Hypothesis, Matrix]

    def of(self, hypothesis: Hypothesis, points: Points) -> Matrix:
        """Return the columns of a hypothesis for what is left of the points where something is held out."""
        if hypothesis not in self.columns:  # of fewer values measured now and then, fewer periods show
            return _on_grid(points, hypothesis)
        return self.columns[hypothesis][np.searchsorted(self.first, points.first)]


class Scan:
    """Hypotheses with their columns at every point of their grids.

    Parameters
    ----------
    points : Points
        The data.
    hypotheses : sequence of Hypothesis
        What could act.
    grid : Grid, optional
        Their columns for all data, where something is held out.

    Attributes
    ----------
    grid : Grid
        Their columns for all data.
    """

    def __init__(self, points: Points, hypotheses: Sequence[Hypothesis], grid: Grid | None = None) -> None:
        self.grid = grid or Grid(points.first, {one: _on_grid(points, one) for one in hypotheses if one.grid()})
        several: dict[int, list[tuple[Hypothesis, Matrix]]] = {}
        for hypothesis in hypotheses:
            if count := len(hypothesis.grid()):
                table = self.grid.of(hypothesis, points)
                width = table.shape[1] // count
                if hypothesis.amplitudes:
                    table = points.scaled(table, hypothesis.sizes, width)[0]
                several.setdefault(width, []).append((hypothesis, table))
        #: Columns of hypotheses with equally many of them, for each number: where they are.
        self._where: dict[int, slice] = {}
        self._starts, tables = list[Start](), [np.zeros((points.count, 0))]
        begin = 0
        for width, some in several.items():
            tables += [table for _, table in some]
            self._starts += [(hypothesis, values) for hypothesis, _ in some for values in hypothesis.grid()]
            end = begin + sum(table.shape[1] for _, table in some)
            self._where[width], begin = slice(begin, end), end
        self._columns = np.concatenate(tables, axis=1)
        self._last: _Whitened | None = None
        self._fixed = np.array([not hypothesis.amplitudes for hypothesis, _ in self._starts], dtype=bool)

    def ranked(self, likelihood: Likelihood, fit: Fit, cost: Callable[[Hypothesis], float]) -> list[Start]:
        """Rank the hypotheses whose places are free by what their best grid point adds to the evidence.

        Parameters
        ----------
        likelihood : Likelihood
            The data with what no effect explains.
        fit : Fit
            What leaves the residual.
        cost : callable
            What a hypothesis costs before the data are seen.
        """
        gains, taken = self._gains(likelihood, fit), fit.places
        best: dict[int, tuple[float, Start]] = {}
        for (hypothesis, values), gain in zip(self._starts, gains.tolist(), strict=True):
            known = best.get(id(hypothesis))
            if (known is None or gain > known[0]) and hypothesis.place not in taken:
                best[id(hypothesis)] = (gain, (hypothesis, values))
        ranking = sorted(best.values(), key=lambda item: cost(item[1][0]) - item[0])
        return [start for _, start in ranking]

    def _gains(self, likelihood: Likelihood, fit: Fit) -> Vector:
        """Return what each grid point adds to the logarithm of the evidence, amplitudes integrated out."""
        known = self._whitened(likelihood)
        white = known.columns
        kept, inner, target = fit.solved(likelihood)
        size = white.shape[0]
        cross, back = kept[:size].T @ white, inner[:, :size] @ white
        # What is projected has the products of what is whitened with the upper part of what is projected.
        products = white.T @ target[:size]
        gains = list[float]()
        for width, at in self._where.items():
            gram = known.grams[width] - _blocks(cross[:, at], back[:, at], width)
            # Rounding of large columns must not take away what the prior adds.
            own = np.maximum(np.diagonal(gram, axis1=1, axis2=2), 0.0)
            unit = np.eye(width)
            gram = np.where(unit, own[:, :, None], gram) + unit * (1.0 + 1e-10 * own.sum(axis=1))[:, None, None]
            moment = products[at].reshape(-1, width)
            solved = np.linalg.solve(gram, moment[..., None])[..., 0]
            added = 0.5 * np.einsum("ij,ij->i", moment, solved) - 0.5 * np.linalg.slogdet(gram)[1]
            fixed = self._fixed[len(gains) : len(gains) + added.size]
            gains += np.where(fixed, moment[:, 0] - 0.5 * own[:, 0], added).tolist()
        return np.array(gains)

    def _whitened(self, likelihood: Likelihood) -> _Whitened:
        """Return the columns without noise correlation; several fits are ranked with one rest."""
        if self._last is None or self._last.rest != likelihood.rest:
            white, taken = likelihood.whitened(self._columns)
            grams = {
                width: _blocks(white[:, at], white[:, at], width) - _blocks(taken[:, at], taken[:, at], width)
                for width, at in self._where.items()
            }
            self._last = _Whitened(likelihood.rest, white, grams)
        return self._last


@dataclass(frozen=True, slots=True)
class _Whitened:
    """Columns of a scan with a rest: whitened, and their products after projection, by how many belong together."""

    rest: SlowRest
    columns: Matrix
    grams: Mapping[int, Matrix]


def _on_grid(points: Points, hypothesis: Hypothesis) -> Matrix:
    """Return the averaged columns of a hypothesis at all points of its grid, side by side."""
    rows = [
        np.concatenate([hypothesis.columns(record, values).T for values in hypothesis.grid()])
        for record in points.evidence.signals
    ]
    return points.averaged(np.concatenate(rows, axis=1).T)


def _blocks(first: Matrix, second: Matrix, width: int) -> Matrix:
    """Return the products of columns with each other, in groups of so many side by side, shape (·, width, width)."""
    found = np.empty((first.shape[1] // width, width, width))
    for i in range(width):
        for j in range(i, width):
            found[:, i, j] = found[:, j, i] = np.einsum("ij,ij->j", first[:, i::width], second[:, j::width])
    return found
