"""The rack: one thread, faults from any thread, errors not lost."""

import threading

import pytest

from sim_hardware.wire import Adam, Faults, ModbusTcpServer, Rack


def test_servers_need_a_running_rack():
    with pytest.raises(RuntimeError, match="not running"):
        Rack().loop  # noqa: B018


def test_everything_runs_in_one_thread(wires, rack):
    threads = set()

    def source():
        threads.add(threading.current_thread().name)
        return 20.0

    for _ in range(3):
        server = rack.add(ModbusTcpServer({1: Adam("adam-6018", sources={0: source})}))
        wires(server.host, server.port).ask("000100000006010300000001", 11)
    assert threads == {"sim-hardware"}


def test_a_source_that_raises_is_heard_of():
    def source():
        raise ZeroDivisionError

    import socket

    with pytest.raises(RuntimeError, match="simulated device failed") as failure, Rack() as rack:
        server = rack.add(ModbusTcpServer({1: Adam("adam-6018", sources={0: source})}))
        with socket.create_connection((server.host, server.port), 2.0) as link:
            link.sendall(bytes.fromhex("000100000006010300000001"))
            link.recv(1)
    assert isinstance(failure.value.__cause__, ZeroDivisionError)


def test_a_fault_may_be_set_by_a_source(wires, rack):
    module = Adam("adam-6018", sources={})

    def source():
        module.faults.set("open", input=1)
        return 21.5

    module.sources[0] = source
    server = rack.add(ModbusTcpServer({1: module}))
    wire = wires(server.host, server.port)
    assert wire.ask("000100000006010300000001", 11)[-4:] == "0404"
    assert "open" in module.faults.of_input(1)


def test_closing_twice_is_harmless():
    rack = Rack()
    with rack:
        rack.add(ModbusTcpServer({1: Adam("adam-6018", sources={})}))
    rack.close()


def test_times_and_clearing():
    faults = Faults()
    faults.set("late", times=2, delay_s=1.0)
    assert [faults.use("late") is not None for _ in range(3)] == [True, True, False]
    faults.set("silence")
    faults.set("open", input=3)
    faults.set("wild", input=3, value=1.0)
    faults.clear("open", input=3)
    assert set(faults.of_input(3)) == {"wild"}
    assert faults.active("silence")
    faults.clear()
    assert not faults.of_input(3)
    assert not faults.any_of_device


@pytest.mark.parametrize("bad", [("open", None), ("silence", 0), ("nonsense", None)])
def test_unknown_faults(bad):
    fault, number = bad
    with pytest.raises(ValueError, match=f"no fault '{fault}'"):
        Faults().set(fault, input=number)
