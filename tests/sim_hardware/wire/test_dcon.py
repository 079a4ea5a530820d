"""DCON lines, character by character, against the examples of the manuals."""

import os

import pytest

from sim_hardware.wire import Adam, DconLine, DconSettings, IcpDas


@pytest.fixture
def line(rack, value):
    """Give a line with an I-7018R at 01, an ADAM-4018+ at 02 and an I-7017 at 0A."""
    return rack.add(
        DconLine(
            {
                1: IcpDas("i-7018r", ranges="J", sources={i: value(20.0 + i) for i in range(8)}),
                2: Adam("adam-4018+", ranges="K", sources={i: value(305.5) for i in range(8)}),
                10: IcpDas("i-7017", ranges="10V", sources={i: value(-2.356) for i in range(8)}),
            }
        )
    )


@pytest.fixture
def wire(line, wires):
    return wires(line.port)


def test_read_all_and_one(wire):
    expected = "".join(f"+0{20 + i}.00" for i in range(8))
    got = wire.line("#01\r")
    assert len(got) == 58
    assert [float(got[1 + 7 * i : 8 + 7 * i]) for i in range(8)] == pytest.approx(
        [20.0 + i for i in range(8)], abs=0.024
    )
    assert [c for c in got if not c.isdigit()] == [c for c in f">{expected}\r" if not c.isdigit()]
    assert wire.line("#020\r") == ">+0305.5\r"
    assert wire.line("#0A7\r") == ">-02.356\r"


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("$012", "!010E0600"),
        ("$022", "!020F0600"),
        ("$0A2", "!0A080600"),
        ("$01M", "!017018R"),
        ("$02M", "!024018P"),
        ("$016", "!01FF"),
        ("$02B", "!0200"),
        ("$013", ">+0025.0"),
        ("$028C3", "!02C3R0F"),
        ("#029", "?02"),
        ("$027C3RFF", "?02"),
        ("%0202FF0600", "?02"),
        ("%02020F0700", "?02"),
        ("%02020F0640", "?02"),
    ],
)
def test_commands(wire, command, reply):
    assert wire.line(command + "\r") == reply + "\r"


@pytest.mark.parametrize("command", ["#03", "#01XY", "$01Q", "01", "#0a", "%0101", "$018C0", "@01", "#01\n"])
def test_no_reply_to_wrong_syntax_or_address(wire, command):
    wire.send(command.encode() + b"\r")
    # The next command's reply is the first thing to be heard.
    assert wire.line("$01M\r") == "!017018R\r"


@pytest.mark.parametrize(
    ("couple", "degc", "text"),
    [("J", 760.0, "7FFF"), ("T", -100.0, "E000"), ("R", 500.0, "2492"), ("T", -101.0, "0000")],
)
def test_adam_two_s_complement(rack, wires, couple, degc, text):
    module = Adam("adam-4018+", ranges=couple, sources={0: lambda: degc})
    line = rack.add(DconLine({1: module}, settings={1: DconSettings(data_format="hex")}))
    assert wires(line.port).line("#010\r") == f">{text}\r"


def test_percent(rack, wires, value):
    module = IcpDas("i-7018r", ranges="K", sources={0: value(686.0), 1: value(-13.72)})
    line = rack.add(DconLine({1: module}, settings={1: DconSettings(data_format="percent")}))
    wire = wires(line.port)
    assert (wire.line("#010\r"), wire.line("#011\r")) == (">+050.00\r", ">-001.00\r")


def test_out_of_range_codes_are_five_characters(line, wire):
    faults = line.module(2).faults
    faults.set("open", input=1)
    faults.set("under", input=6)
    good = "+0305.5"
    assert wire.line("#02\r") == f">{good}+9999{good * 4}-0000{good}\r"
    assert wire.line("$02B\r") == "!0242\r"
    line.module(1).faults.set("over", input=0)
    assert wire.line("#010\r") == ">+9999\r"


def test_disabled_channels_are_blanks(wire):
    assert wire.line("$02581\r") == "!02\r"
    assert wire.line("#02\r") == ">+0305.5" + " " * 42 + "+0305.5\r"
    assert wire.line("$026\r") == "!0281\r"


def test_configure_format_type_and_address(line, wire):
    assert wire.line("%02050E0682\r") == "!05\r"
    assert wire.line("$052\r") == "!050E0682\r"
    assert wire.line("#050\r") == f">{int(305.5 / 760 * 32767 + 0.5):04X}\r"
    assert line.module(5).model == "adam-4018+"
    assert wire.line("$057C3R10\r") == "!05\r"
    assert wire.line("$058C3\r") == "!05C3R10\r"


@pytest.fixture
def summed(rack, wires, value):
    module = IcpDas("i-7018r", ranges="J", sources={0: value(21.5)})
    line = rack.add(DconLine({1: module}, settings={1: DconSettings(checksum=True)}))
    return line, wires(line.port)


def test_checksum(summed):
    _, wire = summed
    wire.send(b"$012\r")
    wire.send(b"$012B8\r")
    assert wire.line("$012B7\r") == "!010E0640" + f"{sum(b'!010E0640') & 0xFF:02X}\r"
    assert wire.line("$01M" + f"{sum(b'$01M') & 0xFF:02X}\r")[:-3] == "!017018R"


def test_checksum_fault(summed):
    line, wire = summed
    line.module(1).faults.set("bad_crc", times=1)
    bad, good = wire.line("$012B7\r"), wire.line("$012B7\r")
    assert bad[:-3] == good[:-3]
    assert bad[-3:-1] != good[-3:-1]


def test_checksum_can_be_switched_with_the_init_pin(rack, wires, value):
    module = IcpDas("i-7018r", ranges="J", sources={})
    line = rack.add(DconLine({1: module}, settings={1: DconSettings(init_grounded=True)}))
    wire = wires(line.port)
    wire.line("%01010E0640\r")
    wire.send(b"$012\r")
    assert wire.line("$012B7\r").startswith("!010E0640")


@pytest.mark.parametrize(
    ("fault", "parameters", "heard"),
    [
        ("silence", {}, "!024018P\r"),
        ("exception", {}, "?01\r!024018P\r"),
        ("wrong_length", {}, "!017018\r!024018P\r"),
        ("truncate", {}, "!017!024018P\r"),
        ("late", {"delay_s": 0.02}, "!024018P\r!017018R\r"),
        ("split", {"pause_s": 0.002}, "!0170!024018P\r18R\r"),
        ("join", {}, "!017018R\r!024018P\r"),
    ],
)
def test_faults(line, wire, fault, parameters, heard):
    line.module(1).faults.set(fault, times=1, **parameters)
    wire.send(b"$01M\r$02M\r")
    assert wire.receive(len(heard)).decode() == heard


def test_garbage(line, wire):
    line.module(1).faults.set("garbage", times=1)
    wire.send(b"$01M\r")
    assert wire.receive(9) != b"!017018R\r"
    assert wire.line("$01M\r") == "!017018R\r"


def test_bad_crc_needs_a_checksum(line):
    with pytest.raises(ValueError, match="bad_crc"):
        line.module(1).faults.set("bad_crc")


def test_unplugged_and_back(line, wire, wires):
    path = line.port
    line.module(2).faults.set("disconnect")
    with pytest.raises(FileNotFoundError):
        os.open(path, os.O_RDWR | os.O_NOCTTY)
    line.module(2).faults.clear()
    assert wires(path).line("$01M\r") == "!017018R\r"


def test_a_tcp_module_does_not_speak_dcon():
    with pytest.raises(ValueError, match="adam-6018 does not support DCON"):
        DconLine({1: Adam("adam-6018", sources={})})
