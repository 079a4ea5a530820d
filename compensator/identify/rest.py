"""Whether a run starts at rest: a known zero is worth more than a fitted one, where it is true."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from compensator.identify.choice import held_out_errors, no_worse
from compensator.identify.output_error import Segment, Structure


def settle_starts(segments: Sequence[Segment], structure: Structure, period_s: float, folds: int) -> list[Segment]:
    """Mark every segment that the data does not contradict to have started at rest.

    Segment by segment, a start from rest is kept where the free-run error on held-out folds is not worse with it
    than with a fitted initial state by more than one standard error. A test of significance would not do: with
    little noise it rejects every start for what the structure cannot follow elsewhere.

    Parameters
    ----------
    segments : sequence of Segment
        What will be fitted.
    structure : Structure
        What it will be fitted with.
    period_s : float
        Sample period, s.
    folds : int
        Number of blocks.

    Returns
    -------
    list of Segment
        The same data, `rest` set where it holds.
    """

    def errors(trial: Sequence[Segment]) -> list[float]:
        return [float(np.sqrt(np.mean(e**2))) for e in held_out_errors(trial, structure, period_s, folds)]

    kept = [dataclasses.replace(segment, rest=False) for segment in segments]
    free = errors(kept)
    for i, segment in enumerate(kept):
        trial = [*kept[:i], dataclasses.replace(segment, rest=True), *kept[i + 1 :]]
        fixed = errors(trial)
        if no_worse(fixed, free):
            kept, free = trial, fixed
    return kept
