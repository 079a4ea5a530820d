"""Errors on data that took no part: the whole search is repeated without each block, and what it finds predicts it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from compensator.arrays import Indices, Vector
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.findings import Findings, by_base, findings_of, not_deployed
from compensator.diagnose.foresight import Foresight
from compensator.diagnose.outcome import FOLDS, Step, rms_of
from compensator.diagnose.own_error import own_error_alone
from compensator.diagnose.scan import Grid
from compensator.model.effects.hypothesis import Place
from compensator.progress import ExecutorMap, Progress

#: How it is described.
HELD_OUT = (
    f"each of {FOLDS} blocks of time predicted after choosing and fitting on the others; zero and initial state also "
    "from the others"
)
HELD_OUT_RECORDINGS = (
    "each of {count} recordings or groups of them predicted after choosing and fitting on the others; its zero is its "
    "own mean"
)
HELD_OUT_VALUES = (
    f"each of {FOLDS} sets of every {FOLDS}rd value predicted after choosing and fitting on the others; what is named "
    "and deployed is decided by the likelihood of all values"
)
#: How the errors are measured where nothing was known of the paths.
WITH_PATHS = "; before: the paths of the first model alone, also refitted to the others"


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """What is left on every sample by estimates that did not see it, µm; NaN where y is missing.

    `base` is left by the base's paths as they are, of which the other blocks set the zero and initial state only;
    `places` by effects of the places that were found in all data, and nothing else that a search named.
    """

    base: Vector
    nothing: Vector
    named: Vector
    places: Vector
    whole: Vector
    ceiling: Vector
    steps: tuple[Step, ...]


def held_out_of(found: Findings, places: Sequence[Place], progress: Progress, executor_map: ExecutorMap) -> HeldOut:
    """Repeat the search without each block; of two choices of nuisances, that which leaves less before."""
    evidence = found.search.evidence
    blocks = list(evidence.blocks(FOLDS))
    progress(1, len(blocks) + 1)
    views = [evidence.without(block) for block in blocks]
    hidden = [not term.effect.observed for term in found.terms]
    unobserved = any(hidden) and not all(hidden)
    # Another process computes the columns sooner than it gets them.
    grid = found.search.grid if executor_map is map else None
    predicted = executor_map(
        partial(
            _predictions,
            places=places,
            own_alone=found.is_own_error_alone,
            unobserved=unobserved,
            grid=grid,
            foresight=found.foresight,
        ),
        views,
    )
    base = by_base(evidence) + not_deployed(found)[1]
    left = np.full((2, 5 + len(places), evidence.used.size), np.nan)
    searches = np.zeros(len(places), dtype=int)
    for done, (block, seen, several) in enumerate(zip(blocks, views, predicted, strict=True), start=2):
        progress(done, len(blocks) + 1)
        searches += several.has
        for choice in (0, 1):
            for i, one in enumerate((base, *several.added)):
                left[choice, i, block] = seen.left(evidence.residual, one, at_rest=choice == 0)[block]
    best = min((0, 1), key=lambda choice: rms_of(left[choice, 1]))
    base, nothing, named, whole, ceiling, *steps = left[best]
    return HeldOut(
        base=base,
        nothing=nothing,
        named=named,
        places=steps[-1] if steps else named,
        whole=whole,
        ceiling=ceiling,
        steps=tuple(Step(rms_um=rms_of(s), searches=n) for s, n in zip(steps, searches.tolist(), strict=True)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Predictions:
    """What a search in a part of the evidence predicts on every sample of all.

    Parameters
    ----------
    added : tuple of numpy.ndarray, shape (n,)
        Of nothing, the named effects, effects and remainder, all channels; of the first place, the first two, …, µm.
    has : numpy.ndarray of int, shape (places,)
        1 where it found an effect of that place.
    """

    added: tuple[Vector, ...]
    has: Indices


def _predictions(
    seen: Evidence,
    *,
    places: Sequence[Place],
    own_alone: bool,
    unobserved: bool,
    grid: Grid | None,
    foresight: Foresight | None,
) -> _Predictions:
    found = findings_of(seen, unobserved=unobserved, grid=grid, foresight=foresight)
    steps, total = [], found.own_paths
    for place in places:
        total = sum(
            (r for t, r in zip(found.terms, found.responses, strict=True) if t.hypothesis.place == place), total
        )
        steps.append(total)
    has = np.array([any(term.hypothesis.place == place for term in found.terms) for place in places], dtype=int)
    # An own error alone and one beside effects say nothing of each other.
    whole = found.named if found.is_own_error_alone else found.whole
    if own_alone:
        own = found.remainder if found.is_own_error_alone else None
        whole = (own or own_error_alone(found.selection.before)).added
    return _Predictions(added=(found.paths, found.named, whole, found.ceiling, *steps), has=has)


def how_held_out(evidence: Evidence) -> str:
    """Return how the errors are measured."""
    count = len(list(evidence.blocks(FOLDS)))
    words = HELD_OUT_VALUES if evidence.is_sparse else HELD_OUT
    if evidence.holds_out_recordings:
        words = HELD_OUT_RECORDINGS.format(count=count)
    return words + WITH_PATHS * evidence.free_paths
