"""A Modbus line: one connection, shared by its devices, one request at a time.

Faults, and how they are handled:

- *Late answer (RTU).* An RTU frame does not say which request it answers. After a missing, broken or
  refused answer the unit is *out of sync*: before its next request the line first waits until it is quiet,
  then sends a fence (`drivers.protocols.modbus.fence_for`), whose answer differs from all other answers of
  the unit. A device answers in order, so after the fence's answer no late answer is pending. Answers of other
  units differ by their unit id.
- *Late answer (TCP).* Recognised by the transaction number. A stream out of step is disconnected.
- *Dead device.* Its attempts are delayed by a back-off (`drivers.lines.backoff`); the other devices continue.
- *Dead host.* A connection that times out is not attempted again by each waiting device.
"""

from __future__ import annotations

import asyncio
import contextlib

from pymodbus.pdu import ModbusPDU

from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout
from drivers.lines.backoff import Backoff
from drivers.lines.modbus_wire import LostError, ModbusWire, RefusalError
from drivers.lines.settings import SerialLine, TcpLine
from drivers.lines.shared_line import LineMember, SharedLine
from drivers.protocols.modbus import Request, WrongAnswerError, exception_text

# Consecutive timeouts after which a TCP connection is reopened, because its peer may be gone.
MOST_TIMEOUTS = 2


class ModbusRefused(DeviceRefused):
    """An exception reply; `exception_code` is the code in it."""

    def __init__(self, device: str, message: str, exception_code: int) -> None:
        super().__init__(device, message)
        self.exception_code = exception_code


class ModbusMember(LineMember):
    """A device on a Modbus line.

    Parameters
    ----------
    line : ModbusLine
        Its line.
    name : str
        Of the device, for messages.
    address : int
        Unit id, 1..247.
    fence : Request
        Request whose answer is unlike any other of this device.
    """

    line: ModbusLine

    def __init__(self, line: ModbusLine, name: str, address: int, fence: Request) -> None:
        super().__init__(line, name, address)
        self.fence = fence

    async def registers(self, request: Request) -> list[int]:
        """Read registers as unsigned words. Only within `serve`."""
        answer = await self.line.ask(self, request)
        words = list(answer.registers)
        if len(words) != request.count:
            raise DeviceGarbled(self.name, f"asked for {request}, got {len(words)} registers")
        return words

    async def bits(self, request: Request) -> list[bool]:
        """Read coils or discrete inputs. Only within `serve`."""
        answer = await self.line.ask(self, request)
        if len(answer.bits) < request.count:
            raise DeviceGarbled(self.name, f"asked for {request}, got {len(answer.bits)} bits")
        return list(answer.bits[: request.count])


class ModbusLine(SharedLine[ModbusMember]):
    """One Modbus connection and the devices on it.

    Parameters
    ----------
    config : SerialLine or TcpLine
        Settings; nothing is opened before the first request.
    """

    def __init__(self, config: SerialLine | TcpLine) -> None:
        super().__init__(config.timeout_s)
        self.config = config
        self._where = config.port if isinstance(config, SerialLine) else f"{config.host}:{config.tcp_port}"
        self._numbered = config.protocol == "modbus-tcp"
        self._wire: ModbusWire | None = None
        self._backoff = Backoff(config.timeout_s)
        self._no_host_since_s = 0.0
        self._timeouts = 0

    def join(self, name: str, address: int, fence: Request) -> ModbusMember:
        """Add a device to the line."""
        member = ModbusMember(self, name, address, fence)
        self._members.append(member)
        return member

    def close(self) -> None:
        """Close the connection; a waiting request fails at once."""
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    def _backoffs(self, member: ModbusMember) -> list[Backoff]:
        return [member.backoff, self._backoff]

    def _check_turn(self, member: ModbusMember, asked_at_s: float) -> None:
        if self._no_host_since_s > asked_at_s:
            raise DeviceTimeout(member.name, f"no connection to {self._where} within {self.timeout_s} s")

    def _received_at_s(self) -> float | None:
        return self._wire.received_at_s if self._wire is not None else None

    async def _open(self, member: ModbusMember) -> None:
        if member.closed:
            raise DeviceDisconnected(member.name, "is closed")
        if self._wire is not None and self._wire.connected:
            return
        self.close()
        wire = self._wire = ModbusWire(self.config)
        loop = asyncio.get_running_loop()
        try:
            await wire.connect()
        except LostError as error:
            raise DeviceDisconnected(member.name, f"cannot open {self._where}: {error}") from None
        except TimeoutError:
            self._no_host_since_s = loop.time()
            self._backoff.failed(loop.time())
            raise DeviceTimeout(member.name, f"no connection to {self._where} within {self.timeout_s} s") from None
        if self._wire is not wire:  # closed meanwhile
            wire.close()
            raise DeviceDisconnected(member.name, "is closed")
        self._backoff.succeeded()
        self._timeouts = 0
        self.generation += 1

    async def _resynchronise(self, member: ModbusMember) -> None:
        if self._numbered:
            return
        await self._be_quiet()
        # A refusal is an answer as well. If it is the late one, the fence's data still come, and match no request.
        with contextlib.suppress(DeviceRefused):
            await self.ask(member, member.fence)
        member.out_of_sync = False
        member.resynchronisations += 1

    async def ask(self, member: ModbusMember, request: Request) -> ModbusPDU:
        """Send one request and turn its failures into driver errors."""
        wire = self._wire
        if wire is None:
            raise DeviceDisconnected(member.name, "is closed")
        before, member.out_of_sync = member.out_of_sync, True
        try:
            answer = await wire.ask(member.address, request)
        except RefusalError as error:
            self._timeouts = 0
            text = f"{request} of unit {member.address} refused with {exception_text(error.code)}"
            raise ModbusRefused(member.name, text, error.code) from None
        except WrongAnswerError as error:
            if self._numbered:
                self.close()
            raise DeviceGarbled(member.name, str(error)) from None
        except LostError as error:
            self.close()
            raise DeviceDisconnected(member.name, f"{self._where}: {error}") from None
        except TimeoutError:
            self._timeouts += 1
            if self._timeouts >= MOST_TIMEOUTS and self._where_is_tcp:
                self.close()
            text = f"no answer from unit {member.address} on {self._where} within {self.timeout_s} s"
            raise DeviceTimeout(member.name, text) from None
        self._timeouts = 0
        member.out_of_sync = before
        return answer

    @property
    def _where_is_tcp(self) -> bool:
        return isinstance(self.config, TcpLine)
