"""Lines of DPRNT: what a simulated control prints is read as it was meant, and anything else is refused."""

from __future__ import annotations

import datetime

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compensator.probes.dprnt import Printed, Unusable, parse
from compensator.probes.lines import Lines
from sim_hardware.wire.printing import Maker, even, formatted

FULL = "TPROBE*YUM#101[53]*CUM#102[53]*OUM#103[53]*F#9[30]*T#20[30]*D#3011[80]*H#3012[60]*A#104[40]*S#105[61]*END"
GOOD = "TPROBE YUM 3.200 CUM -3.200 F 1 END"


def printed(maker: Maker, template: str, **values: float) -> Printed:
    text = formatted(maker, template, {int(name[1:]): value for name, value in values.items()})
    found = parse(text)
    assert found is not None
    return found


@pytest.mark.parametrize("maker", ["fanuc", "fanuc-no-blanks", "haas", "mitsubishi"])
@pytest.mark.parametrize("reading", [0.0, 0.4, -0.0004, 3.2, -12.3456, 999.5, -9999.9])
def test_what_each_control_prints_is_read(maker: Maker, reading: float) -> None:
    values = {
        "_101": reading,
        "_102": -reading,
        "_103": -reading / 2,
        "_9": 7.0,
        "_20": 99.0,
        "_104": 2.0,
        "_105": 20.5,
    }
    found = printed(maker, FULL, **values, _3011=20260302.0, _3012=90503.0)
    assert found.reading_um == pytest.approx(reading, abs=6e-4)
    assert found.offset_um == pytest.approx(-reading / 2, abs=6e-4)
    assert (found.feature, found.tool, found.age_s, found.stopped_s) == ("7", "99", 2.0, 20.5)
    assert found.printed_at == datetime.datetime(2026, 3, 2, 9, 5, 3)


@pytest.mark.parametrize(("word", "factor"), [("UM", 1.0), ("MM", 1000.0), ("IN", 25400.0)])
def test_the_word_has_the_unit(word: str, factor: float) -> None:
    found = parse(f"TPROBE Y{word}.0125 C{word}-.0125 F1 END")
    assert found is not None and found.reading_um == pytest.approx(0.0125 * factor)


def test_what_the_line_does_not_say_is_not_made_up() -> None:
    found = parse("TPROBE YUM 3.2 CUM-3.2 FSPHERE-1 END")
    assert found is not None
    assert (found.offset_um, found.printed_at, found.stopped_s, found.tool, found.feature) == (
        None,
        None,
        None,
        "",
        "SPHERE-1",
    )


@pytest.mark.parametrize(
    ("text", "name"),
    [
        *[("1.", "1"), ("001", "1"), ("1.500", "1.5"), ("- 3", "-3"), ("0.", "0"), ("-0", "-0"), (".00001", "1e-05")],
        *[("999999", "999999"), ("1000000.", "1000000"), ("1234567", "1234567"), ("1234568", "1234568")],
        *[("123456789.123456789", "123456789.123456789"), ("1.0000001", "1.0000001"), (".000123456", "0.000123456")],
    ],
)
def test_no_two_numbers_are_one_name(text: str, name: str) -> None:
    found = parse(GOOD.replace("F 1", f"F{text} T{text}"))
    assert found is not None and (found.feature, found.tool) == (name, name)


def test_a_year_of_two_digits() -> None:
    found = parse(GOOD.replace(" END", " D 260302 H5 END"))
    assert found is not None and found.printed_at == datetime.datetime(2026, 3, 2, 0, 0, 5)


@pytest.mark.parametrize("text", ["", "%", "O9811", "PART 3.2 OK", "tprobe YUM 1. CUM -1. END"])
def test_lines_of_others_are_left_alone(text: str) -> None:
    assert parse(text) is None


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (" END", "", "no END"),
        (" END", " EN", "no END"),
        ("3.200 CUM", "4.200 CUM", "expected the opposite"),
        ("YUM", "YMM", "expected the opposite"),
        ("CUM -3.200", "", "no C"),
        ("YUM 3.200", "", "no Y"),
        ("3.200 CUM -3.200", "3,200 CUM -3,200", "not understood"),
        ("F 1", "F 1 F 2", "F twice"),
        ("F 1", "YMM 1 F 1", "Y twice"),
        ("F 1", "Q 1", "not understood"),
        ("F 1", "F 1 D20260302", "D and H belong together"),
        ("F 1", "F 1 D20261302 H0", "expected a date"),
        ("F 1", "F 1 S-2", "expected 0 to"),
        ("F 1", "F 1 A4000", "expected 0 to 3600"),
        ("3.200 CUM -3.200", "99999.0 CUM -99999.0", "expected at most 10 mm"),
        ("3.200 CUM -3.200", "3.2.0 CUM -3.2.0", "expected a number"),
        ("3.200 CUM -3.200", "1E3 CUM -1E3", "expected a number"),
        ("3.200 CUM", "INF CUM", "expected a number"),
        ("TPROBE", "TPROBEX", "not understood"),
        (" END", f" END {GOOD}", "not understood"),
        ("F 1", "F T 9", "not understood"),
    ],
)
def test_a_line_that_is_not_as_agreed_is_refused(old: str, new: str, why: str) -> None:
    assert parse(GOOD) is not None and old in GOOD
    with pytest.raises(Unusable, match=why):
        parse(GOOD.replace(old, new, 1))


def test_no_part_of_a_line_is_taken_for_the_whole() -> None:
    text = formatted("fanuc", FULL, dict.fromkeys((101, 102, 103, 9, 20, 3011, 3012, 104, 105), 0.0))
    text = text.replace("D       0", "D20260302")
    assert parse(text) is not None
    for length in range(len("TPROBE"), len(text)):
        with pytest.raises(Unusable):
            parse(text[:length])


@given(st.integers(0, 34), st.sampled_from("0123456789"))
@settings(max_examples=300, deadline=None)
def test_no_wrong_digit_of_the_reading_passes(at: int, digit: str) -> None:
    text = "TPROBE YUM  37.200 CUM- 37.200 F1 END"
    changed = text[:at] + digit + text[at + 1 :]
    try:
        found = parse(changed)
    except Unusable:
        return
    assert found is None or found.reading_um == pytest.approx(37.2, abs=0.31)


# ---------------------------------------------------------------------- bytes to lines


def texts(lines: Lines, data: bytes, now_s: float = 0.0) -> list[str]:
    found = lines.feed(data, now_s)
    assert not any(line.broken for line in found), found
    return [line.text for line in found]


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n", b"\n\r\r"])
def test_line_ends_and_what_popen_sends_around(end: bytes) -> None:
    data = b"\x12%" + end + b"\x11ONE" + end + b"T\x13WO" + end + b"%\x14\x00\x7f"
    assert texts(Lines(), data) == ["%", "ONE", "TWO"]


def test_lines_come_in_any_pieces() -> None:
    data = b"\x12ONE 1\r\nTWO 2\r\n\x14"
    for first in range(len(data)):
        for second in range(first, len(data)):
            lines = Lines()
            pieces = (data[:first], data[first:second], data[second:])
            assert [text for piece in pieces for text in texts(lines, piece)] == ["ONE 1", "TWO 2"]


def test_parity_is_stripped_and_checked() -> None:
    data = even(b"TPROBE 1\n\rTWO\n")
    assert data != b"TPROBE 1\n\rTWO\n"
    assert texts(Lines("7E"), data) == ["TPROBE 1", "TWO"]
    for at in range(len(b"TPROBE 1")):
        for bit in range(8):
            wrong = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
            first, second = Lines("7E").feed(wrong, 0.0)
            assert first.broken == "wrong parity" and second == ("TWO", False, "")
    assert all(line.broken for line in Lines("8N").feed(data, 0.0))  # wrongly set: refused, not misread


def test_a_wrong_line_spoils_no_other() -> None:
    lines = Lines()
    found = lines.feed(b"\xff\xfe\nONE\n" + b"x" * 5000 + b"\nTWO\n\x1b[A\nTHREE\n", 0.0)
    assert [line.text for line in found if not line.broken] == ["ONE", "TWO", "THREE"]
    assert sum(bool(line.broken) for line in found) == 3


def test_age() -> None:
    lines = Lines()
    lines.feed(b"ON", 0.0, late=True)
    first, second = lines.feed(b"E\nTWO\n", 0.1)
    assert first.late and not second.late
    lines.feed(b"THR", 1.0)
    (slow,) = lines.feed(b"EE\n", 12.0)
    assert slow.late  # half of it waited for something
    lines.feed(b"half", 13.0)
    rest = lines.lost()
    assert rest is not None and rest.broken and lines.lost() is None
    assert texts(lines, b"NEXT\n") == ["NEXT"]
