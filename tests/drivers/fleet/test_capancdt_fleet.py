"""capaNCDT 6200: a controller of two TCP ports, its stream cut and spoilt in every way."""

from __future__ import annotations

import asyncio
import dataclasses
import struct
from collections.abc import AsyncIterator
from typing import Any

import pytest

from drivers import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout, Quality
from drivers.lines import capancdt_link
from tests.drivers.fleet.conftest import BOUND_S, TIMEOUT_S


def block(counter: int, *frames: tuple[int, int]) -> bytes:
    head = struct.pack("<4siiQIHHI", b"MEAS", 2303024, 7, 0b0101, 0, len(frames), 8, counter & 0xFFFFFFFF)
    return head + b"".join(struct.pack("<ii", *frame) for frame in frames)


class Controller:
    """Answers `$CHIm` with echo and banner; what goes out at the data port is up to the test."""

    def __init__(self) -> None:
        self.reply = "ANO2303024,NAMCS02,SNO{},OFS0,RNG2000,UNTumOK"
        self.writers: list[asyncio.StreamWriter] = []
        self.connected = asyncio.Event()
        self.ports = [0, 0]
        self.rest = b""
        self._servers: list[asyncio.Server] = []
        self._tasks: list[Any] = []

    async def start(self) -> None:
        for index, serve in enumerate((self._data, self._command)):
            server = await asyncio.start_server(serve, "127.0.0.1", self.ports[index])
            self.ports[index] = server.sockets[0].getsockname()[1]
            self._servers.append(server)

    async def _data(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._tasks.append(asyncio.current_task())
        self.writers.append(writer)
        self.connected.set()
        try:
            await reader.read()
        except OSError:
            pass
        finally:
            writer.close()

    async def _command(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._tasks.append(asyncio.current_task())
        writer.write(b"Welcome\r\ncapaNCDT DT6200\r\nSerial 7\r\n")
        try:
            while command := await reader.readuntil(b"\r"):
                text = command.decode().strip()
                if self.reply:
                    answer = self.reply.format(text[-1])
                    writer.write(f"{text}\r\n{text}:{answer}\r\n".encode("latin-1"))
        except (asyncio.IncompleteReadError, OSError):
            pass
        finally:
            writer.close()

    def send(self, data: bytes) -> None:
        self.writers[-1].write(data)

    def drop(self) -> None:
        for writer in self.writers:
            writer.transport.abort()
        self.writers.clear()
        self.connected.clear()

    async def stop(self) -> None:
        for server in self._servers:
            server.close()
        self.drop()
        await asyncio.gather(*self._tasks)
        for server in self._servers:
            await server.wait_closed()
        self._servers.clear()


@pytest.fixture
async def controller() -> AsyncIterator[Controller]:
    made = Controller()
    await made.start()
    yield made
    await made.stop()


def device(rig: Any, controller: Controller, timeout_s: float = TIMEOUT_S, **keys: Any) -> Any:
    line = {"protocol": "capancdt", "host": "127.0.0.1", "timeout_s": timeout_s}
    line["data_port"], line["command_port"] = controller.ports
    table = {"model": "capancdt-6200", "inputs": [{"input": 0}, {"input": 1}], **keys}
    return rig.fleet(line, table).devices["d0"]


async def started(rig: Any, controller: Controller, **keys: Any) -> Any:
    """Connect and read a first block; the next counter is 1."""
    made = device(rig, controller, **keys)
    reading = asyncio.create_task(made.read())
    await controller.connected.wait()
    controller.send(block(0, (0x7FFFFF, 100)))
    await reading
    return made


async def test_mean_extremes_and_count(rig: Any, controller: Controller) -> None:
    made = device(rig, controller)
    assert made.units == {0: "um", 1: "um"}
    reading = asyncio.create_task(made.read())
    await controller.connected.wait()
    controller.send(block(0, (0x7FFFFF, 0x400000)) + block(1, (0x7FFFFF, 0x400002)))
    first = await reading
    assert first[0].value == pytest.approx(999.99, abs=0.011)
    assert first[0].count == 2
    one = 2000.0 / 0xFFFFFF
    assert first[1].value == pytest.approx(0x400001 * one, abs=one / 10)
    assert (first[1].minimum, first[1].maximum) == (0x400000 * one, 0x400002 * one)
    controller.send(block(2, (1000, 1)))
    assert (await made.read())[0].value == pytest.approx(1000 * one)  # nothing of the first read is in it


async def test_unit_of_the_controller_counts(rig: Any, controller: Controller) -> None:
    controller.reply = "ANO1,NAMCS02,SNO{},OFS0,RNG0.5,UNTmmOK"
    made = device(rig, controller)
    reading = asyncio.create_task(made.read())
    await controller.connected.wait()
    controller.send(block(0, (0x7FFFFF, 1)))
    assert (await reading)[0].value == pytest.approx(250.0, abs=0.001)


@pytest.mark.parametrize(
    ("value", "quality"),
    [(0, Quality.UNDER), (-5, Quality.UNDER), (0xFFFFFF, Quality.OVER), (0x1000000, Quality.OVER)],
)
async def test_ends_of_the_converter(rig: Any, controller: Controller, value: int, quality: Quality) -> None:
    made = await started(rig, controller)
    controller.send(block(1, (500, 500), (value, 500)))
    readings = await made.read()
    assert readings[0].quality is quality and "1 of 2 values" in readings[0].detail
    assert readings[1].quality is Quality.GOOD and readings[1].count == 2


async def test_gap_is_counted_and_restart_is_not(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller)
    controller.send(block(5, (10, 10)))
    await made.read()
    assert made.lost_frames == 4
    controller.send(block(0xFFFFFFFF, (10, 10)) + block(0, (10, 10)))  # backwards, then over the top
    assert (await made.read())[0].count == 2
    assert made.lost_frames == 4


async def test_counter_that_stands_still(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller)
    controller.send(block(0, (10, 10)) * 3)
    with pytest.raises(DeviceGarbled, match="counter unchanged at 1"):
        await made.read()


async def test_split_joined_and_torn_blocks(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller)
    stream = b"garbage" + block(1, (10, 10)) + b"MEASx" + block(2, (20, 20)) + block(3, (30, 30))[:20]
    for place in range(0, len(stream), 7):
        controller.send(stream[place : place + 7])
        await asyncio.sleep(0)
    values = [reading.count for reading in (await made.read()).values()]
    while values[0] < 2:
        values = [a + b.count for a, b in zip(values, (await made.read()).values(), strict=True)]
    assert values == [2, 2]
    controller.send(block(3, (30, 30))[20:])
    assert (await made.read())[0].count == 1


async def test_garbage_instead_of_blocks(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller)
    controller.send(bytes(range(200)))
    with pytest.raises(DeviceGarbled, match="197 bytes that belong to no block"):
        await made.read()
    controller.send(block(1, (10, 10)))
    assert (await made.read())[0].count == 1


async def test_no_new_frame_is_bounded_and_named(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller)
    began = asyncio.get_running_loop().time()
    with pytest.raises(DeviceTimeout, match=r"d0: no new measurement from 127.0.0.1"):
        await made.read()
    assert TIMEOUT_S - 0.01 < asyncio.get_running_loop().time() - began < BOUND_S
    controller.send(block(1, (10, 10)))
    assert (await made.read())[0].count == 1


async def test_channel_that_is_not_in_the_stream(rig: Any, controller: Controller) -> None:
    made = device(rig, controller, inputs=[{"input": 0}, {"input": 3}])
    reading = asyncio.create_task(made.read())
    await controller.connected.wait()
    controller.send(block(0, (10, 10)))
    with pytest.raises(DeviceRefused, match="channel 4 is not in the stream"):
        await reading


@pytest.mark.parametrize(
    ("reply", "error", "text"),
    [
        ("", DeviceTimeout, r"\$CHI1|no connection"),
        ("ANO1,OFS0,RNG2000,UNTVOK", DeviceGarbled, "unit 'V'"),
        ("ANO1,OFS0,UNTumOK", DeviceGarbled, "no range"),
        ("$WRONG PARAMETER", DeviceRefused, "WRONG"),
    ],
)
async def test_command_port_that_gives_no_range(
    rig: Any, controller: Controller, reply: str, error: Any, text: str
) -> None:
    good, controller.reply = controller.reply, reply
    made = device(rig, controller)
    began = asyncio.get_running_loop().time()
    with pytest.raises(error, match=text):
        await made.read()
    assert asyncio.get_running_loop().time() - began < BOUND_S
    controller.reply = good
    async with asyncio.timeout(30.0):
        await controller.connected.wait()
    controller.send(block(0, (10, 10)))
    while not isinstance((await asyncio.gather(made.read(), return_exceptions=True))[0], dict):
        await asyncio.sleep(0.01)


async def test_lost_connection_heals(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller, timeout_s=2.0)
    waiting = asyncio.create_task(made.read())
    await asyncio.sleep(0)
    controller.drop()
    with pytest.raises(DeviceDisconnected, match="d0: "):
        await asyncio.wait_for(waiting, BOUND_S)
    async with asyncio.timeout(30.0):
        await controller.connected.wait()
    controller.send(block(0, (10, 10)))
    async with asyncio.timeout(30.0):
        while not isinstance((await asyncio.gather(made.read(), return_exceptions=True))[0], dict):
            await asyncio.sleep(0.01)


async def test_controller_gone_and_back(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller)
    await controller.stop()
    for _ in range(3):
        began = asyncio.get_running_loop().time()
        with pytest.raises((DeviceDisconnected, DeviceTimeout)):
            await made.read()
        assert asyncio.get_running_loop().time() - began < BOUND_S
    await controller.start()
    async with asyncio.timeout(30.0):
        await controller.connected.wait()
    controller.send(block(0, (10, 10)))
    async with asyncio.timeout(30.0):
        while not isinstance((await asyncio.gather(made.read(), return_exceptions=True))[0], dict):
            await asyncio.sleep(0.01)


async def test_silent_stream_is_connected_anew(
    rig: Any, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cable pulled out leaves a connection that looks sound for hours."""
    monkeypatch.setattr(capancdt_link, "SILENT_S", 0.05)
    monkeypatch.setattr(capancdt_link, "SILENT_TIMEOUTS", 0.1)
    made = await started(rig, controller)
    controller.connected.clear()
    with pytest.raises(DeviceTimeout):
        await made.read()
    async with asyncio.timeout(30.0):
        await controller.connected.wait()


async def older_s(made: Any, seconds: float) -> None:
    """Wait until a block has come, and let it be that old."""
    link = made._link
    async with asyncio.timeout(BOUND_S):
        while not link._complete():
            await asyncio.sleep(0.001)
    for kept in link._kept.values():
        kept[-1] = dataclasses.replace(kept[-1], time_s=kept[-1].time_s - seconds)


async def test_old_measurements_are_left_out(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller, window_s=5.0)
    controller.send(block(1, (10, 10)))
    await older_s(made, 6.0)
    controller.send(block(2, (30, 30)))
    async with asyncio.timeout(BOUND_S):
        while made._link._next_counter != 3:
            await asyncio.sleep(0.001)
    assert [len(kept) for kept in made._link._kept.values()] == [2, 2]
    assert (await made.read())[0].count == 1


async def test_a_stream_that_has_stopped_has_no_value(
    rig: Any, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its connection stands for a while yet, and the last block before the stop is older than the window."""
    monkeypatch.setattr(capancdt_link, "SILENT_S", 60.0)
    made = await started(rig, controller, window_s=5.0)
    controller.send(block(1, (10, 10)))
    await older_s(made, 6.0)
    with pytest.raises(DeviceTimeout, match="no new measurement"):
        await made.read()
    controller.send(block(2, (30, 30)))
    assert (await made.read())[0].count == 1


async def test_nobody_reads_for_long(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller)
    for counter in range(1, 5001):
        controller.send(block(counter, (10, 10)))
    while (await made.read())[0].count == 0:
        pass
    kept = made._link._kept[0]
    assert kept.maxlen is not None and len(kept) <= kept.maxlen


async def test_close_during_a_read(rig: Any, controller: Controller) -> None:
    made = await started(rig, controller, timeout_s=2.0)
    task = asyncio.create_task(made.read())
    await asyncio.sleep(0)
    await made.close()
    await made.close()
    with pytest.raises(DeviceDisconnected, match="closed"):
        await asyncio.wait_for(task, BOUND_S)
