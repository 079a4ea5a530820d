"""What a film exchanges with a surface that follows, beside the physics integrated in small steps."""

import numpy as np
import pytest

from compensator.model.effects import effect_from
from compensator.model.effects.blocks import Exchange
from compensator.model.effects.signals import Signals
from compensator.model.effects.stream import EffectStream

N = 600
MINUTES = np.arange(float(N))


def pumps(seed):
    """Return a flow as a share of its largest, which is switched now and then, and a difference of temperatures, K."""
    rng = np.random.default_rng(seed)
    flow = np.repeat(rng.choice([0.0, 0.2, 0.6, 1.0], N // 30), 30)
    flow[:30] = 0.4
    return flow, -4.0 + 2.0 * np.sin(MINUTES / 70.0)


def exchanged(conductance, difference, half, surface_min, steps=200):
    """Return the heat by the energy balance of the surface, from balance, in units of what a film of 1 has."""
    kappa = 1.0 / half
    surface = (1.0 + kappa) * conductance[0] * difference[0] / (1.0 + kappa * conductance[0])
    heat = []
    for i in range(N):
        before = max(i - 1, 0)
        for part in np.linspace(0.0, 1.0, steps):
            c = conductance[before] + part * (conductance[i] - conductance[before])
            d = difference[before] + part * (difference[i] - difference[before])
            flux = c * ((1.0 + kappa) * d - kappa * surface)
            surface += (flux - surface) / surface_min / steps if i else 0.0
        heat.append(c * ((1.0 + kappa) * d - kappa * surface))
    return np.array(heat)


@pytest.mark.parametrize(("half", "surface_min"), [(0.1, 90.0), (1.0, 30.0), (30.0, 200.0)])
def test_it_is_what_the_balance_of_heat_gives(half, surface_min):
    flow, difference = pumps(1)
    flow = np.interp(MINUTES, MINUTES[::15], flow[::15])
    found = Exchange(half, surface_min, 1.0).filter(flow, difference)
    assert found == pytest.approx(exchanged(flow, difference, half, surface_min), abs=0.02 * np.ptp(found))


@pytest.mark.parametrize("surface_min", [0.0, 0.6, 25.0, 900.0])
def test_steps_are_what_a_record_gives(surface_min):
    flow, difference = pumps(2)
    block = Exchange(0.2, surface_min, 1.0)
    whole = block.filter(flow, difference)
    stepped = [block.step(*values) for values in zip(flow, difference, strict=True)]
    assert stepped == pytest.approx(whole, abs=1e-9)


@pytest.mark.parametrize(("half", "surface_min"), [(0.01, 0.6), (0.03, 2.2), (0.001, 30.0), (0.1, 5.0)])
def test_a_surface_that_follows_within_a_sample_does_not_ring(half, surface_min):
    """A fan that runs and stops: the heat has one sign, and an odd number of samples ends as an even one does."""
    ends = []
    for ran in (20, 21):
        flow = np.repeat([0.0, 1.0, 0.0, 1.0], [5, ran, 1, 5])
        heat = Exchange(half, surface_min, 1.0).filter(flow, np.ones(flow.size))
        assert heat.min() >= 0.0 and np.all(np.diff(heat[5 : 5 + ran]) <= 1e-9)
        ends.append(heat[6 + ran])
    assert ends[0] == pytest.approx(ends[1], rel=0.03)


def test_a_surface_that_hardly_waits_is_one_that_follows_at_once():
    flow, difference = pumps(5)
    soon, at_once = (Exchange(0.2, tau, 1.0).filter(flow, difference) for tau in (1e-6, 0.0))
    assert soon == pytest.approx(at_once, abs=1e-4)


def test_a_surface_that_follows_at_once_saturates():
    flow, difference = pumps(3)
    saturated = difference * flow * 1.25 / (flow + 0.25)
    assert Exchange(0.25, 0.0, 1.0).filter(flow, difference) == pytest.approx(saturated)


def test_behind_a_good_conductor_the_film_carries_what_it_is_given():
    flow, difference = pumps(4)
    assert Exchange(1e6, 40.0, 1.0).filter(flow, difference) == pytest.approx(flow * difference, abs=1e-4)


@pytest.mark.parametrize("off", [0.0, 1e-9, -1e-9, 1e-3])
def test_a_lag_as_long_as_what_is_wetted_follows_is_no_exception(off):
    table = {"form": "flow", "channel": "a_lpm", "fluid": "a_degc", "span": 8.0, "half": 1.0, "surface_min": 10.0}
    effect = effect_from("input", table | {"tau_min": [5.0 * (1.0 + off)], "gain": [0.5], "gain_air": [0.2]})
    # L(5) of 1 + exp(-t/5): 1 − exp(-t/5) + t/5 exp(-t/5) is one half at t = 5 · 0.3149.
    assert effect.half_time_min() == pytest.approx(5.0 * 0.3149, rel=0.01)


@pytest.mark.parametrize("surface_min", [0.0, 12.0, 300.0])
def test_half_of_the_response_is_there_at_the_time_that_is_said(surface_min):
    table = {"form": "flow", "channel": "flow_lpm", "fluid": "a_degc", "span": 8.0, "half": 0.4}
    table |= {"tau_min": [5.0, 120.0], "gain": [0.1, 0.5], "gain_air": [0.0, 0.2], "surface_min": surface_min}
    effect = effect_from("input", table)
    stream = EffectStream(effect, 0.1)
    still = dict.fromkeys(("drive", "ambient_k", "t_q_degc", "at_degc", "y_dtf_um", "y_tdtf_um"), 0.0)

    def at(degc):
        return Signals(**still, channels={"flow_lpm": 8.0, "a_degc": degc})

    stream.step(at(0.0))
    response = np.array([stream.step(at(1.0)) for _ in range(20_000)])
    assert response[-1] == pytest.approx(effect.named({})["gain_um_per_k"], rel=0.01)
    assert 0.1 * np.argmax(response >= 0.5 * response[-1]) == pytest.approx(effect.half_time_min(), rel=0.05, abs=0.2)
