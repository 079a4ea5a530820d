"""The scan: every hypothesis on a grid of its searched parameters against what is left, as a first ranking."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Fit, Term, columns_of
from compensator.model.effects.hypothesis import Hypothesis, proposals

#: Single precision: half the memory, and more digits than a first ranking needs.
Coarse = npt.NDArray[np.float32]


class Scan:
    """Every hypothesis for some evidence, with its columns on the grid kept."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        self.hypotheses = proposals(evidence.context)
        self._grids: dict[int, list[tuple[tuple[float, ...], Coarse]]] = {}

    def ranked(self, base: Fit, kept: Sequence[Term]) -> list[tuple[Hypothesis, tuple[float, ...]]]:
        """Rank the hypotheses of free places by what their best grid point would explain of a residual.

        Parameters
        ----------
        base : Fit
            What leaves the residual; its columns are projected out.
        kept : sequence of Term
            Effects whose places are not free.

        Returns
        -------
        list of (Hypothesis, values)
            Best first, with the values of the best grid point.
        """
        known = [columns_of(self.evidence, *term.start)[0] for term in base.terms]
        whole = np.concatenate(known, axis=1) if known and sum(k.shape[1] for k in known) else None
        q = None if whole is None else np.linalg.qr(whole)[0].astype(np.float32)
        residual = base.residual.astype(np.float32)
        count, log_count = self.evidence.count, math.log(self.evidence.count)
        occupied = {term.hypothesis.place for term in kept}
        ranking = []
        for hypothesis in self.hypotheses:
            if hypothesis.place in occupied:
                continue
            best: tuple[float, tuple[float, ...]] | None = None
            for values, table in self._grid(hypothesis):
                gain = _explained(table if q is None else table - q @ (q.T @ table), residual)
                if best is None or gain > best[0]:
                    best = (gain, values)
            if best is not None:
                left = max(base.cost - best[0], 1e-3 * base.cost)
                ranking.append((count * math.log(left) + hypothesis.parameters * log_count, hypothesis, best[1]))
        return [(hypothesis, values) for _, hypothesis, values in sorted(ranking, key=lambda item: item[0])]

    def _grid(self, hypothesis: Hypothesis) -> list[tuple[tuple[float, ...], Coarse]]:
        key = id(hypothesis)
        if key not in self._grids:
            tables = []
            for values in hypothesis.grid():
                table = np.concatenate([hypothesis.columns(record, values) for record in self.evidence.signals])
                table[~self.evidence.used] = 0.0
                tables.append((values, self.evidence.without_nuisances(table).astype(np.float32)))
            self._grids[key] = tables
        return self._grids[key]


def _explained(x: Coarse, residual: Coarse) -> float:
    """Return how much of the residual's sum of squares some columns explain."""
    if x.shape[1] == 1:
        size = float(x[:, 0] @ x[:, 0])
        return float((x[:, 0] @ residual) ** 2 / size) if size > 1e-12 else 0.0
    q, r = np.linalg.qr(x)
    good = np.abs(np.diag(r)) > 1e-5 * np.linalg.norm(r, axis=0) + 1e-9
    part = q.T @ residual
    return float(np.sum(part[good] ** 2))
