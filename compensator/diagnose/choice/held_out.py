"""Errors on data that took no part: the whole search is repeated without each block, and what it finds predicts it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from compensator.arrays import Indices, Vector, rms_of
from compensator.diagnose.advice.ceiling import Ceiling
from compensator.diagnose.choice.outcome import Step
from compensator.diagnose.fitting.likelihood import rest_without_effects
from compensator.diagnose.fitting.points import Points, SlowRest
from compensator.diagnose.fitting.prediction import FOLDS, Nuisances, left_of_block, zeros_known
from compensator.diagnose.residual.evidence import Evidence
from compensator.diagnose.search.background import Background
from compensator.diagnose.search.findings import Findings, findings_of
from compensator.diagnose.search.foresight import Foresight
from compensator.diagnose.search.initial_state import as_begun
from compensator.diagnose.search.own_error import own_error_alone
from compensator.diagnose.search.scan import Grid
from compensator.display import listed
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
HELD_OUT_VALUES = f"each of {FOLDS} sets of every {FOLDS}rd value predicted after choosing and fitting on the others"
#: Added where Y was measured now and then.
BY_LIKELIHOOD = "; what is named and deployed is decided by the likelihood of all values"
#: How the errors are measured where nothing was known of the paths.
WITH_PATHS = "; before: the paths of the first model alone, also refitted to the others"

#: What the error after also has, where an effect was found that no model can have.
WITH_KINDS = "; after: also with {kinds}, which no model can have"


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """What is left on every sample by estimates that did not see it, µm; NaN where y is missing.

    All data say only how large noise, slow rest and initial states are.
    """

    nothing: Vector
    named: Vector
    whole: Vector
    ceiling: Vector
    steps: tuple[Step, ...]


def held_out_of(found: Findings, places: Sequence[Place], progress: Progress, executor_map: ExecutorMap) -> HeldOut:
    """Repeat the search without each block, and predict it by what that finds.

    Where all data name nothing and leave no remainder, nothing of what the others name would be deployed: they are not
    searched, and say only what nothing leaves, and all channels.
    """
    evidence = found.search.evidence
    blocks = list(evidence.blocks(FOLDS))
    progress(1, len(blocks) + 1)
    views = [evidence.without(block) for block in blocks]
    if evidence.has_initial_state:
        views = [view.with_initial_state(None) for view in views]  # all data say what it was; each view does by itself
    rests = found.selection.fit.rest, found.selection.before.rest
    predictions = partial(_of_channels, rests=rests)
    if found.terms or found.remainder is not None or evidence.free_paths:
        hidden = [not term.effect.observed for term in found.terms]
        predictions = partial(
            _predictions,
            places=places,
            own_alone=found.is_own_error_alone,
            unobserved=any(hidden) and not all(hidden),
            # Another process computes the columns sooner than it gets them.
            grid=found.search.grid if executor_map is map and not evidence.has_initial_state else None,
            foresight=found.foresight,
            begins_warm=evidence.has_initial_state,
            leaves_late=found.left_in is not None,
            rests=rests,
        )
    predicted = executor_map(predictions, views)
    left = {name: np.full(evidence.used.size, np.nan) for name in (*_PREDICTED, *places)}
    searches = np.zeros(len(places), dtype=int)
    for done, (block, several) in enumerate(zip(blocks, predicted, strict=True), start=2):
        progress(done, len(blocks) + 1)
        searches += several.has
        for name, one in several.predicted.items():
            left[name][block] = left_of_block(evidence, block, several.knows_zero, one)
    # Nothing is given the better of both: a rest without effects may be that of the effects, and go anywhere.
    return HeldOut(
        nothing=min((left[rest] for rest in _RESTS), key=rms_of),
        named=left["named"],
        whole=left["whole"],
        ceiling=left["ceiling"],
        steps=tuple(
            Step(place=place, rms_um=rms_of(left[place]), searches=count)
            for place, count in zip(places, searches.tolist(), strict=True)
        ),
    )


#: Nothing, with the rest of a search without effects and with that beside them.
_RESTS = ("nothing, without effects", "nothing, beside effects")
_PREDICTED = (*_RESTS, "named", "whole", "ceiling")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Predictions:
    """What a search in a part of the evidence predicts on every sample of all.

    Parameters
    ----------
    predicted : dict of str or Place to numpy.ndarray, shape (n,)
        By the names of `_PREDICTED`, µm, each with the zeros and initial states that are most probable beside it:
        nothing, with each rest; with the rest beside effects also the named effects, effects and remainder, and all
        channels. By each place what its effect and those of the places before it add.
    knows_zero : tuple of bool
        For each zero whether it knows it.
    has : numpy.ndarray of int, shape (places,)
        1 where it found an effect of that place.
    """

    predicted: dict[str | Place, Vector]
    knows_zero: tuple[bool, ...]
    has: Indices


def _predictions(
    seen: Evidence,
    *,
    places: Sequence[Place],
    own_alone: bool,
    unobserved: bool,
    grid: Grid | None,
    foresight: Foresight | None,
    begins_warm: bool,
    leaves_late: bool,
    rests: tuple[SlowRest, SlowRest],
) -> _Predictions:
    search = partial(findings_of, unobserved=unobserved, grid=grid, foresight=foresight, leaves_late=leaves_late)
    found = as_begun(search(seen), search) if begins_warm else search(seen)
    added: dict[str | Place, Vector] = {}
    total = found.own_paths
    for place in places:
        total = sum(
            (r for t, r in zip(found.terms, found.responses, strict=True) if t.hypothesis.place == place), total
        )
        added[place] = total
    has = np.array([any(term.hypothesis.place == place for term in found.terms) for place in places], dtype=int)
    # An own error alone and one beside effects say nothing of each other.
    whole = found.named if found.is_own_error_alone else found.whole
    if own_alone:
        own = found.remainder if found.is_own_error_alone else None
        whole = (own or own_error_alone(found.selection.before)).added
    added |= {"named": found.named, "whole": whole, "ceiling": found.ceiling}
    return _completed(found.search.points, added, found.paths, has, rests)


def _of_channels(seen: Evidence, *, rests: tuple[SlowRest, SlowRest]) -> _Predictions:
    """Return the predictions of a part of the evidence by nothing and by all channels."""
    points = Points(seen)
    channels = Background(seen).fitted(points, np.zeros(points.count), rest_without_effects(points)).added
    nothing = np.zeros(channels.size)
    added: dict[str | Place, Vector] = {"named": nothing, "whole": nothing, "ceiling": channels}
    return _completed(points, added, nothing, np.zeros(0, dtype=int), rests)


def _completed(
    points: Points, added: dict[str | Place, Vector], paths: Vector, has: Indices, rests: tuple[SlowRest, SlowRest]
) -> _Predictions:
    """Return predictions with the most probable zeros and initial states beside what is added, and beside nothing."""
    beside, alone = (Nuisances(points, rest).beside for rest in rests)
    predicted = {name: beside(one) for name, one in added.items()}
    predicted |= {rest: completed(paths) for rest, completed in zip(_RESTS, (alone, beside), strict=True)}
    return _Predictions(predicted=predicted, knows_zero=zeros_known(points), has=has)


def ceiling_of(held_out: HeldOut) -> Ceiling | None:
    """Return what all channels could explain, how much of that the named effects do, and the smallest error of all."""
    before, after, linear = (rms_of(values) ** 2 for values in (held_out.nothing, held_out.named, held_out.ceiling))
    if linear >= before:
        return None
    return Ceiling(
        rms_um=float(np.sqrt(linear)),
        explained_pct=float(np.clip((before - after) / (before - linear), 0, 1)) * 100,
        least_rms_um=float(np.sqrt(min(linear, after, rms_of(held_out.whole) ** 2))),
    )


def how_held_out(evidence: Evidence, beside: Sequence[str] = ()) -> str:
    """Return how the errors are measured; `beside`: kinds that no model can have, and that count as explained."""
    count = len(list(evidence.blocks(FOLDS)))
    words = HELD_OUT_VALUES if evidence.is_sparse else HELD_OUT
    if evidence.holds_out_recordings:
        words = HELD_OUT_RECORDINGS.format(count=count)
    words += BY_LIKELIHOOD * evidence.is_sparse + WITH_PATHS * evidence.free_paths
    return words + (WITH_KINDS.format(kinds=listed(list(beside))) if beside else "")
