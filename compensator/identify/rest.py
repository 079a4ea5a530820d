"""Determines whether a run starts at rest: a known initial state, if correct, is better than a fitted one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import compress

from compensator.identify.choice import FitWithFolds, fit_with_folds, no_worse
from compensator.identify.output_error import Segment, Structure


def settle_starts(
    segments: Sequence[Segment], structure: Structure, period_s: float, folds: int
) -> tuple[list[Segment], FitWithFolds]:
    """Mark the segments whose start from rest the data do not contradict.

    Segment by segment, a start from rest is kept if it increases the free-run error on held-out blocks over that of a
    fitted initial state by at most one standard error. A significance test is not suitable: at low noise it rejects
    every start because of errors of the structure elsewhere.

    Parameters
    ----------
    segments : sequence of Segment
        Data.
    structure : Structure
        Orders of the fit.
    period_s : float
        Sample period, s.
    folds : int
        Number of blocks.

    Returns
    -------
    list of Segment
        The same data, with `rest` set for these segments.
    FitWithFolds
        The structure on them.
    """
    kept = [dataclasses.replace(segment, rest=False) for segment in segments]
    free = fit_with_folds(kept, structure, period_s, folds)
    for i, segment in enumerate(kept):
        trial = [*kept[:i], dataclasses.replace(segment, rest=True), *kept[i + 1 :]]
        fixed = fit_with_folds(trial, structure, period_s, folds)
        # A block that hides how it began says nothing of that.
        judges = [each[i] for each in free.sees_start]
        fixed_rms, free_rms = (list(compress(one.fold_rms, judges)) for one in (fixed, free))
        if not fixed_rms or no_worse(fixed_rms, free_rms):
            kept, free = trial, fixed
    return kept, free
