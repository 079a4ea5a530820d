"""The displacement controller's two ports, byte by byte."""

import contextlib
import itertools
import socket
import struct

import pytest

from sim_hardware.wire import CapaNcdt

HEADER = "<4siiQIHHI"


@pytest.fixture
def controller(rack, value):
    return rack.add(CapaNcdt({1: value(1000.0), 3: value(50.0)}, {1: 2000.0, 3: 100.0}))


@pytest.fixture
def data(controller, wires):
    wire = wires(controller.host, controller.data_port)
    controller.wait_for_client()
    return wire


@pytest.fixture
def command(controller, wires):
    wire = wires(controller.host, controller.command_port)
    banner = b""
    while banner.count(b"\r\n") < 3:
        banner += wire.receive(1)
    return wire


def block(wire, frames, channels=2):
    """Receive one block; its counter, and its values frame by frame."""
    got = wire.receive(32 + 4 * channels * frames)
    preamble, _, _, present, _, m, size, counter = struct.unpack(HEADER, got[:32])
    assert (preamble, present, m, size) == (b"MEAS", 0b010001, frames, 4 * channels)
    values = struct.unpack(f"<{channels * frames}i", got[32:])
    return counter, [values[i : i + channels] for i in range(0, len(values), channels)]


def ask(wire, text):
    wire.send(text.encode() + b"\r")
    reply = b""
    while not reply.endswith(b"\r\n"):
        piece = wire.receive(1)
        assert piece, reply
        reply += piece
    return reply.decode()[:-2]


def test_header_is_32_bytes_and_half_range_is_7fffff(controller, data):
    assert struct.calcsize(HEADER) == 32
    controller.push(2)
    counter, frames = block(data, 2)
    assert counter == 0
    assert frames == [(0x7FFFFF, 0x7FFFFF)] * 2
    assert pytest.approx(999.99, abs=0.01) == 0x7FFFFF / 0xFFFFFF * 2000


def test_counter_counts_frames(controller, data):
    for expected in (0, 4, 8):
        controller.push(4)
        assert block(data, 4)[0] == expected


def test_push_without_a_client_measures_all_the_same(controller, wires):
    controller.push(3)
    wire = wires(controller.host, controller.data_port)
    controller.push(1)
    assert block(wire, 1)[0] == 3


def test_only_the_first_client_is_served(controller, data, wires):
    second = wires(controller.host, controller.data_port)
    controller.push(1)
    block(data, 1)
    controller.push(1)
    assert block(data, 1)[0] == 1
    assert second.receive(1, within_s=0.01) == b""


@pytest.mark.parametrize(
    ("text", "reply"),
    [
        ("$STI1200", "$STI1200,960OK"),
        ("$CHS", "$CHS1,0,1,0OK"),
        ("$AVT1", "$AVT1OK"),
        ("$AVT?", "$AVT?0OK"),
        ("$AVT9", "$AVT9$WRONG PARAMETER"),
        ("$TRG2", "$TRG2OK"),
        ("$XYZ", "$XYZ$UNKNOWN COMMAND"),
        ("noise$CHS", "noise$CHS1,0,1,0OK"),
        ("$CHI2", "$CHI2$WRONG PARAMETER"),
    ],
)
def test_commands_are_echoed_and_answered(command, text, reply):
    assert ask(command, text) == reply


def test_information(controller, command):
    assert ask(command, "$CHI1").endswith(",RNG2000,UNTumOK")
    assert ask(command, "$CHI3").startswith("$CHI3:ANO")
    assert ask(command, "$GDP") == f"$GDP{controller.data_port}OK"
    ask(command, "$AVT2")
    assert ask(command, "$STS") == "$STSSTI960;AVT2;AVN2;TRG0OK"
    assert ask(command, "$VER").startswith("$VERDT62")


def test_every_character_is_echoed_at_once(command):
    for character in b"$CHS":
        command.send(bytes((character,)))
        assert command.receive(1) == bytes((character,))
    command.send(b"\r\n")
    assert command.receive(11) == b"1,0,1,0OK\r\n"


def test_trigger_mode_stops_the_stream_and_gmd_sends_one(controller, data, command):
    ask(command, "$TRG1")
    controller.push(4)
    assert ask(command, "$GMD") == "$GMDOK"
    assert block(data, 1)[0] == 0


def test_real_time_stream(rack, value, wires):
    controller = rack.add(CapaNcdt({1: value(1.0), 3: value(2.0)}, 100.0, realtime=True))
    wire = wires(controller.host, controller.data_port)
    seen = []
    while len(seen) < 3:
        header = wire.receive(32)
        m, size, counter = struct.unpack("<HHI", header[24:])
        wire.receive(m * size)
        seen.append((counter, m))
    assert all(a + m == b for (a, m), (b, _) in itertools.pairwise(seen))


def test_input_faults(controller, data, value):
    faults = controller.faults
    cases = [
        ("open", {}, 0xFFFFFF),
        ("over", {}, 0xFFFFFF),
        ("under", {}, 0),
        ("wild", {"value": 20.0}, 0x333333),
    ]
    for fault, parameters, expected in cases:
        faults.set(fault, input=3, **parameters)
        controller.push(1)
        assert block(data, 1)[1] == [(0x7FFFFF, expected)]
        faults.clear(input=3)


def test_frozen(rack, value, wires):
    source = value(10.0)
    controller = rack.add(CapaNcdt({1: source}, 100.0))
    wire = wires(controller.host, controller.data_port)
    controller.wait_for_client()
    controller.faults.set("frozen", input=1)
    controller.push(1)
    source.value = 90.0
    controller.push(1)
    first, second = wire.receive(36), wire.receive(36)
    assert first[32:] == second[32:]
    assert first[28:32] != second[28:32]


@pytest.mark.parametrize(
    ("fault", "parameters", "counters"),
    [("stale_counter", {}, [0, 0, 0]), ("gap", {"frames": 5}, [5, 11, 17]), ("silence", {"times": 2}, [2])],
)
def test_counter_faults(controller, data, fault, parameters, counters):
    controller.faults.set(fault, **parameters)
    for _ in range(3):
        controller.push(1)
    assert [block(data, 1)[0] for _ in counters] == counters
    assert data.receive(1, within_s=0.01) == b""


def test_shortened_blocks(controller, data):
    controller.faults.set("wrong_length", times=1)
    controller.push(1)
    controller.push(1)
    assert data.receive(40)[36:] == b"MEAS"
    data.receive(36)
    controller.faults.set("truncate", times=1)
    controller.push(1)
    controller.push(1)
    assert data.receive(24)[20:] == b"MEAS"


def test_garbage_has_no_preamble(controller, data):
    controller.faults.set("garbage", times=1)
    controller.push(1)
    assert data.receive(40)[:4] != b"MEAS"
    controller.push(1)
    assert block(data, 1)[0] == 1


def test_split_and_joined_blocks(controller, data):
    pieces = data.in_pieces(controller.faults, lambda: controller.push(1), [20, 20])
    assert [len(piece) for piece in pieces] == [20, 20]
    controller.faults.set("join", times=1)
    controller.push(1)
    controller.push(1)
    assert len(data.once()) == 80


def test_late_blocks_come_after_newer_ones(controller, data):
    controller.faults.set("late", times=1, delay_s=0.02)
    controller.push(1)
    controller.push(1)
    assert [block(data, 1)[0] for _ in range(2)] == [1, 0]


def test_refused_command(controller, command):
    controller.faults.set("exception", times=1)
    assert ask(command, "$CHS") == "$CHS$WRONG PARAMETER"
    assert ask(command, "$CHS") == "$CHS1,0,1,0OK"


def test_disconnect_and_return(controller, data, wires):
    port = controller.data_port
    controller.faults.set("disconnect")
    with contextlib.suppress(ConnectionResetError):
        assert data.once() == b""
    for number in (port, controller.command_port):
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((controller.host, number))
    controller.push(1)
    controller.faults.clear("disconnect")
    back = wires(controller.host, port)
    controller.push(1)
    assert block(back, 1)[0] == 1


def test_push_names_a_client_that_does_not_read(controller, data):
    with pytest.raises(TimeoutError):
        for _ in range(40):
            controller.push(20000)


def test_channels_and_ranges_must_agree(value):
    with pytest.raises(ValueError, match="ranges are given for"):
        CapaNcdt({1: value()}, {2: 100.0})
    with pytest.raises(ValueError, match=r"at least one of 1\.\.4"):
        CapaNcdt({}, 100.0)
