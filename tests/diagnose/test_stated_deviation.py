"""The deviation that an extended model states: right where the effect was seen, growing beyond it."""

import numpy as np
import pytest

import compensator as tc
from tests.diagnose.scenarios import draw, record

NOISE_UM = 1.5


def table(columns):
    return {"t_s": 60.0 * np.arange(columns["y_um"].size), **columns}


@pytest.fixture(scope="module")
def found():
    """A machine with an input, a diagnosis of 12 h of it."""
    scenario = draw("input", 1, size_um=3.0)
    measured, _, _ = record([scenario], 1, 12.0, noise_um=NOISE_UM)
    why = tc.diagnose(tc.load_model("quill"), table(measured))
    assert [(effect.kind, effect.channel) for effect in why.model.effects] == [("input", scenario.place[2])]
    return scenario, why


def test_on_another_day_the_error_is_of_the_size_that_is_stated(found):
    scenario, why = found
    fresh, true, _ = record([scenario], 51, 24.0)
    simulated = tc.simulate(why.model, table(fresh))
    error = true - simulated["y_pred_um"]
    error -= np.mean(error[:10])
    stated = np.sqrt(np.mean(simulated["y_std_um"] ** 2))
    assert 0.3 * stated < np.sqrt(np.mean(error**2)) < 1.5 * stated


def test_it_grows_where_the_effect_runs_beyond_what_was_seen(found):
    scenario, why = found
    channel = scenario.place[2]
    fresh, _, _ = record([scenario], 51, 24.0)
    far = {**fresh, channel: fresh[channel][0] + 5.0 * (fresh[channel] - fresh[channel][0])}
    near_um, far_um = (tc.simulate(why.model, table(columns))["y_std_um"] for columns in (fresh, far))
    own = why.model.y_std_um**2
    # What is open of the effect is in proportion to it; what is stated beside it stays.
    assert np.max(far_um**2 - own) > 10.0 * np.max(near_um**2 - own)
    assert far_um[0] == pytest.approx(near_um[0])


def test_the_rows_are_the_standard_errors_that_are_shown(found):
    _, why = found
    effect = why.model.effects[0]
    by_rows = dict(zip(("tau_min", "gain"), np.linalg.norm(np.array(effect.std_factor)[:, :2], axis=0), strict=True))
    shown = list(effect.std.values())
    # The shown ones grant the published paths no error of their own.
    for rows, std in zip((by_rows["gain"], by_rows["tau_min"]), sorted(shown), strict=True):
        assert 0.8 * std < rows < 3.0 * std
