"""Explanations that the evidence does not tell apart: held-out blocks choose. Strong evidence within an own error."""

import dataclasses

import pytest

from compensator.diagnose import search as search_module
from compensator.diagnose.evidence import evidence_of
from compensator.diagnose.fit import fit_terms, settled
from compensator.diagnose.likelihood import Likelihood, rest_without_effects
from compensator.diagnose.prediction import Folds
from compensator.diagnose.search import FORETELLS, Search
from tests.diagnose.scenarios import draw, record
from tests.diagnose.test_own_error import BASE
from tests.identify.quill_runs import runs_from


def search(kind, seed, size_um, *, hours=24.0, own_um=None):
    base = BASE if own_um is None else dataclasses.replace(BASE, held_out_rms_um=own_um)
    return Search(evidence_of(base, runs_from(record([draw(kind, seed, size_um)], 90 + seed, hours)[0])))


def alone(searched, form, channel):
    """The fit of one form of an effect of a channel."""
    nothing = Likelihood(searched.points, rest_without_effects(searched.points))
    hypothesis = next(h for h in searched.hypotheses if h.label.endswith(form) and h.place[2] == channel)
    return settled(fit_terms(nothing, [(hypothesis, hypothesis.grid()[0])]))


def test_of_explanations_that_are_about_as_likely_the_one_that_foretells_is_taken(monkeypatch):
    searched = search("input", 3, 5.0)
    channel = draw("input", 3, 5.0).place[2]
    wrong = alone(searched, "(square)", channel)
    monkeypatch.setattr(search_module, "NEARLY", 1e9)  # any two are about as likely
    chosen = searched._foretelling(wrong, apart_from=frozenset())
    folds = Folds(searched.points)
    assert folds.error_um(chosen) < FORETELLS * folds.error_um(wrong)
    assert [term.hypothesis.place[2] for term in chosen.terms] == [channel]
    assert searched._foretelling(chosen, apart_from=frozenset()) is chosen


def test_what_is_clearly_more_likely_is_kept_whatever_blocks_say(monkeypatch):
    searched = search("input", 3, 5.0)
    right = alone(searched, "(lag)", draw("input", 3, 5.0).place[2])
    monkeypatch.setattr(
        Folds, "error_um", lambda self, fit: float(fit.terms[0].hypothesis is right.terms[0].hypothesis)
    )
    chosen = searched._foretelling(right, apart_from=frozenset())
    assert [term.hypothesis.place for term in chosen.terms] == [term.hypothesis.place for term in right.terms]
    monkeypatch.setattr(search_module, "NEARLY", 1e9)
    (any_other,) = searched._foretelling(right, apart_from=frozenset()).terms
    assert not any_other.effect.has_any_form


@pytest.mark.parametrize(("kind", "size_um", "is_named"), [("input", 2.0, True), ("none", 0.0, False)])
def test_an_effect_within_the_base_models_own_error_is_named_where_the_evidence_is_strong(kind, size_um, is_named):
    searched = search(kind, 3, size_um, own_um=2.0)
    found = searched.run(unobserved=False)
    assert searched.criterion.is_expected(found.before)
    assert [term.hypothesis.place for term in found.fit.terms] == [draw(kind, 3, size_um).place] * is_named
