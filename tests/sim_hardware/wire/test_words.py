"""Words of the modules against the tables of their makers."""

import struct

import pytest

from sim_hardware.wire import Adam, IcpDas, MoxaE1262, Register, RegisterMap
from sim_hardware.wire.faults import Layers
from sim_hardware.wire.modbus import answer


def ask(module, pdu):
    return answer(module, bytes.fromhex(pdu), Layers(module.faults)).hex()


def word(module, address=0, function=3):
    reply = answer(module, struct.pack(">BHH", function, address, 1), Layers(module.faults))
    assert reply[0] == function, reply.hex()
    return struct.unpack(">H", reply[2:])[0]


@pytest.mark.parametrize(
    ("couple", "degc", "expected"),
    [
        ("J", 760.0, 0x7FFF),
        ("J", -210.0, 0xDCA2),
        ("K", -270.0, 0xE6D0),
        ("T", -270.0, 0xA99A),
        ("E", -270.0, 0xDD71),
        ("N", -270.0, 0xE56B),
        ("L", -200.0, 0xE000),
        ("M", -200.0, 0x8000),
        ("R", 0.0, 0x0000),
    ],
)
def test_icp_hex_is_the_makers_table(couple, degc, expected):
    assert word(IcpDas("m-7018r", ranges=couple, sources={0: lambda: degc})) == expected


@pytest.mark.parametrize(
    ("couple", "degc", "expected"),
    [("K", 1372.0, 13720), ("K", -270.0, 65536 - 2700), ("M", 20.0, 2000), ("J", 21.5, 215)],
)
def test_icp_engineering_counts_tenths(couple, degc, expected):
    module = IcpDas("et-7018z", ranges=couple, sources={0: lambda: degc}, data_format="engineering")
    assert word(module, function=4) == expected


def test_icp_resolves_what_sixteen_bits_resolve(value):
    source = value(25.0)
    module = IcpDas("m-7018r", ranges="K", sources={0: source})
    first = word(module)
    source.value += 0.02
    assert word(module) == first
    source.value += 0.04
    assert word(module) == first + 1


@pytest.mark.parametrize("data_format", ["hex", "engineering"])
def test_icp_open_and_under(data_format, value):
    module = IcpDas("m-7019r", ranges="K", sources={0: value(20.0), 1: value(-271.0)}, data_format=data_format)
    module.faults.set("open", input=0)
    assert (word(module, 0), word(module, 1), word(module, 2)) == (0x7FFF, 0x8000, 0x7FFF)
    # Bits 0, 1 and the unwired rest; function 02 as well as 01.
    assert ask(module, "0200800008") == ask(module, "0100800008").replace("01", "02", 1) == "0201ff"
    module.faults.clear("open", input=0)
    assert ask(module, "0100800008") == "0101fe"


def test_plain_7018_does_not_notice_a_broken_couple():
    module = IcpDas("m-7018", ranges="K", sources={0: lambda: 90.0}, data_format="engineering", cjc_degc=26.0)
    module.faults.set("open", input=0)
    assert word(module) == 260


def test_icp_map(value):
    module = IcpDas("m-7018r", ranges="K", sources={0: value(20.0)}, cjc_degc=25.5)
    assert word(module, 128, 4) == 2550
    assert word(module, 486) == 0x0F
    assert ask(module, "06 01e6 0010") == "0601e60010"
    assert word(module, 486) == 0x10
    assert ask(module, "06 01e6 0099") == "8603"
    assert ask(module, "01 010c 0001") == "010100"
    assert ask(module, "05 010c ff00") == "05010cff00"
    assert word(module) == 200
    assert ask(module, "03 0008 0001") == "8302"
    assert ask(module, "4600") == "460000701800"
    assert ask(module, "4677") == "c602"


def test_et7018z_map(value):
    module = IcpDas("et-7018z", ranges={9: "J"}, sources={9: value(100.0)})
    assert ask(module, "04 0140 0001") == "0402000a"
    assert (word(module, 427), word(module, 436), word(module, 559)) == (0x05, 0x0E, 0x7018)
    assert ask(module, "05 0277 ff00") == "050277ff00"
    assert word(module, 9, 4) == 1000
    assert ask(module, "05 025c 0000") == "05025c0000"
    assert word(module, 9, 4) == 0
    assert ask(module, "03 0000 0001") == "8302"


def test_icp_volts_stop_at_their_limits(value):
    source = value(-10.0)
    module = IcpDas("m-7017", ranges="10V", sources={0: source})
    assert word(module) == 0x8000
    source.value = 12.0
    assert word(module) == 0x7FFF
    module.data_format = "engineering"
    assert word(module) == 10000
    source.value = 1.2345
    assert word(module) == 1234


@pytest.mark.parametrize(
    ("couple", "degc", "raw"), [("T", 23.79, 16225), ("T", 7.49, 14089), ("K", 20.82, 996), ("K", -5.0, 0)]
)
def test_adam_words_are_unsigned(couple, degc, raw):
    assert word(Adam("adam-4118", ranges=couple, sources={0: lambda: degc})) == raw


def test_adam_k_step_is_21_millikelvin(value):
    source = value(996 * 1370 / 65535)
    module = Adam("adam-6018", ranges="K", sources={0: source})
    source.value += 0.0100
    assert word(module) == 996
    source.value += 0.0010
    assert word(module) == 997


def test_adam_map(value):
    module = Adam("adam-4018+", ranges="K", sources={i: value(20.0) for i in range(7)})
    module.faults.set("open", input=2)
    module.faults.set("over", input=3)
    module.faults.set("under", input=4)
    assert [word(module, i) for i in (2, 3, 4, 7)] == [0xFFFF, 0xFFFF, 0, 0xFFFF]
    assert ask(module, "01 0000 0008") == "010184"
    assert ask(module, "03 00c8 0002") == "0304000f000f"
    assert ask(module, "10 00c8 0002 04 0010 000e") == "1000c80002"
    assert ask(module, "03 00c8 0002") == "03040010000e"
    assert ask(module, "03 00d2 0002") == "030440185000"
    assert ask(module, "06 00dc 0001") == "0600dc0001"
    assert word(module, 1) == 0
    assert ask(module, "04 0008 0001") == "8402"


def test_adam_volts_are_offset_binary(value):
    source = value(0.0)
    module = Adam("adam-4117", ranges="10V", sources={0: source})
    assert word(module) == 32768
    source.value = -10.0
    assert word(module) == 0
    assert word(Adam("adam-4117", ranges="150mV", sources={0: value(0.0023)})) == 33270
    assert ask(module, "01 0000 0001") == "8102"


def test_adam_in_hundredths(value):
    assert word(Adam("adam-4018+", sources={0: value(42.02)}, hundredths=True)) == 4202


@pytest.mark.parametrize(("order", "expected"), [("big", "04 04 41ac 0000"), ("little", "04 04 0000 41ac")])
def test_moxa_floats(order, expected, value):
    module = MoxaE1262(sources={1: value(21.52)}, word_order=order)
    assert ask(module, "04 0812 0002") == bytes.fromhex(expected).hex()
    whole = ask(module, "04 0802 0002")
    assert whole == ("0404000000d7" if order == "big" else "040400d70000")


def test_moxa_open_and_negative(value):
    module = MoxaE1262(sources={0: value(-1.0)}, open_degc=3276.7)
    assert ask(module, "04 0800 0002") == "0404fffffff6"
    module.faults.set("open", input=0)
    assert ask(module, "04 0800 0002") == "040400007fff"


def test_register_map(value):
    speed, coolant = value(5999.7), value(21.37)
    module = RegisterMap(
        {
            10: Register(source=speed, kind="uint16"),
            20: Register(source=coolant, per_unit=10.0),
            30: Register(source=speed, kind="float32", word_order="little"),
        },
        coils={3: value(1.0)},
        constants={100: 0x1234},
    )
    assert (word(module, 10), word(module, 20), word(module, 100, 4)) == (6000, 214, 0x1234)
    low, high = struct.unpack(">HH", bytes.fromhex(ask(module, "03 001e 0002"))[2:])
    assert struct.unpack(">f", struct.pack(">HH", high, low))[0] == pytest.approx(5999.7)
    assert ask(module, "01 0003 0001") == "010101"
    assert ask(module, "06 000a 0001") == "8602"
    coolant.value = 1e6
    assert word(module, 20) == 0x7FFF
    with pytest.raises(ValueError, match="two registers at address 31"):
        RegisterMap({30: Register(source=speed, kind="int32"), 31: Register(source=speed)})


def test_both_words_of_a_value_come_from_one_conversion():
    ticks = iter(range(10))
    module = RegisterMap({0: Register(source=lambda: float(next(ticks) * 0x10001), kind="uint32")})
    assert [ask(module, "03 0000 0002") for _ in range(2)] == ["030400000000", "030400010001"]


def test_frozen_and_wild(value):
    source = value(20.0)
    module = Adam("adam-4118", ranges="K", sources={0: source})
    before = word(module)
    module.faults.set("frozen", input=0)
    source.value = 30.0
    assert word(module) == before
    module.faults.clear("frozen", input=0)
    assert word(module) == 1435
    module.faults.set("wild", input=0, value=685.0)
    assert word(module) == 32768


@pytest.mark.parametrize(
    "build",
    [
        lambda: Adam("adam-9999", sources={}),
        lambda: Adam("adam-4018+", ranges="N", sources={}),
        lambda: Adam("adam-4018+", sources={8: float}),
        lambda: IcpDas("m-7018r", ranges="10V", sources={}),
    ],
)
def test_what_does_not_exist_is_refused(build):
    with pytest.raises(ValueError):
        build()


@pytest.mark.parametrize(
    ("pdu", "code"),
    [("07", 1), ("03 0000 0000", 3), ("03 0000 007e", 3), ("03 0000", 3), ("05 0100 1234", 3), ("16 00", 1)],
)
def test_refusals(pdu, code, value):
    request = bytes.fromhex(pdu)
    assert ask(IcpDas("m-7018r", sources={}), pdu) == bytes((request[0] | 0x80, code)).hex()
