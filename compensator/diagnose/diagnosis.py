"""From a model and measured runs to a verdict, the effects that the model lacks, and the model with them.

The error before and after is measured on blocks of time that took no part: for each block the whole search is done
again without it, and what that finds is applied to the block.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from itertools import repeat

import numpy as np

from compensator.arrays import Vector
from compensator.data.runs import Run
from compensator.diagnose.base_refit import FAR_OFF, diagnose_anew, is_far_off
from compensator.diagnose.evidence import Evidence, evidence_of
from compensator.diagnose.joint import Part, response, standard_errors, summed
from compensator.diagnose.outcome import (
    FOLDS,
    HELD_OUT,
    NOISE_TIMES,
    RIVAL_TIMES,
    Diagnosis,
    Effect,
    Rival,
    Verdict,
    how_to_tell_apart,
    rms_of,
    table_of,
    warnings_of,
)
from compensator.diagnose.search import Found, Search, Tried
from compensator.model.effects.unobserved import Unobserved
from compensator.model.simulation import scores
from compensator.model.thermal_model import ThermalModel
from compensator.progress import ExecutorMap, Progress, unreported
from compensator.reasons import Remark

#: A model whose paths were fitted anew is taken instead of a search's answer where it leaves no more than this share.
ANEW_LEAVES = 0.5


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
        return diagnose_anew(model, evidence, progress, executor_map)
    searched = _by_search(model, evidence, progress, executor_map)
    if not _doubtful(searched, evidence):
        return searched
    # What was found in the residual holds nowhere else, or nothing was: perhaps the paths themselves are bent.
    anew = diagnose_anew(model, evidence, progress, executor_map)
    better = rms_of(anew.held_out_after) < ANEW_LEAVES * rms_of(searched.held_out_before)
    return anew if anew.effects and better else searched


def _doubtful(searched: Diagnosis, evidence: Evidence) -> bool:
    """Tell whether what the search says is of no use although much is left."""
    if rms_of(searched.held_out_after) > rms_of(searched.held_out_before):
        return True
    return searched.verdict == "unexplained" and rms_of(searched.held_out_before) > FAR_OFF * evidence.spread_um


def _by_search(model: ThermalModel, evidence: Evidence, progress: Progress, executor_map: ExecutorMap) -> Diagnosis:
    found = Search(evidence).run()
    before, after = _held_out(evidence, found, progress, executor_map)
    helps = rms_of(after) <= rms_of(before)
    everything = _effects(evidence, found)
    effects = tuple(effect for effect in everything if not effect.part.companion)
    # What rounds off an effect is of no use where the effect itself cannot be deployed.
    deployed = [e for e in everything if e.deployable] if any(e.deployable for e in effects) and helps else []
    extended = dataclasses.replace(model, effects=(*model.effects, *map(table_of, deployed)), sha256="")
    if deployed:
        kept_out = [e.wave[evidence.used] for e in everything if not e.deployable]
        extended = dataclasses.replace(extended, y_std_um=_stated(model, rms_of(after), evidence.noise_um, kept_out))
    y = evidence.y_um
    return Diagnosis(
        verdict=_verdict(evidence, found, helps=helps),
        effects=effects,
        before=scores(y, y - before),
        after=scores(y, y - after),
        held_out=HELD_OUT,
        noise_floor_um=evidence.noise_um,
        model=extended,
        evidence=evidence,
        residual_before=np.where(evidence.used, found.before.residual, np.nan),
        residual_after=np.where(evidence.used, found.joint.residual, np.nan),
        held_out_before=before,
        held_out_after=after,
        tried=_tried(found, evidence),
        warnings=(*warnings_of(effects, before, after), *_rounded(everything)),
    )


# ---------------------------------------------------------------------------- held out


def _held_out(evidence: Evidence, found: Found, progress: Progress, executor_map: ExecutorMap) -> tuple[Vector, Vector]:
    """Return the residual before and after on every block, each by a search that did not see it.

    Whether a run's initial state is taken as unknown or as rest is what serves the first model better.
    """
    raw, nothing = evidence.residual, np.zeros(evidence.used.size)
    hidden = [isinstance(part.hypothesis, Unobserved) for part in found.joint.parts]
    before = {rest: np.full(raw.size, np.nan) for rest in (True, False)}
    after = {rest: np.full(raw.size, np.nan) for rest in (True, False)}
    progress(1, FOLDS + 1)
    blocks = list(evidence.blocks(FOLDS))
    views = [evidence.hidden(block) for block in blocks]
    # Nobody knows what a hidden source does in a block that was not seen.
    unknown = bool(hidden) and all(hidden)
    found_without = repeat(nothing) if unknown else executor_map(partial(_found_in, hidden=any(hidden)), views)
    for done, (block, seen, effects) in enumerate(zip(blocks, views, found_without, strict=False), start=2):
        progress(done, FOLDS + 1)
        for rest in (True, False):
            before[rest][block] = seen.left(raw, nothing, at_rest=rest)[block]
            after[rest][block] = seen.left(raw, effects, at_rest=rest)[block]
    best = min((True, False), key=lambda rest: rms_of(before[rest]))
    return before[best], after[best]


def _found_in(seen: Evidence, *, hidden: bool) -> Vector:
    """Search in a part of the data; return what is found there on every sample of all, µm."""
    return summed(seen, Search(seen).run(hidden=hidden).joint)


# ---------------------------------------------------------------------------- what was found


def _effects(evidence: Evidence, found: Found) -> tuple[Effect, ...]:
    joint = found.joint
    errors = standard_errors(evidence, joint, found.colour)
    count = evidence.count
    after = float(np.sqrt(joint.cost / count))
    effects = []
    for i, (part, std) in enumerate(zip(joint.parts, errors, strict=True)):
        wave = response(evidence, part)
        masked = np.where(evidence.used, wave, 0.0)
        without = joint.residual + evidence.without_nuisances(masked)
        rms = float(np.std(wave[evidence.used]))
        effects.append(
            Effect(
                part=part,
                std=std,
                explanation=part.hypothesis.explain(part.named, rms),
                rms_before_um=float(np.sqrt(without @ without / count)),
                rms_after_um=after,
                wave=wave,
                rivals=_rivals(found.rivals[i], part, after, count),
            )
        )
    return tuple(sorted(effects, key=lambda e: -e.rms_before_um))


def _stated(model: ThermalModel, after_um: float, noise_um: float, kept_out: Sequence[Vector]) -> float:
    """Return the standard deviation that an extended model states, µm: what it leaves where nothing was fitted.

    Without it, a service would go on to publish the calibration's own, of a machine on which the effect did not act.
    What was found and cannot be deployed (`kept_out`) goes on acting.
    """
    left = max(after_um**2 - noise_um**2, 0.0) + (float(np.var(np.sum(kept_out, axis=0))) if kept_out else 0.0)
    return max(model.y_std_um, float(np.sqrt(left)))


def _rounded(everything: Sequence[Effect]) -> tuple[Remark, ...]:
    """Say that something unnamed is deployed beside what is named."""
    return tuple(
        Remark(
            "rounded_off",
            "What the effect leaves is rounded off by a row of lags on heat and ambient "
            f"({float(np.std(e.wave)):.2g} µm rms), an effect of the kind dynamics in model.toml.",
        )
        for e in everything
        if e.part.companion
    )


def _rivals(others: Sequence[Tried], part: Part, after: float, count: int) -> tuple[Rival, ...]:
    rivals: list[Rival] = []
    seen = {part.hypothesis.place}
    for other in others:
        rms = float(np.sqrt(other.joint.cost / count))
        place = other.part.hypothesis.place
        if place in seen or rms > RIVAL_TIMES * after:
            continue
        seen.add(place)
        rivals.append(Rival(part=other.part, rms_after_um=rms, how_to_tell_apart=how_to_tell_apart(part, other.part)))
    return tuple(rivals[:3])


def _tried(found: Found, evidence: Evidence) -> tuple[tuple[str, float], ...]:
    if not found.rivals:
        return ()
    best: dict[str, float] = {}
    for tried in found.rivals[0]:
        hypothesis = tried.part.hypothesis
        name = " ".join(word for word in (*hypothesis.place, f"({hypothesis.form})" if hypothesis.form else "") if word)
        rms = float(np.sqrt(tried.joint.cost / evidence.count))
        best[name] = min(rms, best.get(name, np.inf))
    return tuple(sorted(best.items(), key=lambda item: item[1]))


def _verdict(evidence: Evidence, found: Found, *, helps: bool) -> Verdict:
    """Say how far the residual is explained; what does not hold on data that was not seen explains part at most."""
    parts = found.joint.parts
    clean = found.joint.cost < NOISE_TIMES**2 * (evidence.count * evidence.noise_um**2 + evidence.allowance)
    if not parts:
        return "adequate" if clean else "unexplained"
    hidden = [isinstance(part.hypothesis, Unobserved) for part in parts]
    if all(hidden):
        return "unexplained"
    return "explained" if clean and helps and not any(hidden) else "partly_explained"
