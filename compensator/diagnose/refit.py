"""A base model that is far off: refitted together with what it lacks.

A model that was calibrated while something acted that it has no input for has bent its own paths to make up for it. Its
residual is then no longer the effect, and whatever is found in it holds nowhere else. So the paths are refitted beside
each channel, the channel that helps most on held-out blocks of time is added, and so on.

Every path and channel acts through a filter bank with a ridge on its gains, of weight `RIDGE` against columns of
standard deviation 1 (the last fit uses a lighter one where that does better). So there is nothing to search, one Gram
matrix of each block serves all fits, and hundreds of combinations are compared by their error on blocks of several
lengths: short ones alone would favour what merely follows, long ones alone depend on where they begin.

Sources: Hoerl and Kennard, Ridge regression (1970); Stone, Cross-validatory choice (1974).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from compensator.arrays import Indices, Mask, Matrix, Vector
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Term
from compensator.model.effects.blocks import FilterBank, Lag
from compensator.model.effects.hypothesis import BANK, Hypothesis
from compensator.model.effects.input import banks
from compensator.model.transfer_function import SampledTransferFunction

#: Weight of the ridge, as a share of the samples.
RIDGE = 0.03
#: Weights of the last fit, the heaviest first; the one with the least error on held-out blocks is chosen.
RIDGES = (RIDGE, 0.01, 0.003, 0.001)
#: Lengths of the held-out blocks, h.
BLOCKS_H = (3.0, 5.0, 8.0)
#: Most channels added, and what each must leave at most of the held-out error.
MOST, LEAVES = 3, 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelCandidate:
    """A channel and the error on held-out blocks with it.

    Parameters
    ----------
    hypothesis : Hypothesis
        The channel and its curve.
    rms_um : float
        Free-run error on the blocks, µm.
    blocks_um2 : numpy.ndarray
        Sum of squares of each block, µm².
    """

    hypothesis: Hypothesis
    rms_um: float
    blocks_um2: Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class Refit:
    """Base and channels fitted together.

    Parameters
    ----------
    terms : tuple of Term
        The channels, in the order in which they were added.
    std : tuple of dict of str to float
        Standard errors of what each term is named by, from leaving out one block at a time.
    dtf, tdtf : SampledTransferFunction or None
        The refitted paths.
    predicted : numpy.ndarray, shape (n,)
        Deformation on every sample, the zero of each run included, µm.
    by_paths : numpy.ndarray, shape (n,)
        The same by the paths alone, fitted without any channel.
    rms_um : tuple of float
        Error on held-out blocks: of the base alone, then with each channel more.
    rivals : tuple of tuple of ChannelCandidate
        For each term, the other channels in its place, best first.
    """

    terms: tuple[Term, ...]
    std: tuple[dict[str, float], ...]
    dtf: SampledTransferFunction
    tdtf: SampledTransferFunction | None
    predicted: Vector
    by_paths: Vector
    rms_um: tuple[float, ...]
    rivals: tuple[tuple[ChannelCandidate, ...], ...]


def refit(evidence: Evidence) -> Refit:
    """Refit the base and add channels while the error on held-out blocks falls.

    Parameters
    ----------
    evidence : Evidence
        Residual and signals; nothing but the samples used takes part.
    """
    fitting = _Fitting(evidence)
    chosen: list[Hypothesis] = []
    best, blocks = fitting.held_out(chosen)
    errors, rivals = [best], []
    while len(chosen) < MOST:
        added = {hypothesis.effect.channel for hypothesis in chosen}
        candidates = []
        for hypothesis in fitting.hypotheses:
            if hypothesis.effect.channel not in added:
                rms, each = fitting.held_out([*chosen, hypothesis])
                candidates.append(ChannelCandidate(hypothesis=hypothesis, rms_um=rms, blocks_um2=each))
        candidates.sort(key=lambda item: item.rms_um)
        # A gain on a single block is due to that block.
        if not candidates or candidates[0].rms_um > LEAVES * best or np.mean(candidates[0].blocks_um2 < blocks) <= 0.5:
            break
        chosen.append(candidates[0].hypothesis)
        best, blocks = candidates[0].rms_um, candidates[0].blocks_um2
        errors.append(best)
        rivals.append(tuple(candidates[1:]))
    return fitting.result(chosen, tuple(errors), tuple(rivals))


class _Fitting:
    """Columns of everything that could be in the fit, and their Gram matrices."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        context = evidence.context
        self.taus = context.bank_min
        self.hypotheses = banks(context)
        bank = FilterBank(self.taus, [(1.0,) * BANK], context.period_min)
        records = evidence.signals
        drives = [[record.drive for record in records]]
        if context.has_ambient:
            drives.append([record.ambient_k for record in records])
        runs = block_diag(*(np.ones((record.size, 1)) for record in records))
        groups = [
            *(np.concatenate([bank.columns(u) for u in drive]) for drive in drives),
            *(np.concatenate([h.columns(record, ()) for record in records]) for h in self.hypotheses),
        ]
        whole = np.concatenate([runs, *groups], axis=1)
        scale = np.std(whole[evidence.used], axis=0)
        scale[: runs.shape[1]] = 1.0
        scale[scale == 0.0] = 1.0
        self.scale, self.table = scale, whole / scale
        self.base = runs.shape[1] + BANK * len(drives)
        self.y = evidence.deformation_um
        self.blocks = [self._grams(mask) for mask in self._masks()]
        self.all = self._grams([evidence.used])

    def _masks(self) -> list[list[Mask]]:
        hours = self.evidence.count * self.evidence.context.period_min / 60.0
        return [list(self.evidence.blocks(max(2, round(hours / length)))) for length in BLOCKS_H]

    def _grams(self, masks: Sequence[Mask]) -> list[tuple[Matrix, Vector, float, int]]:
        found = []
        for mask in masks:
            x, y = self.table[mask], self.y[mask]
            found.append((x.T @ x, x.T @ y, float(y @ y), int(mask.sum())))
        return found

    def columns_of(self, chosen: Sequence[Hypothesis]) -> Indices:
        """Return which columns a fit has: zeros and paths, then each channel's."""
        at = [np.arange(self.base)]
        for hypothesis in chosen:
            first = self.base + BANK * self.hypotheses.index(hypothesis)
            at.append(np.arange(first, first + BANK))
        return np.concatenate(at)

    def held_out(self, chosen: Sequence[Hypothesis], ridge: float = RIDGE) -> tuple[float, Vector]:
        """Return the error on held-out blocks, µm rms, and the sum of squares of each."""
        at = self.columns_of(chosen)
        cut = np.ix_(at, at)
        (gram, moment, _, count), errors, squares = self.all[0], [], []
        gram, moment = gram[cut], moment[at]
        for blocks in self.blocks:
            for g, m, yy, n in blocks:
                own, right = g[cut], m[at]
                w = _solved(gram - own, moment - right, ridge * (count - n))
                errors.append((max(float(w @ own @ w - 2.0 * w @ right + yy), 0.0), n))
            squares.append(sum(e for e, _ in errors[-len(blocks) :]) / sum(n for _, n in errors[-len(blocks) :]))
        return float(np.sqrt(np.mean(squares))), np.array([e for e, _ in errors])

    def weights(self, chosen: Sequence[Hypothesis], ridge: float, without: int | None = None) -> Vector:
        """Return the weights of the fit to all samples used, or to all but one of the shortest blocks."""
        at = self.columns_of(chosen)
        gram, moment, _, count = self.all[0]
        if without is not None:
            own, right, _, n = self.blocks[0][without]
            gram, moment, count = gram - own, moment - right, count - n
        return _solved(gram[np.ix_(at, at)], moment[at], ridge * count)

    def result(
        self, chosen: Sequence[Hypothesis], errors: tuple[float, ...], rivals: tuple[tuple[ChannelCandidate, ...], ...]
    ) -> Refit:
        """Fit to all samples used, and separate paths and channels."""
        at = self.columns_of(chosen)
        ridge = min(RIDGES, key=lambda weight: self.held_out(chosen, weight)[0])
        w = self.weights(chosen, ridge)
        gains = w / self.scale[at]
        others = [self.weights(chosen, ridge, i) / self.scale[at] for i in range(len(self.blocks[0]))]
        terms, std = [], []
        for i, hypothesis in enumerate(chosen):
            own = slice(self.base + BANK * i, self.base + BANK * (i + 1))
            terms.append(Term(hypothesis=hypothesis, values=(), amplitudes=tuple(gains[own].tolist())))
            std.append(_jackknife(terms[-1], [other[own] for other in others]))
        paths = [
            self._function(gains[first : first + BANK]) for first in range(len(self.evidence.signals), self.base, BANK)
        ]
        return Refit(
            terms=tuple(terms),
            std=tuple(std),
            dtf=paths[0],
            tdtf=paths[1] if len(paths) > 1 else None,
            predicted=self.table[:, at] @ w,
            by_paths=self.table[:, : self.base] @ self.weights([], RIDGE),
            rms_um=errors,
            rivals=rivals,
        )

    def _function(self, gains: Vector) -> SampledTransferFunction:
        """Return a filter bank as one transfer function."""
        period = self.evidence.context.period_min
        poles = np.array([Lag(tau, period).pole for tau in self.taus])
        numerator = np.zeros(poles.size + 1)
        for i, gain in enumerate(gains.tolist()):
            half = (1.0 - poles[i]) / 2.0
            numerator += gain * half * np.convolve([1.0, 1.0], np.poly(np.delete(poles, i)))
        return SampledTransferFunction(
            b=tuple(numerator.tolist()), a=tuple(np.poly(poles).tolist()), period_s=60.0 * period
        )


def _solved(gram: Matrix, moment: Vector, ridge: float) -> Vector:
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(moment.size), moment))


def _jackknife(term: Term, others: Sequence[Vector]) -> dict[str, float]:
    """Return standard errors of what a filter bank is named by, from fits that leave out one block each.

    They include the correlation of the residual in time, and not the ridge's shrinkage, which all fits share.
    """
    named = [term.hypothesis.named((), gains.tolist()) for gains in others]
    count = len(others)
    return {name: float(np.std([n[name] for n in named]) * np.sqrt(count - 1)) for name in term.named}
