"""Diagnosis of a base model that is far off: its paths are refitted beside the channels that it lacks.

Held-out errors as everywhere: for each block of time the whole choice is repeated without it. The error before is that
of the paths alone, also refitted without the block: the first model may have seen it in its calibration.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from compensator.arrays import Vector
from compensator.diagnose.evidence import Evidence
from compensator.diagnose.fit import Term, response
from compensator.diagnose.outcome import (
    FOLDS,
    HELD_OUT,
    Diagnosis,
    FoundEffect,
    described,
    rivals_of,
    rms_of,
    warnings_of,
)
from compensator.diagnose.refit import Refit, refit
from compensator.model.thermal_model import Path, ThermalModel
from compensator.progress import ExecutorMap, Progress
from compensator.reasons import Remark

#: A base whose own calibration left more than this share of the deformation's spread lacks something.
FAR_OFF = 0.1


def is_far_off(model: ThermalModel, evidence: Evidence) -> bool:
    """Tell whether the calibration itself says that the model misses much of the deformation."""
    return model.held_out_rms_um is not None and model.held_out_rms_um > FAR_OFF * evidence.spread_um


def diagnose_by_refit(
    model: ThermalModel, evidence: Evidence, progress: Progress, executor_map: ExecutorMap
) -> Diagnosis:
    """Refit the base with the channels that it lacks, and measure on held-out blocks what that is worth.

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
    deformation = evidence.deformation_um
    whole = refit(evidence)
    before, after = _held_out(evidence, progress, executor_map)
    effects = _effects(evidence, whole)
    helps = bool(effects) and rms_of(after) <= rms_of(before)
    left = np.where(evidence.used, deformation - whole.predicted, np.nan)
    bare = np.where(evidence.used, deformation - whole.by_paths, np.nan)
    clean = evidence.noise.is_explained_held_out(rms_of(after))
    return Diagnosis(
        verdict="unexplained" if not effects else "explained" if clean else "partly_explained",
        effects=effects,
        held_out=f"{HELD_OUT}; before: the paths of the first model alone, also refitted to the others",
        model=_extended(model, whole, effects) if helps else model,
        evidence=evidence,
        residual_before=bare,
        residual_after=left if effects else bare,
        held_out_before=before,
        held_out_after=after if effects else before,
        tried=_tried(whole),
        warnings=(*_refitted(model, whole, helps), *warnings_of(effects, before, after)),
    )


def _held_out(evidence: Evidence, progress: Progress, executor_map: ExecutorMap) -> tuple[Vector, Vector]:
    """Return the residual of the base and of the refit on every block, each without that block."""
    before, after = (np.full(evidence.used.size, np.nan) for _ in range(2))
    deformation = evidence.deformation_um
    progress(1, FOLDS + 1)
    blocks = list(evidence.blocks(FOLDS))
    fits = executor_map(refit, [evidence.without(block) for block in blocks])
    for done, (block, seen) in enumerate(zip(blocks, fits, strict=True), start=2):
        progress(done, FOLDS + 1)
        before[block] = (deformation - seen.by_paths)[block]
        after[block] = (deformation - seen.predicted)[block]
    return before, after


def _effects(evidence: Evidence, whole: Refit) -> tuple[FoundEffect, ...]:
    effects = []
    for i, (term, std) in enumerate(zip(whole.terms, whole.std, strict=True)):
        signal = response(evidence, term)
        effects.append(
            FoundEffect(
                term=term,
                effect=described(term, std, signal[evidence.used]),
                rms_before_um=whole.rms_um[i],
                rms_after_um=whole.rms_um[i + 1],
                signal=signal,
                rivals=rivals_of(term, _others(whole, i), whole.rms_um[i + 1]),
            )
        )
    return tuple(effects)


def _others(whole: Refit, index: int) -> Iterator[tuple[Term, float]]:
    """Yield the other channels in the place of one, with its gains: how fast they act is not compared."""
    gains = whole.terms[index].amplitudes
    for other in whole.rivals[index]:
        yield Term(hypothesis=other.hypothesis, values=(), amplitudes=gains), other.rms_um


def _tried(whole: Refit) -> tuple[tuple[str, float], ...]:
    return tuple((c.hypothesis.label, c.rms_um) for c in whole.rivals[0][:12]) if whole.rivals else ()


def _extended(model: ThermalModel, whole: Refit, effects: tuple[FoundEffect, ...]) -> ThermalModel:
    error = whole.rms_um[-1]
    return dataclasses.replace(
        model,
        dtf=Path(sampled=whole.dtf, unit=model.dtf.unit),
        tdtf=Path(sampled=whole.tdtf, unit=model.tdtf.unit) if model.tdtf and whole.tdtf else model.tdtf,
        effects=(*model.effects, *(found.effect for found in effects)),
        y_std_um=error,
        alternatives={},
        held_out_rms_um=error,
        sha256="",
    )


def _refitted(model: ThermalModel, whole: Refit, helps: bool) -> tuple[Remark, ...]:
    """Return the warning that the paths are not those of the first model."""
    if not helps:
        return ()
    paths = [("DTF", model.dtf, whole.dtf)]
    if model.tdtf and whole.tdtf:
        paths.append(("TDTF", model.tdtf, whole.tdtf))
    gains = ", ".join(
        f"{name} from {old.sampled.dc_gain:.3g} to {new.dc_gain:.3g} {old.unit.replace('um', 'µm')}"
        for name, old, new in paths
    )
    text = (
        "The first model was calibrated while this acted and misses much of its own data, so its paths were refitted "
        f"together with it; gains changed: {gains}."
    )
    return (Remark("fitted_anew", text),)
