"""From a model and measured runs to a verdict, the effects that the model lacks, and the model with them.

The errors before and after are measured on held-out blocks of time: for each block the whole search is repeated without
it, and what that finds is applied to the block.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from compensator.arrays import Vector, rms_of
from compensator.codes import ModelWarning, Remark
from compensator.data.runs import Run
from compensator.diagnose.advice import Advice, advice_of
from compensator.diagnose.ceiling import Ceiling
from compensator.diagnose.chips import without_chips
from compensator.diagnose.criterion import MARGIN
from compensator.diagnose.deciding import Deciding, PlannedTest
from compensator.diagnose.deployment import CONTRADICTS, Deployment, deployment_of, is_adequate
from compensator.diagnose.detection_limit import detection_limits
from compensator.diagnose.evidence import Evidence, evidence_of
from compensator.diagnose.findings import Findings, findings_of, in_free_run
from compensator.diagnose.fit import Term, fit_terms
from compensator.diagnose.found_effect import FoundEffect, described, no_further_than_seen, rivals_of, seen_of
from compensator.diagnose.held_out import HeldOut, held_out_of, how_held_out
from compensator.diagnose.initial_state import with_initial_state
from compensator.diagnose.likelihood import Likelihood
from compensator.diagnose.noise import VERDICT_TIMES
from compensator.diagnose.onset import explains_better, onset_in
from compensator.diagnose.outcome import FOLDS, Diagnosis, Refused, Remainder, Verdict, warnings_of
from compensator.diagnose.points import Points
from compensator.diagnose.refitted_paths import with_paths
from compensator.diagnose.search import Alternative
from compensator.diagnose.standard_errors import standard_errors, std_factors, time_words, with_time_errors
from compensator.diagnose.trials import Trials
from compensator.errors import DataError
from compensator.model.effects import Effect
from compensator.model.effects.hypothesis import Place
from compensator.model.late_observer import late_variance_um2
from compensator.model.thermal_model import LEAST_OWN_ERROR, ThermalModel
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
        Whether the base was calibrated on other data: its error on these is then to be surpassed by paths that are
        fitted anew, or they are kept.
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
    if chosen.needs_known_paths or (options.unseen and chosen.base_foretells_better):
        kept, progress = dataclasses.replace(options, keep_paths=True), after(progress, searched.searches)
        searched = _searched(model, runs, kept, progress, executor_map, is_off=not options.unseen)
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
    found = _as_begun(found)
    evidence = found.search.evidence
    deciding = Deciding(Trials(evidence))
    effects = _effects(found, deciding)
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
    few = evidence.is_sparse
    extended, remarks = (model, ()) if chosen.is_refused else _extended(model, found, effects)
    deployed = extended is not model
    deviation_um = _deviation_um(extended, model, found, effects, held_out)
    if deployed:
        extended = dataclasses.replace(extended, y_std_um=deviation_um, sha256="")
    else:
        remarks = tuple(_deviation_contradicted(model.y_std_um, deviation_um))
    ceiling = _ceiling(held_out)
    verdict, is_explained = _verdict(
        found, effects, held_out, extended, holds_in_free_run=chosen.worse_um is None, is_off=is_off
    )
    if verdict == "explained" and ceiling is not None and ceiling.is_missed(rms_of(held_out.nothing)):
        verdict = "partly_explained"
    could_hide = detection_limits(found.selection, found.search.criterion.price) if few else None
    # Without an effect the verdict says of few values whether they are noise; that something could hide comes on top.
    hides = verdict == "adequate" and could_hide is not None and (could_hide.is_too_much or could_hide.undecided != ())
    advice = None
    if verdict != "adequate" or hides:
        advice = _advice(searched, ceiling, is_explained=is_explained or hides)
    refused = _refused(chosen)
    left = evidence.left(found.whole)
    before = np.where(evidence.used, evidence.residual - found.paths, 0.0)
    warnings = warnings_of(
        effects,
        held_out.nothing,
        held_out.whole,
        deployed=deployed,
        few=few,
        worse_um=chosen.worse_um,
        too_short_h=chosen.too_short_h,
        start_k=evidence.start_k,
    )
    return Diagnosis(
        verdict="unexplained" if hides or chosen.reverses_path else verdict,
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
        tried=_ranked(found, effects),
        warnings=(
            *searched.left_out,
            *remarks,
            *_paths_kept(evidence, verdict, deployed=deployed, is_off=is_off),
            *warnings,
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


def _as_begun(found: Findings) -> Findings:
    """Search once more with the initial state that the named effects need, where they explain more with it."""
    fit, score = found.selection.fit, found.search.criterion.score
    evidence = with_initial_state(fit)
    if evidence is None or score(fit_terms(Likelihood(Points(evidence), fit.rest), fit.starts())) < score(fit) + MARGIN:
        return found
    again = findings_of(evidence)
    return again if score(again.selection.fit) > score(fit) else found


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


def _paths_kept(evidence: Evidence, verdict: Verdict, *, deployed: bool, is_off: bool) -> list[Remark]:
    """Return the remark that paths were kept which would be fitted anew, where something is missing."""
    if verdict == "adequate" or (evidence.free_paths and deployed) or not evidence.is_far_off:
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


def _effects(found: Findings, deciding: Deciding) -> tuple[FoundEffect, ...]:
    """Return the named effects, that which removes most first."""
    evidence, search = found.search.evidence, found.search
    selection = found.selection

    def rms_without(responses: Sequence[Vector]) -> float:
        # Paths that were fitted anew stay as they are.
        left = evidence.residual - sum(responses, found.own_paths)
        return rms_of(evidence.without_nuisances(np.where(evidence.used, left, 0.0))[evidence.used])

    after = rms_without(found.responses)
    chosen = search.criterion.compared(selection.fit), search.criterion.score(selection.fit)
    effects = []
    errors = _errors(found)
    few = evidence.is_sparse
    if few:
        errors = with_time_errors(found.fit, errors)
    for i, (term, std, rivals) in enumerate(zip(found.terms, errors, selection.rivals, strict=True)):
        is_left_in = term is found.left_in
        signal = found.left_in_um if is_left_in else found.responses[i]

        def test(rival: Alternative, first: Term = term) -> PlannedTest | None:
            return deciding.best(selection.fit, rival.fit, (first.label, rival.term.label))

        effect = described(term, std, signal, evidence)
        if few:
            words = effect.explanation + time_words(std, search.points.period_min)
            effect = dataclasses.replace(effect, explanation=words)
        effects.append(
            FoundEffect(
                term=term,
                effect=effect,
                rms_before_um=rms_without([*found.responses[:i], *found.responses[i + 1 :]]),
                rms_after_um=rms_without([*found.responses, signal]) if is_left_in else after,
                signal=signal,
                rivals=rivals_of(term, rivals, chosen, test),
                replaced=not found.deploys_names,
                left_in=is_left_in,
            )
        )
    return tuple(sorted(effects, key=lambda effect: -effect.rms_before_um))


def _errors(found: Findings) -> list[dict[str, float]]:
    """Return the standard errors of each term.

    Beside a late T_Q that is left in, the others are fitted to what it leaves, too: by how much that moves them counts.
    """
    if found.left_in is None:
        return standard_errors(found.fit)
    corrected, others = found.selection.fit, iter(standard_errors(found.fit))
    return [
        std
        if term is found.left_in
        else {name: math.hypot(std, term.named[name] - then.named[name]) for name, std in next(others).items()}
        for term, then, std in zip(found.terms, corrected.terms, standard_errors(corrected), strict=True)
    ]


def _extended(
    model: ThermalModel, found: Findings, effects: Sequence[FoundEffect]
) -> tuple[ThermalModel, tuple[Remark, ...]]:
    """Return the model with every effect that can be deployed and the remainder; the model itself without any."""
    evidence = found.search.evidence
    deployed = _with_factors(model, found, [effect for effect in effects if effect.deployable])
    remarks: tuple[Remark, ...] = ()
    base, remainder = model, found.remainder.effect if found.remainder else None
    if found.refitted:
        base, remainder = with_paths(model, remainder or found.refitted.effect)
        base = dataclasses.replace(base, held_out_rms_um=None)
        remarks = (Remark(ModelWarning.FITTED_ANEW, _refitted(model, base)),)
    if remainder is not None:
        seen = seen_of(remainder, found.whole - found.named, evidence)
        if not found.refitted:
            # Paths that were fitted anew together with it may go further, too, and the two share what both explain.
            remainder = no_further_than_seen(remainder, evidence)
        deployed.append(dataclasses.replace(remainder, explanation=remainder.explain(seen)))
    if not deployed and base is model:
        return model, ()
    return dataclasses.replace(base, effects=(*model.effects, *deployed), sha256=""), remarks


def _with_factors(model: ThermalModel, found: Findings, effects: Sequence[FoundEffect]) -> list[Effect]:
    """Return effects with what the data leave open of all their parameters together.

    Where the base's paths were fitted anew with them, none is stated: what the paths make up for is not known apart.
    """
    if found.refitted or not effects:
        return [effect.effect for effect in effects]
    terms = [term for term in found.terms if term is not found.left_in]
    factors = std_factors(found.fit, terms, beside_own_error=found.is_own_error)
    rows = dict(zip(map(id, terms), factors, strict=True))
    # Rows belong together by their place: those of effects that the model has already come first.
    before = max((len(one.std_factor) for one in model.effects if not one.has_variance), default=0)
    return [
        effect.effect
        if effect.effect.lateness
        else dataclasses.replace(effect.effect, std_factor=((),) * before + rows[id(effect.term)])
        for effect in effects
    ]


def _deviation_contradicted(stated_um: float, shown_um: float) -> Iterator[Remark]:
    """Yield a remark where a model to which nothing is added states a smaller deviation than the data show."""
    if shown_um > VERDICT_TIMES * stated_um:
        text = (
            f"The model states {stated_um:.2f} µm as the standard deviation of its own error; these data show "
            f"{shown_um:.2f} µm. It was left as it is."
        )
        yield Remark(ModelWarning.DEVIATION_CONTRADICTED, text)


def _deviation_um(
    extended: ThermalModel, model: ThermalModel, found: Findings, effects: Sequence[FoundEffect], held_out: HeldOut
) -> float:
    """Return the standard deviation of a model's own error that the data show, µm."""
    evidence, deploys = found.search.evidence, extended is not model
    # What depends on time alone is an error of the measurement: it is not in the machine that the model runs on.
    of_machine = [effect for effect in effects if effect.effect.deployable or not effect.effect.observed]
    kept_out = [
        effect.signal[evidence.used]
        for effect in of_machine
        if effect.left_in or not (deploys and (effect.effect.deployable or effect.replaced))
    ]
    left = found.rest_um**2 + (rms_of(np.sum(kept_out, axis=0)) ** 2 if kept_out else 0.0)
    is_approximate = found.refitted is not None or not found.search.points.is_exact
    if deploys and is_approximate and not kept_out and len(of_machine) == len(effects) and not evidence.is_sparse:
        # No effect has exactly this form: half what the fit expects, half what held-out blocks show. The one is too
        # small, the other has few blocks. What is open of the parameters the effects state by themselves.
        shown = max(rms_of(held_out.whole) ** 2 - evidence.noise.noise_um**2, 0.0)
        left = 0.5 * (left + shown)
    if not deploys and evidence.is_far_off:
        # What is learned beside paths, or an own error, that are not deployed says nothing of what the base leaves.
        left = max(left, in_free_run(found)[0] ** 2 - evidence.noise.noise_um**2)
    # The engine states by itself what it cannot know of a late T_Q.
    late = late_variance_um2(extended) - late_variance_um2(model)
    return float(np.sqrt(max(left - late, (LEAST_OWN_ERROR * evidence.noise.noise_um) ** 2)))


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


def _ceiling(held_out: HeldOut) -> Ceiling | None:
    """Return what all channels could explain, how much of that the named effects do, and the smallest error of all."""
    before, after, linear = (rms_of(values) ** 2 for values in (held_out.nothing, held_out.named, held_out.ceiling))
    if linear >= before:
        return None
    return Ceiling(
        rms_um=float(np.sqrt(linear)),
        explained_pct=float(np.clip((before - after) / (before - linear), 0, 1)) * 100,
        least_rms_um=float(np.sqrt(min(linear, after, rms_of(held_out.whole) ** 2))),
    )


def _ranked(found: Findings, effects: Sequence[FoundEffect]) -> tuple[tuple[str, float], ...]:
    """Return what was tried in place of the largest effect, and that, with what each leaves."""
    if not effects:
        return ()
    largest, selected = effects[0].place, found.selection.fit
    at = next(i for i, term in enumerate(selected.terms) if term.hypothesis.place == largest)
    best = {selected.terms[at].hypothesis.label: found.search.criterion.compared(selected)}
    for candidate in found.selection.rivals[at]:
        label = candidate.term.hypothesis.label
        best[label] = min(candidate.rms_um, best.get(label, np.inf))
    return tuple(sorted(best.items(), key=lambda item: item[1]))


def _verdict(
    found: Findings,
    effects: Sequence[FoundEffect],
    held_out: HeldOut,
    extended: ThermalModel,
    *,
    holds_in_free_run: bool,
    is_off: bool,
) -> tuple[Verdict, bool]:
    """Return the verdict in one word, and whether nothing is left to look for.

    "Explained" is said of the named effects alone; what the remainder corrects beside them is not looked for, but has
    no name. What the engine cannot know of a late T_Q counts as noise.
    """
    evidence = found.search.evidence
    observed = [term.hypothesis.effect.observed for term in found.terms]
    unknown_um2 = late_variance_um2(extended)
    noise = dataclasses.replace(evidence.noise, noise_um=float(np.hypot(evidence.noise.noise_um, unknown_um2**0.5)))

    def leaves_noise(added: Vector) -> bool:
        left = evidence.left(added)[evidence.used]
        return noise.is_explained(float(left @ left))

    is_noise = leaves_noise(found.whole + found.left_in_um)
    if not observed:
        if is_adequate(found, held_out) and not is_off:
            return "adequate", False
        # Noise in the fit, and more on held-out blocks: in the residual is nothing to look for.
        return "unexplained", found.remainder is None and not evidence.free_paths and found.leaves_noise
    if not any(observed):
        return "unexplained", False

    most_um2 = rms_of(held_out.nothing) ** 2
    if evidence.is_sparse:
        # What few values were fitted by must hold on those that it was not fitted to.
        most_um2 = min(most_um2, VERDICT_TIMES**2 * (noise.noise_um**2 + noise.allowance / noise.count))

    def holds(values: Vector) -> bool:
        return rms_of(values) ** 2 < most_um2

    nothing_left = is_noise and holds(held_out.whole) and all(observed) and found.deploys_names and holds_in_free_run
    by_names = (
        leaves_noise(found.named + found.left_in_um) and holds(held_out.named) and all(e.is_determined for e in effects)
    )
    return ("explained" if nothing_left and by_names else "partly_explained"), nothing_left
