"""The named effects of some findings, as they are reported: with their errors, their rivals and what removes most."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from compensator.arrays import Vector, rms_of
from compensator.diagnose.advice.deciding import Deciding, PlannedTest
from compensator.diagnose.choice.found_effect import FoundEffect, described, rivals_of
from compensator.diagnose.fitting.fit import Term
from compensator.diagnose.fitting.standard_errors import standard_errors, time_words, with_time_errors
from compensator.diagnose.search.findings import Findings
from compensator.diagnose.search.search import Alternative


def named_effects(found: Findings, deciding: Deciding) -> tuple[FoundEffect, ...]:
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
    for i, (term, std) in enumerate(zip(found.terms, errors, strict=True)):
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
                rivals=rivals_of(term, search.rivals(selection.fit, i), chosen, test),
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


def ranked(found: Findings, effects: Sequence[FoundEffect]) -> tuple[tuple[str, float], ...]:
    """Return what was tried in place of the largest effect, and that, with what each leaves."""
    if not effects:
        return ()
    largest, selected = effects[0].place, found.selection.fit
    at = next(i for i, term in enumerate(selected.terms) if term.hypothesis.place == largest)
    best = {selected.terms[at].hypothesis.label: found.search.criterion.compared(selected)}
    for candidate in found.search.rivals(selected, at):
        label = candidate.term.hypothesis.label
        best[label] = min(candidate.rms_um, best.get(label, np.inf))
    return tuple(sorted(best.items(), key=lambda item: item[1]))
