"""Small hand-made devices for the tests of the drivers: Modbus slaves, a DCON bus, a capaNCDT controller.

They know no more than the frames the tests need. Times are short and nothing sleeps where an event can be
waited for.
"""

from __future__ import annotations

import asyncio
import gc
import os
import pty
import struct
import threading
import tty
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import drivers
from tests.service.shared_time import SharedTime


def crc(data: bytes) -> bytes:
    """CRC of an RTU frame, written down independently of the driver's."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            carry = value & 1
            value >>= 1
            if carry:
                value ^= 0xA001
    return struct.pack("<H", value)


class Slave:
    """Registers and coils of one unit; `calls` counts reads, `before` may change values just before one."""

    def __init__(
        self,
        registers: Mapping[tuple[int, int], int] | None = None,
        coils: Mapping[int, int] | None = None,
    ) -> None:
        self.registers = dict(registers or {})
        self.coils = dict(coils or {})
        self.requests: list[tuple[int, int, int]] = []

    def block(self, function: int, address: int, words: list[int]) -> None:
        for place, word in enumerate(words):
            self.registers[function, address + place] = word

    def answer(self, pdu: bytes) -> bytes:
        function, address, count = struct.unpack(">BHH", pdu)
        self.requests.append((function, address, count))
        if function in {1, 2}:
            if any(address + i not in self.coils for i in range(count)):
                return bytes([function | 0x80, 2])
            bits = sum(self.coils[address + i] << i for i in range(count))
            data = bits.to_bytes((count + 7) // 8, "little")
        else:
            if any((function, address + i) not in self.registers for i in range(count)):
                return bytes([function | 0x80, 2])
            words = [self.registers[function, address + i] & 0xFFFF for i in range(count)]
            data = struct.pack(f">{count}H", *words)
        return bytes([function, len(data)]) + data


Fault = Callable[[bytes], bytes | None]

#: A device's time-out, in the time of the loop: it stands still while anything works (`shared_time`).
TIMEOUT_S = 0.5
#: Time of the loop within which a read ends that has lost a reply; below the longest time-out.
BOUND_S = 1.5


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Run drivers and ends on a time that stands still while either works: no reply is late on a busy computer."""
    return {"shared time": lambda: SharedTime().new_loop()}


class ModbusBus:
    """Units behind one end. `faults` are used up one for each request; each turns the frame due into what
    is sent.

    A fault that returns None sends nothing; `held` collects what `hold` keeps back, and goes out before the
    next reply that is sent.
    """

    def __init__(self, units: Mapping[int, Slave], *, rtu: bool) -> None:
        self.units = dict(units)
        self.rtu = rtu
        self.faults: deque[Fault] = deque()
        self.held: list[bytes] = []
        self.frames: list[bytes] = []
        self.asked = asyncio.Event()
        self._rest = b""

    def hold(self, frame: bytes) -> None:
        self.held.append(frame)

    def feed(self, data: bytes) -> bytes:
        """Take received bytes, return what is to be sent."""
        out = b""
        self._rest += data
        while (size := 8 if self.rtu else 12) <= len(self._rest):
            frame, self._rest = self._rest[:size], self._rest[size:]
            self.frames.append(frame)
            self.asked.set()
            reply = self._reply(frame)
            if reply is not None:
                fault = self.faults.popleft() if self.faults else None
                reply = fault(reply) if fault else reply
            if reply:
                out += b"".join(self.held) + reply
                self.held.clear()
        return out

    def _reply(self, frame: bytes) -> bytes | None:
        if self.rtu:
            assert crc(frame[:-2]) == frame[-2:]
            unit, pdu = frame[0], frame[1:-2]
        else:
            unit, pdu = frame[6], frame[7:]
        if unit not in self.units:
            return None
        answer = self.units[unit].answer(pdu)
        if self.rtu:
            return bytes([unit]) + answer + crc(bytes([unit]) + answer)
        return frame[:4] + struct.pack(">HB", len(answer) + 1, unit) + answer


class TcpEnd:
    """A TCP port in front of something with `feed`."""

    def __init__(self, feed: Callable[[bytes], bytes]) -> None:
        self.feed = feed
        self.port = 0
        self.connections = 0
        self._server: asyncio.Server | None = None
        self.writers: list[asyncio.StreamWriter] = []
        self._tasks: list[Any] = []

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._tasks.append(asyncio.current_task())
        self.writers.append(writer)
        try:
            while data := await reader.read(4096):
                if out := self.feed(data):
                    writer.write(out)
        except OSError:
            pass
        finally:
            writer.close()

    def drop(self) -> None:
        for writer in self.writers:
            writer.transport.abort()
        self.writers.clear()

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
            self.drop()
            await asyncio.gather(*self._tasks)
            await self._server.wait_closed()
            self._server = None


class PtyEnd:
    """A pseudo-terminal in front of something with `feed`; its path is a link, so that it can come back."""

    def __init__(self, feed: Callable[[bytes], bytes], link: str) -> None:
        self.feed = feed
        self.link = link
        self.master = -1

    def start(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        Path(self.link).symlink_to(os.ttyname(slave))
        self._slave = slave
        asyncio.get_running_loop().add_reader(self.master, self._readable)

    def _readable(self) -> None:
        try:
            data = os.read(self.master, 4096)
        except OSError:
            return
        if out := self.feed(data):
            self.send(out)

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def stop(self) -> None:
        if self.master >= 0:
            asyncio.get_running_loop().remove_reader(self.master)
            Path(self.link).unlink()
            os.close(self._slave)
            os.close(self.master)
            self.master = -1


class Rig:
    """Starts ends and fleets, and closes them after the test."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._ends: list[TcpEnd | PtyEnd] = []
        self._fleets: list[drivers.Fleet] = []

    async def tcp(self, feed: Callable[[bytes], bytes]) -> TcpEnd:
        end = TcpEnd(feed)
        await end.start()
        self._ends.append(end)
        return end

    def pty(self, feed: Callable[[bytes], bytes]) -> PtyEnd:
        end = PtyEnd(feed, f"{self._folder}/port{len(self._ends)}")
        end.start()
        self._ends.append(end)
        return end

    def fleet(self, line: Mapping[str, Any], *devices: Mapping[str, Any]) -> drivers.Fleet:
        tables = [{"name": f"d{index}", "line": "bus", **device} for index, device in enumerate(devices)]
        fleet = drivers.build([{"name": "bus", **line}], tables, source="test")
        self._fleets.append(fleet)
        return fleet

    async def modbus(
        self,
        units: Mapping[int, Slave],
        *devices: Mapping[str, Any],
        rtu: bool = False,
        timeout_s: float = TIMEOUT_S,
    ) -> tuple[ModbusBus, TcpEnd, list[drivers.Device]]:
        """Serve units over TCP and make their devices."""
        bus = ModbusBus(units, rtu=rtu)
        end = await self.tcp(bus.feed)
        protocol = "modbus-rtu-over-tcp" if rtu else "modbus-tcp"
        line = {"protocol": protocol, "host": "127.0.0.1", "tcp_port": end.port, "timeout_s": timeout_s}
        return bus, end, list(self.fleet(line, *devices).devices.values())

    async def stop(self) -> None:
        for fleet in self._fleets:
            await fleet.close()
            await fleet.close()
        for end in self._ends:
            stopping = end.stop()
            if stopping is not None:
                await stopping


@pytest.fixture
async def rig(tmp_path: Any) -> AsyncIterator[Rig]:
    """Serve ends and fleets; forgotten tasks, threads, sockets and ports fail the test that forgot them."""
    threads = threading.active_count()
    made = Rig(str(tmp_path))
    yield made
    await made.stop()
    await asyncio.sleep(0)
    assert not {task.get_name() for task in asyncio.all_tasks() if "capancdt" in task.get_name()}
    assert threading.active_count() <= threads, [thread.name for thread in threading.enumerate()]
    gc.collect()  # what was not closed warns now, and a warning is an error


@pytest.fixture
def slave() -> type[Slave]:
    return Slave


@pytest.fixture
def modbus_bus() -> type[ModbusBus]:
    return ModbusBus
