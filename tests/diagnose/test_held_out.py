"""What is said of held-out blocks where nothing is named: the same as by a search, without one."""

import dataclasses

import numpy as np
import pytest

from compensator.diagnose import held_out as module
from compensator.diagnose.evidence import evidence_of
from compensator.diagnose.findings import findings_of
from compensator.diagnose.held_out import _RESTS, _of_channels, _predictions, held_out_of
from compensator.diagnose.prediction import FOLDS
from compensator.model.model_file import load_model
from compensator.progress import unreported
from tests.diagnose.scenarios import record
from tests.identify.quill_runs import runs_from


@pytest.fixture(scope="module")
def found():
    return findings_of(evidence_of(load_model("quill"), runs_from(record([], 73, 12.0)[0])))


def test_where_nothing_is_named_no_block_is_searched(found, monkeypatch):
    assert not found.terms and found.remainder is None
    monkeypatch.setattr(module, "findings_of", None)
    held_out = held_out_of(found, (), unreported, map)
    np.testing.assert_array_equal(held_out.named, held_out.nothing)
    np.testing.assert_array_equal(held_out.whole, held_out.nothing)
    assert np.isfinite(held_out.ceiling).any() and not np.array_equal(held_out.ceiling, held_out.nothing)


def test_what_nothing_and_all_channels_leave_is_what_a_search_says(found):
    evidence = found.search.evidence
    view = evidence.without(next(iter(evidence.blocks(FOLDS))))
    rests = found.selection.fit.rest, found.selection.before.rest
    searched = _predictions(
        view,
        places=(),
        own_alone=False,
        unobserved=False,
        grid=None,
        foresight=None,
        begins_warm=False,
        leaves_late=False,
        rests=rests,
    )
    short = _of_channels(view, rests=rests)
    assert short.knows_zero == searched.knows_zero
    for name in (*_RESTS, "ceiling"):
        np.testing.assert_array_equal(short.predicted[name], searched.predicted[name])


def test_a_remainder_without_a_name_is_confirmed_by_searches(found, monkeypatch):
    """The own error alone has no name, and is deployed as far as the others find it again."""
    asked, search = [], module.findings_of
    monkeypatch.setattr(module, "findings_of", lambda seen, **known: asked.append(seen) or search(seen, **known))
    with_one = dataclasses.replace(found, remainder=found.channels)
    held_out_of(with_one, (), unreported, map)
    assert len(asked) == FOLDS
