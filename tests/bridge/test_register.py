"""What may be written into somebody else's memory, against a PLC that does as it likes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.bridge.register import AxesRegisters, AxisPlace, Register, single_precision
from compensator.receiver import AxesFollower, AxisLimits, Follower, Limits
from compensator.receiver.axes_applied import NOTHING_READ
from compensator.receiver.limits import Acceptance
from tests.receiver.offsets import MACHINE, offset

LIMITS = Limits(offset_max_um=50.0, offset_rate_max_um_per_min=60.0, step_max_s=2.0)


def register(sign: int = 1, unit_um: float = 1000.0, *, single: bool = True) -> Register:
    return Register(
        Follower(MACHINE, LIMITS), sign=sign, unit_um=unit_um, tolerance_um=0.1, resume_after_s=5.0, single=single
    )


@pytest.mark.parametrize(("sign", "unit_um", "expected"), [(1, 1000.0, -0.0123), (-1, 1000.0, 0.0123), (-1, 1.0, 12.3)])
def test_sign_and_unit(sign: int, unit_um: float, expected: float) -> None:
    r = register(sign, unit_um)
    assert r.check(0.0, 0.0)
    value = r.value(-12.3)
    assert value == pytest.approx(expected, rel=1e-6)
    r.wrote(value)
    assert r.value(-12.3) is None and r.check(1.0, value) and not r.trouble


def test_goes_on_from_what_the_plc_holds() -> None:
    r = register(-1)
    assert r.check(0.0, 0.007) and r._follower.applied_um == pytest.approx(-7.0)
    r.lost("gone")
    assert r.trouble == "gone"
    assert r.check(1.0, -0.002) and r._follower.applied_um == pytest.approx(2.0) and not r.trouble


def test_a_foreign_value_that_is_gone_is_no_trouble_and_the_next_one_has_to_stand_again() -> None:
    r = register()
    assert r.check(0.0, 0.0)
    r.wrote(0.004)
    assert not r.check(1.0, 0.050) and r.trouble
    assert r.check(2.0, 0.004) and not r.trouble
    assert not r.check(3600.0, 0.050) and not r.check(3604.0, 0.050) and r.trouble
    assert r.check(3605.1, 0.050)


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.0501, 1e30])
def test_nothing_is_written_over_what_cannot_be(value: float) -> None:
    r = register()
    assert not r.check(0.0, value) and "[plc_beyond_limit]" in r.trouble
    assert r.check(1.0, 0.001) and not r.trouble


def test_somebody_elses_write_stops_it_until_that_stands() -> None:
    r = register()
    assert r.check(0.0, 0.0)
    r.wrote(0.004)
    assert r.check(1.0, 0.00405)  # within the tolerance
    assert not r.check(2.0, 0.010) and "+10.000 µm instead of the written +4.000 µm" in r.trouble
    assert not r.check(6.0, 0.020) and not r.check(10.0, 0.020)  # still at it
    assert r.check(11.1, 0.020) and r._follower.applied_um == pytest.approx(20.0)
    r.wrote(0.020)
    assert not r.check(12.0, math.nan) and not r.check(30.0, math.nan) and "nan" in r.trouble


@pytest.mark.parametrize("sign", [1, -1])
def test_what_stands_at_its_limit_is_continued(sign: int) -> None:
    """As 32 bits hold 0.1 mm, it is 100.0000015 µm."""
    limits = Limits(offset_max_um=100.0, offset_rate_max_um_per_min=60.0)
    r = Register(Follower(MACHINE, limits), sign=sign, unit_um=1000.0, tolerance_um=0.1, resume_after_s=5.0)
    value = r.value(100.0)
    assert value is not None and abs(value) > 0.1
    assert r.check(0.0, value) and not r.trouble and r._follower.applied_um == 100.0
    assert r.value(100.0) is None
    r.lost("gone")
    assert not r.check(1.0, sign * 0.10002) and "[plc_beyond_limit]" in r.trouble


@pytest.mark.parametrize("end_mm", [-500.0, 500.0])
def test_a_line_that_stands_at_its_limit_is_continued(end_mm: float) -> None:
    limits = AxisLimits(
        offset_max_um=100.0,
        offset_rate_max_um_per_min=60.0,
        slope_max_um_per_m=60.0,
        position_min_mm=-500.0,
        position_max_mm=500.0,
        position_speed_max_mm_per_s=100.0,
    )
    follower = AxesFollower(MACHINE, {"y": limits}, None, Acceptance())
    place = AxisPlace(sign=1, per_um=1e-3, per_slope=1e-6, tolerance_um=0.1, travel_mm=1000.0)
    r = AxesRegisters(follower, {"y": place}, 5.0)
    slope = math.copysign(50.0, end_mm)  # 100 µm at this end
    values = (single_precision(0.075), single_precision(slope * 1e-6))
    assert r.check_all(0.0, values) and not r.trouble
    ends_um = follower.advance(0.0, NOTHING_READ).axes["y"].ends_um
    assert max(ends_um) == 100.0 and min(ends_um) == pytest.approx(50.0)
    r.lost("gone")
    assert not r.check_all(1.0, (0.07502, values[1])) and "[plc_beyond_limit]" in r.trouble


actions = st.one_of(
    st.tuples(st.just("offset"), st.floats(-50.0, 50.0)),
    st.tuples(st.just("plc"), st.one_of(st.floats(-0.06, 0.06), st.just(math.nan))),
    st.tuples(st.just("lost"), st.just(0.0)),
    st.tuples(st.just("refused"), st.just(0.0)),
    st.tuples(st.just("wait"), st.floats(0.0, 30.0)),
)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from([1, -1]), st.booleans(), st.floats(-0.05, 0.05), st.lists(actions, max_size=60))
def test_no_write_is_further_from_what_the_plc_holds_than_the_rate_allows(
    sign: int, single: bool, start: float, steps: list[tuple[str, float]]
) -> None:
    r = register(sign, single=single)
    plc, now, seq, refused = start, 0.0, 0, False
    for what, number in steps:
        now += 1.0 + (number if what == "wait" else 0.0)
        if what == "offset":
            seq += 1
            r._follower.receive(now, offset(seq, number))
        elif what == "plc":
            plc = number
        elif what == "lost":
            r.lost("gone")
        refused = what == "refused"
        may_move = r.check(now, plc)
        r._follower.follow() if may_move else r._follower.hold()
        applied = r._follower.advance(now)
        value = r.value(applied.offset_um) if may_move else None
        if value is not None:
            # What the PLC holds may be off by the tolerance and still be ours.
            assert abs(value - plc) * 1000.0 <= 2.0 + 0.1 + 1e-5 and abs(value) <= 0.05 + 1e-9
            if refused:
                r.lost("refused")
            else:
                plc = value
                r.wrote(value)
