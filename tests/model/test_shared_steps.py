"""Observers of one design share the steps of the covariance: no bit depends on who was first, or on what is kept."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from compensator.model import observer
from compensator.model.engine import Engine, Estimate
from compensator.model.observer import Forecast
from compensator.model.thermal_model import ThermalModel
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
    observer._steps_of.cache_clear()
    first = repr(day(model, 1))
    other = repr(day(model, 2))
    assert repr(day(model, 1)) == first, "with what another run has left"
    monkeypatch.setattr(observer, "_KEPT_STEPS", 3)
    assert repr(day(model, 1)) == first, "with hardly anything kept"
    observer._steps_of.cache_clear()
    assert repr(day(model, 2)) == other, "alone"


def test_designs_share_nothing() -> None:
    """Also models that differ in one noise level alone have steps of their own."""
    estimator = dataclasses.replace(QUILL.estimator, t_q_noise_std_k=2.0 * QUILL.estimator.t_q_noise_std_k)
    models = (QUILL, dataclasses.replace(QUILL, estimator=estimator), with_method("inverse"), late(QUILL))
    alone = []
    for model in models:
        observer._steps_of.cache_clear()
        alone.append(repr(day(model, 3)))
    assert len(set(alone)) == len(models)
    observer._steps_of.cache_clear()
    assert [repr(day(model, 3)) for model in models] == alone


def test_what_is_kept_has_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observer, "_KEPT_STEPS", 50)
    observer._steps_of.cache_clear()
    engine = Engine(QUILL)
    day(QUILL, 4)
    kept = engine._observer._steps
    assert 0 < len(kept) <= 50
