"""A machine of several axes: each direction follows the closed-form answer of its two masses."""

from __future__ import annotations

import math

import pytest

from sim_hardware.physics import Inputs, MachineOfAxes, PublishedQuill
from sim_hardware.physics.axes import USUAL


@pytest.mark.parametrize("step_s", [10.0, 600.0])
def test_a_step_of_heat_and_air_is_answered_by_two_lags(step_s: float) -> None:
    machine = MachineOfAxes(PublishedQuill())
    for _ in range(round(3600.0 / step_s)):
        machine.advance(step_s, Inputs(heat_w=50.0, ambient_degc=23.0))
    signals = machine.signals()
    for growth in USUAL:
        expected = 50.0 * growth.per_w * (1.0 - math.exp(-60.0 / growth.heat_tau_min))
        expected += 3.0 * growth.per_k * (1.0 - math.exp(-60.0 / growth.air_tau_min))
        assert signals[growth.name] == pytest.approx(expected, rel=1e-9)


def test_the_machine_itself_is_as_without_further_directions() -> None:
    one, other = PublishedQuill(), MachineOfAxes(PublishedQuill())
    for machine in (one, other):
        for _ in range(30):
            machine.advance(60.0, Inputs(heat_w=80.0))
    plain = one.signals()
    assert {name: other.signals()[name] for name in plain} == plain
