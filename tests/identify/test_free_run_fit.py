"""The fit where its answer is known in closed form or to the last digits."""

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.errors import DataError
from compensator.identify.choice import fit
from compensator.identify.output_error import (
    Segment,
    Structure,
    _Problem,
    fit_output_error,
    low_frequency_ratio,
    poles_of,
)
from tests.identify.quill_runs import CALIBRATION_W, published

TRUE = Structure(order=3, terms=(3, 2))
TAUS = np.array([4.0, 25.0, 140.0])
AMPLITUDES = np.array([1.2, -8.0, 30.0, -2.5, 15.0])


def inputs(n, seed):
    rng = np.random.default_rng(seed)
    heat = np.repeat(rng.choice([0.0, 30.0, 60.0, 90.0], n // 60 + 1), 60)[:n]
    return np.stack([heat, lfilter([0.02], [1.0, -0.98], rng.normal(0.0, 5.0, n))])


def columns_of(u):
    """Every amplitude's column, written out anew: G u, ΔG u, Δ²G u of the first, G u, ΔG u of the second input."""
    p = poles_of(TAUS, 60.0)
    b, a = [np.prod(1.0 - p)], np.poly(p)
    difference = [1.0, -1.0]
    numerators = [b, np.convolve(b, difference), np.convolve(np.convolve(b, difference), difference)]
    filtered = [lfilter(n, a, u[0]) for n in numerators] + [lfilter(n, a, u[1]) for n in numerators[:2]]
    return np.stack(filtered, axis=1)


def exact(n, lead, zero, seed):
    """A stretch that begins `lead` samples into a run, so that its initial state is not zero."""
    u = inputs(lead + n, seed)
    y = columns_of(u) @ AMPLITUDES
    return u[:, lead:], y[lead:] + zero


def test_two_segments_with_states_and_offsets_give_everything_back():
    first, second = exact(700, 400, 3.0, 1), exact(900, 250, -11.0, 2)
    segments = [Segment.of(*first), Segment.of(*second)]
    result = fit(segments, TRUE, 60.0)
    assert result.taus_min == pytest.approx(TAUS, rel=1e-3)
    assert result.amplitudes == pytest.approx(AMPLITUDES, rel=1e-3)
    assert [result.offset(0), result.offset(1)] == pytest.approx([3.0, -11.0], abs=1e-2)
    for i, (u, y) in enumerate((first, second)):
        whole = result.simulate(u) + result.free_decay(i, y.size) + result.offset(i)
        assert whole == pytest.approx(y, abs=2e-3)
        assert y - whole == pytest.approx(result.residuals[i], abs=1e-9)


def test_what_is_left_of_the_initial_state_dies_out():
    u, y = exact(1500, 400, 3.0, 1)
    decay = fit([Segment.of(u, y)], TRUE, 60.0).free_decay(0, 3000)
    assert np.max(np.abs(decay[:60])) > 5.0
    assert abs(decay[-1]) < 1e-6 * np.max(np.abs(decay))
    assert np.array_equal(fit([Segment.of(u, y, rest=True)], TRUE, 60.0).free_decay(0, 50), np.zeros(50))


def test_kaufman_s_jacobian_gives_the_gradient_of_the_cost():
    """The term it leaves out is orthogonal to the residual, so that the gradient is exact and not an approximation."""
    heat, ambient, _, y, _, _ = published(CALIBRATION_W, 2)
    used = np.arange(720) % 7 != 0
    problem = _Problem([Segment.of([heat, ambient], y, used)], TRUE, 60.0)
    at = np.log([2.0, 25.0, 200.0])
    analytic = problem.jac(at).T @ problem.fun(at)

    def cost(log_taus):
        return 0.5 * float(np.sum(problem.fun(log_taus) ** 2))

    for i in range(3):
        step = 1e-5 * np.eye(3)[i]
        numeric = (cost(at + step) - cost(at - step)) / 2e-5
        assert numeric == pytest.approx(analytic[i], rel=1e-5, abs=1e-5 * np.max(np.abs(analytic)))


def test_the_model_s_own_response_and_its_error_band():
    heat, ambient, _, y, _, _ = published(CALIBRATION_W, 4)
    result = fit([Segment.of([heat, ambient], y)], TRUE, 60.0)
    single = result.simulate([heat, np.zeros(720)])
    assert single == pytest.approx(result.function(0).response(heat), abs=1e-9)
    _, std = result.simulate_with_std([np.full(20_000, 90.0), np.zeros(20_000)])
    # At rest nothing but the gain's own error is left.
    assert std[-1] == pytest.approx(90.0 * result.gain()[1], rel=1e-3)


def test_standard_errors_of_gain_and_time_constant_over_many_seeds():
    u = inputs(500, 5)[:1]
    clean = lfilter([0.03], [1.0, -0.97], u[0])
    structure = Structure(order=1, terms=(1,))
    rows = []
    for seed in range(60):
        y = clean + np.random.default_rng(seed).normal(0.0, 2.0, 500)
        result = fit_output_error([Segment.of(u, y)], structure, period_s=60.0, starts=[[20.0]])
        rows.append((*result.gain(), result.taus_min[0], result.taus_std_min[0], result.variance_inflation))
    gain, gain_std, tau, tau_std, colour = np.array(rows).T
    assert np.std(gain) == pytest.approx(np.mean(gain_std), rel=0.3)
    assert np.std(tau) == pytest.approx(np.mean(tau_std), rel=0.3)
    assert np.mean(gain) == pytest.approx(1.0, abs=4 * np.mean(gain_std) / np.sqrt(60))
    assert np.median(colour) < 1.5


def test_standard_errors_count_the_colour_in():
    """Over many seeds of slow noise the reported error must not stay at what white noise would leave."""
    u = inputs(2000, 6)[:1]
    clean = lfilter([0.03], [1.0, -0.97], u[0])
    structure = Structure(order=1, terms=(1,))
    rows = []
    for seed in range(40):
        white = np.random.default_rng(seed).normal(0.0, 2.0, 2000)
        y = clean + lfilter([np.sqrt(1 - 0.9**2)], [1.0, -0.9], white)
        result = fit_output_error([Segment.of(u, y)], structure, period_s=60.0, starts=[[20.0]])
        rows.append((*result.gain(), result.variance_inflation))
    gain, gain_std, colour = np.array(rows).T
    assert np.median(colour) > 3.0
    assert 0.6 < np.mean(gain_std) / np.std(gain) < 2.5


def test_colour_of_known_noise():
    rng = np.random.default_rng(0)
    white = rng.normal(size=20_000)
    assert low_frequency_ratio([white]) == pytest.approx(1.0, abs=0.2)
    # The spectrum of an autoregression at frequency 0 over its variance is (1 + ρ) / (1 − ρ).
    assert low_frequency_ratio([lfilter([1.0], [1.0, -0.8], white)]) == pytest.approx(9.0, rel=0.35)
    assert low_frequency_ratio([np.zeros(50)]) == 1.0


def test_an_input_that_never_moves_is_a_direction_the_data_does_not_know():
    u = np.stack([inputs(400, 7)[0], np.zeros(400)])
    y = lfilter([0.1], [1.0, -0.9], u[0])
    result = fit([Segment.of(u, y)], Structure(order=1, terms=(1, 1)), 60.0)
    assert result.rank_deficit == 1
    assert result.gain(0)[0] == pytest.approx(1.0, rel=1e-4)
    assert result.gain(1)[0] == pytest.approx(0.0, abs=1e-9)


def test_missing_y_is_neither_used_nor_needed():
    u, y = exact(900, 0, 5.0, 8)
    gappy = y.copy()
    gappy[200:500] = np.nan
    result = fit([Segment.of(u, gappy)], TRUE, 60.0)
    assert result.taus_min == pytest.approx(TAUS, rel=1e-3)
    assert np.isnan(result.residuals[0][200:500]).all()
    assert np.isfinite(result.residuals[0][:200]).all()


def test_too_few_samples_counts_the_nuisances():
    u, y = exact(13, 0, 0.0, 9)
    # 3 time constants, 5 amplitudes, 3 states and 1 offset: 12 numbers.
    with pytest.raises(DataError, match=r"12 measured sample\(s\) for 12 parameters"):
        fit_output_error([Segment.of(u, y, np.arange(13) > 0)], TRUE, period_s=60.0, starts=[TAUS])
    resting = Segment.of(u, y, np.arange(13) > 0, rest=True)
    assert fit_output_error([resting], TRUE, period_s=60.0, starts=[TAUS]).residuals[0].size == 13


@pytest.mark.parametrize(
    "wrong",
    [
        {"terms": ()},
        {"terms": (0,)},
        {"terms": (1,), "order": -1},
    ],
)
def test_structures_that_make_no_sense(wrong):
    with pytest.raises(DataError, match="structure"):
        Structure(**({"order": 1} | wrong))
