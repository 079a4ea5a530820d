"""The correction by probes: what it learns, refuses, believes, states, keeps and hands over."""

import json
import math

import numpy as np
import pytest

from compensator.model.correction import BELIEVED, OUTLIER, ProbeCorrection

NAMES = ["DTF", "TDTF", "1 input coolant_degc"]
REST = [0.0, 0.0, 0.0]


def shares(minute):
    """Shares of a working day, µm."""
    return [40.0 * (1.0 - math.cos(minute / 230.0)), 6.0 * math.sin(minute / 400.0), 5.0 * math.sin(minute / 90.0)]


def run(lacking, *, hours=24.0, every=60, std=1.5, seed=1, wrong=None, correction=None):
    """Probe each `every` minutes what the model lacks; return correction, errors and stated deviations."""
    found = correction or ProbeCorrection(NAMES)
    rng = np.random.default_rng(seed)
    errors, stated, verdicts = [], [], []
    for minute in range(int(hours * 60)):
        now = shares(minute)
        found.step(now)
        if found.active:
            errors.append(lacking(minute, now) - found.correction_um(now))
            stated.append(found.std_um(now))
        if minute % every == 0:
            chip = (wrong or {}).get(minute // every, 0.0)
            y = sum(now) + lacking(minute, now) + rng.normal(0.0, std) + chip
            verdicts.append(found.update(y, std, sum(now), now))
    return found, np.array(errors), np.array(stated), verdicts


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def nothing(minute, now):
    return 0.0


def test_it_does_nothing_before_the_first_probe():
    found = ProbeCorrection(NAMES)
    for minute in range(100):
        found.step(shares(minute))
    assert (found.active, found.correction_um(shares(100)), found.std_um(shares(100))) == (False, 0.0, 0.0)


def test_a_probe_above_the_prediction_raises_it():
    found = ProbeCorrection(NAMES)
    verdict = found.update(12.0, 0.5, 10.0, [8.0, 2.0, 0.0])
    assert verdict.taken and verdict.innovation_um == pytest.approx(2.0)
    assert 1.5 < found.correction_um([8.0, 2.0, 0.0]) < 2.0


def test_the_deviation_falls_at_a_probe_and_grows_after_it():
    found, *_ = run(nothing, hours=12.0)
    before = found.std_um(REST)
    found.step(REST, 60.0)
    waiting = found.std_um(REST)
    found.update(0.0, 1.5, 0.0, REST)
    assert found.std_um(REST) < waiting > before
    for _ in range(60):
        found.step(REST)
    assert found.std_um(REST) > before / 2.0


def test_samples_and_one_long_step_are_the_same_time():
    one, *_ = run(nothing, hours=6.0)
    other = ProbeCorrection.from_dict(one.to_dict())
    for _ in range(90):
        one.step(REST)
    other.step(REST, 90.0)
    assert one.std_um(REST) == other.std_um(REST)


def test_a_gain_is_learned_and_holds_where_no_probe_was():
    found, *_ = run(lambda minute, now: 0.1 * now[0], hours=24.0)
    at_rest, far = found.correction_um(REST), found.correction_um([120.0, 0.0, 0.0])
    assert far - at_rest == pytest.approx(12.0, abs=2.0)


def test_it_is_better_than_the_offset_alone():
    """An offset that is set at each probe leaves what the gain does in the hour after it."""
    _, errors, *_ = run(lambda minute, now: 0.1 * now[0], hours=36.0)
    held = [0.1 * (shares(m)[0] - shares(m - m % 60)[0]) for m in range(36 * 60)]
    assert rms(errors[720:]) < 0.7 * math.hypot(rms(held[720:]), 1.5)


@pytest.mark.parametrize("walk_um", [0.05, 0.2, 0.5])
def test_it_states_its_error_for_every_walk_of_the_offset(walk_um):
    """One fixed walk would be wrong by a factor of four here."""
    ratios, within = [], []
    for seed in range(6):
        offset = np.cumsum(np.random.default_rng([seed, 7]).normal(0.0, walk_um, 60 * 60))
        _, errors, stated, _ = run(lambda m, now, offset=offset: offset[m], hours=60.0, seed=seed)
        ratios.append(rms(errors) / rms(stated))
        within.append(np.mean(np.abs(errors) <= 2.0 * stated))
    assert 0.8 < np.median(ratios) < 1.25
    assert 0.88 < np.mean(within) < 0.99


def test_the_level_of_the_data_is_of_no_importance():
    """After the first probe, however far the level is from zero; a gain that was off would show it."""
    _, errors, stated, _ = run(nothing)
    _, shifted, wider, verdicts = run(lambda minute, now: 3500.0)
    assert all(verdict.taken for verdict in verdicts)
    assert rms(shifted) < rms(errors) + 0.5 and rms(wider) < rms(stated) + 0.7


def test_a_chip_is_refused_and_moves_nothing():
    found, *_ = run(nothing, hours=12.0)
    before, deviation = found.correction_um(shares(720)), found.std_um(shares(720))
    verdict = found.update(sum(shares(720)) + 20.0, 1.5, sum(shares(720)), shares(720))
    assert (verdict.taken, verdict.reason) == (False, OUTLIER)
    assert verdict.innovation_um == pytest.approx(20.0, abs=2.0) and verdict.innovation_std_um < 4.0
    assert found.correction_um(shares(720)) == before
    assert found.std_um(shares(720)) >= deviation


def test_what_is_beyond_every_density_is_refused():
    found, *_ = run(nothing, hours=12.0)
    before = found.correction_um(REST)
    assert not found.update(1e30, 1.5, 0.0, REST).taken
    assert found.correction_um(REST) == before
    assert found.update(0.0, 1.5, 0.0, REST).taken


def test_chips_cost_little():
    lacking = lambda minute, now: -0.1 * now[0]  # noqa: E731
    _, clean, *_ = run(lacking, hours=48.0)
    _, chipped, _, verdicts = run(lacking, hours=48.0, wrong={9: 20.0, 20: -20.0, 33: 20.0, 34: -20.0})
    assert sum(not verdict.taken for verdict in verdicts) == 4
    assert rms(chipped) < 1.2 * rms(clean)


def test_three_refused_ones_that_agree_are_believed():
    found, *_ = run(nothing, hours=12.0)
    quiet = ProbeCorrection.from_dict(found.to_dict())
    reasons = []
    for y in (24.0, 25.5, 25.2):
        found.step(REST, 5.0)
        quiet.step(REST, 5.0)
        reasons.append(found.update(y, 1.5, 0.0, REST).reason)
        quiet.update(y - 25.0, 1.5, 0.0, REST)
    assert reasons == [OUTLIER, OUTLIER, BELIEVED]
    assert found.correction_um(REST) == pytest.approx(25.0, abs=1.5)
    assert found.to_dict()["doubt"] < 0.5  # What was believed is not on probation as what was refused.
    found.step(REST, 60.0)
    quiet.step(REST, 60.0)
    assert found.std_um(REST) > 1.3 * quiet.std_um(REST)  # What jumped once is not as well known as before.


def test_refused_ones_that_contradict_each_other_are_not_believed():
    found, *_ = run(nothing, hours=12.0)
    verdicts = [found.update(y, 1.5, 0.0, REST) for y in (25.0, -24.0, 45.0)]
    assert [verdict.taken for verdict in verdicts] == [False] * 3


def test_refused_ones_that_lie_days_apart_do_not_support_each_other():
    found, *_ = run(nothing, hours=24.0)
    reasons = []
    for _ in range(3):
        found.step(REST, 2000.0)
        state = found.to_dict()
        reasons.append(found.update(40.0, 1.5, 0.0, REST).reason)
        assert len(state["refused"]) < 3
    assert BELIEVED not in reasons


def test_a_probe_that_fits_ends_the_doubt():
    found, *_ = run(nothing, hours=12.0)
    taken = [found.update(y, 1.5, 0.0, REST).taken for y in (25.0, 25.0, 0.5, 25.0, 25.0)]
    assert taken == [False, False, True, False, False]


def test_a_first_probe_that_was_wrong_is_undone():
    """With a level that could be anything the first one cannot be refused; the next ones show it."""
    found = ProbeCorrection(NAMES)
    found.update(60.0, 1.5, 0.0, REST)
    assert found.correction_um(REST) == pytest.approx(60.0, abs=6.0)
    for _ in range(3):
        found.step(REST, 60.0)
        found.update(0.0, 1.5, 0.0, REST)
    assert abs(found.correction_um(REST)) < 2.0


def doubtful(wrong_um):
    """The first probe of a machine that is as predicted, with so much heat that it can be right as well."""
    found, now = ProbeCorrection(NAMES), [20.0, 20.0, 0.0]
    assert found.update(40.0 + wrong_um, 1.5, 40.0, now).taken
    return found, now


def alone(found, bank):
    """One of its two hypotheses."""
    return ProbeCorrection.from_dict(found.to_dict() | {"bank": found.to_dict()[bank], "without": None, "doubt": 0.0})


@pytest.mark.parametrize("wrong_um", [10.0, 15.0, 20.0, 30.0])
def test_a_doubtful_probe_acts_in_part_and_its_doubt_is_in_the_deviation(wrong_um):
    found, now = doubtful(wrong_um)
    right, wrong, doubt = alone(found, "bank"), alone(found, "without"), found.doubt
    apart = right.correction_um(now) - wrong.correction_um(now)
    variance = (1.0 - doubt) * right.std_um(now) ** 2 + doubt * wrong.std_um(now) ** 2
    assert found.correction_um(now) == pytest.approx(right.correction_um(now) - doubt * apart)
    assert found.std_um(now) == pytest.approx(math.sqrt(variance + doubt * (1.0 - doubt) * apart**2))
    assert found.doubted_um(now) == pytest.approx(math.sqrt(doubt * (1.0 - doubt)) * abs(apart))
    assert doubt < 0.1 or found.correction_um(now) < 2.2 * found.std_um(now)


def test_the_next_probe_ends_the_doubt():
    found, now = doubtful(20.0)
    assert found.doubt > 0.3 and found.std_um(now) > 8.0
    found.update(40.0, 1.5, 40.0, now)
    assert found.doubt < 0.1 and abs(found.correction_um(now)) < 1.5 and found.std_um(now) < 2.5


def test_a_probe_that_is_refused_leaves_the_doubt():
    found, now = doubtful(20.0)
    before, deviation = found.correction_um(now), found.std_um(now)
    assert not found.update(-30.0, 1.5, 40.0, now).taken
    assert found.correction_um(now) == before and found.std_um(now) >= deviation - 1e-9


def test_another_model_takes_over_a_doubtful_probe_without_a_jump():
    found, now = doubtful(20.0)
    other = found.transferred(["DTF", "TDTF"], now, [30.0, 4.0], -6.0)
    assert other.correction_um([30.0, 4.0]) - 6.0 == pytest.approx(found.correction_um(now), abs=1e-9)
    assert other.std_um([30.0, 4.0]) == pytest.approx(found.std_um(now), rel=1e-9)
    other.update(34.0 + 6.0, 1.5, 34.0, [30.0, 4.0])  # As the old model foretold it.
    assert abs(other.correction_um([30.0, 4.0]) - 6.0) < 1.5


def test_after_a_zero_the_gains_act_on_what_the_shares_grow_by():
    found, *_ = run(lambda minute, now: 0.15 * now[0], hours=48.0)
    now = shares(2880)
    grown = [now[0] - 60.0, *now[1:]]
    gained, deviation = found.correction_um(grown) - found.correction_um(now), found.std_um(now)
    after = found.at_zero(now)
    assert after.active and not after.is_probed
    assert after.correction_um(now) == pytest.approx(0.0, abs=1e-9)
    assert after.correction_um(grown) == pytest.approx(gained, abs=0.5) and abs(gained) > 7.0
    # The level of a machine that was zeroed is known; far from the zero, the gains are not.
    assert deviation < after.std_um(now) < 3.1 < after.std_um([now[0] + 200.0, *now[1:]])
    # A feature whose place the zero did not change is believed at its first probe.
    assert after.update(sum(now) + 90.0, 1.5, 0.0, now).taken
    assert after.correction_um(now) == pytest.approx(sum(now) + 90.0, abs=3.0) and after.is_probed


def test_other_shares_at_the_zero_leave_the_correction_at_the_zero_as_it_is():
    """The state of the engine was wrong at the zero; the gains act on what the right shares grow by."""
    found, *_ = run(lambda minute, now: 0.15 * now[0], hours=48.0)
    wrong = shares(2880)
    right = [wrong[0] - 25.0, wrong[1] + 3.0, *wrong[2:]]
    after, known = found.at_zero(wrong), found.at_zero(right)
    after.move_zero([b - a for a, b in zip(wrong, right, strict=True)])
    for grown in (right, [right[0] - 60.0, *right[1:]]):
        assert after.correction_um(grown) == pytest.approx(known.correction_um(grown), abs=1e-9)
        assert after.std_um(grown) == pytest.approx(known.std_um(grown), rel=1e-6)
    none = ProbeCorrection(NAMES)
    none.move_zero([5.0] * len(NAMES))
    assert none.to_dict() == ProbeCorrection(NAMES).to_dict()


def test_a_zero_before_the_first_probe_changes_nothing():
    after = ProbeCorrection(NAMES).at_zero(shares(100))
    assert not after.active and after.to_dict() == ProbeCorrection(NAMES).to_dict()


def test_a_chip_near_the_zero_is_refused_at_the_first_probe():
    found = ProbeCorrection(NAMES)
    assert not found.update(20.0, 1.5, 0.0, REST).taken
    assert not found.active and found.correction_um(REST) == 0.0


def test_the_first_feature_is_the_first_of_which_a_probe_is_taken():
    found = ProbeCorrection(NAMES)
    assert not found.update(20.0, 1.5, 0.0, REST, feature="with a chip").taken
    assert found.update(2.0, 1.5, 0.0, REST, feature="sphere").taken
    assert found.correction_um(REST) == pytest.approx(2.0, abs=1.0)


@pytest.mark.parametrize("seed", range(4))
def test_no_refused_probe_moves_the_correction(seed):
    """Whatever was on probation before it."""
    found, rng = ProbeCorrection(NAMES), np.random.default_rng(seed)
    refused = 0
    for minute in range(0, 6000, 30):
        now = shares(minute)
        found.step(now, 30.0)
        before = found.correction_um(now)
        y = sum(now) + rng.normal(0.0, 1.5) + rng.choice([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 14.0, -20.0])
        if not found.update(y, 1.5, sum(now), now).taken:
            refused += 1
            assert found.correction_um(now) == before
    assert refused > 5


def test_a_further_feature_makes_no_jump_and_teaches_changes():
    found, *_ = run(nothing, hours=12.0)
    before, deviation = found.correction_um(REST), found.std_um(REST)
    assert found.update(30.0, 1.5, 0.0, REST, feature="bore").taken
    assert found.correction_um(REST) == pytest.approx(before, abs=0.01)
    assert found.std_um(REST) == pytest.approx(deviation, abs=0.05)
    for rise in np.arange(0.0, 8.0, 1.0):
        found.step(REST, 60.0)
        found.update(30.0 + rise, 1.5, 0.0, REST, feature="bore")
    assert found.correction_um(REST) == pytest.approx(before + 7.0, abs=2.5)


def test_a_further_feature_that_is_believed_leaves_the_offset_and_widens_its_deviation():
    """The feature may have moved as well as the machine."""
    found, *_ = run(nothing, hours=12.0)
    for _ in range(4):
        found.update(30.0, 1.5, 0.0, REST, feature="bore")
    before = found.correction_um(REST)
    verdicts = [found.update(50.0, 1.5, 0.0, REST, feature="bore") for _ in range(3)]
    assert verdicts[-1].reason == BELIEVED
    assert found.correction_um(REST) == pytest.approx(before, abs=0.5)
    assert found.std_um(REST) > 10.0


def test_two_features_that_agree_show_that_the_machine_moved():
    found, *_ = run(nothing, hours=12.0)
    for _ in range(4):
        found.update(30.0, 1.5, 0.0, REST, feature="bore")
    verdicts = [
        found.update(50.0, 1.5, 0.0, REST, feature="bore"),
        found.update(20.0, 1.5, 0.0, REST),
        found.update(20.0, 1.5, 0.0, REST),
    ]
    assert verdicts[-1].reason == BELIEVED
    assert found.correction_um(REST) == pytest.approx(20.0, abs=2.0)


@pytest.mark.parametrize("wrong", [{}, {11: 20.0}, {10: 20.0, 11: 20.0}, {0: 60.0}])
def test_it_continues_bit_by_bit(wrong):
    """In the middle of the time between two probes, with a second feature, refused probes and one on probation."""
    one, *_ = run(lambda minute, now: 0.1 * now[0], hours=12.0, wrong=wrong)
    one.update(200.0, 2.0, 170.0, shares(720), feature="bore")
    one.step(shares(721), 0.7)
    other = ProbeCorrection.from_dict(json.loads(json.dumps(one.to_dict())))
    for correction in (one, other):
        run(lambda minute, now: 0.2 * now[0], hours=6.0, seed=3, correction=correction, wrong={1: 20.0, 2: 21.0})
        correction.update(205.0, 2.0, 170.0, shares(360), feature="bore")
    assert one.to_dict() == other.to_dict()
    assert one.correction_um(shares(5)) == other.correction_um(shares(5))
    assert one.std_um(shares(5)) == other.std_um(shares(5))


@pytest.mark.parametrize(
    "change",
    [
        lambda state: state.pop("bank"),
        lambda state: state["bank"]["weights"].pop(),
        lambda state: state["bank"]["states"][0].append(0.0),
        lambda state: state["bank"]["covariances"][0][0].__setitem__(0, math.nan),
        lambda state: state.__setitem__("names", ["DTF"]),
        lambda state: state.__setitem__("refused", [{"minutes": 1.0}]),
    ],
)
def test_a_state_that_does_not_fit_is_refused(change):
    found, *_ = run(nothing, hours=3.0)
    state = found.to_dict()
    change(state)
    with pytest.raises(ValueError, match="state of the probes"):
        ProbeCorrection.from_dict(state)


def test_another_model_takes_over_without_a_jump():
    found, *_ = run(lambda minute, now: 0.1 * now[0], hours=24.0)
    for _ in range(3):
        found.update(sum(shares(1440)) + 38.0, 1.5, sum(shares(1440)), shares(1440), feature="bore")
    found.step(shares(1441), 13.0)
    now, new, change = shares(1453), [44.0, 1.0, 2.0, 7.0], 9.5
    state = found.to_dict()
    other = found.transferred([*NAMES, "2 gain DTF"], now, new, change)
    assert found.to_dict() == state
    assert other.correction_um(new) + change == pytest.approx(found.correction_um(now), abs=1e-9)
    assert other.std_um(new) == pytest.approx(found.std_um(now), rel=1e-9)
    assert other.active
    # What the new model explains is not counted twice: elsewhere it adds the offset alone.
    elsewhere = [4.0, 1.0, 2.0, 0.0]
    assert other.correction_um(elsewhere) == pytest.approx(other.correction_um(new), abs=1e-9)
    assert other.std_um(elsewhere) > other.std_um(new)


def test_the_zeros_of_features_go_over():
    found, *_ = run(nothing, hours=24.0)
    for _ in range(5):
        found.update(30.0, 1.5, 0.0, REST, feature="bore")
    other = found.transferred(["DTF", "TDTF"], REST, [0.0, 0.0], -4.0)
    verdict = other.update(30.0, 1.5, -4.0, [0.0, 0.0], feature="bore")
    assert verdict.innovation_um == pytest.approx(0.0, abs=1.5) and verdict.innovation_std_um < 4.0


def test_without_a_probe_nothing_goes_over():
    other = ProbeCorrection(NAMES).transferred(["DTF", "TDTF"], REST, [0.0, 0.0], 5.0)
    assert not other.active and other.correction_um([0.0, 0.0]) == 0.0


@pytest.mark.parametrize(
    ("y", "std", "predicted", "now"),
    [(math.nan, 1.0, 0.0, REST), (1.0, 0.0, 0.0, REST), (1.0, 1.0, math.inf, REST), (1.0, 1.0, 0.0, [1.0])],
)
def test_what_is_no_probe_is_an_error(y, std, predicted, now):
    found = ProbeCorrection(NAMES)
    state = found.to_dict()
    with pytest.raises(ValueError, match="expected"):
        found.update(y, std, predicted, now)
    assert found.to_dict() == state
