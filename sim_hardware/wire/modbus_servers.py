"""Modbus over its three carriers: TCP, a serial line, and RTU frames in a TCP stream."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Mapping

from sim_hardware.wire.faults import Faults, Layers
from sim_hardware.wire.modbus import GATEWAY_NO_RESPONSE, answer, crc16
from sim_hardware.wire.module import Module
from sim_hardware.wire.outlet import BYTE_FAULTS, Outlet
from sim_hardware.wire.pty_port import PtyPort
from sim_hardware.wire.rack import Server
from sim_hardware.wire.rtu_frames import RtuFrames
from sim_hardware.wire.tcp_port import Connection, TcpPort

TCP_FAULTS = BYTE_FAULTS | {"exception", "wrong_length", "disconnect"}
RTU_FAULTS = TCP_FAULTS | {"bad_crc"}
MBAP = struct.Struct(">HHHB")
LONGEST_PDU = 253


class _ModbusServer(Server):
    """Base class of the three carriers: modules by unit id, and their faults."""

    def __init__(self, modules: Mapping[int, Module], supported: frozenset[str]) -> None:
        super().__init__()
        self.modules = dict(modules)
        self._layers = {unit: Layers(self.faults, module.faults) for unit, module in modules.items()}
        self._line_only = Layers(self.faults)
        self.watch(self.faults, *self._all_faults(), supported=supported)

    def module(self, unit: int) -> Module:
        """Return the module with a unit id."""
        return self.modules[unit]

    @property
    def _disconnected(self) -> bool:
        return self.faults.active("disconnect") or any(f.active("disconnect") for f in self._all_faults())

    def _all_faults(self) -> list[Faults]:
        return [module.faults for module in self.modules.values()]

    def rtu_reply(self, frame: bytes) -> tuple[bytes, Layers] | None:
        """Return the reply to an RTU request whose CRC is right; None if the line stays silent."""
        unit, pdu = frame[0], frame[1:-2]
        if unit == 0:
            # Broadcast: no module answers.
            for each in self.modules.values():
                answer(each, pdu, Layers())
            return None
        module = self.modules.get(unit)
        if module is None:
            return None
        layers = self._layers[unit]
        reply = bytes((unit,)) + answer(module, pdu, layers)
        crc = crc16(reply)
        if not layers.quiet and layers.use("bad_crc") is not None:
            crc = bytes((crc[0] ^ 0xFF, crc[1]))
        return reply + crc, layers

    def tcp_reply(self, unit: int, pdu: bytes) -> tuple[bytes, Layers]:
        """Return the reply PDU to a Modbus TCP request."""
        module = self.modules.get(unit)
        if module is None and unit in {0, 255} and len(self.modules) == 1:
            # Devices that are their own end point take these two unit ids as "you".
            (unit,) = self.modules
            module = self.modules[unit]
        if module is None:
            return bytes((pdu[0] | 0x80, GATEWAY_NO_RESPONSE)), self._line_only
        return answer(module, pdu, self._layers[unit]), self._layers[unit]


class _OneTcpPort(_ModbusServer):
    """A Modbus server behind one TCP port."""

    def __init__(self, modules: Mapping[int, Module], supported: frozenset[str], port: int) -> None:
        super().__init__(modules, supported)
        self._port = TcpPort(port, self._accept)

    @property
    def host(self) -> str:
        """Address that the server listens on."""
        return self._port.host

    @property
    def port(self) -> int:
        """Port that the server listens on."""
        return self._port.port

    @property
    def connections(self) -> int:
        """Number of open connections."""
        return len(self._port.connections)

    async def start(self) -> None:
        """Listen."""
        await self._port.listen()
        await self.apply_faults()

    async def stop(self) -> None:
        """Close the port and all connections."""
        await self._port.close()

    async def apply_faults(self) -> None:
        """Refuse connections while "disconnect" is on."""
        if self._disconnected:
            await self._port.refuse()
        else:
            await self._port.listen()

    def _accept(self, port: TcpPort) -> Connection:
        raise NotImplementedError


class ModbusTcpServer(_OneTcpPort):
    """Serve modules by Modbus TCP.

    A unit id without a module is answered with exception 0B, as a gateway does whose target is silent.

    Parameters
    ----------
    modules : Mapping[int, Module]
        Modules by unit id.
    port : int
        Port number; 0 takes a free one.
    """

    def __init__(self, modules: Mapping[int, Module], *, port: int = 0) -> None:
        super().__init__(modules, TCP_FAULTS, port)

    def _accept(self, port: TcpPort) -> Connection:
        return _MbapConnection(port, self)


class ModbusRtuTcpServer(_OneTcpPort):
    """Serve modules by RTU frames in a TCP stream, as behind a transparent serial gateway.

    Parameters
    ----------
    modules : Mapping[int, Module]
        Modules by unit id; other ids are met with silence.
    port : int
        Port number; 0 takes a free one.
    """

    def __init__(self, modules: Mapping[int, Module], *, port: int = 0) -> None:
        super().__init__(modules, RTU_FAULTS, port)

    def _accept(self, port: TcpPort) -> Connection:
        return _RtuConnection(port, self)


class ModbusRtuLine(_ModbusServer):
    """Serve modules by Modbus RTU on a serial line; unit ids without a module get no reply.

    Parameters
    ----------
    modules : Mapping[int, Module]
        Modules by unit id.
    baud : float, optional
        Pace of the replies; without it they come at once.
    """

    def __init__(self, modules: Mapping[int, Module], *, baud: float | None = None) -> None:
        super().__init__(modules, RTU_FAULTS)
        self._pty = PtyPort(self._received, baud)
        self._outlet: Outlet | None = None
        self._frames: RtuFrames | None = None

    @property
    def port(self) -> str:
        """Path of the serial port to open."""
        return self._pty.path

    async def start(self) -> None:
        """Open the line."""
        loop = asyncio.get_running_loop()
        self._pty.open()
        self._outlet = Outlet(loop, self._pty.write)
        self._frames = RtuFrames(loop, self._frame)
        await self.apply_faults()

    async def stop(self) -> None:
        """Close the line."""
        if self._outlet is not None and self._frames is not None:
            self._outlet.close()
            self._frames.close()
        self._pty.close()

    async def apply_faults(self) -> None:
        """Unplug the line while "disconnect" is on."""
        if self._disconnected:
            self._pty.unplug()
        else:
            self._pty.plug()

    def _received(self, data: bytes) -> None:
        assert self._frames is not None
        self._frames.feed(data)

    def _frame(self, frame: bytes) -> None:
        assert self._outlet is not None
        reply = self.rtu_reply(frame)
        if reply is not None:
            self._outlet.send(*reply)


class _MbapConnection(Connection):
    def __init__(self, port: TcpPort, server: _ModbusServer) -> None:
        super().__init__(port)
        self._server = server
        self._buffer = b""
        self._outlet = Outlet(asyncio.get_running_loop(), self.write)

    def data_received(self, data: bytes) -> None:
        buffer = self._buffer + data
        while len(buffer) >= MBAP.size:
            transaction, protocol, length, unit = MBAP.unpack_from(buffer)
            if protocol != 0 or not 2 <= length <= LONGEST_PDU + 1:
                # Not Modbus: there is no way to find the next frame in this stream.
                if self.transport is not None:
                    self.transport.abort()
                return
            if len(buffer) < 6 + length:
                break
            reply, layers = self._server.tcp_reply(unit, buffer[MBAP.size : 6 + length])
            self._outlet.send(MBAP.pack(transaction, 0, len(reply) + 1, unit) + reply, layers)
            buffer = buffer[6 + length :]
        self._buffer = buffer

    def closed(self) -> None:
        self._outlet.close()


class _RtuConnection(Connection):
    def __init__(self, port: TcpPort, server: _ModbusServer) -> None:
        super().__init__(port)
        loop = asyncio.get_running_loop()
        self._server = server
        self._outlet = Outlet(loop, self.write)
        self._frames = RtuFrames(loop, self._frame)

    def data_received(self, data: bytes) -> None:
        self._frames.feed(data)

    def closed(self) -> None:
        self._outlet.close()
        self._frames.close()

    def _frame(self, frame: bytes) -> None:
        reply = self._server.rtu_reply(frame)
        if reply is not None:
            self._outlet.send(*reply)
