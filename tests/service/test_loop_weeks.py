"""The drawn weeks as the service is shown them: what a probe shows belongs to its zero and its minute."""

from __future__ import annotations

import numpy as np

from sim_hardware.drawn_machines.trouble import moved_um
from sim_hardware.drawn_machines.weeks import DEVELOPMENT_WEEKS
from tests.bench.loop_week import samples_of


def test_a_zero_sets_the_feature_anew() -> None:
    """A feature that has slipped by 14 µm is where it is from the next zero on."""
    [case] = (case for case in DEVELOPMENT_WEEKS if case.seed == 3063)
    week = case.draw()
    samples = samples_of(week, week.columns, week.true_um)
    seen = {sample.seq: shown_um for sample, shown_um, _ in samples}
    zeros = [0, *(sample.seq for sample, _, is_zero in samples if is_zero)]
    slipped = np.flatnonzero(np.abs(moved_um(week.troubles, week.minutes)) > 10.0)[0]
    assert zeros[0] < slipped < zeros[1]

    def wrong_um(begin: int, end: int, zero: int) -> float:
        """Median of what probes of some minutes show beyond the deformation since a zero."""
        at = [probe.minute for probe in week.probes if begin <= probe.minute < end and probe.minute in seen]
        return float(np.median([seen[i] - (week.true_um[i] - week.true_um[zero]) for i in at]))

    assert abs(wrong_um(0, slipped, 0)) < 0.5
    assert abs(wrong_um(slipped, zeros[1], 0)) > 10.0
    assert abs(wrong_um(zeros[1] + 1, zeros[2], zeros[1])) < 1.0
