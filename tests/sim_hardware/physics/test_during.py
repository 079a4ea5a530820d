"""An effect that begins and ends acts in between, and only there."""

import numpy as np
import pytest

from sim_hardware.physics import Duty, QuillMachine, World, usual_sensors
from sim_hardware.physics.effects import BearingFriction, ProbeDrift, StickSlip
from sim_hardware.physics.effects.during import During

HOUR_S = 3600.0


def y_um(*effects):
    duty = Duty.working_day(3, hours=10.0)
    world = World(QuillMachine(effects=effects), duty, usual_sensors(duty.extra_names), 1)
    world.advance_to(10.0 * HOUR_S)
    past = world.history()
    return past["t_s"], past["y_um"]


def test_heat_is_added_from_the_beginning_to_the_end():
    friction = BearingFriction(full_speed_w=40.0)
    t, healthy = y_um()
    _, acted = y_um(During(effect=friction, from_s=2.0 * HOUR_S, to_s=4.0 * HOUR_S))
    part = acted - healthy
    np.testing.assert_array_equal(part[t <= 2.0 * HOUR_S], 0.0)
    during, after = np.abs(part[(t > 2 * HOUR_S) & (t < 4 * HOUR_S)]), np.abs(part[t > 9.5 * HOUR_S])
    assert during.max() > 2.0
    assert after.max() < 0.5 * during.max()


def test_an_effect_from_the_start_without_an_end_is_the_effect():
    drift = ProbeDrift(um_per_h=2.0)
    np.testing.assert_array_equal(y_um(During(effect=drift, from_s=0.0))[1], y_um(drift)[1])


def test_it_is_described_with_its_times():
    told = During(effect=BearingFriction(full_speed_w=40.0), from_s=60.0, to_s=120.0).describe()
    assert (told["kind"], told["channel"]) == ("input", "spindle_rpm")
    assert (told["from_s"], told["to_s"]) == (60.0, 120.0)


def test_what_has_no_time_is_refused():
    with pytest.raises(ValueError, match="growth_um"):
        During(effect=StickSlip(play_um=5.0), from_s=0.0)
