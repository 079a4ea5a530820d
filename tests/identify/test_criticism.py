"""Warnings come when they should and stay away when they should not."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.identify.calibration import calibrate
from compensator.identify.criticism import LAGS, criticise, view_path, view_residual
from compensator.identify.deformation import PathFit
from compensator.identify.settings import Settings
from compensator.identify.temperature import noise_gain
from compensator.model.transfer_function import SampledTransferFunction, TransferFunction
from tests.identify.quill_runs import QUILL, runs_from

ORDER = (2, 2, 2)
TAUS_MIN = (15.0, 120.0)


def two_modes(fast, slow):
    """Both of the machine's modes side by side, in just the terms that are fitted."""
    p, q = ((2.0 * tau - 1.0) / (2.0 * tau + 1.0) for tau in TAUS_MIN)
    b = fast * (1.0 - p) * np.array([1.0, -q]) + slow * (1.0 - q) * np.array([1.0, -p])
    return SampledTransferFunction(b=tuple(b.tolist()), a=(1.0, -(p + q), p * q), period_s=60.0)


DTF, TDTF = two_modes(3.0, 2.0), two_modes(-1.0, -4.0)


def machine(n=2400, *, swing_k=3.0, seed=0, extra_um=0.0, follows=False):
    """T_Q − AT at several levels, air that swings by ±`swing_k`, white noise of 0.3 µm and whatever is added."""
    rng = np.random.default_rng(seed)
    levels = np.repeat(rng.choice([0.0, 5.0, 10.0, 20.0], n // 80 + 1), 80)[:n]
    levels[:60] = 0.0
    air = swing_k * np.sin(2 * np.pi * np.arange(n) / 1440.0)
    air[:60] = 0.0
    rise = lfilter([0.03], [1.0, -0.97], levels) if not follows else 2.0 * air
    y = DTF.response(rise) + TDTF.response(air) + rng.normal(0.0, 0.3, n) + extra_um
    at = 21.0 + air + rng.normal(0.0, 0.001, n)
    return {"t_q_degc": at + rise, "at_degc": at, "y_um": y}


def made(columns, **changes):
    validation = changes.pop("validation", ())
    return calibrate(
        runs_from(columns),
        Settings(kind="direct", order=ORDER, folds=3, **changes),
        period_s=60.0,
        name="machine",
        validation=validation,
    )


def said(calibration, words):
    return any(words in warning for warning in criticise(calibration).warnings)


@pytest.fixture(scope="module")
def good():
    return made(machine())


@pytest.mark.parametrize(
    "words",
    [
        "ambient changed",
        "poorly determined",
        "longest record",
        "outside the unit circle",
        "not white",
        "worse than no compensation",
        "changed together",
        "slower than the record",
        "coincide",
        "reverses",
        "of noise in a heat",
    ],
)
def test_a_good_calibration_is_not_blamed(good, words):
    assert not said(good, words), criticise(good).warnings


def test_the_range_is_always_said(good):
    low, high = good.model.validity["at_degc"]
    assert low < 18.0
    assert high > 24.0
    assert said(good, f"AT from {low:.0f} to {high:.0f} °C")


def test_quiet_ambient():
    assert said(made(machine(swing_k=0.6)), "The ambient changed by only 1.2 K")


def test_short_record():
    assert said(made(machine(300)), "The longest record covers 5.0 h")


def test_a_zero_outside_the_unit_circle(good):
    wrong_way = SampledTransferFunction(b=(-0.1, 0.3), a=(1.0, -0.9), period_s=60.0)
    deformation = dataclasses.replace(
        good.deformation, dtf=dataclasses.replace(good.deformation.dtf, function=wrong_way)
    )
    assert said(
        dataclasses.replace(good, deformation=deformation), "The DTF has a zero outside the unit circle (z = 3)"
    )


def test_a_coloured_residual():
    slow = 5.0 * lfilter([0.02], [1.0, -0.98], np.random.default_rng(1).normal(0.0, 3.0, 2400))
    assert said(made(machine(extra_um=slow)), "is not white")


def test_white_residuals_are_seldom_blamed():
    """Both tests are held to 99 %, so that one of a dozen may be blamed by chance and no more."""
    blamed = sum(said(made(machine(1200, seed=seed)), "is not white") for seed in range(10, 22))
    assert blamed <= 1


def test_drive_and_ambient_together():
    assert said(
        made(machine(follows=True)),
        "The drive of the DTF and the ambient temperature changed together (correlation 1.00)",
    )


def test_worse_than_no_compensation(good):
    backwards = machine(seed=3)
    backwards["y_um"] = -backwards["y_um"]
    blamed = made(machine(), validation=runs_from(backwards, name="other"))
    assert criticise(blamed).warnings[0].startswith("On other (held out) the model is worse than no compensation")


@pytest.mark.parametrize(("share", "blamed"), [(0.99, True), (0.9, False)])
def test_a_mode_held_at_the_record_s_length(good, share, blamed):
    main = good.deformation.main
    held = dataclasses.replace(main, taus_min=np.array([main.taus_min[0], share * main.longest_min]))
    dtf = dataclasses.replace(good.deformation.dtf, fit=held)
    changed = dataclasses.replace(good, deformation=dataclasses.replace(good.deformation, dtf=dtf))
    assert said(changed, "slower than the record (40 h)") == blamed


def test_noise_through_the_published_inverse():
    assert 0.05 * noise_gain(QUILL.ttf.sampled) == pytest.approx(4.4, rel=0.02)
    noise = np.random.default_rng(0).normal(0.0, 0.05, 100_000)
    assert np.std(lfilter(QUILL.ttf.sampled.a, QUILL.ttf.sampled.b, noise)) == pytest.approx(4.4, rel=0.03)


def test_a_view_is_the_path(good):
    view = criticise(good).paths[0]
    path = good.deformation.dtf.function
    assert (view.name, view.unit) == ("DTF", "um/K")
    assert view.step == pytest.approx(np.cumsum(view.impulse), abs=1e-6)
    assert view.step == pytest.approx(path.response(np.ones(view.t_min.size)), abs=1e-6)
    assert view.gain == pytest.approx(5.0, rel=0.05)
    assert view.magnitude[0] == pytest.approx(abs(view.gain), rel=0.06)
    assert view.frequency_per_h[-1] == pytest.approx(30.0)
    i = int(np.argmin(np.abs(view.frequency_per_h - 1.0)))
    z = np.exp(-2j * np.pi * view.frequency_per_h[i] / 60.0)
    expected = np.polyval(path.b[::-1], z) / np.polyval(path.a[::-1], z)
    assert view.magnitude[i] == pytest.approx(abs(expected), rel=1e-9)
    assert np.exp(1j * np.radians(view.phase_deg[i])) == pytest.approx(expected / abs(expected), abs=1e-9)


def test_a_given_path_has_no_error():
    function = TransferFunction(numerator=(-3.0,), denominator=(1.0, 5.0), unit="um/K").sampled(60.0)
    view = view_path(PathFit(name="TDTF", fit=None, column=0, function=function), "um/K", 60.0)
    assert (view.gain, view.gain_std) == (pytest.approx(-3.0), 0.0)
    assert view.taus_min == pytest.approx((5.0,))
    assert not view.step_std.any()


def test_an_echo_is_found_at_its_lag():
    rng = np.random.default_rng(0)
    cause = rng.normal(size=3000)
    residual = rng.normal(size=3000) * 0.5
    residual[7:] += cause[:-7]
    view = view_residual("y", [residual], {"cause": [cause], "other": [rng.normal(size=3000)]})
    values, limit = view.cross["cause"]
    assert np.argmax(values) - LAGS == 7
    assert values.max() > 5.0 * limit
    assert np.mean(np.abs(view.cross["other"][0]) > view.cross["other"][1]) < 0.05
    assert view.white_chance > 0.01


def test_white_and_coloured_residuals_are_told_apart():
    white = np.random.default_rng(2).normal(size=3000)
    coloured = lfilter([1.0], [1.0, -0.5], white)
    plain, red = (view_residual("y", [r], {}) for r in (white, coloured))
    assert plain.white_chance > 0.01
    assert red.white_chance < 1e-6
    assert red.autocorrelation[:2] == pytest.approx([0.5, 0.25], abs=0.06)
    gappy = white.copy()
    gappy[100:200] = np.nan
    assert np.isfinite(view_residual("y", [gappy], {}).autocorrelation).all()
