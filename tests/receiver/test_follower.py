"""The receiver's behaviour on a virtual clock."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.receiver import Applied, Follower, Limits, ReceiverError
from tests.receiver.offsets import MACHINE, T0_NS, offset

MAX_UM, RATE = 50.0, 6.0
LIMITS = Limits(offset_max_um=MAX_UM, offset_rate_max_um_per_min=RATE)


def follower(**changes: Any) -> Follower:
    return Follower(MACHINE, LIMITS, **changes)


def run(f: Follower, start_s: float, seconds: float, step_s: float = 0.5) -> list[Applied]:
    return [f.advance(start_s + i * step_s) for i in range(1, round(seconds / step_s) + 1)]


def codes(applied: Applied) -> set[str]:
    return {reason.code for reason in applied.reasons}


def settled(y_um: float = 3.0) -> tuple[Follower, float]:
    """A follower that has arrived at an offset, and the time."""
    f = follower()
    f.advance(0.0, offset(1, y_um))
    last = run(f, 0.0, 60.0)[-1]
    assert last.arrived and abs(last.offset_um - y_um) < 0.011
    f.receive(60.0, offset(2, y_um))
    return f, 60.0


# ---------------------------------------------------------------------- following


def test_moves_to_a_new_offset_at_the_permitted_rate_and_says_so() -> None:
    f = follower(applied_um=2.0)
    assert f.advance(0.0).state == "starting" and f.advance(10.0).offset_um == 2.0
    assert f.advance(10.0, offset(1, -4.0)).offset_um == 2.0  # a message alone moves nothing
    way = run(f, 10.0, 70.0, step_s=1.0)
    assert [round(a.offset_um, 9) for a in way[:3]] == [1.9, 1.8, 1.7]
    assert codes(way[0]) == {"catching_up"} and way[0].state == "following" and not way[0].arrived
    assert way[59].offset_um == pytest.approx(-4.0) and way[-1].arrived and not way[-1].reasons


def test_follows_the_rate_for_half_of_the_validity_then_stands_then_holds() -> None:
    f, t = settled(3.0)
    f.receive(t, offset(3, 3.0, y_offset_rate_um_per_min=2.0))
    after = {round(t + 1 + i): a for i, a in enumerate(run(f, t, 200.0, step_s=1.0))}
    assert after[90].offset_um == pytest.approx(3.0 + 2.0 * 0.5)
    assert after[136].offset_um == pytest.approx(3.0 + 2.0 * 75.0 / 60.0) == after[209].offset_um
    assert after[209].state == "following" and after[212].state == "holding" and codes(after[212]) == {"expired"}
    assert after[212].offset_um == after[209].offset_um
    assert "150 s" in after[259].reasons[0].text


def test_what_is_followed_never_leaves_the_size_limit() -> None:
    f = follower(applied_um=49.0)
    f.advance(0.0, offset(1, 49.5, y_offset_rate_um_per_min=5.0))
    last = run(f, 0.0, 70.0)[-1]
    assert last.offset_um == MAX_UM and codes(last) == {"limit_reached"}


def test_a_message_that_claims_to_be_valid_for_ever_is_not() -> None:
    f = follower()
    f.advance(0.0, offset(1, 1.0, valid_for_s=1e9))
    assert f.advance(599.0).state == "following" and f.advance(601.0).state == "holding"


@pytest.mark.parametrize("state", ["hold", "fault", "starting"])
@pytest.mark.parametrize("value", [None, -30.0])
def test_holds_where_it_is_when_the_service_does_not_compensate(state: str, value: float | None) -> None:
    f, t = settled(3.0)
    f.advance(t + 1.0, offset(3, value, state=state, reasons=["t_q_missing"]))
    held = run(f, t + 1.0, 100.0)
    assert all(a.offset_um == held[0].offset_um and a.state == "holding" for a in held)
    assert codes(held[-1]) == {f"service_{state}"} and "t_q_missing" in held[-1].text
    f.advance(t + 101.0, offset(4, 4.0))
    assert run(f, t + 101.0, 30.0)[-1].offset_um == 4.0


def test_degraded_is_followed_and_said() -> None:
    f, t = settled(3.0)
    f.receive(t, offset(3, 3.5, state="degraded", reasons=["predicting"]))
    last = run(f, t, 30.0)[-1]
    assert last.offset_um == 3.5 and codes(last) == {"service_degraded"} and "predicting" in last.text


def test_a_receiver_of_y_alone_says_what_else_the_service_publishes() -> None:
    f, t = settled(3.0)
    f.receive(t, offset(3, 3.5, axis="y", axes=["x", "y", "a"], y_slope_um_per_m=4.0, reference_mm=0.0))
    last = run(f, t, 30.0)[-1]
    assert last.offset_um == 3.5 and codes(last) == {"further_axes", "slope_not_applied"} and "x, a" in last.text
    for seq, axes in enumerate((["y"], "xz", {"x": 1}, [["x"]], ["\ud800"], ["x"] * 9), 4):
        assert f.receive(t, offset(seq, 3.5, axes=axes, y_slope_um_per_m=None))
        assert not f.advance(t + 40.0).reasons


def test_a_new_service_with_another_offset_is_walked_to() -> None:
    f, t = settled(3.0)
    f.alive = False
    assert "service_gone" in codes(f.advance(t + 1.0))
    assert f.advance(t + 400.0).state == "holding"
    f.alive = True
    f.receive(t + 400.0, offset(1000, -20.0))
    assert f.advance(t + 401.0).offset_um == pytest.approx(2.9)
    run(f, t + 401.0, 100.0)
    f.receive(t + 501.0, offset(1001, -20.0))
    assert run(f, t + 501.0, 140.0)[-1].offset_um == -20.0


# ---------------------------------------------------------------------- told by somebody


def test_fades_only_when_told_at_the_stated_rate_and_comes_back_at_the_limit() -> None:
    f, t = settled(3.0)
    f.fade(1.5)
    way = run(f, t, 130.0, step_s=1.0)
    assert way[59].offset_um == pytest.approx(3.0 - 1.5) and way[59].state == "fading" and codes(way[59]) == {"fading"}
    assert way[-1].offset_um == 0.0 and codes(way[-1]) == {"faded"} and way[-1].arrived
    f.receive(t + 130.0, offset(3, 3.0))
    assert run(f, t + 130.0, 5.0)[-1].offset_um == 0.0
    f.follow()
    assert f.advance(t + 136.0).offset_um == pytest.approx(0.1)
    with pytest.raises(ReceiverError, match="above 0"):
        f.fade(0.0)
    f.fade(1e9)
    assert abs(f.advance(t + 137.0).offset_um) <= 0.1 + 1e-12 and f.applied_um >= 0.0


def test_hold_freezes_and_follow_goes_on_from_there() -> None:
    f, t = settled(3.0)
    f.receive(t, offset(3, 10.0))
    moving = f.advance(t + 1.0).offset_um
    f.hold()
    held = run(f, t + 1.0, 50.0)
    assert all(a.offset_um == moving and "held_here" in codes(a) for a in held)
    f.follow()
    assert f.advance(t + 52.0).offset_um == pytest.approx(moving + 0.1)


def test_rebase_goes_on_from_what_the_control_holds() -> None:
    f, t = settled(3.0)
    f.rebase(-7.0)
    assert f.advance(t + 1.0).offset_um == pytest.approx(-6.9)
    wrong: tuple[Any, ...] = (math.nan, math.inf, 50.1, "3.0", None, True, 10**400)
    for bad in wrong:
        with pytest.raises(ReceiverError, match="offset_max_um"):
            f.rebase(bad)
        with pytest.raises(ReceiverError, match="offset_max_um"):
            follower(applied_um=bad)


def test_a_program_that_stood_still_moves_no_further_than_one_step() -> None:
    f, t = settled(0.0)
    f.receive(t, offset(3, 40.0, valid_for_s=600.0))
    assert f.advance(t + 500.0).offset_um == pytest.approx(0.1)
    assert f.advance(t + 100.0).offset_um == pytest.approx(0.1)  # a clock that goes back


# ---------------------------------------------------------------------- dropped

BAD: list[tuple[bytes, str]] = [
    (b"", "malformed"),
    (b"\xff\xfe", "malformed"),
    (b"[1]", "malformed"),
    (b"[" * 60_000, "malformed"),
    (b"x" * 70_000, "malformed"),
    (offset(9, math.nan), "malformed"),
    (offset(9, math.inf), "malformed"),
    (offset(9, -math.inf), "malformed"),
    (offset(9).replace(b'"y_offset_um": 0.0', b'"y_offset_um": 1e999'), "malformed"),
    (offset(9).replace(b'"y_offset_um": 0.0', b'"y_offset_um": "3.0"'), "malformed"),
    (offset(9).replace(b'"y_offset_um": 0.0', b'"y_offset_um": true'), "malformed"),
    (offset(9).replace(b'"y_offset_um": 0.0', b'"y_offset_um": 1.0, "y_offset_um": 2.0'), "malformed"),
    (offset(9).replace(b'"y_offset_um": 0.0, ', b""), "malformed"),
    (offset(9, None), "malformed"),
    (offset(9, note=math.nan), "malformed"),
    (offset(9, y_offset_rate_um_per_min=math.nan), "malformed"),
    (offset(9, y_offset_std_um=-1.0), "malformed"),
    (offset(9, valid_for_s=0.0), "malformed"),
    (offset(9, valid_for_s=-5.0), "malformed"),
    (offset(9, valid_for_s=None), "malformed"),
    (offset(9, state="fine"), "malformed"),
    (offset(9, reasons=None), "malformed"),
    (offset(9, seq="9"), "malformed"),
    (offset(9, seq=True), "malformed"),
    (offset(9, seq=9.5), "malformed"),
    (offset(9, seq=2**70), "malformed"),
    (offset(9, time_utc_ns=None), "malformed"),
    (offset(9, schema=2), "other_schema"),
    (offset(9, machine="vmc-08"), "other_machine"),
    (offset(9, 50.01), "beyond_limit"),
    (offset(9, -1e300), "beyond_limit"),
    (offset(2, 9.0), "replayed"),  # the newest number with another value
    (offset(1, 9.0), "replayed"),
]


@pytest.mark.parametrize(("payload", "code"), BAD)
def test_what_is_not_wholly_right_is_dropped_with_a_reason(payload: bytes, code: str) -> None:
    f, t = settled(3.0)
    assert not f.receive(t, payload)
    assert f.dropped == {code: 1}
    after = run(f, t, 20.0)
    assert all(abs(a.offset_um - 3.0) < 0.011 and a.seq == 2 and code in codes(a) for a in after)
    assert f.receive(t + 20.0, offset(10, 3.0)) and code not in codes(f.advance(t + 20.0))


def test_the_answer_to_the_first_query_and_the_message_itself_are_the_same() -> None:
    f, t = settled(3.0)
    assert not f.receive(t, offset(2, 3.0)) and not f.receive(t, offset(2, 3.0), age_s=1.0, asked=True)
    assert not f.receive(t, offset(1, 9.0), age_s=1.0, asked=True)  # an answer that was overtaken
    assert not f.dropped and not f.advance(t + 1.0).reasons


def test_the_number_outlives_a_restart() -> None:
    f, t = settled(3.0)
    kept = f.snapshot()
    json.dumps(kept)
    after = follower(applied_um=3.0, last_sequence=kept["last_sequence"])
    assert not after.receive(t, offset(1, 9.0)) and not after.receive(t, offset(2, 9.0))
    assert after.dropped == {"replayed": 2} and after.advance(t).state == "starting"
    assert after.receive(t, offset(2, 3.0), age_s=20.0, asked=True)  # asked for, and still fresh
    assert not after.receive(t, offset(2, 3.0), age_s=20.0, asked=True)
    assert after.receive(t, offset(3, 3.0))


# ---------------------------------------------------------------------- age


def test_an_answer_keeps_its_age() -> None:
    f = follower(applied_um=4.0)
    assert f.receive(0.0, offset(1, 3.0, y_offset_rate_um_per_min=2.0), age_s=30.0, asked=True)
    first = f.advance(0.0)
    assert first.age_s == 30.0
    assert f.advance(119.0).state == "following" and f.advance(121.0).state == "holding"
    assert f.applied_um != 4.0


@pytest.mark.parametrize(("age_s", "code"), [(150.1, "late"), (1e9, "late"), (-5.1, "clock_disagrees")])
def test_a_wall_clock_that_disagrees_is_said_and_heals(age_s: float, code: str) -> None:
    f, t = settled(3.0)
    assert not f.receive(t + 60.0, offset(3, 8.0), age_s=age_s)
    assert code in codes(f.advance(t + 60.0)) and f.advance(t + 60.0).state == "following"  # number 2 is still valid
    assert f.advance(t + 160.0).state == "holding"
    assert f.receive(t + 170.0, offset(4, 8.0), age_s=0.2) and f.advance(t + 171.0).state == "following"


def test_setting_a_clock_makes_nothing_fresh() -> None:
    f, t = settled(3.0)
    assert f.advance(t + 151.0).state == "holding"
    # The service's wall clock was set back by a day: numbers go on, and that is what counts.
    assert f.receive(t + 152.0, offset(3, 3.0, time_utc_ns=1))
    assert f.advance(t + 152.0).state == "following"


# ---------------------------------------------------------------------- whatever comes, in whatever order

finite = st.floats(-200.0, 200.0)
anything = st.one_of(
    st.none(),
    st.binary(max_size=40),
    st.builds(
        lambda seq, y, **changes: offset(seq, y, **changes),
        st.integers(0, 40),
        st.one_of(st.none(), finite, st.just(math.nan)),
        y_offset_rate_um_per_min=st.one_of(st.none(), finite),
        valid_for_s=st.one_of(st.floats(-1.0, 400.0), st.just(math.inf)),
        state=st.sampled_from(["ok", "ok", "ok", "degraded", "hold", "fault", "starting", "?"]),
        machine=st.sampled_from([MACHINE, MACHINE, MACHINE, "vmc-08"]),
    ),
)
told = st.sampled_from(["", "", "", "follow", "hold", "fade"])
gap = st.one_of(st.floats(0.0, 2.0), st.floats(0.0, 400.0), st.floats(-100.0, 0.0))
age = st.one_of(st.none(), st.floats(-100.0, 400.0))


@settings(max_examples=150, deadline=None)
@given(st.floats(-MAX_UM, MAX_UM), st.lists(st.tuples(gap, anything, age, st.booleans(), told), max_size=40))
def test_it_never_jumps_never_leaves_the_limit_and_uses_nothing_bad(
    start_um: float, steps: list[tuple[float, bytes | None, float | None, bool, str]]
) -> None:
    f = follower(applied_um=start_um)
    now = before_um = 0.0
    f.advance(now)
    before_um, used = start_um, -1
    for gap_s, payload, age_s, asked, tell in steps:
        now += gap_s
        if tell:
            f.fade(4.0) if tell == "fade" else getattr(f, tell)()
        if payload is not None and f.receive(now, payload, age_s=age_s, asked=asked):
            message = json.loads(payload)
            assert message["machine"] == MACHINE
            assert message["seq"] > used or "count_restarted" in codes(f.advance(now))
            assert message["y_offset_um"] is None or abs(message["y_offset_um"]) <= MAX_UM
            used = message["seq"]
        applied = f.advance(now)
        largest = RATE / 60.0 * min(max(gap_s, 0.0), 1.0)
        assert abs(applied.offset_um - before_um) <= largest * (1 + 1e-9) + 1e-12
        assert abs(applied.offset_um) <= MAX_UM
        if applied.state in ("starting", "holding"):
            assert applied.offset_um == before_um and applied.reasons
        before_um = applied.offset_um
    for _ in range(3):  # and with nothing more to hear, it holds
        now += 601.0
        applied = f.advance(now)
    assert applied.state in ("starting", "holding", "fading")


# ---------------------------------------------------------------------- a lower number


def locked_out() -> tuple[Follower, float]:
    """A follower after a forged number far above the service's, which has expired."""
    f, t = settled(3.0)
    assert f.receive(t, offset(90_000_000_000, 3.0, time_utc_ns=T0_NS))
    assert f.advance(t + 150.0).state == "following" and f.advance(t + 151.0).state == "holding"
    return f, t + 151.0


def test_a_service_that_counts_from_a_lower_number_is_followed_after_three_of_its_messages() -> None:
    f, t = locked_out()
    assert not f.receive(t, offset(3, 9.0)) and not f.receive(t + 61.0, offset(4, 9.0))
    waiting = f.advance(t + 61.0)
    assert waiting.state == "holding" and waiting.offset_um == f.applied_um and "replayed" in codes(waiting)
    assert f.receive(t + 120.0, offset(5, 9.0))
    now = f.advance(t + 121.0)
    assert now.state == "following" and codes(now) == {"count_restarted", "catching_up"}
    assert "number 5 after 90000000000" in now.text and f.snapshot()["last_sequence"] == 5
    assert f.receive(t + 180.0, offset(6, 9.0)) and "count_restarted" not in codes(f.advance(t + 180.0))


def test_the_count_restarts_also_where_a_message_is_used_for_less_than_a_sample() -> None:
    f = Follower(MACHINE, Limits(offset_max_um=MAX_UM, offset_rate_max_um_per_min=RATE, valid_max_s=20.0))
    assert f.receive(0.0, offset(90_000_000_000, 3.0, time_utc_ns=T0_NS))
    assert [f.receive(60.0 * i, offset(i, 9.0)) for i in range(1, 4)] == [False, False, True]
    assert not any(f.receive(300.0 + i, offset(1 + i, 9.0)) for i in range(2))  # a burst still says nothing


def test_no_lower_number_counts_while_the_newest_message_is_valid() -> None:
    f, t = settled(3.0)
    f.receive(t, offset(90, 3.0, valid_for_s=600.0))
    assert not any(f.receive(t + 60.0 * i, offset(3 + i, 9.0)) for i in range(10))
    assert f.advance(t + 599.0).state == "following" and f.advance(t + 599.0).seq == 90


@pytest.mark.parametrize(
    ("numbers", "apart_s", "changes"),
    [
        ((3, 4, 5, 6, 7, 8), 1.0, {}),  # a burst
        ((3, 4, 5, 6, 7, 8), 31.0, {}),  # a recording replayed at twice its speed
        ((8, 7, 6, 5, 4, 3), 60.0, {}),
        ((3, 4, 3, 4, 3, 4), 60.0, {}),
        ((3, 4, 5, 6, 7, 8), 60.0, {"time_utc_ns": 1}),
        ((3, 4, 5, 6, 7, 8), 151.0, {}),  # each has expired when the next arrives
        ((3, 4, 5, 6, 7, 8), 60.0, {"y_um": 50.1}),
        ((3, 4, 5, 6, 7, 8), 60.0, {"machine": "vmc-08"}),
    ],
)
def test_what_does_not_look_like_a_service_restarts_no_count(
    numbers: tuple[int, ...], apart_s: float, changes: dict[str, Any]
) -> None:
    f, t = locked_out()
    for i, number in enumerate(numbers):
        assert not f.receive(
            t + i * apart_s,
            offset(number, changes.get("y_um", 9.0), **{key: value for key, value in changes.items() if key != "y_um"}),
        )
        assert f.advance(t + i * apart_s).state == "holding"


def test_old_messages_restart_no_count_where_the_clock_is_checked() -> None:
    f, t = locked_out()
    assert not any(f.receive(t + 60.0 * i, offset(3 + i, 9.0), age_s=151.0) for i in range(5))
    assert [f.receive(t + 300.0 + 60.0 * i, offset(8 + i, 9.0), age_s=1.0) for i in range(3)] == [False, False, True]


def test_messages_in_between_do_not_prevent_it() -> None:
    f, t = locked_out()
    for i, number in enumerate((3, 4, 5)):
        accepted = f.receive(t + 60.0 * i, offset(number, 9.0))
        for j in range(5 if not accepted else 0):
            assert not f.receive(t + 60.0 * i + 1.0 + j, offset(number + 10 + j, -9.0))
    assert f.advance(t + 130.0).seq == 5


def test_limits_have_no_default_and_no_nonsense() -> None:
    with pytest.raises(ReceiverError, match=r"offset_rate_max_um_per_min = 1e\+308: .* at most 6000"):
        Limits(offset_max_um=1.0, offset_rate_max_um_per_min=1e308)
    for bad in (0.0, -1.0, math.nan, math.inf, 5001.0):
        with pytest.raises(ReceiverError, match="offset_max_um"):
            Limits(offset_max_um=bad, offset_rate_max_um_per_min=1.0)
    with pytest.raises(TypeError):
        Limits()  # type: ignore[call-arg]
