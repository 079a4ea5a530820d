"""From a model and measured runs to a verdict, the effects that the model lacks, and the model with them.

The error before and after is measured on held-out blocks of time: for each block the whole search is repeated without
it, and what that finds is applied to the block.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from itertools import repeat

import numpy as np

from compensator.arrays import Vector
from compensator.data.runs import Run
from compensator.diagnose.base_refit import FAR_OFF, diagnose_by_refit, is_far_off
from compensator.diagnose.evidence import Evidence, evidence_of
from compensator.diagnose.fit import response, standard_errors, summed
from compensator.diagnose.outcome import (
    FOLDS,
    HELD_OUT,
    Diagnosis,
    FoundEffect,
    Verdict,
    described,
    rivals_of,
    rms_of,
    warnings_of,
)
from compensator.diagnose.search import Search, Selection
from compensator.model.thermal_model import ThermalModel
from compensator.progress import ExecutorMap, Progress, unreported
from compensator.reasons import Remark

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
        return diagnose_by_refit(model, evidence, progress, executor_map)
    searched = _by_search(model, evidence, progress, executor_map)
    if not _doubtful(searched, evidence):
        return searched
    # What was found in the residual holds nowhere else, or nothing was: perhaps the paths themselves are bent.
    refitted = diagnose_by_refit(model, evidence, progress, executor_map)
    better = rms_of(refitted.held_out_after) < REFIT_LEAVES * rms_of(searched.held_out_before)
    return refitted if refitted.effects and better else searched


def _doubtful(searched: Diagnosis, evidence: Evidence) -> bool:
    """Tell whether the search did not help although much is left."""
    if rms_of(searched.held_out_after) > rms_of(searched.held_out_before):
        return True
    return searched.verdict == "unexplained" and rms_of(searched.held_out_before) > FAR_OFF * evidence.spread_um


def _by_search(model: ThermalModel, evidence: Evidence, progress: Progress, executor_map: ExecutorMap) -> Diagnosis:
    found = Search(evidence).run()
    before, after = _held_out(evidence, found, progress, executor_map)
    helps = rms_of(after) <= rms_of(before)
    everything = _effects(evidence, found)
    effects = tuple(effect for effect in everything if not effect.term.companion)
    # A companion is of no use where the effect itself cannot be deployed.
    deployed = [e for e in everything if e.deployable] if any(e.deployable for e in effects) and helps else []
    extended = dataclasses.replace(model, effects=(*model.effects, *(e.effect for e in deployed)), sha256="")
    if deployed:
        kept_out = [e.signal[evidence.used] for e in everything if not e.deployable]
        stated = _stated(model, rms_of(after), evidence.noise.noise_um, kept_out)
        extended = dataclasses.replace(extended, y_std_um=stated)
    return Diagnosis(
        verdict=_verdict(evidence, found, helps=helps),
        effects=effects,
        held_out=HELD_OUT,
        model=extended,
        evidence=evidence,
        residual_before=np.where(evidence.used, found.before.residual, np.nan),
        residual_after=np.where(evidence.used, found.fit.residual, np.nan),
        held_out_before=before,
        held_out_after=after,
        tried=_tried(found, evidence),
        warnings=(*warnings_of(effects, before, after), *_companions(everything)),
    )


# ---------------------------------------------------------------------------- held out


def _held_out(
    evidence: Evidence, found: Selection, progress: Progress, executor_map: ExecutorMap
) -> tuple[Vector, Vector]:
    """Return the residual before and after on every sample, each block by a search that did not see it.

    Only the zero of each run is taken as unknown, or its initial state too: whichever leaves less before.
    """
    raw, nothing = evidence.residual, np.zeros(evidence.used.size)
    observed = [term.hypothesis.effect.observed for term in found.fit.terms]
    before = {rest: np.full(raw.size, np.nan) for rest in (True, False)}
    after = {rest: np.full(raw.size, np.nan) for rest in (True, False)}
    progress(1, FOLDS + 1)
    blocks = list(evidence.blocks(FOLDS))
    views = [evidence.without(block) for block in blocks]
    # What an unobserved source does in a held-out block is not known.
    unknown = bool(observed) and not any(observed)
    search = partial(_found_in, unobserved=not all(observed))
    found_without = repeat(nothing) if unknown else executor_map(search, views)
    for done, (block, seen, effects) in enumerate(zip(blocks, views, found_without, strict=False), start=2):
        progress(done, FOLDS + 1)
        for rest in (True, False):
            before[rest][block] = seen.left(raw, nothing, at_rest=rest)[block]
            after[rest][block] = seen.left(raw, effects, at_rest=rest)[block]
    best = min((True, False), key=lambda rest: rms_of(before[rest]))
    return before[best], after[best]


def _found_in(seen: Evidence, *, unobserved: bool) -> Vector:
    """Search in a part of the data; return what is found there on every sample of all, µm."""
    return summed(seen, Search(seen).run(unobserved=unobserved).fit.terms)


# ---------------------------------------------------------------------------- what was found


def _effects(evidence: Evidence, found: Selection) -> tuple[FoundEffect, ...]:
    fit, count = found.fit, evidence.count
    errors = standard_errors(evidence, fit, found.variance_inflation)
    after = float(np.sqrt(fit.cost / count))
    effects = []
    for i, (term, std) in enumerate(zip(fit.terms, errors, strict=True)):
        signal = response(evidence, term)
        without = fit.residual + evidence.without_nuisances(np.where(evidence.used, signal, 0.0))
        others = ((c.term, float(np.sqrt(c.fit.cost / count))) for c in found.rivals[i])
        effects.append(
            FoundEffect(
                term=term,
                effect=described(term, std, signal[evidence.used]),
                rms_before_um=float(np.sqrt(without @ without / count)),
                rms_after_um=after,
                signal=signal,
                rivals=rivals_of(term, others, after),
            )
        )
    return tuple(sorted(effects, key=lambda e: -e.rms_before_um))


def _stated(model: ThermalModel, after_um: float, noise_um: float, kept_out: Sequence[Vector]) -> float:
    """Return the standard deviation that an extended model states, µm: what it leaves where nothing was fitted.

    Without it, a service would go on to publish that of the calibration, on a machine without the effect. What was
    found and cannot be deployed (`kept_out`) goes on acting.
    """
    left = max(after_um**2 - noise_um**2, 0.0) + (float(np.var(np.sum(kept_out, axis=0))) if kept_out else 0.0)
    return max(model.y_std_um, float(np.sqrt(left)))


def _companions(everything: Sequence[FoundEffect]) -> tuple[Remark, ...]:
    """Return a warning for each effect that is deployed without being named."""
    return tuple(
        Remark(
            "rounded_off",
            "What the effect leaves is absorbed by a filter bank on heat and ambient "
            f"({float(np.std(e.signal)):.2g} µm rms), an effect of kind {e.place[0]} in model.toml.",
        )
        for e in everything
        if e.term.companion
    )


def _tried(found: Selection, evidence: Evidence) -> tuple[tuple[str, float], ...]:
    if not found.rivals:
        return ()
    best: dict[str, float] = {}
    for candidate in found.rivals[0]:
        label, rms = candidate.term.hypothesis.label, float(np.sqrt(candidate.fit.cost / evidence.count))
        best[label] = min(rms, best.get(label, np.inf))
    return tuple(sorted(best.items(), key=lambda item: item[1]))


def _verdict(evidence: Evidence, found: Selection, *, helps: bool) -> Verdict:
    """Return how far the residual is explained; what does not hold on held-out data explains part at most."""
    observed = [term.hypothesis.effect.observed for term in found.fit.terms]
    clean = evidence.noise.is_explained(found.fit.cost)
    if not observed:
        return "adequate" if clean else "unexplained"
    if not any(observed):
        return "unexplained"
    return "explained" if clean and helps and all(observed) else "partly_explained"
