"""Drawn machines: the same by seed, tables as described, effects that add up, two sets of cases that share nothing."""

import functools
from collections import Counter

import numpy as np
import pytest

from sim_hardware.drawn_machines import CATALOGUE, DEVELOPMENT, EFFECTS, FAMILIES, SEALED, SEALED_RUNS, draw

MODEL_KINDS = ("input", "gain", "dynamics", "delay", "nonlinear", "scheduled", "hysteresis")
TIME_KINDS = ("drift", "step", "periodic", "unobserved")
#: Some of each family that are drawn quickly.
SOME = (
    ("transfer", 1, "gain_dtf"),
    ("transfer", 2, "lag_t_q"),
    ("transfer", 3, "step"),
    ("conduction", 1, "none"),
    ("conduction", 2, "more_power"),
    ("conduction", 3, "delay_t_q"),
    ("lumped", 1, "bearing"),
    ("lumped", 4, "drift"),
)


@functools.cache
def drawn(family, seed, effect):
    return draw(family, seed, effect=effect, shop_floor=seed % 2 == 0)


@pytest.fixture(params=SOME, ids=lambda some: "-".join(map(str, some)))
def one(request):
    return drawn(*request.param)


def test_the_same_seed_draws_the_same_machine():
    for some in (SOME[1], SOME[3]):
        first, second = drawn(*some), draw(*some[:2], effect=some[2], shop_floor=some[1] % 2 == 0)
        assert first.truth == second.truth
        for name in ("calibration", "record", "fresh", "healthy"):
            one, two = getattr(first, name), getattr(second, name)
            assert list(one.columns) == list(two.columns)
            for column, values in one.columns.items():
                np.testing.assert_array_equal(values, two.columns[column])


def test_other_seeds_and_families_draw_other_machines():
    lengths = {(m.record.hours, m.noise_um, tuple(m.record.columns)) for m in (drawn(*some) for some in SOME)}
    assert len(lengths) == len(SOME)
    assert {drawn(*some).family for some in SOME} == set(FAMILIES)


def test_tables_are_what_they_claim(one):
    for table in (one.calibration, one.record, one.fresh, one.healthy):
        columns = table.columns
        np.testing.assert_array_equal(columns["t_s"], 60.0 * np.arange(table.true_um.size))
        assert {"t_q_degc", "at_degc", "y_um"} < set(columns)
        assert all(values.shape == columns["t_s"].shape for values in columns.values())
        assert np.isfinite(table.true_um).all()
        assert one.shop_floor == any(np.isnan(values).any() for values in columns.values())
        assert 20.0 <= np.ptp(table.true_um) <= 160.0
    assert "heat_w" not in one.record.columns
    assert 6.0 <= one.record.hours <= 120.0
    for place in one.truth.places[:1]:
        assert not place[2] or place[2] in one.record.columns


def test_noise_is_as_stated(one):
    error = one.healthy.columns["y_um"] - one.healthy.true_um
    jumps = np.abs(np.diff(error[np.isfinite(error)]))
    assert np.median(jumps) / 0.6745 / 2.0**0.5 == pytest.approx(one.noise_um, rel=0.15)


def test_the_effect_adds_up(one):
    truth, entry = one.truth, CATALOGUE[one.truth.effect]
    np.testing.assert_allclose(one.fresh.true_um - one.healthy.true_um, one.fresh.part_um, atol=1e-9)
    assert not one.calibration.part_um.any()
    error = one.record.columns["y_um"] - one.record.true_um - (one.record.part_um if entry.acts_on == "y" else 0.0)
    assert np.nanmedian(np.abs(error)) < 3.0 * one.noise_um + 0.3 * one.shop_floor
    if one.family == "transfer" and entry.acts_on == "machine":  # Its effects do not warm T_Q.
        assert np.std(one.record.part_um) == pytest.approx(truth.size_um)
    if entry.acts_on == "y":
        assert np.std(one.record.part_um) == pytest.approx(truth.size_um)
        assert not one.fresh.part_um.any()
    if entry.acts_on == "t_q":
        assert not one.record.part_um.any()
        late = one.fresh.columns["t_q_degc"] - one.healthy.columns["t_q_degc"]
        assert np.nanmax(np.abs(late)) > 5.0 * one.noise_k
    if truth.effect != "none":
        assert 1.0 <= truth.size_um <= 30.0
        assert truth.size_um >= 3.0 * one.noise_um


def test_a_changed_gain_is_that_share_of_the_paths_response():
    one = draw("transfer", 8, effect="gain_dtf", shop_floor=False, published=True)
    share = one.fresh.part_um / one.truth.strength
    ambient = one.healthy.true_um - share  # What is left moves with the air alone.
    quiet = np.flatnonzero(np.abs(share) < 1e-12)
    assert quiet.size >= 30
    assert np.std(ambient) < np.std(share)
    assert 0.05 <= abs(one.truth.strength) <= 0.15


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="expected one of: transfer"):
        draw("hydrostatic", 1)
    with pytest.raises(ValueError, match="expected one of: none, coolant, wet"):
        draw("lumped", 1, effect="gain_tdtf")


def test_names_are_those_of_the_contract():
    for name, entry in CATALOGUE.items():
        for kind, path, channel in entry.places:
            assert kind in (MODEL_KINDS if entry.deployable else TIME_KINDS)
            assert path in ("", "DTF", "TDTF", "TTF")
            assert bool(channel) == (kind in ("input", "scheduled"))
        assert bool(entry.places) == (name != "none")


def test_the_two_sets_share_nothing_and_hold_each_effect_equally_often():
    assert not {case.seed for case in DEVELOPMENT} & {case.seed for case in SEALED}
    assert len(SEALED_RUNS) <= 3
    for cases in (DEVELOPMENT, SEALED):
        assert Counter(case.family for case in cases) == {"transfer": 42, "conduction": 30, "lumped": 30}
        assert len({(case.family, case.seed) for case in cases}) == len(cases)
        for family in FAMILIES:
            mine = [case for case in cases if case.family == family]
            assert set(Counter(case.effect for case in mine).values()) == {len(mine) // len(EFFECTS[family])}
            assert abs(sum(case.shop_floor for case in mine) - len(mine) / 2) <= 1
