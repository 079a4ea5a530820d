"""Held-out blocks: what is said of them where nothing is named, and what a remainder has to show on them."""

import dataclasses
import functools

import numpy as np
import pytest

from compensator.diagnose.choice import held_out as module
from compensator.diagnose.choice.deployment import _with_remainder_that_helps
from compensator.diagnose.choice.held_out import _RESTS, _of_channels, _predictions, held_out_of
from compensator.diagnose.fitting.prediction import FOLDS
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.findings import findings_of
from compensator.model.model_file import load_model
from compensator.progress import unreported
from tests.diagnose.scenarios import draw, held_out_errors, record
from tests.identify.quill_runs import runs_from


@dataclasses.dataclass
class Reported:
    """What is reported of a named effect, as far as it is asked for."""

    replaced: bool = False


@functools.cache
def diagnosed(kind):
    """What is found in half a day of the published machine with an effect."""
    return findings_of(evidence_of(load_model("quill"), runs_from(record([draw(kind, 2, 4.0)], 73, 12.0)[0])))


@pytest.fixture(scope="module")
def found():
    return diagnosed("none")


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


@pytest.mark.parametrize(
    ("kind", "left", "is_deployed"),
    [("drift", 0.9, False), ("drift", 0.5, True), ("gain DTF", 0.9, True), ("gain DTF", 1.1, False)],
)
def test_beside_an_error_of_the_measurement_alone_a_remainder_gains_by_far(kind, left, is_deployed):
    """What a drift's form misses all channels took in: the fresh run of a right model was 0.68 instead of 0.49 µm."""
    named = diagnosed(kind)
    assert named.is_of_measurement is (kind == "drift") and named.deploys_names
    with_one = dataclasses.replace(named, remainder=named.channels, is_own_error=False)
    ones = np.ones(named.ceiling.size)
    errors = held_out_errors(3.0 * ones, named=ones, whole=left * ones, ceiling=ones)
    found, _, held_out = _with_remainder_that_helps(with_one, (Reported(),), errors)
    assert (found.remainder is not None) is is_deployed
    assert held_out.whole[0] == (left if is_deployed else 1.0)
