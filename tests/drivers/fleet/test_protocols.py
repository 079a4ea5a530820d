"""Frames and scaling as pure functions, against printed vectors and random bytes."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import Quality
from drivers.families.inputs import CapacitiveProbe, reading_of
from drivers.protocols.analogue import advantech_volts, icpdas_volts
from drivers.protocols.capancdt import BadReplyError, Blocks, channel_info, micrometres
from drivers.protocols.dcon import BadTextError, checksum, command, reply, split_values, thermocouple
from drivers.protocols.modbus import (
    Request,
    WrongAnswerError,
    crc16,
    describe_rtu,
    fence_for,
    find_rtu,
    find_tcp,
)
from drivers.protocols.registers import decode
from drivers.protocols.thermocouples import ADVANTECH, ICPDAS, STANDARD

EIGHT = Request(function=4, address=0, count=8)


def rtu(unit: int, pdu: bytes) -> bytes:
    frame = bytes([unit]) + pdu
    return frame + crc16(frame).to_bytes(2, "little")


def block(counter: int, frames: list[list[int]], present: int = 0b0101) -> bytes:
    values = [value for frame in frames for value in frame]
    width = 4 * len(frames[0])
    head = struct.pack("<4siiQIHHI", b"MEAS", 1, 2, present, 0, len(frames), width, counter)
    return head + struct.pack(f"<{len(values)}i", *values)


def test_icpdas_read_of_eight_channels_is_the_printed_frame() -> None:
    assert rtu(1, bytes.fromhex("0400000008")).hex(" ").upper() == "01 04 00 00 00 08 F1 CC"


@pytest.mark.parametrize(
    ("letter", "word", "degc"),
    [
        ("K", 0xE6D0, -269.98),
        ("J", 0xDCA2, -209.99),
        ("T", 0xA99A, -269.99),
        ("E", 0xDD71, -269.99),
        ("N", 0xE56B, -269.97),
        ("L", 0xE000, -200.0),
        ("L-DIN", 0xE38E, -200.0),
        ("R", 0x0000, 0.0),
        ("M", 0x4000, 100.0),
        ("K", 0x7FFE, 1371.96),
    ],
)
def test_icpdas_hex_words_of_the_register_table(letter: str, word: int, degc: float) -> None:
    assert ICPDAS[letter].icp_hex(word).value == pytest.approx(degc, abs=0.011)


def test_icpdas_marks() -> None:
    assert ICPDAS["K"].icp_hex(0x7FFF).quality is Quality.OPEN
    assert ICPDAS["K"].icp_hex(0x8000).quality is Quality.UNDER
    assert ICPDAS["K"].icp_engineering(0x7FFF, 0.1).quality is Quality.OPEN
    assert ICPDAS["K"].icp_engineering(13720, 0.1).value == pytest.approx(1372.0)
    assert ICPDAS["K"].icp_engineering(-2700 & 0xFFFF, 0.1).value == pytest.approx(-270.0)
    assert ICPDAS["K"].icp_engineering(14000, 0.1).quality is Quality.OVER
    assert ICPDAS["T"].icp_engineering(2345, 0.01).value == pytest.approx(23.45)


@pytest.mark.parametrize(("letter", "word", "degc"), [("T", 16225, 23.79), ("T", 14089, 7.49), ("K", 996, 20.82)])
def test_advantech_words_of_captures(letter: str, word: int, degc: float) -> None:
    assert ADVANTECH[letter].advantech(word).value == pytest.approx(degc, abs=0.006)


@pytest.mark.parametrize("letter", ["J", "K", "E", "T"])
def test_advantech_ends_are_clamps(letter: str) -> None:
    low, high = ADVANTECH[letter].advantech(0), ADVANTECH[letter].advantech(65535)
    assert (low.quality, high.quality) == (Quality.UNDER, Quality.OVER)
    assert math.isnan(low.value) and low.count == 0 and low.detail


def test_float_that_is_no_number_is_invalid() -> None:
    assert STANDARD["K"].reading(math.nan).quality is Quality.INVALID
    assert STANDARD["K"].reading(3.4e38).quality is Quality.OVER


def test_voltages() -> None:
    assert advantech_volts(33271, 0.15) == pytest.approx(0.00230, abs=1e-5)
    assert advantech_volts(32768, 10.0) == pytest.approx(0.0, abs=2e-4)
    assert icpdas_volts(0xC000, 10.0, "hex") == pytest.approx(-5.0, abs=1e-3)
    assert icpdas_volts(0xF060, 10.0, "engineering") == -4.0
    for end in (
        advantech_volts(0, 10.0),
        icpdas_volts(0x8000, 10.0, "hex"),
        icpdas_volts(-10000 & 0xFFFF, 10.0, "engineering"),
    ):
        assert reading_of(end, None).quality is Quality.UNDER
    for end in (
        advantech_volts(65535, 10.0),
        icpdas_volts(0x7FFF, 10.0, "hex"),
        icpdas_volts(10000, 10.0, "engineering"),
    ):
        assert reading_of(end, None).quality is Quality.OVER


@pytest.mark.parametrize("polarity", [1, -1])
def test_probe_equation(polarity: int) -> None:
    probe = CapacitiveProbe(um_per_v=5.0, polarity=polarity, standoff_um=50.0, volt_min=-9.9, volt_max=9.9)
    assert reading_of(0.0, probe).value == 50.0
    assert reading_of(2.0, probe).value == 50.0 + polarity * 10.0
    assert reading_of(9.95, probe).quality is Quality.OVER
    assert reading_of(-9.95, probe).quality is Quality.UNDER


def test_number_types() -> None:
    words = list(struct.unpack(">2H", struct.pack(">f", 21.5)))
    assert decode(words, "float32", "big") == 21.5
    assert decode(words[::-1], "float32", "little") == 21.5
    assert decode([0xFFFF, 0xFF38], "int32", "big") == -200.0
    assert decode([0x8000], "uint16", "big") == 32768.0


def test_fence_differs_from_every_request() -> None:
    requests = (
        Request(function=3, address=0, count=1),
        Request(function=3, address=9, count=2),
        Request(function=4, address=0, count=3),
    )
    fence = fence_for(requests)
    assert (fence.function, fence.address, fence.count) == (3, 0, 3)


def test_rtu_answer_is_found_behind_noise_and_late_ones() -> None:
    due = rtu(1, bytes([4, 16]) + bytes(range(16)))
    late = rtu(1, bytes([4, 2, 0, 7]))
    foreign = rtu(2, bytes([4, 16]) + bytes(16))
    assert find_rtu(b"\xff\x00" + late + foreign + due, 1, EIGHT) == due
    assert find_rtu(late + foreign + due[:-1], 1, EIGHT) is None
    assert find_rtu(rtu(1, bytes([0x84, 2])), 1, EIGHT) == rtu(1, bytes([0x84, 2]))
    assert describe_rtu(foreign, 1, EIGHT) is None
    assert "2 bytes" in (describe_rtu(late, 1, EIGHT) or "")
    assert "CRC" in (describe_rtu(due[:-1] + b"\x00", 1, EIGHT) or "")


@given(st.binary(max_size=80))
@settings(max_examples=200, deadline=None)
def test_random_bytes_are_no_modbus_answer(data: bytes) -> None:
    assert find_rtu(data, 1, EIGHT) is None
    describe_rtu(data, 1, EIGHT)
    try:
        assert find_tcp(data, 7, 1, EIGHT) is None
    except WrongAnswerError as error:
        assert str(error)


def test_tcp_answer() -> None:
    body = bytes([4, 16]) + bytes(16)
    due = struct.pack(">HHHB", 7, 0, len(body) + 1, 1) + body
    late = struct.pack(">HHHB", 6, 0, len(body) + 1, 1) + body
    assert find_tcp(late + due, 7, 1, EIGHT) == due
    assert find_tcp(late + due[:12], 7, 1, EIGHT) is None
    for wrong, text in [
        (due[:6] + b"\x02" + due[7:], "unit 2"),
        (due[:7] + b"\x03" + due[8:], "function 3"),
        (struct.pack(">HHHB", 7, 0, 17, 1) + bytes([4, 14]) + bytes(14), "the answer has 14"),
        (b"HTTP/1.1 200 OK", "header"),
    ]:
        with pytest.raises(WrongAnswerError, match=text):
            find_tcp(wrong, 7, 1, EIGHT)


@pytest.mark.parametrize(("text", "total"), [("$012", "B7"), ("!01200600", "AA"), ("!01400600", "AC")])
def test_dcon_checksums(text: str, total: str) -> None:
    assert checksum(text) == total
    if text[0] == "$":
        assert command(text, with_checksum=True) == f"{text}{total}\r".encode()
    else:
        assert reply(f"{text}{total}".encode(), with_checksum=True).body == text[1:]
        with pytest.raises(BadTextError, match="checksum"):
            reply(f"{text}00".encode(), with_checksum=True)


def test_dcon_printed_replies() -> None:
    body = "+05.123+04.153+07.234-02.356+10.000-05.133+02.345+08.234"
    assert [float(t) for t in split_values(body, 8, "engineering")][3] == -2.356
    assert len(split_values("+7.2111+7.2567+7.3125+7.1000+7.4712+7.2555+7.1234+7.5678", 8, "engineering")) == 8
    mixed = "+023.50+9999-0000       +0.0276-10.000+9999+024.00"
    texts = split_values(mixed, 8, "engineering")
    qualities = [thermocouple(t, "engineering", STANDARD["K"], None).quality for t in texts]
    assert [str(q) for q in qualities[:4]] == ["good", "open_circuit", "under_range", "invalid"]
    assert qualities[6] is Quality.OPEN


@pytest.mark.parametrize(
    "body", ["+023.5+024.0", "+023.50", "+023.50+02", "+023.50+024.00+025.00", "garbage", "+++-", "4C53"]
)
def test_dcon_bodies_that_are_no_values(body: str) -> None:
    with pytest.raises(BadTextError):
        split_values(body, 2, "engineering")


def test_dcon_scaling() -> None:
    icp, adam = ICPDAS["K"], ADVANTECH
    assert thermocouple("+100.00", "percent", icp, "icpdas").value == pytest.approx(1372.0)
    # Type M has its full scale at -200 °C.
    assert thermocouple("+010.00", "percent", ICPDAS["M"], "icpdas").value == pytest.approx(20.0)
    assert thermocouple("E6D0", "hex", icp, "icpdas").value == pytest.approx(-269.98, abs=0.01)
    assert thermocouple("7FFF", "hex", icp, "icpdas").quality is Quality.OPEN
    assert thermocouple("E000", "hex", adam["T"], "advantech").value == pytest.approx(-100.0)
    assert thermocouple("2492", "hex", adam["R"], "advantech").value == pytest.approx(500.0, abs=0.1)
    assert thermocouple("FFFF", "hex", adam["T"], "advantech").quality is Quality.OPEN
    assert thermocouple("0000", "hex", adam["J"], "advantech").quality is Quality.UNDER
    assert thermocouple("+9999.9", "engineering", icp, "icpdas").quality is Quality.OPEN
    assert thermocouple("-9999.9", "engineering", icp, "icpdas").quality is Quality.UNDER


@given(st.text(max_size=60), st.sampled_from(["engineering", "percent", "hex"]))
@settings(max_examples=200, deadline=None)
def test_random_text_is_values_or_an_error(body: str, form: str) -> None:
    try:
        for text in split_values(body, 8, form):
            thermocouple(text, form, ICPDAS["K"], "icpdas")
    except BadTextError as error:
        assert str(error)


def test_capancdt_scaling() -> None:
    assert micrometres(0x7FFFFF, 2000.0) == pytest.approx(999.99, abs=0.011)
    assert channel_info("$CHI1:ANO1,NAMCS2,SNO7,OFS0,RNG2,UNTmmOK\r\n").range_um == 2000.0
    for text in (
        "$CHI1:ANO1,NAMCS2,SNO7,OFS0,RNG2,UNTVOK",
        "$CHI1:UNTumOK",
        "$CHI1:RNGx,UNTumOK",
        "$CHI1:RNG0,UNTumOK",
    ):
        with pytest.raises(BadReplyError):
            channel_info(text)


@given(st.lists(st.integers(1, 60), min_size=1, max_size=30))
@settings(max_examples=60, deadline=None)
def test_capancdt_blocks_split_and_joined_anywhere(cuts: list[int]) -> None:
    # 0x5341454D is MEAS: a measurement that looks like a preamble must not lead astray.
    sent = [[10, 0x5341454D], [11, 21], [12, 22]]
    stream = b"torn MEA" + block(5, sent[:2]) + block(7, sent[2:]) + block(8, [[13, 23]])
    blocks, found, place = Blocks(), [], 0
    for cut in cuts:
        found += blocks.feed(stream[place : place + cut])
        place += cut
    found += blocks.feed(stream[place:])
    assert [b.counter for b in found] == [5, 7, 8]
    assert [v for b in found for v in b.of(0)] == [10, 11, 12, 13]
    assert [v for b in found for v in b.of(1)] == [0x5341454D, 21, 22, 23]


def test_capancdt_torn_block_costs_only_itself() -> None:
    blocks = Blocks()
    found = blocks.feed(block(1, [[1, 2]] * 20)[:90] + block(21, [[3, 4]]))
    assert [b.counter for b in found] == [21]
    assert blocks.skipped == 90


@pytest.mark.parametrize("cut", range(33, 112))
@pytest.mark.parametrize("piece", [5, 1000])
def test_capancdt_torn_blocks_of_any_length_give_no_wrong_value(cut: int, piece: int) -> None:
    whole = block(1, [[1, 2]] * 10)
    stream = whole[:cut] + block(11, [[3, 4]] * 10) + block(21, [[5, 6]])
    blocks = Blocks()
    found = [b for place in range(0, len(stream), piece) for b in blocks.feed(stream[place : place + piece])]
    assert [b.counter for b in found] == ([1, 11, 21] if cut == len(whole) else [11, 21])
    assert {v for b in found for v in b.values} <= {1, 2, 3, 4, 5, 6}


@given(st.binary(max_size=200))
@settings(max_examples=100, deadline=None)
def test_capancdt_random_bytes(data: bytes) -> None:
    blocks = Blocks()
    blocks.feed(data)
    blocks.feed(b"MEAS" + data)
