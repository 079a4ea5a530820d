"""DCON modules on a pseudo-terminal: texts, faults, and late replies that carry no address."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import pytest

import drivers
from drivers import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout, Quality
from drivers.lines import backoff
from tests.drivers.fleet.conftest import BOUND_S, TIMEOUT_S

NAMES = {"M": "7018R", "2": "0F0600"}


class Module:
    """Replies by what follows the address: `replies["#"]`, `replies["$M"]`, …"""

    def __init__(self, values: str, *, checksum: bool = False, **replies: str | None) -> None:
        self.replies: dict[str, str | None] = {"#": values, "$M": "7018R", "$2": "0F0600", **replies}
        self.checksum = checksum


class Bus:
    """Modules by address; `faults` and `held` as on the Modbus bus of the other tests."""

    def __init__(self, modules: dict[int, Module]) -> None:
        self.modules = modules
        self.faults: deque[Callable[[bytes], bytes | None]] = deque()
        self.held: list[bytes] = []
        self.commands: list[str] = []
        self._rest = b""

    def hold(self, reply: bytes) -> None:
        self.held.append(reply)

    def feed(self, data: bytes) -> bytes:
        *commands, self._rest = (self._rest + data).split(b"\r")
        out = b""
        for command in commands:
            self.commands.append(command.decode())
            reply = self._reply(command.decode())
            if reply is not None:
                fault = self.faults.popleft() if self.faults else None
                reply = fault(reply) if fault else reply
            if reply:
                out += b"".join(self.held) + reply
                self.held.clear()
        return out

    def _reply(self, command: str) -> bytes | None:
        module = self.modules.get(int(command[1:3], 16))
        if module is None:
            return None
        if module.checksum:
            assert f"{sum(command[:-2].encode()) & 0xFF:02X}" == command[-2:]
            command = command[:-2]
        body = module.replies.get(command[0] + command[3:], "?")
        if body is None:
            return None
        text = f"?{command[1:3]}" if body == "?" else f">{body}" if command[0] == "#" else f"!{command[1:3]}{body}"
        if module.checksum:
            text += f"{sum(text.encode()) & 0xFF:02X}"
        return text.encode() + b"\r"


def values(degc: float) -> str:
    return f"{degc:+07.2f}" * 8


def table(address: int = 1, **keys: Any) -> dict[str, Any]:
    return {"model": "dcon", "address": address, "inputs": [{"input": 0, "couple": "K"}], "verify": False, **keys}


def made(
    rig: Any, modules: dict[int, Module], *tables: dict[str, Any], timeout_s: float = TIMEOUT_S
) -> tuple[Bus, Any, list[drivers.Device]]:
    bus = Bus(modules)
    end = rig.pty(bus.feed)
    line = {"protocol": "dcon", "port": end.link, "timeout_s": timeout_s}
    return bus, end, list(rig.fleet(line, *tables).devices.values())


OLD, NEW = values(11.11), values(22.22)


async def test_engineering_with_everything_a_reply_can_hold(rig: Any) -> None:
    body = "+023.50+9999-0000       -0010.5+1370.0+9999+024.00"
    inputs = [{"input": n, "couple": "K"} for n in range(8)]
    _, _, [device] = made(rig, {1: Module(body)}, table(inputs=inputs))
    readings = await device.read()
    assert [str(readings[n].quality) for n in range(4)] == ["good", "open_circuit", "under_range", "invalid"]
    assert [readings[n].value for n in (0, 4, 5, 7)] == [23.5, -10.5, 1370.0, 24.0]
    assert "switched off" in readings[3].detail
    assert device.units == dict.fromkeys(range(8), "degc")


async def test_checksum_is_sent_and_compared(rig: Any) -> None:
    bus, _, [device] = made(rig, {1: Module(NEW, checksum=True)}, table(checksum=True, verify=True))
    assert (await device.read())[0].value == 22.22
    assert "$012B7" in bus.commands
    bus.faults.append(lambda reply: reply.replace(b"2", b"3", 1))
    with pytest.raises(DeviceGarbled, match="checksum"):
        await device.read()
    assert (await device.read())[0].value == 22.22


@pytest.mark.parametrize(("form", "body"), [("hex", "0148" * 8), ("percent", "+001.00" * 8)])
async def test_other_formats(rig: Any, form: str, body: str) -> None:
    _, _, [device] = made(rig, {1: Module(body)}, table(format=form, vendor="icpdas"))
    assert (await device.read())[0].value == pytest.approx(13.72, abs=0.03)


async def test_diagnosis(rig: Any) -> None:
    inputs = [{"input": n, "couple": "K"} for n in range(3)]
    _, _, [device] = made(rig, {1: Module(NEW, **{"$B": "02"})}, table(diagnose=True, inputs=inputs))
    assert [str(r.quality) for r in (await device.read()).values()] == ["good", "open_circuit", "good"]


@pytest.mark.parametrize(
    ("replies", "text"),
    [
        ({"$2": "0E0600"}, r"type code of input 0 in \$AA2 is 0x0E \(type J\), the configuration expects 0x0F"),
        ({"$2": "0F0602"}, "data format in .* is hex, the configuration expects engineering"),
        ({"$M": "4118", "$8C0": "C0R0E"}, r"in \$AA8C0 is 0x0E \(type J\)"),
    ],
)
async def test_what_the_module_says_must_agree(rig: Any, replies: dict[str, str], text: str) -> None:
    _, _, [device] = made(rig, {1: Module(NEW, **replies)}, table(verify=True))
    with pytest.raises(DeviceRefused, match=text):
        await device.read()


async def test_a_type_of_another_input_is_no_answer(rig: Any) -> None:
    replies = {"$M": "4018P", "$2": "000600", "$8C0": "C1R0F"}
    _, _, [device] = made(rig, {1: Module(NEW, **replies)}, table(verify=True))
    with pytest.raises(DeviceGarbled, match=r"\$AA8C0 answers 'C1R0F', expected C0R"):
        await device.read()


async def test_verification_takes_what_there_is(rig: Any) -> None:
    replies = {"$M": "4018P", "$2": "000600", "$8C0": "C0R0F"}
    bus, _, [one, two] = made(
        rig, {1: Module(NEW, **replies), 2: Module(NEW, **{"$2": "?"})}, *(table(n, verify=True) for n in (1, 2))
    )
    assert (await one.read())[0].value == (await two.read())[0].value == 22.22
    await one.read()
    assert bus.commands == ["$01M", "$012", "$018C0", "#01", "$02M", "$022", "#02", "#01"]


@pytest.mark.parametrize(
    ("fault", "error", "text"),
    [
        (lambda reply: None, DeviceTimeout, r"no reply to '#01' from address 01 on .* within 0.5 s"),
        (lambda reply: reply[:-1], DeviceGarbled, "no valid reply to '#01' in b'>"),
        (lambda reply: reply[:-3] + b"\r", DeviceGarbled, "5 characters|expected"),
        (lambda reply: reply[:-8] + b"\r", DeviceGarbled, "7 values in .* expected 8"),
        (lambda reply: b"\x80\xff\x00\r", DeviceGarbled, "not ASCII"),
        (lambda reply: b"hello\r", DeviceGarbled, "does not begin with"),
        (lambda reply: bytes(range(14, 250)) * 40, DeviceGarbled, "no valid reply"),
        (lambda reply: b"?01\r", DeviceRefused, "address 01 refuses the command"),
        (lambda reply: b"!02\r", DeviceGarbled, "no valid reply"),
    ],
)
async def test_faults_and_the_next_read(rig: Any, fault: Any, error: type[drivers.DriverError], text: str) -> None:
    bus, _, [device] = made(rig, {1: Module(NEW)}, table())
    bus.faults.append(fault)
    began = asyncio.get_running_loop().time()
    with pytest.raises(error, match=text) as caught:
        await device.read()
    assert asyncio.get_running_loop().time() - began < BOUND_S
    assert str(caught.value).startswith("d0: ")
    assert (await device.read())[0].value == 22.22


@pytest.mark.parametrize("lost", [1, 2])
async def test_late_reply_is_not_taken_for_a_later_one(rig: Any, lost: int) -> None:
    bus, _, [device] = made(rig, {1: Module(OLD)}, table())
    bus.faults.extend([bus.hold] * lost)
    for _ in range(lost):
        with pytest.raises(DeviceTimeout):
            await device.read()
    bus.modules[1].replies["#"] = NEW
    assert (await device.read())[0].value == 22.22
    assert not bus.held


async def test_late_reply_is_not_taken_for_another_modules(rig: Any) -> None:
    """The reply of module 1 comes together with that of module 2, and looks just like it."""
    bus, _, [one, two] = made(rig, {1: Module(OLD), 2: Module(NEW)}, table(1), table(2))
    bus.faults.append(bus.hold)
    with pytest.raises(DeviceTimeout):
        await one.read()
    with pytest.raises(DeviceGarbled, match="more than one data reply"):
        await two.read()
    assert (await two.read())[0].value == 22.22
    assert (await one.read())[0].value == 11.11
    del bus.commands[:]
    await two.read()
    assert bus.commands == ["#02"]  # nothing is missing any more, nothing needs confirming


async def test_late_reply_on_a_quiet_line_is_dropped(rig: Any) -> None:
    _, end, [device] = made(rig, {1: Module(NEW)}, table())
    await device.read()
    end.send(f">{OLD}\r".encode())
    assert (await device.read())[0].value == 22.22


async def test_dead_module_does_not_starve_the_others(rig: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "FIRST_WAIT_S", 2.0)
    bus, _, [alive, dead] = made(rig, {1: Module(NEW)}, table(1), table(9))
    for _ in range(8):
        result, reading = await asyncio.gather(dead.read(), alive.read(), return_exceptions=True)
        assert isinstance(result, DeviceTimeout)
        assert isinstance(reading, dict)
    assert sum(command[1:3] == "09" for command in bus.commands) == 3
    bus.modules[9] = Module(NEW)
    async with asyncio.timeout(30.0):
        while isinstance((await asyncio.gather(dead.read(), return_exceptions=True))[0], DeviceTimeout):
            await asyncio.sleep(0.25)


async def test_adapter_unplugged_and_back(rig: Any) -> None:
    threads = threading.active_count()
    _, end, [device] = made(rig, {1: Module(NEW)}, table())
    await device.read()
    end.stop()
    for _ in range(4):
        with pytest.raises(DeviceDisconnected, match="port0"):
            await device.read()
    end.start()
    assert (await device.read())[0].value == 22.22
    # Those of other tests may end meanwhile.
    assert threading.active_count() <= threads


async def test_adapter_unplugged_during_a_command(rig: Any) -> None:
    bus, end, [device] = made(rig, {1: Module(NEW)}, table(), timeout_s=2.0)
    bus.faults.append(lambda reply: asyncio.get_running_loop().call_soon(end.stop) and None)
    began = asyncio.get_running_loop().time()
    with pytest.raises(DeviceDisconnected):
        await device.read()
    assert asyncio.get_running_loop().time() - began < BOUND_S


async def test_close_during_a_read(rig: Any) -> None:
    bus, _, [device] = made(rig, {}, table(), timeout_s=2.0)
    task = asyncio.create_task(device.read())
    while not bus.commands:
        await asyncio.sleep(0)
    await device.close()
    with pytest.raises(DeviceDisconnected, match="closed"):
        await asyncio.wait_for(task, BOUND_S)


async def test_cancelled_read_leaves_the_line_usable(rig: Any) -> None:
    bus, _, [device] = made(rig, {1: Module(OLD)}, table())
    bus.faults.append(bus.hold)
    task = asyncio.create_task(device.read())
    while not bus.held:
        await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    bus.modules[1].replies["#"] = NEW
    assert (await device.read())[0].value == 22.22


async def test_open_couple_is_data(rig: Any) -> None:
    _, _, [device] = made(rig, {1: Module("+9999" * 8)}, table())
    reading = (await device.read())[0]
    assert reading.quality is Quality.OPEN and reading.count == 0 and reading.value != reading.value
