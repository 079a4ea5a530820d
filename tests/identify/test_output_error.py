"""The fit against closed answers, central differences and the scatter over many seeds."""

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.errors import DataError
from compensator.identify.arx import free_run_rms
from compensator.identify.choice import fit, folds_of
from compensator.identify.output_error import Segment, Structure, _Problem, fit_output_error
from compensator.identify.rest import settle_starts
from tests.identify.quill_runs import CALIBRATION_W, QUILL, VALIDATION_W, fit_pct, published

TRUE = Structure(order=3, terms=(3, 2))


def test_noise_free_data_gives_the_equations_back():
    heat, ambient, _, _, _, y = published(CALIBRATION_W, 1)
    result = fit([Segment.of([heat, ambient], y + 7.0)], TRUE, 60.0)
    assert result.function(0).b == pytest.approx(QUILL.dtf.sampled.b[:3], rel=1e-3)
    assert result.function(0).a == pytest.approx(QUILL.dtf.sampled.a, rel=1e-4)
    assert result.function(1).b == pytest.approx(QUILL.tdtf.sampled.b[:2], rel=1e-3)
    assert result.offset(0) == pytest.approx(7.0, abs=1e-3)


def test_a_warm_start_and_a_zero_are_fitted_for_each_record():
    heat, ambient, _, _, _, y = published(np.concatenate([CALIBRATION_W, VALIDATION_W]), 1)
    warm = [Segment.of([heat[a:b], ambient[a:b]], y[a:b] + zero) for a, b, zero in ((200, 800, 3.0), (800, 1600, -5.0))]
    result = fit(warm, TRUE, 60.0)
    assert result.sigma < 1e-3
    assert result.gain(0)[0] == pytest.approx(QUILL.dtf.in_s().dc_gain, rel=1e-3)
    again = result.simulate([heat[200:800], ambient[200:800]]) + result.free_decay(0, 600) + result.offset(0)
    assert again == pytest.approx(y[200:800] + 3.0, abs=0.05)


def test_sensitivities_are_those_of_central_differences():
    heat, ambient, _, y, _, _ = published(CALIBRATION_W, 2)
    problem = _Problem([Segment.of([heat, ambient], y)], TRUE, 60.0)
    at = np.log([2.0, 25.0, 200.0])
    problem.solve(at)
    coefficients, analytic = problem.coefficients.copy(), problem.sensitivities()
    for i in range(3):
        outputs = []
        for side in (1.0, -1.0):
            moved = at.copy()
            moved[i] += side * 1e-5
            problem.solve(moved)
            outputs.append(problem.stacked(problem.parts) @ coefficients)
        numeric = (outputs[0] - outputs[1]) / 2e-5
        scale = np.max(np.abs(numeric))
        assert analytic[:720, i] == pytest.approx(numeric[:720], abs=1e-5 * scale)


def test_hidden_samples_take_no_part():
    heat, ambient, _, y, _, _ = published(CALIBRATION_W, 3)
    used = np.ones(720, dtype=bool)
    used[300:400] = False
    spoilt = y.copy()
    spoilt[300:400] = 1e4
    clean, other = (fit([Segment.of([heat, ambient], v, used)], TRUE, 60.0) for v in (y, spoilt))
    assert clean.amplitudes == pytest.approx(other.amplitudes, rel=1e-12)
    assert np.min(np.abs(other.residuals[0][300:400])) > 1000.0


def test_standard_errors_are_what_scatters():
    gains, taus, stds = [], [], []
    for seed in range(60):
        heat, _, difference, _, _, _ = published(CALIBRATION_W, seed)
        result = fit([Segment.of(heat, difference)], Structure(order=2, terms=(2,)), 60.0)
        gains.append(result.gain()[0])
        taus.append(result.taus_min[1])
        stds.append((result.gain()[1], result.taus_std_min[1]))
    mean = np.mean(stds, axis=0)
    assert np.std(gains) == pytest.approx(mean[0], rel=0.35)
    assert np.std(taus) == pytest.approx(mean[1], rel=0.35)


def test_a_coloured_residual_widens_the_errors():
    heat, _, _, _, difference, _ = published(CALIBRATION_W, 1)
    rng = np.random.default_rng(0)
    structure = Structure(order=2, terms=(2,))
    white = rng.normal(0, 0.05, 720)
    red = lfilter([1.0], [1.0, -0.95], white) * np.sqrt(1 - 0.95**2)
    plain, coloured = (fit([Segment.of(heat, difference + e)], structure, 60.0) for e in (white, red))
    assert plain.variance_inflation < 2.0
    assert coloured.variance_inflation > 5.0
    assert coloured.gain()[1] > 2.0 * plain.gain()[1]


def test_simulate_is_the_function_that_goes_into_the_file():
    heat, ambient, _, y, _, _ = published(CALIBRATION_W, 4)
    result = fit([Segment.of([heat, ambient], y)], TRUE, 60.0)
    both = result.function(0).response(heat) + result.function(1).response(ambient)
    assert result.simulate([heat, ambient]) == pytest.approx(both, abs=1e-7)


def test_coefficient_errors_follow_from_those_of_gain_and_time_constants():
    heat, _, difference, _, _, _ = published(CALIBRATION_W, 5)
    result = fit([Segment.of(heat, difference)], Structure(order=2, terms=(2,)), 60.0)
    b, a = result.function().b, result.function().a
    total = sum(a)
    gradient = np.array([1 / total] * len(b) + [-sum(b) / total**2] * 2)
    covariance = result.coefficient_covariance()
    assert np.sqrt(gradient @ covariance @ gradient) == pytest.approx(result.gain()[1], rel=1e-4)


def test_every_start_leads_to_a_stable_function():
    rng = np.random.default_rng(9)
    noise = rng.normal(size=400)
    for start in ([0.6, 0.7], [300.0, 390.0], [1.0, 1.0]):
        result = fit_output_error(
            [Segment.of(rng.normal(size=400), noise)], Structure(order=2, terms=(2,)), period_s=60.0, starts=[start]
        )
        assert result.function().is_stable()


def test_more_parameters_than_samples_is_refused():
    with pytest.raises(DataError, match="measured sample"):
        fit([Segment.of(np.ones(6), np.arange(6.0))], TRUE.__class__(order=3, terms=(3,)), 60.0)


def test_folds_hide_every_sample_once():
    segments = [Segment.of(np.ones(50), np.ones(50)), Segment.of(np.ones(70), np.ones(70), np.arange(70) > 9)]
    hidden = np.zeros(120, dtype=int)
    for part in folds_of(segments, 4):
        kept = np.concatenate([s.used for s in part])
        hidden += np.concatenate([s.used for s in segments]) & ~kept
    assert hidden.tolist() == [1] * 50 + [0] * 10 + [1] * 60


def test_rest_is_kept_where_true_and_given_up_where_not():
    heat, ambient, _, y, _, _ = published(CALIBRATION_W, 6)
    cold = [Segment.of([heat, ambient], y)]
    warm = [Segment.of([heat[420:], ambient[420:]], y[420:])]
    assert settle_starts(cold, TRUE, 60.0, 5)[0][0].rest
    assert not settle_starts(warm, TRUE, 60.0, 5)[0][0].rest


def test_accuracy_on_the_published_case():
    ttf, deformation = [], []
    for seed in range(5):
        heat, ambient, difference, y, _, _ = published(CALIBRATION_W, seed)
        q, a, d, v, true_d, true_y = published(VALIDATION_W, 100 + seed)
        temperature = fit([Segment.of(heat, difference)], Structure(order=2, terms=(2,)), 60.0)
        both = fit([Segment.of([heat, ambient], y, rest=True)], TRUE, 60.0)
        ttf.append(fit_pct(d, true_d) - fit_pct(d, temperature.simulate(q)))
        deformation.append(fit_pct(v, true_y) - fit_pct(v, both.simulate([q, a])))
    assert np.median(ttf) < 0.02
    assert np.median(deformation) < 0.5


def test_arx_is_far_off_in_free_run_where_output_error_is_not():
    heat, ambient, _, y, _, _ = published(CALIBRATION_W, 1)
    segment = Segment.of([heat, ambient], y)
    assert fit([segment], TRUE, 60.0).sigma < 0.35
    assert free_run_rms([segment], TRUE, period_s=60.0) > 3.0
