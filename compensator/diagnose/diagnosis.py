"""From a model and measured runs to a verdict, the effects that the model lacks, and the model with them.

The error before and after is measured on held-out blocks of time: for each block the whole search is repeated without
it, and what that finds is applied to the block.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from compensator.arrays import Vector
from compensator.codes import ModelWarning, Remark
from compensator.data.runs import Run
from compensator.diagnose.base_refit import FAR_OFF, BaseRefit, is_far_off
from compensator.diagnose.estimate import Estimate
from compensator.diagnose.evidence import Evidence, evidence_of
from compensator.diagnose.outcome import FOLDS, Diagnosis, FoundEffect, Verdict, rms_of, warnings_of
from compensator.diagnose.residual_search import ResidualSearch
from compensator.model.thermal_model import ThermalModel
from compensator.progress import ExecutorMap, Progress, unreported

#: A base refit replaces a search's answer where it leaves no more than this share.
REFIT_LEAVES = 0.5


def diagnose(
    model: ThermalModel, runs: Sequence[Run], *, progress: Progress = unreported, executor_map: ExecutorMap = map
) -> Diagnosis:
    """Find what a model lacks.

    Parameters
    ----------
    model : ThermalModel
        The base model.
    runs : sequence of Run
        Measured data with y and every channel that was logged.
    progress : callable
        Called with how many searches of how many are done.
    executor_map : callable
        Does the searches for the held-out blocks: `map`, or that of an executor.

    Raises
    ------
    DataError
        If there is too little data.
    """
    evidence = evidence_of(model, runs)
    progress(0, FOLDS + 1)
    if is_far_off(model, evidence):
        return _diagnosed(model, BaseRefit(evidence), progress, executor_map)
    searched = _diagnosed(model, ResidualSearch(evidence), progress, executor_map)
    if not _doubtful(searched, evidence):
        return searched
    # What was found in the residual holds nowhere else, or nothing was: perhaps the paths themselves are bent.
    refitted = _diagnosed(model, BaseRefit(evidence), progress, executor_map)
    better = rms_of(refitted.held_out_after) < REFIT_LEAVES * rms_of(searched.held_out_before)
    return refitted if refitted.effects and better else searched


def _doubtful(searched: Diagnosis, evidence: Evidence) -> bool:
    """Return whether the search did not help although much is left."""
    if rms_of(searched.held_out_after) > rms_of(searched.held_out_before):
        return True
    return searched.verdict == "unexplained" and rms_of(searched.held_out_before) > FAR_OFF * evidence.spread_um


def _diagnosed(model: ThermalModel, estimate: Estimate, progress: Progress, executor_map: ExecutorMap) -> Diagnosis:
    """Return the diagnosis of an estimate, checked on held-out blocks."""
    evidence = estimate.evidence
    before, after = _held_out(estimate, progress, executor_map)
    errors = rms_of(before), rms_of(after)
    effects = tuple(effect for effect in estimate.effects if not effect.term.companion)
    # A companion is of no use where the effect itself cannot be deployed.
    helps = any(effect.deployable for effect in effects) and errors[1] <= errors[0]
    deployed = [effect for effect in estimate.effects if effect.deployable] if helps else []
    extended, remarks = estimate.extended(model, deployed, errors[1]) if deployed else (model, ())
    return Diagnosis(
        verdict=_verdict(estimate.effects, is_explained=estimate.is_explained(*errors)),
        effects=effects,
        held_out=estimate.held_out,
        model=extended,
        evidence=evidence,
        residual_before=np.where(evidence.used, estimate.residual_before, np.nan),
        residual_after=np.where(evidence.used, estimate.residual_after, np.nan),
        held_out_before=before,
        held_out_after=after,
        tried=estimate.tried,
        warnings=(*remarks, *warnings_of(effects, before, after), *_companions(estimate.effects)),
    )


def _held_out(estimate: Estimate, progress: Progress, executor_map: ExecutorMap) -> tuple[Vector, Vector]:
    """Return the residual before and after on every sample, each block by an estimate that did not see it.

    Of several choices of nuisances, the one that leaves less before.
    """
    evidence = estimate.evidence
    progress(1, FOLDS + 1)
    blocks = list(evidence.blocks(FOLDS))
    views = [evidence.without(block) for block in blocks]
    before, after = (defaultdict[int, Vector](lambda: np.full(evidence.used.size, np.nan)) for _ in range(2))
    predictions = estimate.predictions(views, executor_map)
    for done, (block, seen, predicted) in enumerate(zip(blocks, views, predictions, strict=True), start=2):
        progress(done, FOLDS + 1)
        for residuals, one in zip((before, after), predicted, strict=True):
            for choice, residual in enumerate(estimate.left(seen, one)):
                residuals[choice][block] = residual[block]
    best = min(before, key=lambda choice: rms_of(before[choice]))
    return before[best], after[best]


def _companions(everything: Sequence[FoundEffect]) -> tuple[Remark, ...]:
    """Return a warning for each effect that is deployed without being named."""
    return tuple(
        Remark(
            ModelWarning.ROUNDED_OFF,
            "What the effect leaves is absorbed by a filter bank on heat and ambient "
            f"({float(np.std(e.signal)):.2g} µm rms), an effect of kind {e.place[0]} in model.toml.",
        )
        for e in everything
        if e.term.companion
    )


def _verdict(everything: Sequence[FoundEffect], *, is_explained: bool) -> Verdict:
    observed = [found.effect.observed for found in everything]
    if not observed:
        return "adequate" if is_explained else "unexplained"
    if not any(observed):
        return "unexplained"
    return "explained" if is_explained and all(observed) else "partly_explained"
