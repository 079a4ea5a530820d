"""Machine-weeks: effects act while they act, troubles spoil what is read and never the machine, the same by seed."""

import dataclasses
import functools
from collections import Counter

import numpy as np
import pytest

from sim_hardware.drawn_machines.conduction import ConductionMachine
from sim_hardware.drawn_machines.duty import PER_H, Habits, draw_duty
from sim_hardware.drawn_machines.lumped import LumpedMachine
from sim_hardware.drawn_machines.transfer import TransferMachine
from sim_hardware.drawn_machines.trouble import Trouble, draw_troubles, moved_um, spoiled
from sim_hardware.drawn_machines.weeks import (
    DAY_MIN,
    DEVELOPMENT_WEEKS,
    SEALED_WEEK_RUNS,
    SEALED_WEEKS,
    Week,
)

HABITS = Habits.drawn(np.random.default_rng(3))
PLANTS = {
    "transfer": (lambda: TransferMachine(np.random.default_rng(0), published=False), "speed", 5.0),
    "path": (lambda: TransferMachine(np.random.default_rng(0), published=False), "gain_dtf", 0.1),
    "conduction": (lambda: ConductionMachine(np.random.default_rng(1)), "coolant", 5.0),
    "fan": (lambda: ConductionMachine(np.random.default_rng(1)), "fan", 1.0),
    "lumped": (lambda: LumpedMachine(np.random.default_rng(2)), "weak_bearing", 0.5),
}


@functools.cache
def week(family="transfer", seed=7, effects=("coolant",), probed=False):
    return Week(
        family=family, seed=seed, effects=effects, probed=probed, shop_floor=False, published=False, days=7
    ).draw()


@functools.cache
def duty():
    return draw_duty(np.random.default_rng(5), HABITS, 12.0, kind="steps")


@pytest.mark.parametrize("name", PLANTS)
def test_an_effect_that_always_acts_is_the_effect(name):
    make, effect, strength = PLANTS[name]
    always = make().run(duty(), HABITS, effect, strength)
    masked = make().run(duty(), HABITS, effect, strength, np.ones(duty().n, dtype=bool))
    np.testing.assert_allclose(masked.y_um, always.y_um, atol=1e-9)


@pytest.mark.parametrize("name", PLANTS)
def test_an_effect_acts_from_its_beginning_and_dies_out_after_its_end(name):
    make, effect, strength = PLANTS[name]
    on = np.zeros(duty().n, dtype=bool)
    begin, end = duty().before + 3 * PER_H, duty().before + 6 * PER_H
    on[begin:end] = True
    healthy, acted = make().run(duty(), HABITS, effect, 0.0), make().run(duty(), HABITS, effect, strength, on)
    part = (acted.y_um - healthy.y_um) + 0.0
    minute = begin * 15 // 60
    np.testing.assert_allclose(part[:minute], 0.0, atol=1e-9)
    during, last = part[minute : end * 15 // 60], part[-60:]
    assert np.max(np.abs(during)) > 0.05
    assert np.max(np.abs(last)) < np.max(np.abs(during))


def test_the_same_seed_draws_the_same_week():
    one, two = week(), week.__wrapped__()
    assert (one.spells, one.troubles, one.visits, one.probes) == (two.spells, two.troubles, two.visits, two.probes)
    for name, values in one.columns.items():
        np.testing.assert_array_equal(values, two.columns[name])


@pytest.mark.parametrize("family", ["transfer", "conduction"])
def test_a_week_is_healthy_until_its_effect_begins(family):
    one = week(family)
    (spell,) = one.spells
    part = one.true_um - one.healthy_um
    np.testing.assert_allclose(part[: spell.from_min], 0.0, atol=1e-9)
    assert np.std(part[spell.from_min : spell.to_min]) > 1.0
    assert DAY_MIN <= spell.from_min <= one.minutes - 3.5 * DAY_MIN
    assert one.minutes == 7 * DAY_MIN == one.columns["t_q_degc"].size
    for name in one.columns:
        np.testing.assert_array_equal(one.columns[name][:600] + 0.0, one.healthy[name][:600] + 0.0)


def test_a_probed_week_has_no_displacement_sensor_and_its_probes_feel_the_mount():
    seed = next(
        s
        for s in range(20, 60)
        if any(t.kind in ("creep", "slip") for t in week(seed=s, probed=True).troubles) and week(seed=s, probed=True)
    )
    one = week(seed=seed, probed=True)
    assert "y_um" not in one.columns
    moved = moved_um(one.troubles, one.minutes)
    late = [probe for probe in one.probes if abs(moved[probe.minute]) > 3.0 and abs(probe.error_um) < 100.0]
    assert late
    error = np.median([probe.error_um - moved[probe.minute] for probe in late])
    assert abs(error) < 3.0 * one.probe_std_um


def columns():
    rng = np.random.default_rng(1)
    return {name: rng.normal(20.0, 1.0, 100) for name in ("t_q_degc", "at_degc", "y_um")}


def trouble(kind, channel="t_q_degc", size=0.0):
    return Trouble(kind=kind, channel=channel, from_min=20, to_min=50, size=size)


def test_troubles_spoil_what_is_read_while_they_last():
    before = columns()
    broken = spoiled(before, [trouble("break")])["t_q_degc"]
    assert np.isnan(broken[20:50]).all() and np.isfinite(np.delete(broken, np.s_[20:50])).all()
    jumped = spoiled(before, [trouble("jump", "at_degc", 3.0)])["at_degc"] - before["at_degc"]
    np.testing.assert_allclose(jumped[20:50], 3.0)
    assert not np.delete(jumped, np.s_[20:50]).any()
    stuck = spoiled(before, [trouble("stuck")])["t_q_degc"]
    assert np.ptp(stuck[20:50]) == 0.0 and stuck[50] == before["t_q_degc"][50]
    swapped = spoiled(before, [trouble("exchange")])
    np.testing.assert_array_equal(swapped["t_q_degc"][20:50], before["at_degc"][20:50])
    np.testing.assert_array_equal(swapped["at_degc"][20:50], before["t_q_degc"][20:50])


def test_a_mount_that_has_crept_stays_where_it_is():
    before = columns()
    crept = spoiled(before, [trouble("creep", "y_um", 6.0)])["y_um"] - before["y_um"]
    assert not crept[:20].any()
    assert crept[35] == pytest.approx(3.0)
    np.testing.assert_allclose(crept[50:], 6.0)
    swayed = spoiled(before, [trouble("period", "y_um", 6.0)])["y_um"] - before["y_um"]
    assert not swayed[50:].any() and np.max(np.abs(swayed)) > 3.0


def test_every_kind_of_trouble_is_drawn():
    drawn = [t for seed in range(60) for t in draw_troubles(np.random.default_rng(seed), 7, probed=seed % 2 == 0)]
    assert set(Counter(t.kind for t in drawn)) == {
        "break", "jump", "stuck", "exchange", "creep", "slip", "period", "hand",
    }  # fmt: skip
    assert all(t.from_min < t.to_min <= 7 * DAY_MIN for t in drawn)


def test_the_two_sets_share_nothing():
    assert not {one.seed for one in DEVELOPMENT_WEEKS} & {one.seed for one in SEALED_WEEKS}
    run = [seed for seeds, _ in SEALED_WEEK_RUNS for seed in seeds]
    assert len(set(run)) == len(run) and set(run) <= {one.seed for one in SEALED_WEEKS}
    for each in (DEVELOPMENT_WEEKS, SEALED_WEEKS):
        assert len({(one.family, one.seed) for one in each}) == len(each) == 100
        assert 10 <= sum("none" in one.effects for one in each) <= 14
        assert 30 <= sum(one.probed for one in each) <= 36
        effects = Counter(effect for one in each for effect in one.effects)
        assert {"coolant", "speed", "gain_dtf", "loose_couple", "hidden", "fan"} <= set(effects)
        assert not {"drift", "step", "period"} & set(effects)  # Errors of Y's measurement are troubles there.


def test_an_unfair_week_is_drawn_anew_or_refused():
    case = dataclasses.replace(DEVELOPMENT_WEEKS[0], effects=("wet",))
    with pytest.raises((ValueError, KeyError)):
        case.draw()
