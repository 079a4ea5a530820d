"""Micro-Epsilon capaNCDT 6200: displacement blocks on a data port, commands on a Telnet port.

Source: Micro-Epsilon capaNCDT 6200 operating instructions, "Ethernet Interface".
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping

from sim_hardware.wire.capancdt_block import FULL_SCALE, block, raw
from sim_hardware.wire.capancdt_command import WRONG, Controller
from sim_hardware.wire.capancdt_connections import CommandConnection, DataConnection
from sim_hardware.wire.faults import Layers, Parameters, number
from sim_hardware.wire.module import Source
from sim_hardware.wire.outlet import BYTE_FAULTS
from sim_hardware.wire.rack import Server
from sim_hardware.wire.tcp_port import TcpPort

CAPANCDT_FAULTS = BYTE_FAULTS | {"exception", "wrong_length", "disconnect", "stale_counter", "gap"}
SHORTEST_TICK_S = 0.01
DRAIN_S = 2.0


class CapaNcdt(Server):
    """Serve a displacement controller.

    Only the client that has been connected to the data port longest is sent values; others receive nothing.
    Faults act on the data port, "exception" and "silence" on the command port too.

    Parameters
    ----------
    channels : Mapping[int, Source]
        Source of each channel, µm from the near end of the range; channels count from 1, up to 4.
    ranges : float or Mapping[int, float]
        Measuring range, of all channels or of each, µm.
    realtime : bool
        Whether the controller streams with its own sample time. Otherwise blocks are sent only by `push`.
    data_port, command_port : int
        Port numbers; 0 takes a free one.

    Raises
    ------
    ValueError
        If a channel does not exist or has no range.
    """

    def __init__(
        self,
        channels: Mapping[int, Source],
        ranges: float | Mapping[int, float],
        *,
        realtime: bool = False,
        data_port: int = 0,
        command_port: int = 0,
    ) -> None:
        super().__init__()
        if not channels or not all(1 <= n <= 4 for n in channels):
            raise ValueError(f"channels {sorted(channels)}: at least one of 1..4 is needed")
        if isinstance(ranges, (int, float)):
            ranges = dict.fromkeys(channels, float(ranges))
        if set(ranges) != set(channels):
            raise ValueError(f"ranges are given for {sorted(ranges)}, channels for {sorted(channels)}")
        self._channels = dict(sorted(channels.items()))
        self.controller = Controller(ranges_um=dict(ranges))
        self.counter = 0
        self._realtime = realtime
        self._layers = Layers(self.faults)
        self._last: dict[int, int] = {}
        self._data = TcpPort(data_port, DataConnection)
        self._commands = TcpPort(command_port, self._accept_command)
        self._stream: asyncio.Task[None] | None = None
        self.watch(self.faults, supported=CAPANCDT_FAULTS)

    @property
    def host(self) -> str:
        """Address of both ports."""
        return self._data.host

    @property
    def data_port(self) -> int:
        """Number of the data port."""
        return self._data.port

    @property
    def command_port(self) -> int:
        """Number of the command port."""
        return self._commands.port

    def push(self, n_frames: int = 4) -> None:
        """Measure `n_frames` times and send them as one block.

        Returns when the block has been handed to the client's socket, or at once if there is no client or the
        controller waits for a trigger.

        Raises
        ------
        TimeoutError
            If the client does not read.
        """
        self.rack.run(self._push(n_frames))

    def wait_for_client(self, timeout_s: float = 5.0) -> None:
        """Wait until a client is connected to the data port.

        Raises
        ------
        TimeoutError
            If none comes.
        """

        async def arrived() -> None:
            while not self._data.connections:
                await asyncio.sleep(0.001)

        self.rack.run(asyncio.wait_for(arrived(), timeout_s))

    async def start(self) -> None:
        """Listen on both ports, and start the stream if it runs by itself."""
        await self.apply_faults()
        self.controller.data_port = self._data.port
        if self._realtime:
            self._stream = asyncio.get_running_loop().create_task(self._run())
            self._stream.add_done_callback(self._stream_ended)

    async def stop(self) -> None:
        """Close both ports."""
        if self._stream is not None:
            self._stream.cancel()
            self._stream = None
        await self._data.close()
        await self._commands.close()

    async def apply_faults(self) -> None:
        """Refuse connections while "disconnect" is on."""
        for port in (self._data, self._commands):
            await (port.refuse() if self.faults.active("disconnect") else port.listen())

    def execute(self, command: str) -> str:
        """Return the answer to a command of the Telnet port, without the echo."""
        if self._layers.use("exception") is not None:
            return WRONG
        answer = self.controller.answer(command)
        if self.controller.single_requests:
            self.controller.single_requests = 0
            self._send(1)
        return answer

    def _accept_command(self, port: TcpPort) -> CommandConnection:
        return CommandConnection(port, self.execute, lambda: self.faults.active("silence"))

    async def _push(self, n_frames: int) -> None:
        # A client may have connected a moment ago, and be waiting for the loop to accept it.
        while self._data.pending():
            await asyncio.sleep(0)
        for _ in range(3):
            await asyncio.sleep(0)
        if self.controller.streaming:
            self._send(n_frames)
        client = next(iter(self._data.connections), None)
        if isinstance(client, DataConnection):
            await asyncio.wait_for(client.drained(), DRAIN_S)

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            period_s = self.controller.sample_time_us * 1e-6
            await asyncio.sleep(max(period_s, SHORTEST_TICK_S))
            n_frames = int((loop.time() - due_s) / period_s)
            due_s += n_frames * period_s
            if n_frames > 0 and self.controller.streaming:
                self._send(n_frames)

    def _stream_ended(self, stream: asyncio.Task[None]) -> None:
        error = None if stream.cancelled() else stream.exception()
        if error is not None:
            self.rack.errors.append(error)

    def _send(self, n_frames: int) -> None:
        frames = [[self._measure(channel) for channel in self._channels] for _ in range(n_frames)]
        lost = self._layers.use("gap")
        if lost is not None:
            self.counter += int(number(lost, "frames", n_frames))
        data = block(self._channels, frames, self.counter)
        if self._layers.use("stale_counter") is None:
            self.counter += n_frames
        client = next(iter(self._data.connections), None)
        if not isinstance(client, DataConnection):
            return
        if self._layers.use("wrong_length") is not None:
            # The header announces one value more than follows.
            data = data[:-4]
        client.outlet.send(data, self._layers)

    def _measure(self, channel: int) -> int:
        faults = self.faults.of_input(channel)
        if "frozen" in faults and channel in self._last:
            return self._last[channel]
        self._last[channel] = self._convert(channel, faults)
        return self._last[channel]

    def _convert(self, channel: int, faults: Mapping[str, Parameters]) -> int:
        # The stream has no code for a faulty sensor: a missing cable reads as an infinite distance.
        if "open" in faults or "over" in faults:
            return FULL_SCALE
        if "under" in faults:
            return 0
        value_um = number(faults["wild"], "value", 0.0) if "wild" in faults else self._channels[channel]()
        if math.isnan(value_um):
            return FULL_SCALE
        return raw(value_um, self.controller.ranges_um[channel])
