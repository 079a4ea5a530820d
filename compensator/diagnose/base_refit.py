"""The diagnosis of a base model that is far off: its paths are fitted anew beside the channels that it lacks.

Held-out errors as everywhere: for each block of time the whole choice is made again without it. The error before is
that of the paths alone, fitted anew without the block too: the first model may have seen it in its calibration.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.joint import Part, response
from compensator.diagnose.outcome import (
    FOLDS,
    HELD_OUT,
    NOISE_TIMES,
    RIVAL_TIMES,
    Diagnosis,
    Effect,
    Rival,
    how_to_tell_apart,
    rms_of,
    table_of,
    warnings_of,
)
from compensator.diagnose.refit import Refit, Tried, refit
from compensator.model.simulation import scores
from compensator.model.thermal_model import Path, ThermalModel
from compensator.progress import ExecutorMap, Progress
from compensator.reasons import Remark

#: A base whose own calibration left more than this share of the deformation's spread lacks something.
FAR_OFF = 0.1


def is_far_off(model: ThermalModel, evidence: Evidence) -> bool:
    """Tell whether the calibration itself says that the model misses much of the deformation."""
    return model.held_out_rms_um is not None and model.held_out_rms_um > FAR_OFF * evidence.spread_um


def diagnose_anew(model: ThermalModel, evidence: Evidence, progress: Progress, executor_map: ExecutorMap) -> Diagnosis:
    """Fit the base anew with the channels that it lacks, and say what that is worth on held-out blocks.

    Parameters
    ----------
    model : ThermalModel
        The base model.
    evidence : Evidence
        Its residual and signals.
    progress : callable
        Called with how many blocks of how many are done.
    executor_map : callable
        Does the fits without a block: `map`, or that of an executor.
    """
    y, open_ = evidence.y_um, evidence.deformation_um
    whole = refit(evidence)
    before, after = _held_out(evidence, progress, executor_map)
    effects = _effects(evidence, whole)
    helps = bool(effects) and rms_of(after) <= rms_of(before)
    left = np.where(evidence.used, open_ - whole.predicted, np.nan)
    bare = np.where(evidence.used, open_ - whole.by_paths, np.nan)
    clean = rms_of(after) < NOISE_TIMES * evidence.noise_um
    return Diagnosis(
        verdict="unexplained" if not effects else "explained" if clean else "partly_explained",
        effects=effects,
        before=scores(y, y - before),
        after=scores(y, y - (after if effects else before)),
        held_out=f"{HELD_OUT}; before: the first model's paths alone, fitted anew to the others",
        noise_floor_um=evidence.noise_um,
        model=_extended(model, whole, effects) if helps else model,
        evidence=evidence,
        residual_before=bare,
        residual_after=left if effects else bare,
        held_out_before=before,
        held_out_after=after if effects else before,
        tried=_tried(whole),
        warnings=(*_words(model, whole, helps), *warnings_of(effects, before, after)),
    )


def _held_out(evidence: Evidence, progress: Progress, executor_map: ExecutorMap) -> tuple[Vector, Vector]:
    """Return the residual of the base and of the refit on every block, each without that block."""
    before, after = (np.full(evidence.used.size, np.nan) for _ in range(2))
    open_ = evidence.deformation_um
    progress(1, FOLDS + 1)
    blocks = list(evidence.blocks(FOLDS))
    fits = executor_map(refit, [evidence.hidden(block) for block in blocks])
    for done, (block, seen) in enumerate(zip(blocks, fits, strict=True), start=2):
        progress(done, FOLDS + 1)
        before[block] = (open_ - seen.by_paths)[block]
        after[block] = (open_ - seen.predicted)[block]
    return before, after


def _effects(evidence: Evidence, whole: Refit) -> tuple[Effect, ...]:
    effects = []
    for i, (part, std) in enumerate(zip(whole.parts, whole.std, strict=True)):
        wave = response(evidence, part)
        effects.append(
            Effect(
                part=part,
                std=std,
                explanation=part.hypothesis.explain(part.named, float(np.std(wave[evidence.used]))),
                rms_before_um=whole.rms_um[i],
                rms_after_um=whole.rms_um[i + 1],
                wave=wave,
                rivals=_rivals(part, whole.rivals[i], whole.rms_um[i + 1]),
            )
        )
    return tuple(effects)


def _rivals(part: Part, others: tuple[Tried, ...], after: float) -> tuple[Rival, ...]:
    rivals: list[Rival] = []
    seen = {part.hypothesis.channel}
    for other in others:
        hypothesis = other.hypothesis
        if hypothesis.channel not in seen and other.rms_um <= RIVAL_TIMES * after:
            seen.add(hypothesis.channel)
            # How fast the rival would be is not asked: its lags are those of the effect.
            rival = Part(hypothesis=hypothesis, values=(), amplitudes=part.amplitudes)
            words = how_to_tell_apart(part, rival)
            rivals.append(Rival(part=rival, rms_after_um=other.rms_um, how_to_tell_apart=words))
    return tuple(rivals[:3])


def _tried(whole: Refit) -> tuple[tuple[str, float], ...]:
    if not whole.rivals:
        return ()
    return tuple((f"input {t.hypothesis.channel} ({t.hypothesis.curve})", t.rms_um) for t in whole.rivals[0][:12])


def _extended(model: ThermalModel, whole: Refit, effects: tuple[Effect, ...]) -> ThermalModel:
    error = whole.rms_um[-1]
    return dataclasses.replace(
        model,
        dtf=Path(sampled=whole.dtf, unit=model.dtf.unit),
        tdtf=Path(sampled=whole.tdtf, unit=model.tdtf.unit) if model.tdtf and whole.tdtf else model.tdtf,
        effects=(*model.effects, *(table_of(effect) for effect in effects)),
        y_std_um=error,
        alternatives={},
        held_out_rms_um=error,
        sha256="",
    )


def _words(model: ThermalModel, whole: Refit, helps: bool) -> tuple[Remark, ...]:
    if not helps:
        return ()
    paths = [("DTF", model.dtf, whole.dtf)]
    if model.tdtf and whole.tdtf:
        paths.append(("TDTF", model.tdtf, whole.tdtf))
    gains = ", ".join(
        f"{name} from {old.sampled.dc_gain:.3g} to {new.dc_gain:.3g} {old.unit.replace('um', 'µm')}"
        for name, old, new in paths
    )
    return (
        Remark(
            "fitted_anew",
            "The first model was calibrated while this acted and misses much of its own data, so its paths were fitted "
            f"anew beside it; gains went: {gains}.",
        ),
    )
