"""Observers of one design share the steps of the covariance: no bit depends on who was first, or on what is kept."""

from __future__ import annotations

import dataclasses
import gc
import math
import tracemalloc

import numpy as np
import pytest

from compensator.model import covariance
from compensator.model.engine import Engine, Estimate
from compensator.model.late_observer import observer_of
from compensator.model.observer import Forecast, Observer
from compensator.model.thermal_model import Path, ThermalModel
from tests.service.records import QUILL, direct, late, with_method

N = 300


def day(model: ThermalModel, seed: int) -> tuple[list[Estimate], list[Forecast]]:
    """Run a fresh engine over samples, some without a temperature, with forecasts before some of them."""
    rng = np.random.default_rng(seed)
    engine = Engine(model)
    engine.set_reference(20.0, 20.0)
    estimates, forecasts = [], []
    for i in range(N):
        t_q, at = 20.0 + 5.0 * math.sin(i / 50.0) + 0.05 * rng.normal(), 20.0 + 0.05 * rng.normal()
        t_q, at = (math.nan if rng.random() < 0.02 else value for value in (t_q, at))
        if i % 3 == 0:
            forecasts += [engine.forecast(at), engine.forecast(math.nan)]
        estimates.append(engine.step(t_q, at))
    return estimates, forecasts


@pytest.mark.parametrize(
    "model",
    [with_method("kalman"), with_method("inverse"), late(QUILL), direct("kalman")],
    ids=["kalman", "inverse", "late", "direct"],
)
def test_the_second_of_a_design_has_the_bits_of_the_first(model: ThermalModel, monkeypatch: pytest.MonkeyPatch) -> None:
    covariance._shared.clear()
    first = repr(day(model, 1))
    other = repr(day(model, 2))
    assert repr(day(model, 1)) == first, "with what another run has left"
    monkeypatch.setattr(covariance, "_KEPT_BYTES", 10_000)
    assert repr(day(model, 1)) == first, "with hardly anything kept"
    covariance._shared.clear()
    assert repr(day(model, 2)) == other, "alone"


def test_designs_share_nothing() -> None:
    """Also models that differ in one noise level alone have steps of their own."""
    estimator = dataclasses.replace(QUILL.estimator, t_q_noise_std_k=2.0 * QUILL.estimator.t_q_noise_std_k)
    models = (QUILL, dataclasses.replace(QUILL, estimator=estimator), with_method("inverse"), late(QUILL))
    alone = []
    for model in models:
        covariance._shared.clear()
        alone.append(repr(day(model, 3)))
    assert len(set(alone)) == len(models)
    covariance._shared.clear()
    assert [repr(day(model, 3)) for model in models] == alone


def test_a_zero_of_another_sign_is_another_design() -> None:
    dtf = QUILL.dtf.sampled
    zeros = [
        dataclasses.replace(
            QUILL, dtf=Path(unit=QUILL.dtf.unit, sampled=dataclasses.replace(dtf, b=(zero, *dtf.b[1:])))
        )
        for zero in (0.0, -0.0)
    ]
    assert zeros[0].dtf == zeros[1].dtf
    covariance._shared.clear()
    for model in zeros:
        Observer(model).step(0.0, 0.0)
    assert len(covariance._shared.steps) == 2


@pytest.mark.parametrize("method", ["kalman", "inverse"])
def test_one_that_is_still_at_rest_leaves_nothing_to_one_that_moves(method: str) -> None:
    """A late T_Q that is restored before its first sample runs on from rest, where its covariance does not move."""
    model = late(with_method(method))

    def first_without_t_q() -> str:
        fresh = Observer(model)
        fresh.step(math.nan, 0.1)
        return repr((fresh.forecast(0.1), fresh.forecast(math.nan), fresh.step(0.2, 0.1), fresh.snapshot()))

    covariance._shared.clear()
    alone = first_without_t_q()
    covariance._shared.clear()
    at_rest = observer_of(model)
    at_rest.restore(at_rest.snapshot())
    at_rest.forecast(0.1)
    at_rest.forecast(math.nan)
    assert first_without_t_q() == alone


@pytest.mark.parametrize("method", ["kalman", "inverse"])
def test_the_way_to_the_present_is_one_step(method: str) -> None:
    """That of a late T_Q: kept for each past and each AT that was measured since or was missing."""
    model, steps = late(with_method(method)), 40
    covariance._shared.clear()
    observers = [observer_of(model), observer_of(model)]
    for observer in observers:
        for i in range(steps):
            observer.step(0.1, math.nan if i == 20 else 0.1)
    assert len(covariance._shared.steps) <= steps, "nobody has asked for the covariance of the present"
    for observer in observers:
        assert observer.y_variance_um2 > 0.0
    assert len(covariance._shared.steps) <= steps + 1, "the samples between are not kept"
    assert repr(observers[0].snapshot()) == repr(observers[1].snapshot())
    assert observers[0].y_variance_um2 == observers[1].y_variance_um2
    fresh = observer_of(model)
    for _ in range(steps):
        fresh.step(0.1, 0.1)
    assert fresh.y_variance_um2 < observers[0].y_variance_um2, "AT that was missing is another way"


@pytest.mark.parametrize("method", ["kalman", "inverse"])
def test_the_gains_on_the_way_are_those_of_the_covariance(method: str) -> None:
    """To the bit: they are found without it, and an audit on the other way finds them with it."""
    observer = Observer(late(with_method(method)))
    here, there = observer._covariance, Observer(late(with_method(method)))._covariance
    for i in range(70):
        observer.step(0.1 * i, 0.1)
        extras = (0.0, None, 0.02, 0.0)
        gains = there.run_on(here, extras)
        there._set(here.p, covariance._Expected())
        for extra, gain in zip(extras, gains, strict=True):
            variance = None if extra is None else there._design.at_var_k2 + extra
            step = there._computed(variance, None, complete=False)
            there._set(step.p, covariance._Expected())
            assert repr(gain) == repr(step.gains.at)


def test_a_step_takes_no_more_memory_than_is_counted() -> None:
    for model in (QUILL, late(QUILL), direct("kalman")):
        observer = Observer(model)
        covariance._shared.clear()
        tracemalloc.start()
        try:
            for i in range(300):
                observer.forecast(0.1)
                observer.forecast(math.nan)
                observer.step(math.nan if i % 50 == 0 else 0.1, 0.1)
            gc.collect()
            taken = tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()
        assert len(covariance._shared.steps) == 300
        assert 0.7 * covariance._shared.bytes < taken < covariance._shared.bytes


def test_what_is_kept_has_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """That of all designs together, whether or not their observers are still there."""
    monkeypatch.setattr(covariance, "_KEPT_BYTES", 100_000)
    covariance._shared.clear()
    observers = [Observer(model) for model in (QUILL, with_method("inverse"), late(QUILL), direct("kalman"))]
    most = 0
    for _ in range(100):
        for observer in observers:
            observer.step(0.1, 0.1)
            most = max(most, covariance._shared.bytes)
    assert 90_000 < most <= 100_000
    assert 0 < len(covariance._shared.steps) < 100
