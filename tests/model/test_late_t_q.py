"""A late T_Q is corrected as it comes in: how much is left, how far to trust it, and by the same bits everywhere."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from compensator.errors import ModelError
from compensator.model.effects import effect_from
from compensator.model.effects.lateness import Lateness
from compensator.model.engine import Engine
from compensator.model.late_observer import observe, observer_of
from compensator.model.model_file import load_model, parse_model
from compensator.model.model_writer import dump_model
from compensator.model.thermal_model import Path, ThermalModel
from compensator.model.transfer_function import SampledTransferFunction
from tests.diagnose.scenarios import signals
from tests.service.records import QUILL, direct, late, with_method


def made_late(u: np.ndarray, lag_min: float, delay_min: float) -> np.ndarray:
    """The exact lag of an input that is a straight line between samples, then the dead time."""
    if lag_min:
        keep = np.exp(-1.0 / lag_min)
        first = 1.0 - lag_min * (1.0 - keep)
        u = lfilter([first, 1.0 - keep - first], [1.0, -keep], u - u[0]) + u[0]
    k = np.arange(u.size)
    return np.interp(k - delay_min, k, u)


def run_of(
    seed: int, hours: float, noise_k: float, *, form: str, lag_min: float, delay_min: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_Q, AT and the true deformation of a working day."""
    n, columns, _, _, y_dtf, y_tdtf, difference = signals(seed, hours)
    at = columns["ambient_degc"]
    lags = {"lag_min": lag_min, "delay_min": delay_min}
    t_q = made_late(at + difference, **lags) if form == "sensor" else at + made_late(difference, **lags)
    rng = np.random.default_rng([seed, 17])
    return t_q + rng.normal(0, noise_k, n), at + rng.normal(0, noise_k, n), y_dtf + y_tdtf


def predicted(model: ThermalModel, t_q: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    engine = Engine(model)
    engine.set_reference(20.0, 20.0)
    estimates = engine.run(t_q, at)
    return np.array([e.y_um for e in estimates]), np.array([e.y_std_um for e in estimates])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("lag_min", "delay_min", "without_um", "most_um", "most_inverse_um"),
    [
        (1.0, 0.0, 0.9, 0.32, 0.36),
        (6.0, 0.0, 4.7, 0.49, 0.90),
        (0.0, 0.5, 0.5, 0.31, 0.34),
        (0.0, 2.6, 2.3, 0.47, 0.50),
        (0.0, 4.0, 3.5, 0.95, 0.95),
        (3.0, 2.0, 4.2, 0.80, 1.15),
    ],
)
@pytest.mark.parametrize("form", ["sensor", "path"])
def test_what_is_left(
    form: str, lag_min: float, delay_min: float, without_um: float, most_um: float, most_inverse_um: float
) -> None:
    days = [
        run_of(seed, 24.0, noise_k, form=form, lag_min=lag_min, delay_min=delay_min)
        for seed, noise_k in ((1, 0.01), (2, 0.04))
    ]

    def left(model: ThermalModel) -> float:
        return rms(np.array([rms(predicted(model, t_q, at)[0] - y) for t_q, at, y in days]))

    assert left(with_method("kalman")) > without_um
    for method, most in (("kalman", most_um), ("inverse", most_inverse_um)):
        assert left(late(with_method(method), form=form, lag_min=lag_min, delay_min=delay_min)) < most, method


@functools.cache
def prompt_week() -> tuple[float, float]:
    """The model's own error in a week with a T_Q that is not late, and the deviation that follows from it, µm."""
    t_q, at, y = run_of(30, 168.0, 0.03, form="sensor", lag_min=0.0, delay_min=0.0)
    y_pred, std = predicted(dataclasses.replace(QUILL, y_std_um=0.0), t_q, at)
    own_um = float(np.sqrt(max(rms(y_pred - y) ** 2 - rms(std) ** 2, 0.0)))
    return own_um, rms(np.hypot(std, own_um))


@pytest.mark.parametrize(("lag_min", "delay_min"), [(6.0, 0.0), (0.0, 3.5), (2.0, 3.0)])
def test_the_stated_deviation_is_that_of_a_week(lag_min: float, delay_min: float) -> None:
    """The model's own error is what it leaves in another week with a T_Q that is not late."""
    own_um, prompt_um = prompt_week()
    model = dataclasses.replace(
        late(dataclasses.replace(QUILL, y_std_um=0.0), lag_min=lag_min, delay_min=delay_min), y_std_um=own_um
    )
    t_q, at, y = run_of(31, 168.0, 0.03, form="sensor", lag_min=lag_min, delay_min=delay_min)
    y_pred, std = predicted(model, t_q, at)
    assert 0.7 < rms(y_pred - y) / rms(std) < 1.4
    assert rms(std) > 1.15 * prompt_um


@pytest.mark.parametrize("method", ["kalman", "inverse"])
@pytest.mark.parametrize(("lag_min", "delay_min"), [(5.0, 0.0), (0.0, 3.0), (3.0, 2.25)])
def test_the_deviation_is_exact_on_a_machine_that_is_as_the_filter_takes_it_to_be(
    method: str, lag_min: float, delay_min: float
) -> None:
    """The lag by the backward difference and the heat as a random walk: then rms over stated is 1."""
    base = dataclasses.replace(with_method(method), y_std_um=0.0)
    model, settings = late(base, lag_min=lag_min, delay_min=delay_min), QUILL.estimator
    rng, n = np.random.default_rng(5), 6000
    heat = np.cumsum(settings.drive_walk_std * rng.normal(size=n))
    ambient = np.cumsum(settings.at_walk_std_k * rng.normal(size=n))
    assert QUILL.ttf is not None and QUILL.tdtf is not None
    t_q = ambient + QUILL.ttf.sampled.response(heat)
    pole = lag_min / (lag_min + 1.0)
    t_q = lfilter([1.0 - pole], [1.0, -pole], t_q)
    t_q = np.interp(np.arange(n) - delay_min, np.arange(n), t_q) + settings.t_q_noise_std_k * rng.normal(size=n)
    y = QUILL.dtf.sampled.response(heat) + QUILL.tdtf.sampled.response(ambient)
    y_pred, std = predicted(model, 20.0 + t_q, 20.0 + ambient + settings.at_noise_std_k * rng.normal(size=n))
    # The plain inverse takes a part of a sample as a lag.
    low = 0.9 if method == "kalman" or delay_min % 1.0 == 0.0 else 0.8
    assert low < rms((y_pred - y)[50:] / std[50:]) < 1.1


def test_the_noise_of_at_counts_where_the_heat_alone_is_late() -> None:
    """The filter gets T_Q with the change of AT over the dead time, and so with its noise of both ends."""
    noise_k = 0.3
    settings = dataclasses.replace(
        with_method("kalman").estimator, at_noise_std_k=noise_k, drive_walk_std=0.5, at_walk_std_k=0.01
    )
    model = late(dataclasses.replace(QUILL, estimator=settings, y_std_um=0.0), form="path", lag_min=0.0, delay_min=4.0)
    rng, n = np.random.default_rng(6), 4000
    heat, ambient = (np.cumsum(std * rng.normal(size=n)) for std in (0.5, 0.01))
    assert QUILL.ttf is not None and QUILL.tdtf is not None
    t_q = np.concatenate((np.zeros(4), QUILL.ttf.sampled.response(heat)[:-4])) + ambient
    t_q += settings.t_q_noise_std_k * rng.normal(size=n)
    y = QUILL.dtf.sampled.response(heat) + QUILL.tdtf.sampled.response(ambient)
    y_pred, std = predicted(model, 20.0 + t_q, 20.0 + ambient + noise_k * rng.normal(size=n))
    error_um = rms((y_pred - y)[500:])
    assert 0.7 < error_um / std[-1] < 1.0
    assert error_um < 0.9


@pytest.mark.parametrize(("period_s", "delay_min", "samples"), [(5.0, 0.3333333333, 4), (5.0, 49 * 5 / 60, 49)])
def test_a_dead_time_of_whole_samples_is_not_split_by_rounding(period_s: float, delay_min: float, samples: int) -> None:
    lateness = Lateness(lag_min=0.0, delay_min=delay_min, of_ambient=True)
    assert lateness.samples(period_s) == samples
    assert lateness.within_a_sample(period_s, invertible=False).order == 0
    part = Lateness(lag_min=0.0, delay_min=delay_min + 0.01, of_ambient=True)
    assert part.samples(period_s) == samples
    assert part.within_a_sample(period_s, invertible=False).b == pytest.approx((0.88, 0.12))


@pytest.mark.parametrize("form", ["sensor", "path"])
def test_a_direct_model_too(form: str) -> None:
    base = direct("kalman")
    assert QUILL.tdtf is not None
    t_q, at, _ = run_of(3, 24.0, 0.02, form=form, lag_min=0.0, delay_min=0.0)
    _, _, _, ambient, _, _, difference = signals(3, 24.0)
    y = base.dtf.sampled.response(difference) + QUILL.tdtf.sampled.response(ambient)
    prompt = rms(predicted(base, t_q, at)[0] - y)
    for lag_min, delay_min in ((4.0, 0.0), (0.0, 3.0)):
        model = late(base, path="DTF", form=form, lag_min=lag_min, delay_min=delay_min)
        t_q, at, _ = run_of(3, 24.0, 0.02, form=form, lag_min=lag_min, delay_min=delay_min)
        before, after = (rms(predicted(m, t_q, at)[0] - y) for m in (base, model))
        assert before > 1.9 * prompt
        assert after < 1.1 * prompt


def behind(behind_min: float, walk_times: float, **changes: Any) -> ThermalModel:
    return late(direct("kalman"), path="DTF", walk_times=walk_times, behind_min=behind_min, **changes)


def test_a_drive_that_goes_on_is_foreseen() -> None:
    """T_Q − AT does not stay where it is when the heat has changed: what a dead time hides is foreseen in part."""
    base = direct("kalman")
    _, _, _, ambient, _, _, difference = signals(3, 24.0)
    assert QUILL.tdtf is not None
    y = base.dtf.sampled.response(difference) + QUILL.tdtf.sampled.response(ambient)
    t_q, at, _ = run_of(3, 24.0, 0.005, form="sensor", lag_min=0.0, delay_min=8.0)
    stays = late(base, path="DTF", lag_min=0.0, delay_min=8.0)
    goes_on = behind(20.0, 20.0 / 21.0, lag_min=0.0, delay_min=8.0)
    held, foreseen = (rms(predicted(m, t_q, at)[0] - y) for m in (stays, goes_on))
    t_q, at, _ = run_of(3, 24.0, 0.005, form="sensor", lag_min=0.0, delay_min=0.0)
    prompt = rms(predicted(base, t_q, at)[0] - y)
    assert foreseen**2 - prompt**2 < 0.4 * (held**2 - prompt**2)


def test_a_drive_behind_what_moves_is_one_behind_a_ttf() -> None:
    """The direct model has the deformation of a model with that lag as its TTF; its drive stays T_Q − AT, K."""
    model = behind(9.0, 0.3, delay_min=2.5, lag_min=3.0)
    lag = SampledTransferFunction(b=(0.1,), a=(1.0, -0.9), period_s=60.0)
    estimator = dataclasses.replace(model.estimator, drive_walk_std=3.0 * model.estimator.drive_walk_std)
    ttf, dtf = Path(sampled=lag, unit="K/W"), Path(sampled=lag.times(model.dtf.sampled), unit="um/W")
    same = dataclasses.replace(model, kind="heat", ttf=ttf, dtf=dtf, estimator=estimator, effects=())
    same = late(same, delay_min=2.5, lag_min=3.0)
    t_q, at, _ = run_of(4, 12.0, 0.02, form="sensor", lag_min=3.0, delay_min=2.5)
    ours, theirs = (observe(m, t_q - 20.0, at - 20.0) for m in (model, same))
    np.testing.assert_allclose(ours.y_dtf_um, theirs.y_dtf_um, rtol=0, atol=1e-9)
    difference = signals(4, 12.0)[6]
    assert rms(ours.drive - difference) < 0.1 * rms(difference)
    assert observer_of(model).drive_for(1.0) == pytest.approx(8.0)
    past = observer_of(model)
    for t, a in zip((t_q - 20.0)[:300].tolist(), (at - 20.0)[:300].tolist(), strict=True):
        past.step(t, a)
    again = observer_of(model)
    again.restore(past.snapshot())
    assert (again.drive, again.shares_um(), again.drive_std) == (past.drive, past.shares_um(), past.drive_std)


def test_how_fast_the_drive_moves_counts_in_a_gap_too() -> None:
    t_q, at, _ = run_of(4, 12.0, 0.02, form="sensor", lag_min=3.0, delay_min=2.5)
    t_q[300:330] = np.nan
    by_effect = late(QUILL, lag_min=3.0, delay_min=2.5, walk_times=4.0)
    estimator = dataclasses.replace(QUILL.estimator, drive_walk_std=4.0 * QUILL.estimator.drive_walk_std)
    by_estimator = late(dataclasses.replace(QUILL, estimator=estimator), lag_min=3.0, delay_min=2.5)
    np.testing.assert_array_equal(predicted(by_effect, t_q, at), predicted(by_estimator, t_q, at))


@pytest.mark.parametrize("method", ["kalman", "inverse"])
def test_the_record_at_once_has_the_bits_of_the_stream(method: str) -> None:
    t_q, at, _ = run_of(4, 12.0, 0.02, form="sensor", lag_min=3.0, delay_min=2.5)
    t_q[200:205] = at[202:210] = t_q[400] = np.nan
    model = late(with_method(method), lag_min=3.0, delay_min=2.5)
    # A gap is not bridged here, because the record at once does not go back either.
    engine = Engine(model, bridge_samples=0)
    engine.set_reference(20.0, 20.0)
    streamed = engine.run(t_q, at)
    seen = observe(model, t_q - 20.0, at - 20.0)
    assert [e.heat_w.hex() for e in streamed] == [v.hex() for v in seen.drive.tolist()]
    assert [e.y_dtf_um.hex() for e in streamed] == [v.hex() for v in seen.y_dtf_um.tolist()]
    assert [e.y_tdtf_um.hex() for e in streamed] == [v.hex() for v in seen.y_tdtf_um.tolist()]


@pytest.mark.parametrize("method", ["kalman", "inverse"])
def test_no_lateness_changes_no_bit(method: str) -> None:
    t_q, at, _ = run_of(5, 6.0, 0.02, form="sensor", lag_min=0.0, delay_min=0.0)
    base = with_method(method)
    plain, prompt = (predicted(m, t_q, at) for m in (base, late(base, lag_min=0.0, delay_min=0.0)))
    assert [v.hex() for v in plain[0].tolist()] == [v.hex() for v in prompt[0].tolist()]
    assert plain[1].tolist() == prompt[1].tolist()


def test_the_deviation_does_not_depend_on_how_it_was_reached() -> None:
    """Once the covariance has settled, the way on is kept; a gap or a restart computes it again."""
    model = late(QUILL, lag_min=2.0, delay_min=3.5)
    t_q, at, _ = run_of(6, 40.0, 0.02, form="sensor", lag_min=2.0, delay_min=3.5)
    whole, again = Engine(model), Engine(model)
    whole.set_reference(20.0, 20.0)
    whole.run(t_q[:2000], at[:2000])
    assert whole.snapshot().observer.settled
    for k in range(2000, 2060):
        again.restore(whole.snapshot())
        one = at[k] if k != 2020 else np.nan
        assert again.step(t_q[k], one) == whole.step(t_q[k], one)


def test_a_missing_t_q_is_held_and_bridged() -> None:
    model = late(QUILL, lag_min=3.0, delay_min=2.0)
    t_q, at, _ = run_of(7, 24.0, 0.02, form="sensor", lag_min=3.0, delay_min=2.0)
    gone = t_q.copy()
    gone[600:620] = np.nan
    (full, full_std), (held, held_std) = predicted(model, t_q, at), predicted(model, gone, at)
    assert np.all(np.diff(held_std[600:620]) > 0.0)
    assert held_std[619] > full_std[619] + 1.0
    assert rms((held - full)[680:]) < 0.2
    assert np.isfinite(held).all()


@pytest.mark.parametrize(("lag_min", "delay_min"), [(6.0, 0.0), (0.0, 1.0), (0.0, 2.0)])
def test_nothing_jumps_more_than_the_quill_itself(lag_min: float, delay_min: float) -> None:
    t_q, at, y = run_of(1, 24.0, 0.02, form="sensor", lag_min=lag_min, delay_min=delay_min)
    y_pred, _ = predicted(late(QUILL, lag_min=lag_min, delay_min=delay_min), t_q, at)
    assert np.max(np.abs(np.diff(y_pred))) < np.max(np.abs(np.diff(y))) + 0.8


def test_other_effects_get_the_corrected_signals() -> None:
    t_q, at, y = run_of(8, 24.0, 0.01, form="sensor", lag_min=6.0, delay_min=0.0)
    gain = effect_from("gain", {"path": "DTF", "change": 0.5})
    model = late(QUILL, lag_min=6.0, delay_min=0.0)
    model = dataclasses.replace(model, effects=(gain, *model.effects))
    engine = Engine(model)
    engine.set_reference(20.0, 20.0)
    estimates = engine.run(t_q, at)
    for estimate in estimates:
        assert estimate.y_effects_um == (0.5 * estimate.y_dtf_um, 0.0)
    wrong = rms(np.array([e.y_dtf_um + e.y_tdtf_um for e in estimates]) - y)
    assert wrong < 0.49


def test_the_file_keeps_it() -> None:
    model = late(QUILL, form="path", lag_min=2.5, delay_min=1.5)
    again = parse_model(dump_model(model).encode(), source="late")
    assert again.effects == model.effects
    assert again.late_t_q == model.late_t_q
    assert "walk_times" not in dump_model(model) and "behind_min" not in dump_model(model)
    foreseeing = behind(7.0, 2.0)
    again = parse_model(dump_model(foreseeing).encode(), source="late")
    assert again.effects == foreseeing.effects
    assert again.late_t_q is not None and (again.late_t_q.walk_times, again.late_t_q.behind_min) == (2.0, 7.0)
    # A table of version 0.1.0 has no form: it is a late path of the deformation.
    assert effect_from("delay", {"path": "DTF", "delay_min": 1.0, "lag_min": 0.0}).lateness is None


@pytest.mark.parametrize(
    ("model", "tables", "words"),
    [
        (QUILL, [{}, {}], "2 effects of a late T_Q"),
        (QUILL, [{"path": "DTF"}], "path = 'DTF', expected 'TTF'"),
        (direct("kalman"), [{"path": "TTF"}], "path = 'TTF', expected 'DTF'"),
        (QUILL, [{"behind_min": 5.0}], "behind_min = 5.0, expected 0"),
    ],
)
def test_what_cannot_be_run_is_refused(model: ThermalModel, tables: list[dict[str, Any]], words: str) -> None:
    defaults = {"path": "TTF", "form": "sensor", "delay_min": 1.0, "lag_min": 0.0}
    effects = tuple(effect_from("delay", defaults | table) for table in tables)
    with pytest.raises(ModelError, match=words):
        dataclasses.replace(model, effects=effects)


def test_the_published_model_has_no_lateness() -> None:
    assert load_model("quill").late_t_q is None
