"""Several axes on a virtual clock: together or not at all, tilt with the tool's length, slope with the position."""

from __future__ import annotations

import itertools
import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.receiver import (
    AppliedAxes,
    AxesFollower,
    AxisLimits,
    ControlState,
    ReceiverError,
    TiltLimits,
    ToolLimits,
)
from compensator.receiver.limits import Acceptance
from tests.receiver.limits import MAX_UM, plain, sloped
from tests.receiver.offsets import axis_offset, slope

MACHINE, RATE = "vmc-07", 6.0
PLAIN, SLOPED = plain(RATE), sloped(RATE)
TOOL = ToolLimits(length_min_mm=20.0, length_max_mm=400.0)


def follower(applied_um: dict[str, float] | None = None, tool: ToolLimits | None = TOOL, **axes: Any) -> AxesFollower:
    return AxesFollower(MACHINE, axes or {"x": PLAIN, "y": PLAIN, "z": PLAIN}, tool, Acceptance(), applied_um)


def sample(f: AxesFollower, now_s: float, seq: int, **values: Any) -> bool:
    """Publish a sample; a value is a number or the arguments of its message."""
    names = "".join(values)
    used = False
    for axis, value in values.items():
        changes = value if isinstance(value, dict) else {"value": value}
        number = changes.pop("value", 0.0) if isinstance(value, dict) else value
        used = f.receive(
            now_s, axis, axis_offset(axis, seq, number, axes=names, **(changes if isinstance(value, dict) else {}))
        )
    return used


def run(f: AxesFollower, start_s: float, seconds: float, control: ControlState | None = None) -> list[AppliedAxes]:
    control = control or ControlState(tool_length_mm=100.0)
    return [f.advance(start_s + i + 1.0, control) for i in range(round(seconds))]


def codes(applied: Any) -> set[str]:
    return {reason.code for reason in applied.reasons}


def um(applied: AppliedAxes) -> tuple[float, ...]:
    return tuple(round(one.offset_um, 6) for one in applied.axes.values())


# ---------------------------------------------------------------------- together


def test_each_axis_moves_to_its_own_offset_at_its_own_rate() -> None:
    slow = AxisLimits(offset_max_um=MAX_UM, offset_rate_max_um_per_min=RATE / 2, sign=-1)
    f = follower({"y": 2.0}, x=PLAIN, y=PLAIN, z=slow)
    assert sample(f, 0.0, 1, x=1.0, y=-3.0, z=5.0)
    f.advance(0.0)
    first, *_, last = run(f, 0.0, 110.0)
    assert um(first) == (0.1, 1.9, -0.05)
    assert um(last) == (1.0, -3.0, -5.0) and last.arrived and last.state == "following" and not last.reasons


@pytest.mark.parametrize(
    ("axis", "changes", "code"),
    [
        ("z", None, "incomplete"),
        ("z", {"value": math.nan}, "malformed"),
        ("z", {"value": 50.1}, "beyond_limit"),
        ("x", {"machine": "vmc-08"}, "axes_disagree"),
        ("z", {"time_utc_ns": 5}, "axes_disagree"),
        ("z", {"axes": "yz"}, "axis_not_published"),
        ("z", {"axes": "xyzz"}, "malformed"),
        ("z", {"axis": "x"}, "malformed"),
        ("z", {"schema": 2}, "other_schema"),
        ("z", {"value": "1"}, "malformed"),
        ("z", {"rate": 1e300}, "malformed"),
        ("y", {"reasons": 3}, "malformed"),
    ],
)
def test_a_sample_of_which_one_axis_is_not_right_moves_no_axis(axis: str, changes: Any, code: str) -> None:
    f = follower()
    sample(f, 0.0, 1, x=1.0, y=1.0, z=1.0)
    f.advance(0.0)
    run(f, 0.0, 60.0)
    for one in "xyz":
        its = {"value": 9.0} if one != axis else changes
        if its is not None:
            its = dict(its)
            assert not f.receive(60.0, one, axis_offset(one, 2, its.pop("value", 9.0), **its))
    after = run(f, 60.0, 30.0)
    assert all(um(a) == (1.0, 1.0, 1.0) and a.seq == 1 for a in after) and code in codes(after[-1])
    assert all(a.state == "following" for a in after)  # the sample before is still valid
    expired = run(f, 150.0, 5.0)[-1]
    assert (
        expired.state == "holding"
        and {"expired", code} <= codes(expired) <= {"expired", code, "incomplete"}
        and um(expired) == (1.0, 1.0, 1.0)
    )
    assert sample(f, 156.0, 3, x=2.0, y=2.0, z=2.0)
    assert codes(run(f, 156.0, 60.0)[-1]) == set()


def test_what_is_left_of_a_sample_does_not_spoil_the_later_ones_with_its_number() -> None:
    f = follower()
    f.receive(0.0, "z", axis_offset("z", 1, 1.0, time_utc_ns=1))  # of x and y nothing arrived
    taken = [f.receive(1.0, axis, axis_offset(axis, 1, 2.0, time_utc_ns=2)) for axis in "xyz"]
    assert taken == [False, False, True]
    assert codes(run(f, 1.0, 60.0)[-1]) == set()


def test_an_axis_that_stays_away_is_named() -> None:
    f = follower()
    for seq in range(1, 4):
        for axis in "xy":
            f.receive(60.0 * seq, axis, axis_offset(axis, seq, 5.0))
    last = run(f, 180.0, 5.0)[-1]
    assert um(last) == (0.0, 0.0, 0.0) and last.state == "starting"
    assert "number 3 without z" in last.text and codes(last) == {"no_message", "incomplete"}


def test_an_axis_that_arrives_late_does_not_make_the_others_young() -> None:
    f = follower(x=PLAIN, z=PLAIN)
    f.receive(0.0, "x", axis_offset("x", 1, 5.0, axes="xz"))
    assert f.receive(100.0, "z", axis_offset("z", 1, 5.0, axes="xz"))
    assert f.advance(100.0).age_s == 100.0
    f.receive(200.0, "x", axis_offset("x", 2, 5.0, axes="xz"))
    assert not f.receive(351.0, "z", axis_offset("z", 2, 5.0, axes="xz")) and "late" in codes(f.advance(351.0))


def test_a_flood_of_numbers_that_are_never_whole_is_forgotten() -> None:
    f = follower(x=PLAIN, z=PLAIN)
    for seq in range(10_000):
        f.receive(0.0, "x", axis_offset("x", seq, 5.0, axes="xz"))
    assert len(f._assembler._begun) <= 16
    assert sample(f, 1.0, 20_000, x=2.0, z=2.0) and len(f._assembler._begun) <= 16
    assert sample(f, 9.0, 20_001, x=2.0, z=2.0) and not f._assembler._begun


def test_axes_arrive_in_any_order_and_interleaved() -> None:
    for order in itertools.permutations([(axis, seq) for axis in "xz" for seq in (1, 2)]):
        f = follower(x=PLAIN, z=PLAIN)
        used = [f.receive(0.1, axis, axis_offset(axis, seq, float(seq), axes="xz")) for axis, seq in order]
        assert used.count(True) in (1, 2) and f.advance(0.2).seq == 2, order
        assert "incomplete" not in codes(f.advance(5.0)) and set(f.dropped) <= {"replayed"}


def test_one_axis_holds_while_the_others_follow() -> None:
    f = follower()
    sample(f, 0.0, 1, x=1.0, y=1.0, z=1.0)
    f.advance(0.0)
    run(f, 0.0, 30.0)
    sample(f, 30.0, 2, x=2.0, y={"value": 1.0, "state": "hold", "reasons": ["implausible:model"]}, z=2.0)
    last = run(f, 30.0, 30.0)[-1]
    assert um(last) == (2.0, 1.0, 2.0) and last.state == "holding" and not last.arrived
    assert last.axes["x"].state == "following" and last.axes["x"].arrived and not last.axes["x"].reasons
    assert last.reasons[0].text.endswith("(y: implausible:model)")


def test_a_service_with_y_alone_is_followed_and_two_axes_of_it_are_not() -> None:
    from tests.receiver.offsets import offset

    f = follower(y=PLAIN)
    assert f.receive(0.0, "y", offset(1, 3.0))
    f.advance(0.0)
    assert um(run(f, 0.0, 60.0)[-1]) == (3.0,)
    f = follower(y=PLAIN, z=PLAIN)
    assert not f.receive(0.0, "y", offset(1, 3.0)) and f.dropped == {"axis_not_published": 1}


def test_axes_that_are_not_applied_are_named() -> None:
    f = follower(z=PLAIN)
    assert f.receive(0.0, "z", axis_offset("z", 1, 3.0, axes="xza"))
    f.advance(0.0)
    last = run(f, 0.0, 60.0)[-1]
    assert um(last) == (3.0,) and codes(last) == {"further_axes"} and "x, a" in last.text and last.arrived


def test_a_lower_number_is_a_replay_until_the_count_restarts() -> None:
    f = follower(x=PLAIN, z=PLAIN)
    sample(f, 0.0, 90, x=1.0, z=1.0)
    assert not sample(f, 10.0, 7, x=9.0, z=9.0) and "replayed" in codes(f.advance(10.0))
    used = [sample(f, 151.0 + 60.0 * i, 8 + i, x=2.0, z=2.0) for i in range(3)]
    assert used == [False, False, True] and "count_restarted" in codes(f.advance(271.0))
    assert f.snapshot() == {"machine": MACHINE, "last_sequence": 10}


def test_an_old_answer_is_late_whatever_completes_it() -> None:
    f = follower(x=PLAIN, z=PLAIN)
    old = {"time_utc_ns": 1_000_000_000}
    f.receive(0.0, "x", axis_offset("x", 1, 5.0, axes="xz", **old), utc_ns=lambda: 200_000_000_000, asked=True)
    assert not f.receive(0.0, "z", axis_offset("z", 1, 5.0, axes="xz", **old))
    assert f.dropped == {"late": 1}


def test_hold_and_fade_are_of_all_axes() -> None:
    f = follower()
    sample(f, 0.0, 1, x=1.0, y=2.0, z=-3.0)
    f.advance(0.0)
    run(f, 0.0, 60.0)
    f.hold()
    assert f.advance(61.0).state == "holding" and codes(f.advance(62.0)) == {"held_here"}
    f.fade(1.5)
    way = run(f, 62.0, 121.0)
    assert um(way[59])[2] == pytest.approx(-1.5) and um(way[-1]) == (0.0, 0.0, 0.0)
    assert codes(way[0]) == {"fading"} and codes(way[-1]) == {"faded"} and way[-1].arrived
    f.rebase("z", 4.0)
    assert f.applied_um["z"] == 4.0
    with pytest.raises(ReceiverError, match="offset_max_um"):
        f.rebase("z", 50.1)
    wrong: tuple[Any, ...] = ("1.0", None, [1.0], 10**400, math.nan)
    for bad in wrong:
        for changes in ({"applied_um": bad}, {"slope_um_per_m": bad}, {"at_mm": [] if bad is None else bad}):
            with pytest.raises(ReceiverError, match="applied offset = "):
                f.rebase("z", **{"applied_um": 1.0, **changes})


@pytest.mark.parametrize(("published", "here", "said"), [(-1, -1, True), (-1, 1, False), (1, -1, False)])
def test_an_axis_that_both_sides_turn_is_said(published: int, here: int, said: bool) -> None:
    f = follower(y=PLAIN, z=AxisLimits(offset_max_um=MAX_UM, offset_rate_max_um_per_min=RATE, sign=here))
    own = {"sign": published} if published != 1 else {}
    assert sample(f, 0.0, 1, y=1.0, z={"value": 2.0, **own})
    f.advance(0.0)
    last = run(f, 0.0, 60.0)[-1]
    assert um(last) == (1.0, 2.0 * here) and last.arrived  # it is said, not corrected: only a gauge knows
    assert codes(last) == ({"signs_cancel"} if said else set()) and (not said or "(z) [signs_cancel]" in last.text)


@pytest.mark.parametrize("sign", [0, 2, True, "1", None, [1]])
def test_a_sign_that_is_none_drops_the_sample(sign: Any) -> None:
    f = follower(y=PLAIN, z=PLAIN)
    assert not sample(f, 0.0, 1, y=1.0, z={"value": 2.0, "sign": sign})
    assert set(f.dropped) == {"malformed"}


# ---------------------------------------------------------------------- tilt


def tilting(tool: ToolLimits = TOOL, sign: int = 1) -> AxesFollower:
    """Y at 2 µm and an angle of 40 µrad, for a tool of 100 mm, arrived."""
    y = AxisLimits(offset_max_um=MAX_UM, offset_rate_max_um_per_min=RATE, sign=sign)
    f = follower(tool=tool, y=y, a=TiltLimits(offset_max_urad=200.0))
    assert sample(f, 0.0, 1, y={"value": 2.0, "valid_for_s": 600.0}, a={"value": 40.0, "valid_for_s": 600.0})
    f.advance(0.0)
    assert run(f, 0.0, 30.0)[-1].arrived
    return f


def test_an_angle_adds_what_the_tool_is_longer_at_the_permitted_rate() -> None:
    f = tilting()
    way = run(f, 30.0, 80.0, ControlState(tool_length_mm=250.0, cutting=False))
    assert um(way[0]) == (2.1,) and codes(way[0]) == {"catching_up"} and not way[0].arrived
    assert um(way[-1]) == (pytest.approx(2.0 + 40.0 * 0.150),) and way[-1].arrived and not way[-1].reasons
    f = tilting(sign=-1)
    assert um(run(f, 30.0, 80.0, ControlState(tool_length_mm=250.0))[-1]) == (pytest.approx(-8.0),)


def test_at_a_tool_change_the_length_alone_moves_faster_and_only_while_nothing_cuts() -> None:
    tool = ToolLimits(length_min_mm=20.0, length_max_mm=400.0, rate_at_tool_change_um_per_min=120.0)
    f = tilting(tool)
    cutting, free = (ControlState(tool_length_mm=250.0, cutting=cutting) for cutting in (True, False))
    assert um(run(f, 30.0, 1.0, cutting)[-1]) == (2.1,)
    assert um(run(f, 31.0, 1.0, free)[-1]) == (pytest.approx(4.1),)
    assert um(run(f, 32.0, 3.0, free)[-1]) == (8.0,)
    sample(f, 35.0, 2, y={"value": 9.0, "valid_for_s": 600.0}, a={"value": 40.0, "valid_for_s": 600.0})
    assert um(run(f, 35.0, 1.0, free)[-1]) == (pytest.approx(8.1),)  # a new offset is no tool change


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    "lengths_mm", [[300.0] + 99 * [100.0], 50 * [101.0, 100.0], 50 * [100.0, 101.0], 10 * [300.0] + 90 * [100.0]]
)
def test_a_length_that_goes_and_comes_back_lets_nothing_catch_up_faster(sign: int, lengths_mm: list[float]) -> None:
    """The axis catches up by 60 µm at its rate; what a flicker of the length asks for and takes back adds nothing."""
    f = tilting(ToolLimits(length_min_mm=20.0, length_max_mm=400.0, rate_at_tool_change_um_per_min=120.0), sign)
    sample(f, 30.0, 2, y={"value": 62.0, "valid_for_s": 600.0}, a={"value": 40.0, "valid_for_s": 600.0})
    before = sign * 2.0
    for i, length_mm in enumerate(lengths_mm):
        last = f.advance(30.0 + 0.2 * (i + 1), ControlState(tool_length_mm=length_mm, cutting=False))
    # At most what the longest time with another length may have moved for it.
    assert abs(um(last)[0] - before) < RATE * 20.0 / 60.0 + 2.0 * 2.01


def test_after_a_fade_nothing_moves_faster_whatever_tool_there_is() -> None:
    f = tilting(ToolLimits(length_min_mm=20.0, length_max_mm=400.0, rate_at_tool_change_um_per_min=120.0))
    f.fade(RATE)
    free = ControlState(tool_length_mm=250.0, cutting=False)
    assert um(run(f, 30.0, 60.0, free)[-1]) == (0.0,)
    f.follow()
    assert um(run(f, 90.0, 1.0, free)[-1]) == (pytest.approx(0.1),)


@pytest.mark.parametrize(
    ("length_mm", "code"),
    [
        (None, "no_tool_length"),
        (0.0, "tool_length_beyond"),
        (math.nan, "tool_length_beyond"),
        (1e9, "tool_length_beyond"),
        (10**400, "no_tool_length"),
        ("250", "no_tool_length"),
        (True, "no_tool_length"),
        ([250.0], "no_tool_length"),
    ],
)
def test_without_a_length_the_offset_is_that_of_the_reference_and_this_is_said(length_mm: Any, code: str) -> None:
    f = tilting()
    run(f, 30.0, 80.0, ControlState(tool_length_mm=250.0))
    last = run(f, 110.0, 80.0, ControlState(tool_length_mm=length_mm))[-1]
    assert um(last) == (2.0,) and codes(last) == {code} and last.state == "following"
    assert len(last.text) < 300 and last.text.isprintable()


def test_a_tool_that_is_changed_while_the_offset_is_held_moves_nothing_and_is_said() -> None:
    f = tilting()
    last = run(f, 700.0, 80.0, ControlState(tool_length_mm=250.0))[-1]
    assert um(last) == (2.0,) and last.state == "holding" and codes(last) == {"expired", "tool_changed"}
    assert "+6.00 µm" in last.text
    assert codes(run(f, 780.0, 5.0)[-1]) == {"expired"}  # the first tool again


def test_an_angle_that_is_not_good_or_not_whole_holds_its_axis() -> None:
    f = tilting()
    for seq, change in enumerate(({"acts_on": "z"}, {"value": 201.0}, {"reference_mm": "1"}, {"acts_on": 5}), 2):
        assert not sample(f, 30.0, seq, y=9.0, a=dict(change))
        assert um(run(f, 30.0, 1.0)[-1]) == (2.0,)
    assert set(f.dropped) == {"axis_not_applied", "beyond_limit", "malformed"}
    assert sample(f, 31.0, 9, y=9.0, a={"value": None, "state": "fault"})
    last = run(f, 31.0, 5.0)[-1]
    assert um(last) == (2.0,) and last.state == "holding" and codes(last) == {"service_fault"}


def test_what_a_long_tool_asks_for_ends_at_the_limit_and_this_is_said() -> None:
    f = tilting()
    sample(f, 30.0, 2, y={"value": 20.0, "valid_for_s": 600.0}, a={"value": 200.0, "valid_for_s": 600.0})
    last = run(f, 30.0, 590.0, ControlState(tool_length_mm=400.0))[-1]
    assert um(last) == (MAX_UM,) and codes(last) == {"limit_reached"}


# ---------------------------------------------------------------------- slope


def sloping() -> AxesFollower:
    """Y at 4 µm at 200 mm, and 20 µm/m over its travel, arrived at 200 mm."""
    f = follower(y=SLOPED)
    assert sample(f, 0.0, 1, y={"value": 4.0, "valid_for_s": 600.0, **slope(20.0, 200.0)})
    f.advance(0.0, at(200.0))
    assert um(run(f, 0.0, 300.0, at(200.0))[-1]) == (4.0,)
    return f


def at(position_mm: Any) -> ControlState:
    return ControlState(positions_mm={"y": position_mm})


def test_the_offset_follows_the_position_at_once_also_while_it_is_held() -> None:
    f = sloping()
    way = [f.advance(300.0 + i, at(200.0 + 100.0 * i)) for i in range(9)]
    assert [um(a)[0] for a in way] == [pytest.approx(4.0 + 2.0 * i) for i in range(9)]
    assert all(a.arrived and not a.reasons for a in way)
    assert way[0].axes["y"].slope_um_per_m == pytest.approx(20.0)
    assert way[0].axes["y"].at(200.0) == pytest.approx(4.0) and way[0].axes["y"].at(0.0) == pytest.approx(0.0)
    run(f, 600.0, 3.0, at(1000.0))
    held = f.advance(604.0, at(700.0))
    assert held.state == "holding" and um(held) == (pytest.approx(14.0),)


def test_a_new_slope_comes_at_the_rate_at_each_position_and_another_reference_changes_nothing() -> None:
    f = sloping()
    assert sample(f, 300.0, 2, y={"value": 14.0, "valid_for_s": 600.0, **slope(20.0, 700.0)})
    same = f.advance(301.0, at(200.0))
    assert um(same) == (pytest.approx(4.0),) and same.arrived
    assert sample(f, 301.0, 3, y={"value": 14.0, "valid_for_s": 600.0, **slope(40.0, 700.0)})
    before = same.axes["y"]
    for applied in run(f, 301.0, 40.0, at(200.0)):
        now = applied.axes["y"]
        for position in (0.0, 333.0, 1000.0):
            assert abs(now.at(position) - before.at(position)) <= 0.1 + 1e-9
        before = now
    # At 0 mm it is 14 − 28 = −14 µm instead of 0, at the other end 26 instead of 20.
    assert before.ends_um == (pytest.approx(-4.0), pytest.approx(24.0))


@pytest.mark.parametrize("jump_mm", [900.0, -150.0])
def test_a_position_that_cannot_be_the_axis_motion_does_not_move_the_offset(jump_mm: float) -> None:
    f = sloping()
    run(f, 300.0, 1.0, at(200.0))
    jumped = f.advance(301.1, at(200.0 + jump_mm))  # homed again: another zero
    assert um(jumped) == (pytest.approx(4.0, abs=0.011),) and "position_jumped" in codes(jumped)
    moved = f.advance(301.6, at(200.0 + jump_mm))
    assert abs(um(moved)[0] - um(jumped)[0]) <= 0.051 and "catching_up" in codes(moved)


def test_a_position_that_is_lost_or_outside_is_said() -> None:
    f = sloping()
    for position in (None, math.nan, math.inf, "300", True, 10**400):
        lost = f.advance(300.5, at(position))
        assert um(lost) == (4.0,) and codes(lost) == {"no_position"} and not lost.arrived
    assert um(f.advance(301.0, at(300.0))) == (pytest.approx(6.0),)
    f.advance(302.0, at(700.0))
    outside = [f.advance(302.5 + i / 10.0, at(700.0 + 49.0 * i)) for i in range(8)]
    assert um(outside[-1]) == (pytest.approx(20.0),) and codes(outside[-1]) == {"position_beyond"}


@pytest.mark.parametrize(
    "changes", [slope(60.1), slope(20.0, -1600.0), {**slope(1.0), "reference_mm": None}, slope(1e7)]
)
def test_a_slope_beyond_its_limit_or_the_offsets_at_an_end_is_dropped(changes: dict[str, Any]) -> None:
    f = sloping()
    assert not sample(f, 300.0, 2, y={"value": 19.0, **changes})
    assert set(f.dropped) <= {"beyond_limit", "malformed"} and f.dropped


def test_a_slope_that_this_receiver_does_not_apply_is_said() -> None:
    f = follower(y=PLAIN)
    assert sample(f, 0.0, 1, y={"value": 4.0, **slope(20.0, 200.0)})
    f.advance(0.0)
    last = run(f, 0.0, 60.0)[-1]
    assert um(last) == (4.0,) and codes(last) == {"slope_not_applied"} and "200 mm" in last.text


def test_limits_that_are_none() -> None:
    for axes, expected in (
        ({"q": PLAIN}, "axis.q"),
        ({"a": PLAIN}, "axis.a: expected x, y or z"),
        ({"a": TiltLimits(offset_max_urad=1.0)}, "at least one of x, y, z"),
    ):
        with pytest.raises(ReceiverError, match=expected):
            follower(**axes)
    with pytest.raises(ReceiverError, match=r"needs a table \[tool\]"):
        follower(tool=None, y=PLAIN, a=TiltLimits(offset_max_urad=1.0))
    for bad in ({"sign": 2}, {"slope_max_um_per_m": 5.0}, {"position_max_mm": 5.0}):
        with pytest.raises(ReceiverError):
            AxisLimits(offset_max_um=1.0, offset_rate_max_um_per_min=1.0, **bad)
    with pytest.raises(ReceiverError, match="length_min_mm = 9"):
        ToolLimits(length_min_mm=9.0, length_max_mm=9.0)


# ---------------------------------------------------------------------- whatever comes, in whatever order

numbers = st.one_of(st.none(), st.floats(-60.0, 60.0), st.just(math.nan), st.just(1e300))
message = st.builds(
    lambda axis, seq, value, rate, reference, slopes, **changes: (
        axis,
        axis_offset(axis, seq, value, axes="yza", rate=rate, **{**(slopes if axis == "y" else {}), **changes})
        if axis != "a"
        else axis_offset(axis, seq, value, axes="yza", rate=rate, **{**changes, "reference_mm": reference}),
    ),
    st.sampled_from("yza"),
    st.integers(0, 6),
    numbers,
    st.one_of(st.just(0.0), st.floats(-100.0, 100.0)),
    st.one_of(st.just(100.0), st.floats(-500.0, 500.0)),
    st.one_of(st.just({}), st.builds(slope, st.floats(-70.0, 70.0), st.floats(-100.0, 900.0), st.floats(-9.0, 9.0))),
    state=st.sampled_from(["ok", "ok", "ok", "degraded", "hold", "fault"]),
    acts_on=st.sampled_from(["y", "y", "y", "z", "x"]),
)
whole = st.builds(
    lambda seq, y, z, a, slopes: [
        ("y", axis_offset("y", seq, y, axes="yza", **slopes)),
        ("z", axis_offset("z", seq, z, axes="yza")),
        ("a", axis_offset("a", seq, a, axes="yza")),
    ],
    st.integers(0, 40),
    st.floats(-20.0, 20.0),
    st.floats(-50.0, 50.0),
    st.floats(-200.0, 200.0),
    st.one_of(st.just({}), st.builds(slope, st.floats(-30.0, 30.0), st.floats(0.0, 900.0))),
)
something = st.one_of(
    whole, st.lists(message, max_size=3), st.lists(st.tuples(st.sampled_from("yza"), st.binary(max_size=9)))
)
#: What a control's program may hand over by mistake.
no_number = st.none() | st.sampled_from(["250", "", "\x1b", True, [1.0], {}, b"1", 1j, 10**400]) | st.text(max_size=9)
control = st.builds(
    ControlState,
    tool_length_mm=st.one_of(no_number, st.floats(20.0, 400.0), st.floats(), st.sampled_from([100.0, 250.0])),
    positions_mm=st.fixed_dictionaries({"y": st.one_of(no_number, st.floats(), st.floats(-50.0, 1050.0))}),
    cutting=st.booleans(),
)
told = st.sampled_from(["", "", "", "", "follow", "follow", "hold", "fade"])
FAST = 60.0


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.floats(0.0, 2.0) | st.floats(-9.0, 300.0), something, control, told), max_size=30))
def test_no_axis_ever_jumps_or_leaves_its_limit(steps: list[Any]) -> None:
    tool = ToolLimits(length_min_mm=20.0, length_max_mm=400.0, rate_at_tool_change_um_per_min=FAST)
    f = follower({"y": 5.0}, tool, y=SLOPED, z=PLAIN, a=TiltLimits(offset_max_urad=200.0))
    now, located_s, before = 0.0, 0.0, f.advance(0.0, at(300.0))
    for gap_s, messages, state, tell in steps:
        now += gap_s
        if tell:
            f.fade(4.0) if tell == "fade" else getattr(f, tell)()
        for axis, payload in messages:
            if f.receive(now, axis, payload):
                assert f.last_sequence == json.loads(payload)["seq"]
        applied = f.advance(now, state)
        passed_s = min(max(gap_s, 0.0), 1.0)
        rate = RATE if state.cutting else FAST
        most = rate / 60.0 * passed_s + 1e-9
        y, z, last = applied.axes["y"], applied.axes["z"], before.axes["y"]
        # Y: what the rate allows, and what its own motion asks for along the line that was applied.
        own = (
            max(abs(last.slope_um_per_m), abs(y.slope_um_per_m))
            / 1000.0
            * 500.0
            * (min(max(now - located_s, 0.0), 1.0) + 0.05)
        )
        assert abs(y.offset_um - last.offset_um) <= most + own + 1e-9
        assert abs(z.offset_um - before.axes["z"].offset_um) <= RATE / 60.0 * passed_s + 1e-9
        assert all(abs(one.offset_um) <= MAX_UM + 1e-9 for one in applied.axes.values())
        assert all(abs(end) <= MAX_UM for one in applied.axes.values() for end in one.ends_um)
        for one in applied.axes.values():
            if one.state in ("starting", "holding"):
                assert one.reasons
        if z.state in ("starting", "holding"):
            assert z.offset_um == before.axes["z"].offset_um
        assert len(applied.text + applied.steady_reasons) < 10_000
        position = state.positions_mm["y"]
        located_s = now if isinstance(position, float) and math.isfinite(position) else located_s
        before = applied
