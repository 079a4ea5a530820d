"""The two TCP ports of a capaNCDT controller, kept open by a background task.

The task queries the ranges at the command port, then reads the stream of the data port, and starts again after any
loss. A read waits for new blocks, for a bounded time. Only sums of the values are kept, so memory does not grow between
reads.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Mapping, Sequence

from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout, DriverError
from drivers.lines.settings import CapancdtLine
from drivers.protocols.capancdt import BadReplyError, Block, Blocks, Channel, channel_info
from drivers.protocols.capancdt_sums import Sums, sums

# Between attempts to connect, s: short at first, as after a loose cable.
RETRY_S = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0)
# Time limits and seconds of silence after which a stream is reconnected: the other end may be long gone.
SILENT_TIMEOUTS = 10.0
SILENT_S = 2.0
_MOST_BLOCKS = 2048
_READ_BYTES = 65536


class CapancdtLink:
    """Connections to one controller.

    Parameters
    ----------
    config : CapancdtLine
        Settings; nothing is opened before the first `collect`.
    """

    def __init__(self, config: CapancdtLine) -> None:
        self.config = config
        self.timeout_s = config.timeout_s
        self.lost_frames = 0
        self._channels: tuple[int, ...] = ()
        self._name = config.name
        self._infos: dict[int, Channel] = {}
        self._kept: dict[int, deque[Sums]] = {}
        self._next_counter: int | None = None
        self._repeated = 0
        self._heard = False
        self._blocks = Blocks()
        self._skipped = 0
        self._changed = asyncio.Event()
        self._failure: DriverError | None = None
        self._task: asyncio.Task[None] | None = None
        self._closed = False

    def join(self, name: str, channels: Sequence[int]) -> None:
        """Name the device, for messages, and its channels, from 0."""
        self._name = name
        self._channels = tuple(channels)
        self._kept = {channel: deque(maxlen=_MOST_BLOCKS) for channel in channels}

    async def collect(self, window_s: float) -> Mapping[int, tuple[Channel, list[Sums]]]:
        """Return the sums since the last call; wait for new blocks if there are none.

        Parameters
        ----------
        window_s : float
            What came longer before this call is dropped, s: a stream that has stopped has no present value.

        Raises
        ------
        DriverError
            Nothing new within the time limit, with the reason.
        """
        if self._closed:
            raise DeviceDisconnected(self._name, "is closed")
        wait_s = self.timeout_s
        self._drop_before(asyncio.get_running_loop().time() - window_s)
        if self._task is None or self._task.done():
            # The first call also waits for the connections and the ranges.
            wait_s = 2.0 * self.timeout_s
            self._task = asyncio.create_task(self._keep(), name=f"capancdt {self._name}")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                while not self._complete() and self._failure is None:
                    self._changed.clear()
                    await self._changed.wait()
        if not self._complete():
            raise self._why_nothing(wait_s)
        collected = {channel: (self._infos[channel], list(kept)) for channel, kept in self._kept.items()}
        self._clear()
        return collected

    async def close(self) -> None:
        """Close both ports and end the task."""
        self._closed = True
        self._failure = DeviceDisconnected(self._name, "is closed")
        self._changed.set()
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    def _complete(self) -> bool:
        """Return whether every channel has new values."""
        return all(self._kept[channel] and channel in self._infos for channel in self._channels)

    def _drop_before(self, oldest_s: float) -> None:
        for kept in self._kept.values():
            while kept and kept[0].time_s < oldest_s:
                kept.popleft()

    def _clear(self) -> None:
        for kept in self._kept.values():
            kept.clear()
        self._repeated = 0
        self._skipped = self._blocks.skipped

    def _why_nothing(self, wait_s: float) -> DriverError:
        """Return why nothing new came, in a new object each time, because a raised error keeps its traceback."""
        if self._failure is not None:
            return type(self._failure)(self._name, self._failure.message)
        if self._repeated:
            text = f"{self._repeated} blocks with the counter unchanged at {self._next_counter}"
            self._repeated = 0
            return DeviceGarbled(self._name, text)
        if (skipped := self._blocks.skipped - self._skipped) > 0:
            self._skipped = self._blocks.skipped
            return DeviceGarbled(self._name, f"{skipped} bytes that belong to no block")
        missing = [channel for channel in self._channels if not self._kept[channel]]
        if self._infos and len(missing) < len(self._channels):
            numbers = ", ".join(str(channel + 1) for channel in missing)
            return DeviceRefused(self._name, f"channel {numbers} is not in the stream of the data port")
        if not self._infos:
            return DeviceTimeout(self._name, f"no connection to {self.config.host} within {wait_s} s")
        where = f"{self.config.host}:{self.config.data_port}"
        return DeviceTimeout(
            self._name,
            f"no new measurement from {where} within {wait_s} s (is another client connected to the data port?)",
        )

    async def _keep(self) -> None:
        """Connect and receive, again and again."""
        tries = 0
        while True:
            try:
                self._infos = await self._ask_channels()
                await self._receive()
            except DriverError as error:
                self._failure = error
            except TimeoutError:
                host = self.config.host
                self._failure = DeviceTimeout(self._name, f"no connection to {host} within {self.timeout_s} s")
            except (OSError, ValueError) as error:  # ValueError: a host that is no name
                self._failure = DeviceDisconnected(self._name, f"{self.config.host}: {error}")
            # A controller that accepts connections but sends nothing is retried at growing intervals.
            tries = 0 if self._heard else tries
            self._heard = False
            self._infos = {}
            self._clear()
            self._changed.set()
            await asyncio.sleep(RETRY_S[min(tries, len(RETRY_S) - 1)])
            tries += 1

    async def _ask_channels(self) -> dict[int, Channel]:
        """Query range and unit of each channel at the command port."""
        config = self.config
        async with asyncio.timeout(self.timeout_s):
            reader, writer = await asyncio.open_connection(config.host, config.command_port)
        try:
            infos = {}
            for channel in self._channels:
                infos[channel] = await self._ask_channel(reader, writer, channel)
            return infos
        finally:
            await _shut(writer)

    async def _ask_channel(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, channel: int) -> Channel:
        """Query one channel; the controller counts from 1, echoes the command, and sends a banner first."""
        command = f"$CHI{channel + 1}"
        writer.write(f"{command}\r".encode("ascii"))
        heard = ""
        try:
            async with asyncio.timeout(self.timeout_s):
                while True:
                    heard = (await reader.readuntil(b"\n")).decode("latin-1")
                    start = heard.rfind(f"{command}:")
                    if start >= 0 and heard.rstrip().endswith("OK"):
                        return channel_info(heard[start:])
                    if "WRONG" in heard or "UNKNOWN" in heard or "ERROR" in heard.upper():
                        raise DeviceRefused(self._name, f"{command} answered with {heard.strip()!r}")
        except TimeoutError:
            raise DeviceTimeout(self._name, f"no reply to {command} within {self.timeout_s} s") from None
        except asyncio.IncompleteReadError:
            raise DeviceDisconnected(self._name, f"command port closed the connection at {command}") from None
        except (BadReplyError, asyncio.LimitOverrunError) as error:
            raise DeviceGarbled(self._name, f"{command}: {error}") from None

    async def _receive(self) -> None:
        """Read the stream until it ends."""
        config = self.config
        async with asyncio.timeout(self.timeout_s):
            reader, writer = await asyncio.open_connection(config.host, config.data_port)
        self._failure, self._next_counter, self._blocks, self._skipped = None, None, Blocks(), 0
        loop = asyncio.get_running_loop()
        try:
            while data := await self._more(reader):
                for block in self._blocks.feed(data):
                    self._keep_block(block, loop.time())
                self._changed.set()
        finally:
            await _shut(writer)
        raise DeviceDisconnected(self._name, f"{config.host}:{config.data_port} closed the connection")

    async def _more(self, reader: asyncio.StreamReader) -> bytes:
        """Wait for bytes of the stream, for a limited time."""
        silent_s = max(SILENT_S, SILENT_TIMEOUTS * self.timeout_s)
        try:
            async with asyncio.timeout(silent_s):
                return await reader.read(_READ_BYTES)
        except TimeoutError:
            where = f"{self.config.host}:{self.config.data_port}"
            raise DeviceTimeout(self._name, f"nothing from {where} for {silent_s:g} s, reconnecting") from None

    def _keep_block(self, block: Block, time_s: float) -> None:
        """Keep a block, unless its counter shows that it is not new."""
        if self._next_counter is not None and block.counter != self._next_counter:
            gap = (block.counter - self._next_counter) & 0xFFFFFFFF
            behind = 0x100000000 - gap
            if behind <= block.frames:
                self._repeated += 1
                return
            # A counter that runs backwards is a restarted controller: how many frames were lost is unknown.
            self.lost_frames += gap if gap < 0x80000000 else 0
        self._heard = True
        self._next_counter = (block.counter + block.frames) & 0xFFFFFFFF
        for channel, kept in self._kept.items():
            if values := block.of(channel):
                kept.append(sums(values, time_s))


async def _shut(writer: asyncio.StreamWriter) -> None:
    """Close a connection at once; unsent data is dropped."""
    writer.transport.abort()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
