"""The three carriers of Modbus, byte by byte, and every fault on them."""

import contextlib
import os
import socket
import time

import pytest

from sim_hardware.wire import Adam, IcpDas, ModbusRtuLine, ModbusRtuTcpServer, ModbusTcpServer
from sim_hardware.wire.modbus import crc16

READ_ONE = "010300000001"


def module(value=21.5):
    return Adam("adam-6018", ranges="K", sources={0: lambda: value})


def request(transaction, pdu="0300000001", unit=1):
    body = bytes((unit,)) + bytes.fromhex(pdu)
    return transaction.to_bytes(2, "big") + b"\0\0" + len(body).to_bytes(2, "big") + body


def reply(transaction):
    return f"{transaction:04x}00000005" + "0103020404"


@pytest.fixture
def tcp(rack):
    return rack.add(ModbusTcpServer({1: module()}))


@pytest.fixture
def wire(tcp, wires):
    return wires(tcp.host, tcp.port)


def rtu(text):
    data = bytes.fromhex(text)
    return data + crc16(data)


def test_tcp_answers_with_the_transaction_asked(wire):
    assert wire.ask(request(0x1234), 11) == reply(0x1234)
    assert wire.ask(request(7, "0300630001"), 9) == "0007000000030183" + "02"
    assert wire.ask(request(8, unit=9), 9) == "000800000003" + "09830b"
    assert wire.ask(request(9, unit=255), 11) == reply(9).replace("0103", "ff03")


def test_tcp_takes_requests_in_pieces_and_together(wire):
    wire.send(request(1)[:5])
    wire.send(request(1)[5:] + request(2))
    assert wire.receive(22).hex() == reply(1) + reply(2)


def test_tcp_drops_who_does_not_speak_modbus(wire):
    wire.send(b"GET / HTTP/1.0\r\n\r\n")
    with contextlib.suppress(ConnectionResetError):
        assert wire.once() == b""


def test_tcp_is_quick(tcp):
    took_s = []
    with socket.create_connection((tcp.host, tcp.port)) as link:
        for _ in range(20):
            started = time.perf_counter()
            for _ in range(50):
                link.sendall(request(1))
                assert len(link.recv(64)) == 11
            took_s.append((time.perf_counter() - started) / 50)
    # 30 000 requests in well under 20 s; on a busy computer some of them, for it does not stop a process all the time.
    assert min(took_s) < 0.002, took_s


@pytest.mark.parametrize(
    ("fault", "parameters", "expected"),
    [
        ("silence", {}, reply(2)),
        ("exception", {"code": 6}, "000100000003018306" + reply(2)),
        ("wrong_length", {}, "000100000003010300" + reply(2)),
        ("truncate", {}, reply(1)[:10] + reply(2)),
        ("late", {"delay_s": 0.02}, reply(2) + reply(1)),
        ("join", {}, reply(1) + reply(2)),
    ],
)
def test_tcp_faults(tcp, wire, fault, parameters, expected):
    tcp.module(1).faults.set(fault, times=1, **parameters)
    wire.send(request(1) + request(2))
    assert wire.receive(len(expected) // 2).hex() == expected
    assert wire.ask(request(3), 11) == reply(3)


def test_tcp_garbage(tcp, wire):
    tcp.faults.set("garbage", times=1)
    got = wire.ask(request(1), 11)
    assert len(got) == 22
    assert got != reply(1)
    assert wire.ask(request(2), 11) == reply(2)


def test_tcp_joined_replies_come_in_one_piece(tcp, wire):
    tcp.faults.set("join", times=1)
    wire.send(request(1))
    assert wire.receive(1, within_s=0.02) == b""
    wire.send(request(2))
    assert wire.once().hex() == reply(1) + reply(2)


def test_tcp_split_reply_comes_in_pieces(tcp, wire):
    pieces = wire.in_pieces(tcp.faults, lambda: wire.send(request(1)), [4, 4, 3])
    assert [len(piece) for piece in pieces] == [4, 4, 3]
    assert b"".join(pieces).hex() == reply(1)


def test_tcp_disconnect_and_return(tcp, wire, wires):
    wire.ask(request(1), 11)
    port = tcp.port
    tcp.module(1).faults.set("disconnect")
    with contextlib.suppress(ConnectionResetError):
        assert wire.once() == b""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((tcp.host, port))
    tcp.module(1).faults.clear("disconnect")
    assert tcp.port == port
    assert wires(tcp.host, port).ask(request(2), 11) == reply(2)


def test_a_refusing_port_stays_reserved(tcp):
    # No connection has been made, so that none in TIME_WAIT keeps the number busy.
    tcp.faults.set("disconnect")
    with socket.socket() as thief, pytest.raises(OSError, match="in use"):
        thief.bind((tcp.host, tcp.port))


def test_the_other_module_is_not_touched(rack, wires):
    server = rack.add(ModbusTcpServer({1: module(), 2: module()}))
    server.module(1).faults.set("exception", code=4)
    wire = wires(server.host, server.port)
    assert wire.ask(request(1), 9)[-4:] == "8304"
    assert wire.ask(request(2, unit=2), 11)[-8:] == "03020404"


def test_what_a_carrier_lacks_is_refused(tcp):
    with pytest.raises(ValueError, match="bad_crc"):
        tcp.module(1).faults.set("bad_crc")
    with pytest.raises(ValueError, match="gap"):
        tcp.faults.set("gap")
    with pytest.raises(ValueError, match="delay_s"):
        tcp.faults.set("late")
    with pytest.raises(ValueError, match="no fault 'opn'"):
        tcp.module(1).faults.set("opn", input=0)


def test_rtu_documented_frame(rack, wires):
    values = {i: (lambda: 100.0) for i in range(8)}
    m7018 = IcpDas("m-7018r", ranges="K", sources=values, data_format="engineering")
    line = rack.add(ModbusRtuLine({1: m7018}))
    wire = wires(line.port)
    got = wire.ask("01 04 00 00 00 08 F1 CC", 21)
    assert got == rtu("010410" + "03e8" * 8).hex()
    assert wire.ask("01 46 00 12 60", 9) == rtu("014600" + "00701800").hex()
    assert wire.ask(rtu("0107"), 5) == rtu("018701").hex()


def test_rtu_line_is_silent_to_strangers_and_garbled_frames(rack, wires):
    line = rack.add(ModbusRtuLine({1: module(), 2: module(137.0)}))
    wire = wires(line.port)
    wire.send(rtu("030300000001"))
    wire.send(rtu(READ_ONE)[:-1] + b"\0")
    assert wire.receive(1, within_s=0.1) == b""
    # On a busy computer the line may not have read these yet, and takes them and the next request for one frame.
    answers = (wire.ask(rtu("020300000001"), 7) for _ in range(3))
    assert next(filter(None, answers)) == rtu("020302199a").hex()
    assert wire.ask(rtu(READ_ONE), 7) == rtu("0103020404").hex()


def test_rtu_broadcast_is_obeyed_and_not_answered(rack, wires):
    line = rack.add(ModbusRtuLine({1: module(), 2: module()}))
    wire = wires(line.port)
    wire.send(rtu("000600dc0001"))
    assert wire.ask(rtu("020300dc0001"), 7) == rtu("0203020001").hex()


def test_rtu_reply_takes_its_time_on_the_wire(rack, wires):
    line = rack.add(ModbusRtuLine({1: module()}, baud=9600))
    wire = wires(line.port)
    started = time.perf_counter()
    wire.ask(rtu("010300000008"), 21)
    assert time.perf_counter() - started >= 21 * 10 / 9600


def test_rtu_bad_crc_and_late_reply(rack, wires):
    line = rack.add(ModbusRtuLine({1: module()}))
    wire = wires(line.port)
    good = rtu("0103020404")
    line.module(1).faults.set("bad_crc", times=1)
    wire.send(rtu(READ_ONE))
    bad = wire.receive(7)
    assert bad[:5] == good[:5]
    assert bad != good
    # The reply to the first request arrives after that to the second: RTU cannot tell them apart.
    line.module(1).faults.set("late", times=1, delay_s=0.03)
    wire.send(rtu(READ_ONE))
    assert wire.ask(rtu("010300630001"), 5) == rtu("018302").hex()
    assert wire.receive(7) == good


def test_rtu_line_is_unplugged_and_returns_under_its_name(rack, wires):
    line = rack.add(ModbusRtuLine({1: module()}))
    path, wire = line.port, wires(line.port)
    line.faults.set("disconnect")
    with pytest.raises(OSError):
        if not os.read(wire.fd, 1):
            raise OSError("end of file")
    with pytest.raises(FileNotFoundError):
        os.open(path, os.O_RDWR | os.O_NOCTTY)
    line.faults.clear()
    assert line.port == path
    assert wires(path).ask(rtu(READ_ONE), 7) == rtu("0103020404").hex()


def test_rtu_client_may_close_and_come_back(rack, wires):
    line = rack.add(ModbusRtuLine({1: module()}))
    fd = os.open(line.port, os.O_RDWR | os.O_NOCTTY)
    os.close(fd)
    assert wires(line.port).ask(rtu(READ_ONE), 7) == rtu("0103020404").hex()


def test_rtu_over_tcp(rack, wires):
    server = rack.add(ModbusRtuTcpServer({1: module()}))
    wire = wires(server.host, server.port)
    wire.send(rtu("090300000001") + rtu(READ_ONE)[:3])
    wire.send(rtu(READ_ONE)[3:])
    assert wire.receive(7) == rtu("0103020404")
    server.module(1).faults.set("bad_crc")
    assert wire.ask(rtu(READ_ONE), 7)[:10] == "0103020404"
    server.faults.set("disconnect")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((server.host, server.port))
