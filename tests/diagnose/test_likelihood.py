"""The likelihood against what its covariance says when it is written out, with gaps and several records."""

import numpy as np
import pytest

from compensator.diagnose.fitting import likelihood as likelihood_module
from compensator.diagnose.fitting.fit import fit_terms
from compensator.diagnose.fitting.likelihood import Likelihood, RandomColumns, learned_rest
from compensator.diagnose.fitting.points import Points, SlowRest
from compensator.diagnose.fitting.whitening import MANY, Whitening
from compensator.diagnose.residual.evidence import evidence_of
from compensator.diagnose.search.background import Background, _Problem
from compensator.diagnose.search.scan import Scan
from compensator.diagnose.search.search import Search
from compensator.model.effects.hypothesis import proposals
from compensator.model.model_file import load_model
from tests.diagnose.scenarios import draw, record
from tests.identify.quill_runs import runs_from

QUILL = load_model("quill")
REST = SlowRest(0.2, 1.5, 90.0, 3.0, 0.4, 0.5)


@pytest.fixture(scope="module")
def evidence():
    """A day of an effect with four hours without Y, and another day."""
    columns, _, _ = record([draw("input", 3, 4.0)], 70, 24.0)
    columns["y_um"][400:640] = np.nan
    other, _, _ = record([draw("input", 3, 4.0)], 71, 12.0)
    return evidence_of(QUILL, [*runs_from(columns), *runs_from(other)])


def covariance(points, rest):
    """Noise and slow rest, from run to run independent."""
    run = np.searchsorted(points.starts, np.arange(points.count), side="right")
    together = run[:, None] == run[None, :]
    apart = np.abs(points.first[:, None] - points.first[None, :])
    noise = np.diag(rest.noise_um**2 * points.relative_variance)
    return noise + together * rest.slow_um**2 * np.exp(-apart / rest.tau_min)


def test_points_are_the_means_of_what_is_used(evidence):
    points, end = Points(evidence), evidence.used.size
    held_out = np.zeros(end, dtype=bool)
    held_out[100:301] = True
    part = Points(evidence.without(held_out))
    assert set(part.first) < set(points.first)
    course = np.arange(float(end))
    compared = evidence.used.copy()
    for run_end in np.cumsum([signals.size for signals in evidence.signals]):
        compared[run_end - 10 : run_end] = False  # only later samples would say what acted there
    for each, used in ((points, compared), (part, compared & ~held_out)):
        edges = [*each.first.tolist(), end]
        averaged = each.averaged(course[:, None])[:, 0]
        for i in range(each.count):
            some = [k for k in range(edges[i], min(edges[i] + 3, end)) if used[k]]
            assert averaged[i] == pytest.approx(np.mean(course[some])), (i, edges[i])


@pytest.mark.parametrize(
    "rest", [REST, SlowRest(0.02, 40.0, 2000.0, 3.0, 0.4, 0.5), SlowRest(2.0, 1e-3, 1.0, 3.0, 0.4, 0.5)]
)
def test_whitened_data_have_the_covariance_written_out(evidence, rest):
    held_out = np.zeros(evidence.used.size, dtype=bool)
    held_out[100:301] = True
    for each in (evidence, evidence.without(held_out)):
        points = Points(each)
        whitening, y, full = Whitening(points, rest), points.residual, covariance(points, rest)
        assert float(np.sum(whitening.of(y[:, None]) ** 2)) == pytest.approx(float(y @ np.linalg.solve(full, y)))
        assert whitening.log_det == pytest.approx(float(np.linalg.slogdet(full)[1]))


def test_many_columns_are_whitened_as_one_is(evidence):
    points = Points(evidence)
    table = np.random.default_rng(4).normal(size=(points.count, MANY + 1))
    whitening = Whitening(points, REST)
    one_by_one = np.column_stack([whitening.of(table[:, [i]]) for i in range(table.shape[1])])
    assert whitening.of(table) == pytest.approx(one_by_one)
    assert whitening.of(table[:, :7]) == pytest.approx(one_by_one[:, :7])


def test_products_of_whitened_columns_are_those_of_projected_ones(evidence):
    points = Points(evidence)
    likelihood, table = Likelihood(points, REST), np.random.default_rng(5).normal(size=(points.count, 3))
    white, taken = likelihood.whitened(table)
    projected = likelihood.projected(table)
    assert white.T @ white - taken.T @ taken == pytest.approx(projected.T @ projected)
    assert white.T @ likelihood.target[: points.count] == pytest.approx(projected.T @ likelihood.target)


def test_the_scan_ranks_by_what_a_fit_adds_to_the_evidence(evidence):
    """Also beside an effect, and for hypotheses of one, two and no amplitude."""
    points = Points(evidence)
    hypotheses = [one for one in proposals(evidence.context) if len(one.amplitudes) < 3][:40]
    likelihood, scan = Likelihood(points, REST), Scan(points, hypotheses)
    beside = next(one for one in hypotheses if one.amplitudes and one.grid())
    fit = fit_terms(likelihood, [(beside, beside.grid()[0])], evaluations=1)
    base = fit_of(likelihood, fit.columns)
    for hypothesis, values in scan.ranked(likelihood, fit, lambda _: 0.0)[:12]:
        columns = points.columns_of(hypothesis, tuple(values))
        best = max(gain(likelihood, fit, points, hypothesis, at) - base for at in hypothesis.grid())
        assert gain(likelihood, fit, points, hypothesis, values) - base == pytest.approx(best, abs=1e-6), columns.shape


def fit_of(likelihood, columns, fixed=None):
    target = likelihood.target if fixed is None else likelihood.left_by(fixed)
    return -RandomColumns(likelihood.projected(columns), target).surprise


def gain(likelihood, fit, points, hypothesis, values):
    columns = points.columns_of(hypothesis, tuple(values))
    if not hypothesis.amplitudes:
        return fit_of(likelihood, fit.columns, columns[:, 0])
    scaled = points.scaled(columns, hypothesis.sizes, columns.shape[1])[0]
    return fit_of(likelihood, np.column_stack([fit.columns, scaled]))


def test_slopes_of_the_evidence_are_those_of_differences(evidence, monkeypatch):
    """The minimiser gets what it would get from differences of the whole."""
    points, seen = Points(evidence), []

    def minimised(function, begin, **_):
        for i in range(begin.size):
            step = 1e-4 * (np.arange(begin.size) == i)
            by_difference = (function(begin + step)[0] - function(begin - step)[0]) / 2e-4
            seen.append((function(begin)[1][i], by_difference))
        raise StopIteration

    monkeypatch.setattr(likelihood_module, "minimize", minimised)
    with pytest.raises(StopIteration):
        learned_rest(points, np.zeros((points.count, 0)), np.zeros(points.count), REST)
    from compensator.diagnose.search import background as background_module

    monkeypatch.setattr(background_module, "minimize", minimised)
    with pytest.raises(StopIteration):
        Background(evidence).fitted(points, np.zeros(points.count), REST)
    got, wanted = np.array(seen).T
    assert got == pytest.approx(wanted, rel=0.01, abs=0.01)


def test_all_lags_of_a_channel_have_gains_of_one_expected_size(evidence):
    """A long lag moves little in a record: as large in it as a short one, it would be the largest on a longer day."""
    points = Points(evidence)
    background = Background(evidence)
    problem = _Problem(background, points, np.zeros(points.count))
    moves = np.std(points.averaged(background.columns), axis=0)
    for group in range(len(background.template.channels)):
        lags = background.groups == group
        assert np.ptp(problem.scale[lags]) == 0.0
        assert np.max(np.std(problem.table[:, lags], axis=0)) == pytest.approx(1.0)
    assert np.min(moves / problem.scale) < 0.7


def test_a_search_without_some_data_uses_the_columns_of_the_whole(evidence):
    held_out = np.zeros(evidence.used.size, dtype=bool)
    held_out[800:1200] = True
    part = evidence.without(held_out)
    whole = Search(evidence)
    places = [
        [term.hypothesis.place for term in Search(part, grid).run(unobserved=False).fit.terms]
        for grid in (None, whole.grid)
    ]
    assert places[0] == places[1] != []
