"""Calibrations whose DTF is driven by the known heat, from cold and from warm."""

import numpy as np
import pytest

from compensator.errors import DataError
from compensator.identify.calibration import calibrate
from compensator.identify.settings import Settings
from tests.identify.quill_runs import CALIBRATION_W, QUILL, VALIDATION_W, fit_pct, published, runs_from

KNOWN = Settings(order=(3, 3, 2), drive="known", folds=2)


def columns(heat_w, seed, **noise):
    heat, ambient, difference, y, _, true_y = published(heat_w, seed, **noise)
    at = 21.0 + ambient
    return {"t_q_degc": at + difference, "at_degc": at, "y_um": y, "heat_w": heat}, true_y


def test_the_drive_is_what_was_asked_for():
    data, _ = columns(CALIBRATION_W, 1)
    known = calibrate(runs_from(data), KNOWN, period_s=60.0, name="known")
    assert np.array_equal(known.drives[0], CALIBRATION_W)
    told = calibrate(runs_from(data), Settings(order=(3, 3, 2), folds=2), period_s=60.0, name="ttf")
    assert np.std(told.drives[0] - CALIBRATION_W) > 2.0
    assert told.deformation.main.sigma > known.deformation.main.sigma
    assert known.deformation.main.sigma == pytest.approx(0.3, rel=0.1)


def test_known_heat_on_unseen_runs_within_half_a_point_of_the_truth():
    short = []
    for seed in range(5):
        data, _ = columns(CALIBRATION_W, seed)
        result = calibrate(runs_from(data), KNOWN, period_s=60.0, name="known")
        heat, ambient, _, y, _, true_y = published(VALIDATION_W, 100 + seed)
        short.append(fit_pct(y, true_y) - fit_pct(y, result.deformation.main.simulate([heat, ambient])))
    assert np.median(short) < 0.5


def test_a_record_whose_first_eight_hours_are_missing_has_a_fitted_start():
    data, _ = columns(np.concatenate([CALIBRATION_W, VALIDATION_W]), 3, noise_k=0.01, noise_um=0.1)
    warm = {name: values[480:] for name, values in data.items()}
    result = calibrate(runs_from(warm), KNOWN, period_s=60.0, name="warm")
    assert not result.deformation.segments[0].rest
    assert result.deformation.main.sigma == pytest.approx(0.1, rel=0.15)
    assert result.deformation.main.gain()[0] == pytest.approx(QUILL.dtf.in_s().dc_gain, rel=0.05)
    assert np.max(np.abs(result.deformation.main.free_decay(0, 60))) > 5.0


def test_what_was_seen_bounds_what_is_trusted():
    data, _ = columns(CALIBRATION_W, 1)
    model = calibrate(runs_from(data), KNOWN, period_s=60.0, name="known").model
    assert model.validity["heat_w"] == pytest.approx((-0.33 * 90.0, 1.33 * 90.0), abs=1e-3)
    low, high = model.validity["at_degc"]
    assert low == pytest.approx(data["at_degc"].min() - 2.0, abs=1e-3)
    assert high == pytest.approx(data["at_degc"].max() + 2.0, abs=1e-3)
    assert model.estimator.t_q_noise_std_k == pytest.approx(0.05, rel=0.25)


def test_too_little_before_fit_until_is_refused():
    data, _ = columns(CALIBRATION_W, 1)
    with pytest.raises(DataError, match="run: less than 2 h of samples left for the fit"):
        calibrate(runs_from(data), KNOWN, period_s=60.0, name="x", fit_until_s=119 * 60.0)
