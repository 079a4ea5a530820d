"""Whatever is published below the prefix: no payload ends, blocks or locks a receiver, and nothing jumps."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from compensator.receiver.axis_message import AxisMessage, parse_axis
from compensator.receiver.message import OffsetMessage, Rejected, parse_offset, parse_status
from tests.fuzz.attacked_axes import AxesAttack
from tests.fuzz.attacked_receiver import Attack
from tests.fuzz.payloads import payload
from tests.receiver.offsets import MACHINE, T0_NS, axis_offset, offset, slope

FUZZ = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))


@settings(FUZZ, max_examples=300)
@given(rng=st.randoms(use_true_random=False))
def test_a_payload_is_a_message_or_is_rejected_with_a_line(rng: random.Random) -> None:
    data = payload(rng)
    for parse in (parse_offset, lambda data: parse_status(data, MACHINE)):
        try:
            found = parse(data)
        except Rejected as rejected:
            line = rejected.reason.marked
            assert line.isprintable() and len(line) < 400
        else:
            if isinstance(found, OffsetMessage):
                assert 0 <= found.seq <= 10**11 and 0.0 < found.valid_for_s < 1.8e308


@settings(FUZZ, max_examples=120)
@given(rng=st.randoms(use_true_random=False), axis=st.sampled_from("yza"))
def test_a_payload_of_an_axis_is_a_message_or_is_rejected_with_a_line(rng: random.Random, axis: str) -> None:
    try:
        found = parse_axis(payload(rng, axis=axis), axis)
    except Rejected as rejected:
        line = rejected.reason.marked
        assert line.isprintable() and len(line) < 400
    else:
        assert isinstance(found, AxisMessage) and found.axis in found.axes
        numbers = (found.offset or 0.0, found.rate_per_min, found.slope_um_per_m, found.reference_mm)
        assert all(abs(number) <= 1e6 for number in numbers)


@settings(FUZZ, max_examples=25)
@given(seed=st.integers(0, 2**32), check_clock=st.booleans())
def test_no_payload_ends_blocks_or_locks_a_receiver_of_several_axes(seed: int, check_clock: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        AxesAttack(random.Random(seed), Path(folder), check_clock=check_clock).run(30)


@FUZZ
@given(seed=st.integers(0, 2**32), check_clock=st.booleans())
def test_no_payload_ends_blocks_or_locks_a_receiver(seed: int, check_clock: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        Attack(random.Random(seed), Path(folder), check_clock=check_clock).run(30)


@pytest.mark.parametrize("check_clock", [False, True])
@pytest.mark.parametrize("restart", [False, True])
def test_the_largest_number_locks_nobody_out_over_a_restart_either(
    tmp_path: Path, check_clock: bool, restart: bool
) -> None:
    attack = Attack(random.Random(1), tmp_path, check_clock=check_clock)
    attack.honest()
    attack.poll(1.0)
    attack.offsets.put(offset(10**11, 20.0, time_utc_ns=attack.utc_ns, valid_for_s=1e300))
    assert attack.poll(1.0).seq == 10**11
    if restart:
        attack.begin(attack.applied_um)
    attack.recover()
    assert attack.result.restarted
    attack.poll(0.0)
    attack.begin(attack.applied_um)  # the state file holds the lower number now
    attack.honest()
    assert attack.poll(1.0).seq == attack.seq


@pytest.mark.parametrize("digits", [19, 20, 400, 4300, 4301, 60_000])
@pytest.mark.parametrize("key", ["time_utc_ns", "seq", "schema", "valid_for_s", "y_offset_um"])
def test_a_number_of_many_digits_at_every_way_in(tmp_path: Path, key: str, digits: int) -> None:
    attack = Attack(random.Random(1), tmp_path, check_clock=True)
    data = offset(5, 3.0, **{"time_utc_ns": T0_NS, key: "@"}).replace(b'"@"', b"9" * digits)
    for channel in (attack.offsets, attack.statuses):
        channel.put(data)
    attack.answers.put_reply(data)
    attack.poll(1.0)
    attack.recover()


@pytest.mark.parametrize("digits", [19, 400, 4301, 60_000])
@pytest.mark.parametrize(
    "key", ["time_utc_ns", "seq", "y_offset_um", "y_slope_um_per_m", "y_slope_std_um_per_m", "reference_mm"]
)
def test_a_number_of_many_digits_in_the_message_of_an_axis(tmp_path: Path, key: str, digits: int) -> None:
    attack = AxesAttack(random.Random(1), tmp_path, check_clock=True)
    data = axis_offset("y", 5, 3.0, axes="yza", **{**slope(1.0), "time_utc_ns": T0_NS, key: "@"})
    for place in (attack.offsets.put_axis, attack.answers.reply_axis):
        place("y", data.replace(b'"@"', b"9" * digits))
    attack.lengths.put(b'{"schema":1,"machine":"vmc-07","tool_length_mm":' + b"9" * digits + b"}")
    attack.poll(1.0)
    attack.recover()
