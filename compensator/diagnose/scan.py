"""The scan: every hypothesis on a grid of its searched parameters against what a fit leaves, as a first ranking."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from compensator.arrays import Indices, Matrix, Vector
from compensator.diagnose.fit import Fit, Start
from compensator.diagnose.likelihood import Likelihood
from compensator.diagnose.points import Points, Rest
from compensator.model.effects.hypothesis import Hypothesis
from compensator.model.effects.signals import RecordSignals

#: Columns that are kept for other searches take no more memory than this, bytes.
KEPT_BYTES = 3e8


class Grid:
    """Columns of hypotheses at every point of their grids on every sample: they do not depend on what is held out.

    Parameters
    ----------
    signals : sequence of RecordSignals
        What effects act by.
    """

    def __init__(self, signals: Sequence[RecordSignals]) -> None:
        self._signals = signals
        self._known: dict[Hypothesis, Matrix] = {}
        self._bytes = 0

    def columns(self, hypothesis: Hypothesis) -> Matrix:
        """Return the columns of all points of a grid side by side, shape (n, points · amplitudes)."""
        known = self._known.get(hypothesis)
        if known is not None:
            return known
        rows = [
            np.concatenate([hypothesis.columns(record, values).T for values in hypothesis.grid()])
            for record in self._signals
        ]
        table = np.ascontiguousarray(np.concatenate(rows, axis=1).T)
        if self._bytes + table.nbytes < KEPT_BYTES:
            self._bytes += table.nbytes
            self._known[hypothesis] = table
        return table


class Scan:
    """Hypotheses with their columns at every point of their grids.

    Parameters
    ----------
    points : Points
        The data.
    hypotheses : list of Hypothesis
        What could act.
    grid : Grid
        Their columns on every sample.
    """

    def __init__(self, points: Points, hypotheses: Sequence[Hypothesis], grid: Grid) -> None:
        self._points = points
        self._where = [(hypothesis, values) for hypothesis in hypotheses for values in hypothesis.grid()]
        tables, widths = [], []
        for hypothesis in hypotheses:
            count = len(hypothesis.grid())
            if not count:
                continue
            table = points.averaged(grid.columns(hypothesis))
            width = table.shape[1] // count
            widths += [width] * count
            tables.append(points.scaled(table, hypothesis.sizes, width)[0] if hypothesis.amplitudes else table)
        self._columns = np.concatenate(tables, axis=1)
        self._first = np.array([0, *itertools.accumulate(widths)])

    def ranked(self, rest: Rest, fit: Fit, cost: Callable[[Hypothesis], float]) -> list[Start]:
        """Rank the hypotheses whose places are free by what their best grid point adds to the evidence.

        Parameters
        ----------
        rest : Rest
            What no effect explains.
        fit : Fit
            What leaves the residual.
        cost : callable
            What a hypothesis costs before the data are seen.
        """
        likelihood = Likelihood(self._points, rest)
        gains = self._gains(likelihood, fit)
        best: dict[int, tuple[float, Start]] = {}
        for (hypothesis, values), gain in zip(self._where, gains.tolist(), strict=True):
            known = best.get(id(hypothesis))
            if hypothesis.place not in fit.places and (known is None or gain > known[0]):
                best[id(hypothesis)] = (gain, (hypothesis, values))
        ranking = sorted(best.values(), key=lambda item: cost(item[1][0]) - item[0])
        return [start for _, start in ranking]

    def _gains(self, likelihood: Likelihood, fit: Fit) -> Matrix:
        """Return what each grid point adds to the logarithm of the evidence, amplitudes integrated out."""
        white, taken = likelihood.whitened(self._columns)
        kept, inner, target = fit.solved(likelihood)
        size = white.shape[0]
        cross, back = kept[:size].T @ white, inner[:, :size] @ white
        # What is projected has the products of what is whitened with the upper part of what is projected.
        products = white.T @ target[:size]
        squares = _squares(white, white) - _squares(taken, taken) - _squares(cross, back)
        squares = np.maximum(squares, 0.0)  # rounding, where a column hardly changes
        widths = np.diff(self._first)
        gains = np.empty(widths.size)
        for width in set(widths.tolist()):
            which = np.flatnonzero(widths == width)
            at = self._first[which][:, None] + np.arange(width)
            if width == 1:
                one = at[:, 0]
                gains[which] = 0.5 * (products[one] ** 2 / (1.0 + squares[one]) - np.log1p(squares[one]))
                continue
            gram = np.eye(width) + _grams(white, white, at) - _grams(taken, taken, at) - _grams(cross, back, at)
            # Rounding of large columns must not take away what the prior adds.
            gram += 1e-10 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(width)
            moment = products[at]
            solved = np.linalg.solve(gram, moment[..., None])[..., 0]
            gains[which] = 0.5 * np.einsum("ij,ij->i", moment, solved) - 0.5 * np.linalg.slogdet(gram)[1]
        for i, (hypothesis, _) in enumerate(self._where):
            if not hypothesis.amplitudes:
                gains[i] = products[self._first[i]] - 0.5 * squares[self._first[i]]
        return gains


def _squares(first: Matrix, second: Matrix) -> Vector:
    """Return the product of each column with its like."""
    return np.asarray(np.einsum("ij,ij->j", first, second))


def _grams(first: Matrix, second: Matrix, at: Indices) -> Matrix:
    """Return the products of some columns with each other, for each row of their numbers."""
    return np.asarray(first.T[at] @ second.T[at].transpose(0, 2, 1))
