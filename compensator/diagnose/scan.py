"""The scan: every hypothesis on a grid of its searched parameters against what a fit leaves, as a first ranking."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from compensator.arrays import Matrix
from compensator.diagnose.fit import Fit, Start, raw_columns
from compensator.diagnose.likelihood import Likelihood, dense
from compensator.diagnose.points import Points, Rest
from compensator.model.effects.hypothesis import Hypothesis


class Scan:
    """Hypotheses with their columns at every point of their grids.

    Parameters
    ----------
    points : Points
        The data.
    hypotheses : list of Hypothesis
        What could act.
    """

    def __init__(self, points: Points, hypotheses: list[Hypothesis]) -> None:
        self._points = points
        self._where = [(hypothesis, values) for hypothesis in hypotheses for values in hypothesis.grid()]
        tables, widths = [], []
        for hypothesis in hypotheses:
            parts = [points.averaged(raw_columns(points.evidence, hypothesis, v)) for v in hypothesis.grid()]
            width = parts[0].shape[1]
            widths += [width] * len(parts)
            table = np.concatenate(parts, axis=1)
            tables.append(points.scaled(table, hypothesis.sizes, width)[0] if hypothesis.amplitudes else table)
        # Single precision is enough for a ranking, and takes half the time.
        self._columns = np.concatenate([table.astype(np.float32) for table in tables], axis=1)
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
        white = np.asarray(dense(likelihood).astype(np.float32) @ self._columns, dtype=np.float64)
        kept, inner, target = fit.solved(likelihood)
        cross, back = kept.T @ white, inner @ white
        products = white.T @ target
        squares = np.einsum("ij,ij->j", white, white) - np.einsum("ij,ij->j", cross, back)
        widths = np.diff(self._first)
        gains = np.empty(widths.size)
        for width in set(widths.tolist()):
            which = np.flatnonzero(widths == width)
            at = self._first[which][:, None] + np.arange(width)
            if width == 1:
                one = at[:, 0]
                gains[which] = 0.5 * (products[one] ** 2 / (1.0 + squares[one]) - np.log1p(squares[one]))
                continue
            some = white.T[at]
            gram = np.eye(width) + some @ some.transpose(0, 2, 1) - cross.T[at] @ back.T[at].transpose(0, 2, 1)
            # Rounding of large columns must not take away what the prior adds.
            gram += 1e-10 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(width)
            moment = products[at]
            solved = np.linalg.solve(gram, moment[..., None])[..., 0]
            gains[which] = 0.5 * np.einsum("ij,ij->i", moment, solved) - 0.5 * np.linalg.slogdet(gram)[1]
        for i, (hypothesis, _) in enumerate(self._where):
            if not hypothesis.amplitudes:
                gains[i] = products[self._first[i]] - 0.5 * squares[self._first[i]]
        return gains
