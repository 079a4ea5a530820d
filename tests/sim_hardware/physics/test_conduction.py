"""The conduction against closed forms, its own energy balance, and the published figures."""

import numpy as np
import pytest

from sim_hardware.physics import Inputs, QuillMachine
from sim_hardware.physics.film import Film
from sim_hardware.physics.network import Network
from sim_hardware.physics.published import step_responses
from sim_hardware.physics.sizing import fit_pct, responses

REST_DEGC = 20.0
HEAT = Inputs(heat_w=90.0)


def rod(nodes=400):
    """Return a rod with a film along its side, heated at its first node."""
    dx, section_m2, perimeter_m, w_per_mk, film = 0.5 / nodes, 1e-3, 0.2, 46.0, 12.0
    network = Network()
    for i in range(nodes):
        network.mass(f"{i}", 3.67e6 * section_m2 * dx, film * perimeter_m * dx)
    for i in range(nodes - 1):
        network.link(i, i + 1, w_per_mk * section_m2 / dx)
    return network.build()


def test_heated_rod_is_the_fin_of_the_textbook():
    conduction = rod()
    heat_w = np.zeros(400)
    heat_w[0] = 10.0
    theta = conduction.steady(heat_w)
    m = np.sqrt(12.0 * 0.2 / (46.0 * 1e-3))
    x = (np.arange(400) + 0.5) * 0.5 / 400
    # Source: adiabatic tip, heat flow given at the root: θ = q cosh(m(L−x)) / (λ A m sinh(mL)).
    expected = 10.0 * np.cosh(m * (0.5 - x)) / (46.0 * 1e-3 * m * np.sinh(m * 0.5))
    np.testing.assert_allclose(theta, expected, rtol=2e-3)


def test_stepping_the_rod_reaches_its_steady_state_with_any_step():
    conduction = rod(nodes=30)
    heat_w = np.zeros(30)
    heat_w[0] = 10.0
    for dt_s, count in ((7.0, 7000), (3600.0, 14)):
        phi, psi = conduction.step(dt_s)
        theta = np.zeros(30)
        for _ in range(count):
            theta = phi @ theta + psi @ heat_w
        np.testing.assert_allclose(theta, conduction.steady(heat_w), rtol=1e-9)


def test_one_block_cools_exponentially_and_an_isolated_one_keeps_its_heat():
    network = Network()
    network.mass("free", 1000.0, 2.0)
    network.mass("isolated", 500.0)
    phi, psi = network.build().step(250.0)
    theta = phi @ np.array([10.0, 3.0]) + psi @ np.array([0.0, 4.0])
    np.testing.assert_allclose(theta, [10.0 * np.exp(-0.5), 3.0 + 4.0 * 250.0 / 500.0], rtol=1e-12)


def test_impossible_masses_and_links_are_refused():
    network = Network()
    with pytest.raises(ValueError, match="capacity"):
        network.mass("none", 0.0)
    a, b = network.mass("a", 1.0), network.mass("b", 1.0)
    with pytest.raises(ValueError, match="a to b"):
        network.link(a, b, -1.0)


def test_film_grows_with_temperature_mildly():
    film = Film(np.array([1.0]), 5.0, 0.3, 0.8, REST_DEGC)
    cold = film.coefficient(np.array([20.0]), 20.0)[0]
    # 5 W/m²K of moving air and 4 ε σ T³ of radiation.
    assert cold == pytest.approx(5.0 + 4 * 0.8 * 5.670374e-8 * 293.15**3, rel=1e-9)
    warm = film.coefficient(np.array([42.0]), 20.0)[0]
    assert 1.08 < warm / cold < 1.35
    assert film.excess_w(np.array([42.0]), 20.0)[0] == pytest.approx((warm - cold) * -22.0, rel=1e-9)


def test_heat_in_is_heat_stored_and_heat_to_the_air():
    machine = QuillMachine()
    to_air_j, before_w = 0.0, machine.to_air_w()
    for k in range(2160):
        machine.advance(10.0, HEAT if k < 1440 else Inputs())
        after_w = machine.to_air_w()
        to_air_j += 10.0 * (before_w + after_w) / 2.0
        before_w = after_w
    supplied_j = 90.0 * 14_400.0
    assert machine.stored_j() > 0.05 * supplied_j
    assert machine.stored_j() + to_air_j == pytest.approx(supplied_j, rel=2e-3)


def test_at_rest_nothing_moves():
    machine = QuillMachine()
    machine.advance(36_000.0, Inputs())
    signals = machine.signals()
    assert signals["y_um"] == pytest.approx(0.0, abs=1e-9)
    assert signals["t_q_degc"] == pytest.approx(REST_DEGC, abs=1e-9)


def test_steady_state_gives_all_heat_to_the_air_and_is_where_time_leads():
    settled, waited = QuillMachine(), QuillMachine()
    settled.settle(HEAT)
    assert settled.to_air_w() == pytest.approx(90.0, rel=1e-6)
    for _ in range(96):
        waited.advance(3600.0, HEAT)
    for name in ("y_um", "t_q_degc", "base_degc"):
        assert waited.signals()[name] == pytest.approx(settled.signals()[name], abs=0.01)


def test_figures_of_a_90_w_step():
    y, rise, air = responses(QuillMachine().design, 10.0)
    assert y[60] == pytest.approx(114.0, abs=2.0)
    assert y.max() == pytest.approx(116.5, abs=1.0)
    assert 60 <= y.argmax() <= 110
    assert y[-1] == pytest.approx(92.0, abs=1.5)
    assert rise[-1] == pytest.approx(22.6, abs=0.2)
    assert np.diff(y).max() == pytest.approx(5.0, abs=0.6)
    assert air[-1] == pytest.approx(10.3, abs=0.4)


def test_responses_come_near_the_published_ones():
    fits = [fit_pct(p, s) for p, s in zip(step_responses(1440), responses(QuillMachine().design), strict=True)]
    assert fits[0] > 93.0
    assert fits[1] > 90.0
    assert fits[2] > 95.0


@pytest.mark.parametrize(("dt_s", "tolerance_um"), [(60.0, 1e-9), (1.0, 0.05), (0.25, 0.05), (7.2, 0.02)])
def test_step_length_does_not_matter(dt_s, tolerance_um):
    reference, other = QuillMachine(), QuillMachine()
    for _ in range(360):
        reference.advance(10.0, HEAT)
    for _ in range(round(3600.0 / dt_s)):
        other.advance(dt_s, HEAT)
    for name in ("y_um", "t_q_degc"):
        assert other.signals()[name] == pytest.approx(reference.signals()[name], abs=tolerance_um)


def test_pieces_under_a_second_keep_the_inputs_that_they_had():
    mixed, even = QuillMachine(), QuillMachine()
    for _ in range(2000):
        mixed.advance(0.3, Inputs(heat_w=90.0))
        mixed.advance(0.3, Inputs(heat_w=30.0))
    even.advance(1200.0, Inputs(heat_w=60.0))
    assert mixed.signals()["y_um"] == pytest.approx(even.signals()["y_um"], abs=0.1)


def test_nonsense_of_time_is_refused():
    for dt_s in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="dt_s"):
            QuillMachine().advance(dt_s, HEAT)


def test_ambient_sensor_lags():
    machine = QuillMachine()
    machine.advance(45.0, Inputs(ambient_degc=21.0))
    assert machine.signals()["at_degc"] == pytest.approx(21.0 - np.exp(-1.0), abs=1e-6)
