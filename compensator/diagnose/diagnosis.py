"""From a model and measured runs to a verdict, the effects that the model lacks, and the model with them.

The errors before and after are measured on held-out blocks of time: for each block the whole search is repeated without
it, and what that finds is applied to the block.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial

import numpy as np

from compensator.arrays import Indices, Vector
from compensator.codes import ModelWarning, Remark
from compensator.data.runs import Run
from compensator.diagnose.advice import advice_of, label
from compensator.diagnose.chips import without_chips
from compensator.diagnose.deciding import Deciding, PlannedTest
from compensator.diagnose.event_time import with_time_errors, words_of
from compensator.diagnose.evidence import Evidence, evidence_of
from compensator.diagnose.findings import Findings, findings_of, with_paths
from compensator.diagnose.fit import Term, standard_errors
from compensator.diagnose.hiding import hiding
from compensator.diagnose.noise import VERDICT_TIMES
from compensator.diagnose.outcome import (
    FOLDS,
    HELD_OUT,
    HELD_OUT_RECORDINGS,
    HELD_OUT_VALUES,
    Ceiling,
    Diagnosis,
    FoundEffect,
    Remainder,
    Step,
    Verdict,
    described,
    rivals_of,
    rms_of,
    seen_of,
    warnings_of,
)
from compensator.diagnose.search import Candidate
from compensator.diagnose.trials import Trials
from compensator.model.effects import Effect
from compensator.model.effects.hypothesis import Place
from compensator.model.late_observer import late_variance_um2
from compensator.model.thermal_model import ThermalModel
from compensator.progress import ExecutorMap, Progress, unreported

#: A base whose own calibration left more than this share of the deformation's spread lacks something.
FAR_OFF = 0.1
#: Effects are not deployed where held-out blocks are predicted worse with them by more than this factor.
CONTRADICTS = 1.25
#: From few values a remainder is deployed only where it leaves less than this share of the error on held-out ones.
LOWERS = 0.97
#: How the errors are measured where nothing was known of the paths.
WITH_PATHS = "; before: the paths of the first model alone, also refitted to the others"


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
    evidence = _evidence(model, runs)
    progress(0, len(list(evidence.blocks(FOLDS))) + 1)
    found, left_out = findings_of(evidence), list[Remark]()
    if evidence.is_sparse:
        found, left_out = without_chips(found, partial(_evidence, model))
        evidence = found.search.evidence
    deciding = Deciding(Trials(evidence))
    effects = _effects(found, deciding)
    # Paths that were refitted with all effects say nothing beside only some of them.
    places = [] if evidence.free_paths else [effect.place for effect in effects]
    held_out = _held_out(found, places, progress, executor_map)
    if not effects and not evidence.free_paths:
        # Nothing has a name: what the searches for the blocks named is not deployed and credits nothing.
        whole = held_out.whole if found.remainder is not None else held_out.nothing
        held_out = dataclasses.replace(held_out, named=held_out.nothing, whole=whole)
    few = evidence.is_sparse
    beside = found.remainder is not None and found.explains and not evidence.free_paths
    if beside and rms_of(held_out.whole) > rms_of(held_out.named):
        # What explains nothing has to show that it helps.
        found = dataclasses.replace(found, remainder=None)
        held_out = dataclasses.replace(held_out, whole=held_out.named)
    if few and found.remainder is not None and not _lowers(held_out):
        # Few values: chance lowers the error of no remainder by much.
        found = dataclasses.replace(found, remainder=None, explains=True)
        effects = tuple(dataclasses.replace(effect, replaced=False) for effect in effects)
        held_out = dataclasses.replace(held_out, whole=held_out.named)
    # Where every block holds an event of its own, none foretells another: only a clear contradiction counts.
    contradicted = not (few or evidence.free_paths) and rms_of(held_out.whole) > CONTRADICTS * rms_of(held_out.nothing)
    extended, remarks = (model, ()) if contradicted else _extended(model, found, effects, held_out)
    remainder = None
    if found.remainder is not None:
        remainder = Remainder(
            deployed=extended is not model,
            channels=tuple(dict.fromkeys(found.remainder.effect.channels_that_matter())),
            rms_before_um=rms_of(held_out.named),
            rms_after_um=rms_of(held_out.whole),
        )
    left = evidence.left(evidence.residual, found.whole, at_rest=False)
    verdict, ceiling = _verdict(found, held_out, extended), _ceiling(held_out)
    could_hide, advice = hiding(found.selection, found.search.price) if few else None, None
    # Without an effect the verdict says of few values whether they are noise; that something could hide comes on top.
    hides = verdict == "adequate" and could_hide is not None and (could_hide.is_too_much or could_hide.undecided != ())
    if verdict != "adequate" or hides:
        tests = [rival.test for effect in effects for rival in effect.rivals if rival.test is not None]
        tests += _between_undecided(found, deciding)
        explained_pct, is_explained = ceiling.explained_pct if ceiling else None, verdict == "explained" or hides
        advice = advice_of(
            found, deciding, between_rivals=tests, explained_pct=explained_pct, is_explained=is_explained
        )
    return Diagnosis(
        verdict="unexplained" if hides else verdict,
        effects=effects,
        held_out=_how(evidence),
        model=extended,
        evidence=evidence,
        residual_before=np.where(evidence.used, found.search.left(found.selection.before) - found.paths, np.nan),
        residual_after=np.where(evidence.used, left, np.nan),
        held_out_before=held_out.nothing,
        held_out_named=held_out.named,
        held_out_after=held_out.whole,
        tried=_ranked(found),
        warnings=(
            *left_out,
            *remarks,
            *warnings_of(effects, held_out.nothing, held_out.whole, deployed=extended is not model, few=few),
        ),
        steps=held_out.steps,
        remainder=remainder,
        ceiling=ceiling,
        advice=advice,
        could_hide=could_hide,
    )


def _evidence(model: ThermalModel, runs: Sequence[Run]) -> Evidence:
    """Return the evidence of runs, with free paths where the model is far off."""
    evidence = evidence_of(model, runs)
    if model.held_out_rms_um is not None and model.held_out_rms_um > FAR_OFF * evidence.spread_um:
        return evidence.with_free_paths()
    return evidence


def _between_undecided(found: Findings, deciding: Deciding) -> list[PlannedTest]:
    """Return the test between the two effects that come nearest, or of the one, where few values do not decide."""
    undecided = found.selection.undecided
    if not undecided:
        return []
    first = undecided[0]
    second = next((fit for fit in undecided if fit.places != first.places), found.selection.fit)
    test = deciding.best(
        first, second, (label(first.terms[-1]), label(second.terms[-1]) if second.terms else "nothing")
    )
    return [test] if test is not None else []


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _HeldOut:
    """What is left on every sample by estimates that did not see it, µm; NaN where y is missing."""

    nothing: Vector
    named: Vector
    whole: Vector
    ceiling: Vector
    steps: tuple[Step, ...]


def _held_out(found: Findings, places: Sequence[Place], progress: Progress, executor_map: ExecutorMap) -> _HeldOut:
    """Repeat the search without each block; of two choices of nuisances, that which leaves less before."""
    evidence = found.search.evidence
    blocks = list(evidence.blocks(FOLDS))
    progress(1, len(blocks) + 1)
    views = [evidence.without(block) for block in blocks]
    timed = [t.effect for t in found.terms if not t.effect.deployable]
    only_unobserved = bool(found.terms) and not any(term.hypothesis.effect.observed for term in found.terms)
    unobserved = any(not effect.observed for effect in timed) and not only_unobserved
    predicted = executor_map(partial(_predictions, places=places, unobserved=unobserved), views)
    left = np.full((2, 4 + len(places), evidence.used.size), np.nan)
    searches = np.zeros(len(places), dtype=int)
    for done, (block, seen, several) in enumerate(zip(blocks, views, predicted, strict=True), start=2):
        progress(done, len(blocks) + 1)
        searches += several.has
        for choice in (0, 1):
            for i, one in enumerate(several.added):
                left[choice, i, block] = seen.left(evidence.residual, one, at_rest=choice == 0)[block]
    best = min((0, 1), key=lambda choice: rms_of(left[choice, 0]))
    nothing, named, whole, ceiling, *steps = left[best]
    return _HeldOut(
        nothing=nothing,
        named=named,
        whole=whole,
        ceiling=ceiling,
        steps=tuple(Step(rms_um=rms_of(s), searches=n) for s, n in zip(steps, searches.tolist(), strict=True)),
    )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
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


def _predictions(seen: Evidence, *, places: Sequence[Place], unobserved: bool) -> _Predictions:
    found = findings_of(seen, unobserved=unobserved)
    steps, total = [], found.own_paths
    for place in places:
        total = sum(
            (r for t, r in zip(found.terms, found.responses, strict=True) if t.hypothesis.place == place), total
        )
        steps.append(total)
    has = np.array([any(term.hypothesis.place == place for term in found.terms) for place in places], dtype=int)
    return _Predictions(added=(found.paths, found.named, found.whole, found.ceiling, *steps), has=has)


def _effects(found: Findings, deciding: Deciding) -> tuple[FoundEffect, ...]:
    """Return the named effects, that which removes most first."""
    evidence, search = found.search.evidence, found.search
    selection = found.selection

    def rms_without(responses: Sequence[Vector]) -> float:
        left = evidence.residual - sum(responses, np.zeros(evidence.used.size))
        return rms_of(evidence.without_nuisances(np.where(evidence.used, left, 0.0))[evidence.used])

    after, searched = rms_without(found.responses), search.rms(selection.fit)
    effects = []
    errors = standard_errors(selection.fit)
    few = evidence.is_sparse
    if few:
        errors = with_time_errors(selection.fit, errors)
    for i, (term, std, rivals) in enumerate(zip(found.terms, errors, selection.rivals, strict=True)):
        signal = found.responses[i]

        def test(rival: Candidate, first: Term = term) -> PlannedTest | None:
            return deciding.best(selection.fit, rival.fit, (label(first), label(rival.term)))

        effect = described(term, std, signal, evidence)
        if few:
            words = effect.explanation + words_of(std, search.points.period_min)
            effect = dataclasses.replace(effect, explanation=words)
        effects.append(
            FoundEffect(
                term=term,
                effect=effect,
                rms_before_um=rms_without([*found.responses[:i], *found.responses[i + 1 :]]),
                rms_after_um=after,
                signal=signal,
                rivals=rivals_of(term, rivals, searched, test),
                replaced=not found.explains,
            )
        )
    return tuple(sorted(effects, key=lambda effect: -effect.rms_before_um))


def _extended(
    model: ThermalModel, found: Findings, effects: Sequence[FoundEffect], held_out: _HeldOut
) -> tuple[ThermalModel, tuple[Remark, ...]]:
    """Return the model with every effect that can be deployed, the remainder, and the error that is left."""
    evidence = found.search.evidence
    deployed: list[Effect] = [effect.effect for effect in effects if effect.deployable]
    remarks: tuple[Remark, ...] = ()
    base, remainder = model, found.remainder.effect if found.remainder else None
    if found.refitted:
        base, remainder = with_paths(model, remainder or found.refitted.effect)
        base = dataclasses.replace(base, held_out_rms_um=None)
        remarks = (Remark(ModelWarning.FITTED_ANEW, _refitted(model, base)),)
    if remainder is not None:
        seen = seen_of(remainder, found.whole - found.named, evidence)
        deployed.append(dataclasses.replace(remainder, explanation=remainder.explain(seen)))
    if not deployed and base is model:
        return model, ()
    kept_out = [effect.signal[evidence.used] for effect in effects if not effect.effect.deployable]
    left = found.rest_um**2 + (float(np.var(np.sum(kept_out, axis=0))) if kept_out else 0.0)
    extended = dataclasses.replace(base, effects=(*model.effects, *deployed), sha256="")
    if not kept_out and not evidence.is_sparse:
        # Half what the fit expects, half what held-out blocks show: the one is too small, the other has few blocks.
        shown = max(rms_of(held_out.whole) ** 2 - evidence.noise.noise_um**2, 0.0)
        left = 0.5 * (left + shown)
    # The engine states by itself what it cannot know of a late T_Q.
    left = max(left - (late_variance_um2(extended) - late_variance_um2(model)), 0.0)
    return dataclasses.replace(extended, y_std_um=float(np.sqrt(left))), remarks


def _refitted(old: ThermalModel, new: ThermalModel) -> str:
    paths = [("DTF", old.dtf, new.dtf), *([("TDTF", old.tdtf, new.tdtf)] if old.tdtf and new.tdtf else [])]
    gains = ", ".join(
        f"{name} from {a.sampled.dc_gain:.3g} to {b.sampled.dc_gain:.3g} {a.unit.replace('um', 'µm')}"
        for name, a, b in paths
    )
    return (
        "The first model was calibrated while this acted and misses much of its own data, so its paths were refitted "
        f"together with it; gains changed: {gains}."
    )


def _how(evidence: Evidence) -> str:
    """Return how the errors are measured."""
    count = len(list(evidence.blocks(FOLDS)))
    words = HELD_OUT_VALUES if evidence.is_sparse else HELD_OUT
    if evidence.holds_out_recordings:
        words = HELD_OUT_RECORDINGS.format(count=count)
    return words + WITH_PATHS * evidence.free_paths


def _ceiling(held_out: _HeldOut) -> Ceiling | None:
    """Return what all channels could explain, and how much of that the named effects do."""
    before, after, least = (rms_of(values) ** 2 for values in (held_out.nothing, held_out.named, held_out.ceiling))
    if least >= before:
        return None
    return Ceiling(
        rms_um=float(np.sqrt(least)), explained_pct=float(np.clip((before - after) / (before - least), 0, 1)) * 100
    )


def _lowers(held_out: _HeldOut) -> bool:
    """Whether the remainder lowers the error on held-out data enough to deploy it from few values."""
    return rms_of(held_out.whole) < LOWERS * min(rms_of(held_out.named), rms_of(held_out.nothing))


def _ranked(found: Findings) -> tuple[tuple[str, float], ...]:
    best: dict[str, float] = {}
    for candidate in found.selection.rivals[0] if found.selection.rivals else ():
        label = candidate.term.hypothesis.label
        best[label] = min(candidate.rms_um, best.get(label, np.inf))
    return tuple(sorted(best.items(), key=lambda item: item[1]))


def _verdict(found: Findings, held_out: _HeldOut, extended: ThermalModel) -> Verdict:
    """Return the verdict in one word; what the engine cannot know of a late T_Q counts as noise."""
    evidence = found.search.evidence
    observed = [term.hypothesis.effect.observed for term in found.terms]
    left = evidence.left(evidence.residual, found.whole, at_rest=False)[evidence.used]
    unknown_um2 = late_variance_um2(extended)
    noise = dataclasses.replace(evidence.noise, noise_um=float(np.hypot(evidence.noise.noise_um, unknown_um2**0.5)))
    is_noise = noise.is_explained(float(left @ left))
    if not observed:
        nothing_acts = is_noise and not evidence.free_paths and found.remainder is None
        return "adequate" if nothing_acts else "unexplained"
    if not any(observed):
        return "unexplained"
    holds = rms_of(held_out.whole) <= rms_of(held_out.nothing)
    if evidence.is_sparse:
        # What few values were fitted by is judged by those that it was not fitted to.
        level = VERDICT_TIMES**2 * (noise.noise_um**2 + noise.allowance / noise.count)
        holds = holds and rms_of(held_out.whole) ** 2 <= level
    return "explained" if is_noise and holds and all(observed) and found.explains else "partly_explained"
