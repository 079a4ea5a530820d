"""Which effects may stand beside each other, and what a search asks for once."""

import dataclasses

import numpy as np
import pytest

from compensator.diagnose.fitting.fit import Term, response
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search import search as search_module
from compensator.diagnose.search.search import Search
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import draw, record
from tests.identify.quill_runs import runs_from


@pytest.fixture(scope="module")
def searched():
    columns, _, _ = record([draw("input", 3, 4.0)], 72, 12.0)
    return Search(evidence_of(load_model("quill"), runs_from(columns)))


def lag_of(searched, tau_min, size_um):
    """An input by one lag, of a size."""
    hypothesis = next(
        h
        for h in searched.hypotheses
        if h.place == ("input", "", "spindle_rpm") and len(h.amplitudes) == 1 == len(h.free)
    )
    evidence = searched.evidence
    unit = Term(hypothesis=hypothesis, values=(tau_min,), amplitudes=(1.0,))
    added = evidence.without_nuisances(np.where(evidence.used, response(evidence, unit), 0.0))
    return dataclasses.replace(unit, amplitudes=(size_um / float(np.std(added)),))


@pytest.mark.parametrize(("second_um", "is_plausible"), [(4.0, True), (-2.0, True), (-6.0, False)])
def test_two_large_effects_of_nearly_one_course_do_not_make_up_for_each_other(searched, second_um, is_plausible):
    """Each had the wrong form, and the fresh run was 2.9 instead of 1.5 µm; what acted was not found beside them."""
    first, second = lag_of(searched, 40.0, 7.0), lag_of(searched, 30.0, second_um)
    assert searched.criterion.is_plausible([first])
    assert searched.criterion.is_plausible([first, second]) is is_plausible


def test_where_effects_make_up_for_each_other_another_is_proposed(searched, monkeypatch):
    fit = searched.run(unobserved=False).fit
    assert [term.hypothesis.place for term in fit.terms] == [("input", "", "spindle_rpm")]
    asked = []
    monkeypatch.setattr(searched.criterion, "_make_up", lambda terms: asked.append(terms) or True)
    assert searched._fitted(fit, unobserved=False, apart_from=frozenset()) == [] and asked


def test_no_explanation_is_settled_twice(searched, monkeypatch):
    """Exchange, foretelling and a second search ask for the same."""
    settled, asked = search_module.settled, []
    monkeypatch.setattr(search_module, "settled", lambda fit: asked.append(search_module._values(fit)) or settled(fit))
    again = Search(searched.evidence, searched.grid)
    first = again.run()
    count = len(asked)
    assert count == len(set(asked)) > 0
    assert again.run().fit is first.fit and len(asked) == count
