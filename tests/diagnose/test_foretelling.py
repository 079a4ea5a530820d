"""Explanations that the evidence does not tell apart: held-out blocks choose. Strong evidence within an own error."""

import dataclasses

import numpy as np
import pytest

from compensator.diagnose.fitting.fit import fit_terms, settled
from compensator.diagnose.fitting.likelihood import Likelihood, rest_without_effects
from compensator.diagnose.fitting.prediction import Folds
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search import search as search_module
from compensator.diagnose.search.search import FORETELLS, Search
from tests.diagnose.scenarios import Scenario, draw, lag, record
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


def test_each_effect_is_looked_at_once_in_whatever_order_they_are_exchanged(monkeypatch):
    """One that was exchanged stands at the end: by its number another one was left out, and one never."""
    channels = draw("input", 3, 5.0).place[2], draw("input", 5, 5.0).place[2]
    searched = Search(evidence_of(BASE, runs_from(record([draw("input", 3, 5.0), draw("input", 5, 5.0)], 93, 24.0)[0])))
    nothing = Likelihood(searched.points, rest_without_effects(searched.points))
    forms = [("(square)", channels[0]), ("(row, linear)", "coolant_degc"), ("(lag)", channels[1])]
    named = [next(h for h in searched.hypotheses if h.label == f"input {name} {form}") for form, name in forms]
    fit = settled(fit_terms(nothing, [(hypothesis, hypothesis.grid()[0]) for hypothesis in named]))
    monkeypatch.setattr(search_module, "NEARLY", 1e9)
    monkeypatch.setattr(  # each exchange foretells better, and best a form of any lags
        Folds,
        "error_um",
        lambda _, one: 0.1 ** sum(term.effect.has_any_form for term in one.terms) if one is not fit else 1e6,
    )
    chosen = searched._foretelling(fit, apart_from=frozenset())
    by_channel = {term.hypothesis.place[2]: term.effect.has_any_form for term in chosen.terms}
    assert by_channel == {channels[0]: False, "coolant_degc": True, channels[1]: False}


def test_within_the_own_error_nothing_but_an_input_is_named():
    """A channel that acts in two ways: a change of a path by it may come by itself on another day."""
    lagged = Scenario(place=("input", "", "fan_rpm"), act=lambda s: 1.6 * (e := lag(s[1]["fan_rpm"], 20.0)) / np.std(e))
    columns, _, _ = record([draw("scheduled", 4, 2.6), lagged], 94, 24.0)
    searched = Search(evidence_of(dataclasses.replace(BASE, held_out_rms_um=3.0), runs_from(columns)))
    found = searched.run(unobserved=False)
    assert searched.criterion.is_expected(found.before)
    assert [term.hypothesis.place for term in found.fit.terms] == [lagged.place]


@pytest.mark.parametrize(("kind", "size_um", "is_named"), [("input", 2.0, True), ("none", 0.0, False)])
def test_an_effect_within_the_base_models_own_error_is_named_where_the_evidence_is_strong(kind, size_um, is_named):
    searched = search(kind, 3, size_um, own_um=2.0)
    found = searched.run(unobserved=False)
    assert searched.criterion.is_expected(found.before)
    assert [term.hypothesis.place for term in found.fit.terms] == [draw(kind, 3, size_um).place] * is_named
