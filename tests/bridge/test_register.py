"""What may be written into somebody else's memory, against a PLC that does as it likes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.bridge.register import Register
from compensator.receiver import Follower, Limits
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
