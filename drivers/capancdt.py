"""Micro-Epsilon capaNCDT 6200: capacitive displacement, streamed by the controller itself.

Source: Micro-Epsilon capaNCDT 6200 operating instructions, "Ethernet Interface".
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from drivers.capancdt_stream import BlockReader, ChannelSums, StreamSums, range_um
from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceTimeout
from drivers.family import DeviceSettings, Family, LineSettings
from drivers.reading import Reading

INPUTS = 4
CHUNK = 65536
LONGEST_ANSWER = 4096
DEAD_TIMEOUTS = 3.0
DEAD_S = 1.0
"""Without a byte for this long, and for three time limits, the connection is taken for dead, s."""


class CapaNcdtInput(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One input: its number (channel 1 is input 0), and y = zero_um + polarity × displacement."""

    input: Annotated[int, Meta(ge=0, lt=INPUTS)]
    polarity: Literal[1, -1] = 1
    zero_um: float = 0.0


class CapaNcdtSettings(DeviceSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `[[device]]` with `model = "capancdt-6200"`."""

    inputs: Annotated[list[CapaNcdtInput], Meta(min_length=1, max_length=INPUTS)]


class CapaNcdtLine:
    """Hold where the controller is (`host` is needed); its device keeps the connections."""

    def __init__(self, settings: LineSettings) -> None:
        self._settings = settings
        self._devices: list[CapaNcdt] = []

    @property
    def settings(self) -> LineSettings:
        """Its table of the configuration."""
        return self._settings

    def attach(self, device: CapaNcdt) -> None:
        """Have a device closed together with the line."""
        self._devices.append(device)

    async def close(self) -> None:
        """Close the connections of its device. May be called twice."""
        for device in self._devices:
            await device.close()


class CapaNcdt:
    """Collect the stream in the background, and give mean and extremes of what came since the last read."""

    def __init__(self, settings: CapaNcdtSettings, line: CapaNcdtLine) -> None:
        self._settings = settings
        self._line = line.settings
        self._units = {each.input: "um" for each in settings.inputs}
        self._turn = asyncio.Lock()
        self._news = asyncio.Event()
        self._writer: asyncio.StreamWriter | None = None
        self._task: asyncio.Task[None] | None = None
        self._sums = StreamSums({})
        self._blocks = BlockReader()
        self._heard_s = 0.0
        self._loss = ""
        self._closed = False
        line.attach(self)

    @property
    def name(self) -> str:
        """Name of the device in the configuration."""
        return self._settings.name

    @property
    def units(self) -> Mapping[int, str]:
        """Unit of each configured input: `um`."""
        return self._units

    @property
    def lost_frames(self) -> int:
        """Frames missing in this connection, by the controller's counter."""
        return self._sums.lost_frames

    async def read(self) -> Mapping[int, Reading]:
        """Return mean, minimum, maximum and count of the frames since the last read, µm.

        Waits for a frame if there is none yet. Returns or raises within twice the time limit.

        Raises
        ------
        DeviceTimeout
            If no frame came in time, or the controller does not answer.
        DeviceGarbled
            If what came in time is no measurement, or the channel data cannot be understood.
        DeviceRefused
            If the controller does not have a configured channel.
        DeviceDisconnected
            If the connection was lost or refused; the next read tries again.
        """
        if self._closed:
            raise DeviceDisconnected(self.name, "has been closed")
        async with self._turn:
            await self._check_loss()
            if self._writer is None:
                await self._connect()
            await self._wait()
            self._news.clear()
            readings = self._sums.take([each.input + 1 for each in self._settings.inputs])
        return {each.input: reading for each, reading in zip(self._settings.inputs, readings, strict=True)}

    async def close(self) -> None:
        """Close the connections. May be called twice."""
        self._closed = True
        async with self._turn:
            await self._drop()

    async def _wait(self) -> None:
        limit_s = self._line.timeout_s
        garbled = self._blocks.garbled_bytes
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                await self._news.wait()
        await self._check_loss()
        if self._news.is_set():
            return
        silent_s = asyncio.get_running_loop().time() - self._heard_s
        strange = self._blocks.garbled_bytes - garbled
        if silent_s >= max(DEAD_S, DEAD_TIMEOUTS * limit_s):
            await self._drop()
        if strange:
            raise DeviceGarbled(self.name, f"{strange} bytes in {limit_s:g} s are no measurement")
        raise DeviceTimeout(self.name, f"no measurement within {limit_s:g} s, silent for {silent_s:.1f} s")

    async def _check_loss(self) -> None:
        if self._loss:
            loss, self._loss = self._loss, ""
            await self._drop()
            raise DeviceDisconnected(self.name, loss)

    async def _connect(self) -> None:
        line = self._line
        try:
            async with asyncio.timeout(line.timeout_s):
                ranges_um = await self._ask_ranges()
                reader, self._writer = await asyncio.open_connection(line.host, line.data_port)
        except TimeoutError:
            raise DeviceTimeout(
                self.name, f"{line.host} does not answer within {line.timeout_s:g} s"
            ) from None
        except (OSError, EOFError) as error:
            raise DeviceDisconnected(self.name, f"{line.host}: {error}") from error
        self._sums = StreamSums(
            {
                each.input + 1: ChannelSums(ranges_um[each.input], each.polarity, each.zero_um)
                for each in self._settings.inputs
            }
        )
        self._blocks = BlockReader()
        self._news.clear()
        loop = asyncio.get_running_loop()
        self._heard_s = loop.time()
        self._task = loop.create_task(self._collect(reader), name=f"capancdt-{self.name}")

    async def _collect(self, reader: asyncio.StreamReader) -> None:
        loop = asyncio.get_running_loop()
        loss = "connection closed by the controller"
        try:
            while data := await reader.read(CHUNK):
                self._heard_s = loop.time()
                blocks = self._blocks.feed(data)
                for block in blocks:
                    self._sums.add(block)
                if blocks:
                    self._news.set()
        except OSError as error:
            loss = f"connection lost: {error}"
        self._loss = loss
        self._news.set()

    async def _ask_ranges(self) -> dict[int, float]:
        reader, writer = await asyncio.open_connection(self._line.host, self._line.command_port)
        try:
            return {
                each.input: await self._ask_range(reader, writer, each.input + 1)
                for each in self._settings.inputs
            }
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def _ask_range(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, channel: int
    ) -> float:
        command = f"$CHI{channel}"
        writer.write(f"{command}\r".encode("ascii"))
        text = ""
        # A banner comes before the first answer, and every character sent is echoed.
        while (start := text.find(command)) < 0 or "\n" not in text[start:]:
            data = await reader.read(LONGEST_ANSWER)
            if not data:
                raise EOFError("command connection closed by the controller")
            text += data.decode("utf-8", "replace") if b"\xb5" not in data else data.decode("latin-1")
            if len(text) > LONGEST_ANSWER:
                raise DeviceGarbled(self.name, f"{command}: {len(text)} characters without an answer")
        return range_um(self.name, channel, text[start + len(command) :].partition("\n")[0].strip())

    async def _drop(self) -> None:
        task, self._task = self._task, None
        writer, self._writer = self._writer, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
        if writer is not None:
            writer.transport.abort()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


def _make(settings: CapaNcdtSettings, line: CapaNcdtLine) -> CapaNcdt:
    return CapaNcdt(settings, line)


FAMILIES: list[Family] = [
    Family(
        model="capancdt-6200",
        protocols=("capancdt",),
        settings=CapaNcdtSettings,
        input_count=INPUTS,
        make=_make,
        address_matters=False,
    )
]
