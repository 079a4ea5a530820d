"""The standard deviation after a gap is that of the error, on a machine that is as the filter takes it to be."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from compensator.model.engine import Engine
from compensator.model.model_file import load_model

QUILL = load_model("quill")
RUNS, BEFORE = 60, 120


@pytest.mark.parametrize("method", ["kalman", "inverse"])
@pytest.mark.parametrize("gap", [10, 240])
def test_error_after_a_gap_has_the_stated_size(method: str, gap: int) -> None:
    """Counting the interpolated samples as independent would state a tenth of it."""
    assert QUILL.ttf is not None and QUILL.tdtf is not None
    settings = QUILL.estimator
    model = dataclasses.replace(QUILL, estimator=dataclasses.replace(settings, method=method))  # type: ignore[arg-type]
    rng = np.random.default_rng(gap)
    n = BEFORE + gap + 31
    ratios: list[list[float]] = []
    for _ in range(RUNS):
        heat = np.cumsum(settings.drive_walk_std * rng.normal(size=n))
        ambient = np.cumsum(settings.at_walk_std_k * rng.normal(size=n))
        y = QUILL.dtf.sampled.response(heat) + QUILL.tdtf.sampled.response(ambient)
        t_q = 20.0 + ambient + QUILL.ttf.sampled.response(heat) + settings.t_q_noise_std_k * rng.normal(size=n)
        at = 20.0 + ambient + settings.at_noise_std_k * rng.normal(size=n)
        engine = Engine(model)
        engine.set_reference(20.0, 20.0)
        engine.run(t_q[:BEFORE], at[:BEFORE])
        engine.skip(gap)
        after = engine.run(t_q[BEFORE + gap :], at[BEFORE + gap :])
        deviations = [np.sqrt(e.y_std_um**2 - QUILL.y_std_um**2) for e in after]
        ratios.append([(e.y_um - y[BEFORE + gap + i]) / deviations[i] for i, e in enumerate(after)])
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    # 60 runs know a standard deviation to 9 %.
    assert 0.7 < rms[0] < 1.35
    assert 0.6 < rms[30] < 1.5
