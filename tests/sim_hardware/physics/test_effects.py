"""Each effect changes the outputs in the way that it says, and no other."""

import numpy as np
import pytest

from sim_hardware.physics import Duty, Inputs, QuillMachine, World, draw_effect
from sim_hardware.physics.effects import (
    BearingFriction,
    CoolantJacket,
    Cycle,
    FanOnFilm,
    HiddenSource,
    LateSensor,
    MountSlip,
    ProbeDrift,
    SecondMass,
    SizeDependent,
    StickSlip,
    WetGuide,
    WrongStrength,
)
from sim_hardware.physics.effects.draw import _DRAWS

HOUR_S = 3600.0
KINDS = {
    "input",
    "gain",
    "dynamics",
    "delay",
    "nonlinear",
    "scheduled",
    "hysteresis",
    "drift",
    "step",
    "periodic",
    "unobserved",
}


def run(effects, hours=6.0, **inputs):
    """Return the truth under constant inputs, by channel, every minute."""
    world = World(QuillMachine(effects=effects), Duty(hours * HOUR_S, **inputs))
    world.advance_to(hours * HOUR_S)
    return world.history()


def difference(effect, name="y_um", **inputs):
    """Return what the effect adds to a channel, over time."""
    return run([effect], **inputs)[name] - run([], **inputs)[name]


def test_jacket_follows_the_coolant_and_is_silent_at_its_own_temperature():
    jacket = CoolantJacket(w_per_k=5.0)
    warm, warmer = (difference(jacket, coolant_degc=20.0 + k) for k in (2.0, 4.0))
    # The housing's levers point back: warm coolant moves the tool towards -Y, in proportion.
    assert warm[-1] < -0.5
    assert warmer[-1] / warm[-1] == pytest.approx(2.0, abs=0.1)
    assert np.abs(difference(jacket)).max() < 1e-9
    cold_quill = CoolantJacket(w_per_k=2.0, place="quill")
    assert difference(cold_quill, coolant_degc=17.0)[-1] < -1.0


@pytest.mark.parametrize(("exponent", "ratio"), [(1.0, 2.0), (2.0, 4.0)])
def test_bearing_heats_by_speed_and_t_q_hardly_feels_it(exponent, ratio):
    friction = BearingFriction(full_speed_w=20.0, exponent=exponent)
    full, half = (difference(friction, spindle_rpm=n) for n in (8000.0, 4000.0))
    assert full[-1] > 5.0
    assert full[-1] / half[-1] == pytest.approx(ratio, rel=0.06)
    per_kelvin = difference(friction, "t_q_degc", spindle_rpm=8000.0)[-1] / full[-1]
    heated = run([], heat_w=90.0)
    assert per_kelvin < 0.1 * (heated["t_q_degc"][-1] - 20.0) / heated["y_um"][-1]


def test_fan_weakens_and_quickens_the_growth_only_while_it_turns():
    fan = FanOnFilm(full_speed_factor=2.0)
    assert np.abs(difference(fan, heat_w=90.0)).max() < 1e-9
    with_fan, without = run([fan], heat_w=90.0, fan_rpm=3000.0), run([], heat_w=90.0)
    assert with_fan["y_um"].max() < 0.9 * without["y_um"].max()
    assert with_fan["t_q_degc"][-1] < without["t_q_degc"][-1] - 1.0
    assert with_fan["y_um"].argmax() < without["y_um"].argmax()


def test_wet_guide_needs_both_heat_and_coolant():
    wet = WetGuide(w_per_k=4.0)
    assert np.abs(difference(wet, heat_w=90.0)).max() < 1e-9
    assert np.abs(difference(wet, coolant_flow_lpm=12.0)).max() < 1e-9
    assert difference(wet, heat_w=90.0, coolant_flow_lpm=12.0)[-1] < -2.0


def test_second_mass_comes_late():
    added = difference(SecondMass(j_per_k=40e3, w_per_k=3.0, lever_m=1.5), heat_w=90.0)
    assert added[-1] > 2.0
    assert added[180] < 0.15 * added[-1]


def test_second_mass_keeps_the_energy_balance():
    machine = QuillMachine(effects=[SecondMass(j_per_k=40e3, w_per_k=3.0, lever_m=1.0)])
    machine.settle(Inputs(heat_w=90.0))
    assert machine.to_air_w() == pytest.approx(90.0, rel=1e-6)


def test_hidden_source_acts_in_its_own_hours():
    added = difference(HiddenSource(heat_w=20.0, switch_s=(2 * HOUR_S, 4 * HOUR_S), place="nose"))
    at = {h: added[int(h * 360)] for h in (2.0, 4.0, 6.0)}
    assert abs(at[2.0]) < 1e-9
    assert at[4.0] > 3.0
    assert at[6.0] < 0.5 * at[4.0]


def test_wrong_strength_scales_the_growth_and_leaves_t_q():
    plain, strong = run([], heat_w=90.0), run([WrongStrength(factor=1.2)], heat_w=90.0)
    np.testing.assert_array_equal(strong["t_q_degc"], plain["t_q_degc"])
    gained = strong["y_um"] - plain["y_um"]
    assert gained[360] == pytest.approx(0.2 * plain["y_um"][360], rel=0.2)
    np.testing.assert_allclose(
        run([WrongStrength(factor=1.4)], heat_w=90.0)["y_um"] - plain["y_um"], 2.0 * gained, atol=1e-6
    )


def test_size_dependence_is_quadratic():
    effect = SizeDependent(per_100_um=0.1)
    assert effect.growth_um(100.0) == pytest.approx(110.0)
    assert effect.growth_um(-100.0) == pytest.approx(-90.0)
    small, large = (difference(effect, heat_w=q)[-1] for q in (30.0, 90.0))
    assert large / small == pytest.approx(9.0, rel=0.15)


def test_joint_sticks_and_slips():
    joint = StickSlip(play_um=10.0).begin()
    path = [joint.growth_um(g) for g in (4.0, 5.0, 30.0, 21.0, 20.0, 0.0, 9.0)]
    assert path == [0.0, 0.0, 25.0, 25.0, 25.0, 5.0, 5.0]
    # Two machines of one effect have a joint each.
    assert StickSlip(play_um=10.0).begin() is not joint
    assert difference(StickSlip(play_um=10.0), heat_w=90.0)[360] == pytest.approx(-5.0, abs=1e-6)


def test_late_sensor_shifts_t_q_and_leaves_y():
    plain, late = run([], heat_w=90.0), run([LateSensor(delay_s=120.0)], heat_w=90.0)
    np.testing.assert_array_equal(late["y_um"], plain["y_um"])
    np.testing.assert_allclose(late["t_q_degc"][12:], plain["t_q_degc"][:-12], atol=1e-9)
    lagging = run([LateSensor(delay_s=0.0, lag_s=300.0)], heat_w=90.0)["t_q_degc"]
    rate = np.gradient(lagging, 10.0)
    # A lag's defining equation, read off the samples: τ dT/dt + T = input.
    np.testing.assert_allclose((lagging + 300.0 * rate)[60:-1], plain["t_q_degc"][60:-1], atol=0.15)


def test_mounts_drift_slip_and_swing_on_y_alone():
    hours = np.linspace(0.0, 6.0, 2161)
    np.testing.assert_allclose(difference(ProbeDrift(um_per_h=1.5)), 1.5 * hours, atol=1e-9)
    np.testing.assert_allclose(
        difference(MountSlip(at_s=7200.0, jump_um=-3.0)), np.where(hours >= 2.0 - 1e-9, -3.0, 0.0), atol=1e-9
    )
    np.testing.assert_allclose(
        difference(Cycle(amplitude_um=2.0, period_s=1800.0)), 2.0 * np.sin(4.0 * np.pi * hours), atol=1e-9
    )


def test_two_effects_at_once():
    both = run([ProbeDrift(um_per_h=1.0), WrongStrength(factor=1.1)], heat_w=90.0)["y_um"]
    one = run([WrongStrength(factor=1.1)], heat_w=90.0)["y_um"]
    assert (both - one)[-1] == pytest.approx(6.0, abs=1e-9)


def test_drawing_is_by_seed_covers_every_kind_and_keeps_its_secret():
    drawn = [draw_effect(seed, 5.0) for seed in range(13)]
    assert len({type(e.reveal()) for e in drawn}) == len(_DRAWS)
    assert {e.reveal().kind for e in drawn} == KINDS
    for seed, effect in enumerate(drawn):
        assert draw_effect(seed, 5.0).reveal() == effect.reveal()
        assert draw_effect(seed + 13, 5.0).reveal() != effect.reveal()
        assert repr(effect) == "SealedEffect(…)"
        assert effect.kind == ""
        with pytest.raises(TypeError, match="reveal"):
            effect.describe()
        assert effect.reveal().describe()["kind"] in KINDS


@pytest.fixture(scope="module")
def plain_day():
    """Return a working day and what the machine does in it without any effect."""
    duty = Duty.working_day(4)
    world = World(QuillMachine(), duty)
    world.advance_to(duty.duration_s)
    return duty, world.history()


@pytest.mark.parametrize("seed", range(13))
def test_drawn_effects_have_about_the_size_asked_for(seed, plain_day):
    duty, plain = plain_day
    effect = draw_effect(seed, 6.0)
    world = World(QuillMachine(effects=[effect]), duty)
    world.advance_to(duty.duration_s)
    spread = np.std(world.history()["y_um"] - plain["y_um"])
    if effect.reveal().kind == "delay":
        assert spread == 0.0
        assert np.std(world.history()["t_q_degc"] - plain["t_q_degc"]) > 0.3
    else:
        assert 0.4 < spread / 6.0 < 2.5


def test_no_size_is_refused():
    with pytest.raises(ValueError, match="positive"):
        draw_effect(1, 0.0)
