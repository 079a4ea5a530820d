"""A candidate that is right about every change of Y and wrong in its level is adopted for its changes alone."""

import numpy as np
import pytest

from compensator.service.loop.run import LoopRun
from tests.service.looping import DAY, Night, decisions, errors, extended, machine, run, settings, shown
from tests.service.test_restart import QUILL as QUILL_FILE


def warm_at_first(i: int, values: dict[str, float]) -> None:
    """The coolant is 4 K warmer at the zero, while it does not act yet, than later."""
    values["coolant_degc"] += 4.0 if i < DAY // 2 else 0.0


@pytest.mark.parametrize("change", [warm_at_first, lambda i, values: None], ids=["another level", "the same level"])
def test_the_level_of_the_present_model_stays_where_that_of_the_candidate_contradicts_measured_y(change):
    loop = LoopRun(settings(), QUILL_FILE, Night(shown(extended())))
    samples = machine(3 * DAY, lambda i: 1.0 if i >= DAY // 2 else 0.0, change=change)
    steps = run(loop, samples)
    (adopted,) = [seq for seq, step, _ in decisions(steps) if step == "adopt"]
    error = errors(steps)
    before, after = error[adopted - 720 : adopted], error[adopted + 30 :]
    # 3 µm/K times 4 K would be 12 µm.
    assert abs(np.mean(after)) < abs(np.mean(before)) + 1.0
    assert np.std(after) < 0.5 * np.std(before)
