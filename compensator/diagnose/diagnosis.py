"""From a model and measured runs to a verdict, the effects that the model lacks, and the model with them.

The errors before and after are measured on held-out blocks of time: for each block the whole search is repeated without
it, and what that finds is applied to the block.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from compensator.arrays import rms_of
from compensator.codes import ModelWarning, Remark
from compensator.data.runs import Run
from compensator.diagnose.advice.advice import Advice, advice_of
from compensator.diagnose.advice.ceiling import Ceiling
from compensator.diagnose.advice.deciding import Deciding, PlannedTest
from compensator.diagnose.advice.trials import Trials
from compensator.diagnose.choice.deployment import CONTRADICTS, Deployment, deployment_of
from compensator.diagnose.choice.extended_model import extended_model
from compensator.diagnose.choice.found_effect import FoundEffect
from compensator.diagnose.choice.held_out import HeldOut, ceiling_of, held_out_of, how_held_out
from compensator.diagnose.choice.named_effects import named_effects, ranked
from compensator.diagnose.choice.onset import explains_better, onset_in
from compensator.diagnose.choice.outcome import Diagnosis, Refused, Remainder
from compensator.diagnose.choice.verdict import Judged, judged
from compensator.diagnose.fitting.prediction import FOLDS
from compensator.diagnose.residual.evidence import Evidence, evidence_of
from compensator.diagnose.search.chips import without_chips
from compensator.diagnose.search.detection_limit import detection_limits
from compensator.diagnose.search.findings import Findings, findings_of
from compensator.diagnose.search.initial_state import as_begun
from compensator.diagnose.words.warning_words import ceiling_in_part, warnings_on
from compensator.errors import DataError
from compensator.model.effects.hypothesis import Place
from compensator.model.thermal_model import ThermalModel
from compensator.progress import ExecutorMap, Progress, after, unreported


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosisOptions:
    """What is known of data and base beside themselves, and what is asked of their diagnosis.

    Parameters
    ----------
    expected : frozenset of Place
        Effects that another axis of the machine shows.
    keep_paths : bool
        Keep the paths of the base as they are even if its own calibration left much.
    unseen : bool
        Whether the base was calibrated on other data: what is found with its paths is then to be surpassed by paths
        that are fitted anew, or they are kept.
    all_data : bool
        Whether all of the data are searched, also where an effect began within them (`onset`).
    """

    expected: frozenset[Place] = frozenset()
    keep_paths: bool = False
    unseen: bool = False
    all_data: bool = False


#: Those of a diagnosis of which nothing else is known or asked.
DEFAULTS = DiagnosisOptions()


def diagnose(
    model: ThermalModel,
    runs: Sequence[Run],
    options: DiagnosisOptions = DEFAULTS,
    *,
    progress: Progress = unreported,
    executor_map: ExecutorMap = map,
) -> Diagnosis:
    """Find what a model lacks: in all of the data, and where an effect began within them, in those since.

    Parameters
    ----------
    model : ThermalModel
        The base model.
    runs : sequence of Run
        Measured data with y and every channel that was logged.
    options : DiagnosisOptions
        What is asked.
    progress : callable
        Called with how many searches of how many are done.
    executor_map : callable
        Does the searches for the held-out blocks: `map`, or that of an executor.

    Raises
    ------
    DataError
        If there is too little data.
    """
    steps = 0

    def counted(done: int, total: int) -> None:
        nonlocal steps
        steps = total
        progress(done, total)

    found = _as_a_whole(model, runs, options, counted, executor_map)
    onset = None if options.all_data else onset_in(found)
    if onset is None:
        return found
    kept = dataclasses.replace(options, keep_paths=True)
    try:
        later = _as_a_whole(model, [onset.run], kept, after(progress, steps), executor_map)
    except DataError:  # too little data since then
        return found
    if not explains_better(later, found):
        return found
    return dataclasses.replace(later, since_h=onset.since_h, warnings=(onset.remark, *later.warnings))


def _as_a_whole(
    model: ThermalModel,
    runs: Sequence[Run],
    options: DiagnosisOptions,
    progress: Progress,
    executor_map: ExecutorMap,
) -> Diagnosis:
    """Diagnose data as one: with paths fitted anew where the base is far off, unless nothing comes of that."""
    searched = _searched(model, runs, options, progress, executor_map)
    chosen = searched.chosen
    if chosen.found.search.evidence.free_paths and (chosen.is_refused or options.unseen):
        kept, progress = dataclasses.replace(options, keep_paths=True), after(progress, searched.searches)
        beside = _searched(model, runs, kept, progress, executor_map, is_off=not options.unseen)
        if not chosen.surpasses(beside.chosen):
            searched = beside
    return _result(model, searched)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Searched:
    """What was found in all of the data, and what of it is deployed.

    Parameters
    ----------
    chosen : Deployment
        Effects and remainder, their errors on held-out blocks, and what of them is deployed.
    deciding : Deciding
        The tests of the machine that may decide between explanations.
    left_out : list of Remark
        A remark on values that do not fit and took no part, if there are any.
    searches : int
        Number of searches: in all data, and without each block.
    is_off : bool
        Whether a search for paths fitted anew has given nothing that is deployed, so those of the base are kept. It is
        far off all the same, and has seen the data.
    """

    chosen: Deployment
    deciding: Deciding
    left_out: list[Remark]
    searches: int
    is_off: bool


def _searched(
    model: ThermalModel,
    runs: Sequence[Run],
    options: DiagnosisOptions,
    progress: Progress,
    executor_map: ExecutorMap,
    *,
    is_off: bool = False,
) -> _Searched:
    """Search all of the data and without each block, and choose what is deployed; `is_off` as in `_Searched`."""
    evidence_of_runs = partial(_evidence, model, options=options)
    evidence = evidence_of_runs(runs)
    searches = 1 + len(list(evidence.blocks(FOLDS)))
    progress(0, searches)
    found, left_out = findings_of(evidence), list[Remark]()
    if evidence.is_sparse:
        found, left_out = without_chips(found, evidence_of_runs)
    found = as_begun(found, findings_of)
    evidence = found.search.evidence
    deciding = Deciding(Trials(evidence))
    effects = named_effects(found, deciding)
    # Paths that were refitted with all effects say nothing beside only some of them.
    places = [] if evidence.free_paths else [effect.place for effect in effects if not effect.left_in]
    held_out = held_out_of(found, places, progress, executor_map)
    # A base that is far off and has seen the data: effects beside it have to show that they foretell them.
    chosen = deployment_of(found, effects, held_out, contradicts=1.0 if is_off else CONTRADICTS)
    return _Searched(chosen=chosen, deciding=deciding, left_out=left_out, searches=searches, is_off=is_off)


def _result(model: ThermalModel, searched: _Searched) -> Diagnosis:
    """Return the result: verdict, extended model, errors, advice and warnings."""
    chosen, is_off = searched.chosen, searched.is_off
    found, effects, held_out = chosen.found, chosen.effects, chosen.held_out
    evidence = found.search.evidence
    extended, remarks = extended_model(model, chosen)
    deployed = extended is not model
    ceiling = ceiling_of(held_out)
    could_hide = detection_limits(found.selection, found.search.criterion.price) if evidence.is_sparse else None
    base = judged(chosen, extended, ceiling, could_hide, is_off=is_off)
    advice = None
    if base.verdict != "adequate":
        advice = _advice(searched, ceiling, is_explained=base.nothing_left)
    refused = _refused(chosen)
    left = evidence.left(found.whole)
    before = np.where(evidence.used, evidence.residual - found.paths, 0.0)
    return Diagnosis(
        verdict=base.verdict,
        effects=effects,
        held_out=how_held_out(evidence, () if refused else _of_no_model(effects)),
        model=extended,
        evidence=evidence,
        residual_before=np.where(evidence.used, evidence.without_nuisances(before), np.nan),
        residual_after=np.where(evidence.used, left, np.nan),
        paths_um=found.own_paths - found.paths,
        remainder_um=found.whole - found.named,
        named_rms_um=rms_of(evidence.left(found.named)[evidence.used]),
        held_out_before=held_out.nothing,
        held_out_named=held_out.named,
        held_out_after=held_out.nothing if refused else held_out.whole,
        tried=ranked(found, effects),
        warnings=(
            *searched.left_out,
            *remarks,
            *_paths_kept(evidence, base, deployed=deployed, is_off=is_off),
            *warnings_on(chosen, deployed=deployed),
            *ceiling_in_part(evidence.context),
        ),
        steps=held_out.steps,
        remainder=_remainder(found, held_out, deployed=deployed),
        ceiling=ceiling,
        advice=advice,
        could_hide=could_hide,
        refused=refused,
    )


def _advice(searched: _Searched, ceiling: Ceiling | None, *, is_explained: bool) -> Advice:
    """Return what to measure and to test next."""
    found, deciding = searched.chosen.found, searched.deciding
    tests = [rival.test for effect in searched.chosen.effects for rival in effect.rivals if rival.test is not None]
    tests += _between_undecided(found, deciding)
    explained_pct = ceiling.explained_pct if ceiling else None
    return advice_of(found, deciding, between_rivals=tests, explained_pct=explained_pct, is_explained=is_explained)


def _refused(chosen: Deployment) -> Refused | None:
    """Return what a model could have of what was found, where none of it is deployed."""
    has_any = chosen.found.remainder is not None or any(effect.is_refused for effect in chosen.effects)
    return Refused(why=chosen.refused, held_out=chosen.held_out.whole) if chosen.is_refused and has_any else None


def _of_no_model(effects: Sequence[FoundEffect]) -> list[str]:
    """Return the kinds of effects that no model can have, and in whose place no remainder stands."""
    return sorted({effect.kind for effect in effects if not effect.effect.deployable and not effect.replaced})


def _remainder(found: Findings, held_out: HeldOut, *, deployed: bool) -> Remainder | None:
    if found.remainder is None:
        return None
    return Remainder(
        deployed=deployed,
        channels=tuple(dict.fromkeys(found.remainder.effect.channels_that_matter())),
        rms_before_um=rms_of(held_out.named),
        rms_after_um=rms_of(held_out.whole),
        instead=not found.deploys_names,
        belongs=found.is_own_error,
        confirmed=found.confirmed,
    )


def _evidence(model: ThermalModel, runs: Sequence[Run], options: DiagnosisOptions = DEFAULTS) -> Evidence:
    """Return the evidence of runs, with free paths where the model is far off, unless they are to be kept."""
    evidence = dataclasses.replace(evidence_of(model, runs), expected=options.expected)
    return evidence.with_free_paths() if evidence.is_far_off and not options.keep_paths else evidence


def _paths_kept(evidence: Evidence, base: Judged, *, deployed: bool, is_off: bool) -> list[Remark]:
    """Return the remark that paths were kept which would be fitted anew, where something is missing."""
    if base.verdict == "adequate" or base.hides or (evidence.free_paths and deployed) or not evidence.is_far_off:
        return []
    left_um = evidence.model.held_out_rms_um or 0.0
    why = "nothing came of paths fitted anew, so its own were kept" if is_off else "its paths were kept"
    text = (
        f"The calibration of the model left {left_um:.1f} µm rms, {100.0 * left_um / evidence.spread_um:.0f} % of the "
        f"{evidence.spread_um:.1f} µm by which Y varies here, and {why}."
    )
    return [Remark(ModelWarning.PATHS_KEPT, text)]


def _between_undecided(found: Findings, deciding: Deciding) -> list[PlannedTest]:
    """Return the test between the two effects that come nearest, or of the one, where few values do not decide."""
    undecided = found.selection.undecided
    if not undecided:
        return []
    first = undecided[0]
    second = next((fit for fit in undecided if fit.places != first.places), found.selection.fit)
    test = deciding.best(first, second, (first.terms[-1].label, second.terms[-1].label if second.terms else "nothing"))
    return [test] if test is not None else []
