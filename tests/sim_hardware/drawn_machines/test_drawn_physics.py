"""The three physics of drawn machines against closed forms, energy balances and other arithmetic."""

import numpy as np
import pytest
from scipy.optimize import fsolve

from sim_hardware.drawn_machines.conduction import ConductionMachine
from sim_hardware.drawn_machines.duty import CONTROLLED, PER_H, Duty, Habits, draw_duty, lag
from sim_hardware.drawn_machines.lumped import BASE, NODES, SHAFT, LumpedMachine
from sim_hardware.drawn_machines.measuring import mismeasured_t_q, mismeasured_y
from sim_hardware.drawn_machines.transfer import Modes, TransferMachine

HABITS = Habits.drawn(np.random.default_rng(3))
HALL = HABITS.hall_degc


def constant(hours, power_w, **others):
    """A duty that holds from its start."""
    columns = dict.fromkeys(("power_w", "hidden", *CONTROLLED), 0.0)
    columns |= dict.fromkeys(("air_degc", "floor_degc", "coolant_degc"), HALL)
    columns |= {"power_w": power_w, **others}
    n = round(hours * PER_H)
    return Duty(columns={k: np.full(n, float(v)) for k, v in columns.items()}, before=0, profiles={})


def run(machine, duty, effect="none", strength=0.0):
    return machine.run(duty, HABITS, effect, strength)


def test_the_published_functions_give_the_checked_figures():
    y = run(TransferMachine(np.random.default_rng(0), published=True), constant(60.0, 90.0)).y_um
    assert y[60] == pytest.approx(114.3, abs=0.05)
    assert y[-1] == pytest.approx(91.7, abs=0.1)


def test_modes_follow_the_closed_form():
    modes = Modes(gains=(2.0, -0.5), taus_min=(7.0, 90.0))
    t = np.arange(1, 301)
    expected = 2.0 * (1.0 - np.exp(-t / 7.0)) - 0.5 * (1.0 - np.exp(-t / 90.0))
    np.testing.assert_allclose(modes(np.ones(300)), expected, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_conduction_comes_to_the_balance_of_all_resistances(seed):
    """By incidence of links and nodes, solved at rest: neither the machine's matrices nor its exponential."""
    machine = ConductionMachine(np.random.default_rng(seed))
    found = run(machine, constant(400.0, 150.0))
    to_air = machine.film_w_per_k.copy()
    to_air[machine.base] += machine.feet_w_per_k
    first, second, w_per_k = zip(*machine._links, *machine.bearings, strict=True)
    incidence = np.eye(to_air.size)[list(first)] - np.eye(to_air.size)[list(second)]
    heat = np.bincount(machine.heated, np.full(machine.heated.size, 150.0 / machine.heated.size), to_air.size)
    rise = np.linalg.solve(incidence.T @ np.diag(w_per_k) @ incidence + np.diag(to_air), heat)
    assert float(to_air @ rise) == pytest.approx(150.0, rel=1e-4)  # What goes in comes out.
    assert found.t_q_degc[-1] - HALL == pytest.approx(rise[machine.seat], rel=1e-3)
    assert found.y_um[-1] == pytest.approx(machine.growth_um_per_k @ (HALL + rise), abs=0.05)


def test_conduction_loses_heat_to_air_and_floor_only():
    machine = ConductionMachine(np.random.default_rng(1))
    K, B = machine.matrices()
    np.testing.assert_allclose(K, K.T)
    np.testing.assert_allclose(K.sum(axis=1), B[:, 1:3].sum(axis=1), atol=1e-9)
    assert B[:, 0].sum() == pytest.approx(1.0)
    assert np.min(np.linalg.eigvalsh(K)) > 0.0


@pytest.mark.parametrize("seed", range(3))
def test_lumped_comes_to_the_balance_of_its_laws(seed):
    """The laws written out once more, one link after another, and solved by another method."""
    m = LumpedMachine(np.random.default_rng(seed))
    power, speed = 200.0, HABITS.full["spindle_rpm"]
    found = run(m, constant(150.0, power, spindle_rpm=speed))

    def balance(degc):
        into = np.zeros(len(NODES))
        for (a, b), g, tight in zip(m.pairs, m.link_w_per_k, m.tighter_per_k, strict=True):
            flow = g * min(max(1.0 + tight * (degc[a] - degc[b]), 0.4), 2.0) * (degc[a] - degc[b])
            into[a] -= flow
            into[b] += flow
        for i in range(len(NODES)):
            above = degc[i] - HALL
            forced = m.forced_w_per_m2k[i] * (1.0 + m.whirl if i == SHAFT else 1.0)
            into[i] -= m.area_m2[i] * (forced + m.natural_w_per_m2k * abs(above) ** 0.25) * above
            into[i] -= m.area_m2[i] * m.emissivity * 5.67e-8 * ((degc[i] + 273.15) ** 4 - (HALL + 273.15) ** 4)
        into[BASE] -= m.feet_w_per_k * (degc[BASE] - HALL)
        for node, share in m.heated.items():
            into[node] += share * power * (1.0 - m.thinner_per_k * (degc[node] - HALL))
        return into

    degc = fsolve(balance, np.full(len(NODES), HALL + 5.0), xtol=1e-12)
    assert found.t_q_degc[-1] == pytest.approx(degc[m.seat], abs=0.02)
    assert found.y_um[-1] == pytest.approx(m.growth_um_per_k @ degc, abs=0.05)


def test_only_the_lumped_machine_is_not_linear_in_its_heat():
    def bend(machine):
        once, twice = (np.ptp(run(machine, constant(20.0, watts)).y_um) for watts in (150.0, 300.0))
        return abs(twice / once / 2.0 - 1.0)

    assert bend(TransferMachine(np.random.default_rng(2), published=False)) < 1e-9
    assert bend(ConductionMachine(np.random.default_rng(2))) < 1e-9
    assert bend(LumpedMachine(np.random.default_rng(2))) > 0.01


@pytest.mark.parametrize("kind", [ConductionMachine, LumpedMachine])
def test_effects_act_by_their_own_channel_only(kind):
    machine = kind(np.random.default_rng(5))
    still = constant(4.0, 0.0)
    for effect in ("coolant", "wet", "bearing", "more_power", "floor", "hidden"):
        strength = machine.first_strength(effect)[0]
        at_rest = run(machine, still, effect, strength).y_um
        np.testing.assert_allclose(at_rest, at_rest[0], atol=1e-5)
    turning = constant(4.0, 0.0, spindle_rpm=HABITS.full["spindle_rpm"])
    assert np.ptp(run(machine, turning, "bearing", 100.0).y_um) > 0.5
    heated = run(machine, constant(4.0, 200.0, fan_rpm=HABITS.full["fan_rpm"]), "fan", 2.0).y_um
    assert np.max(np.abs(heated - run(machine, constant(4.0, 200.0), "fan", 2.0).y_um)) > 0.1


def test_bearing_heat_follows_the_power_of_the_speed():
    machine = ConductionMachine(np.random.default_rng(7))
    full, half = (
        np.ptp(run(machine, constant(4.0, 0.0, spindle_rpm=share * HABITS.full["spindle_rpm"]), "bearing", 50.0).y_um)
        for share in (1.0, 0.5)
    )
    assert full / half == pytest.approx(2.0**machine.friction_power, rel=1e-6)


def test_a_late_thermocouple():
    t_q, air = np.repeat([20.0, 30.0], 40), np.full(80, 20.0)
    np.testing.assert_array_equal(np.diff(mismeasured_t_q(t_q, air, "delay_t_q", 3.0)).argmax(), 42)
    lagged = mismeasured_t_q(t_q, air, "lag_t_q", 5.0)[40:]
    np.testing.assert_allclose(lagged, 30.0 - 10.0 * np.exp(-np.arange(1, 41) / 5.0), atol=1e-9)
    assert mismeasured_t_q(t_q, air, "loose_couple", 0.2)[-1] == pytest.approx(28.0, abs=0.01)


@pytest.mark.parametrize("effect", ["drift", "step", "period"])
def test_errors_of_y_have_the_size_that_was_asked_for(effect):
    error = mismeasured_y(np.random.default_rng(1), 1000, effect)
    assert np.std(error) == pytest.approx(1.0)
    assert error[0] == 0.0


def test_a_lag_is_exact_for_held_inputs():
    np.testing.assert_allclose(lag(np.r_[0.0, np.ones(9)], 2.0, 1.0), 1.0 - np.exp(-np.arange(10) / 2.0), atol=1e-12)


def test_duties_hold_what_they_promise():
    for seed in range(6):
        rng = np.random.default_rng(seed)
        habits = Habits.drawn(rng)
        duty = draw_duty(rng, habits, 24.0, kind="programme", use="fresh")
        assert duty.before == 0
        assert duty.n == 24 * PER_H
        for name in CONTROLLED:
            share = duty.share(name, habits)
            assert share.min() >= 0.0
            assert share.max() <= 1.0
            np.testing.assert_allclose(4.0 * share, np.round(4.0 * share), atol=1e-9)
            assert not share[: PER_H // 2].any()
        assert all(np.isfinite(values).all() for values in duty.columns.values())
