"""A Modbus line: one connection, shared by its devices, one request at a time.

What can go wrong here, and what is done:

- *Late answer (RTU).* An RTU frame does not say which request it answers. After a missing, broken or
  refused answer the unit is *unsettled*: before its next request the line first waits until it is quiet,
  then asks a fence (`drivers.protocols.modbus.fence_for`), whose answer no other of the unit's answers
  resembles. A device answers in order, so after the fence's answer nothing late is left. Answers of other
  units differ by their unit id.
- *Late answer (TCP).* The transaction number tells. Bytes out of step cost the connection.
- *Dead device.* Its tries are spaced out (`drivers.lines.patience`); the others go on.
- *Dead host.* A connection that does not come about in time is not tried again by every device in turn.
"""

from __future__ import annotations

import asyncio
import contextlib

from pymodbus.pdu import ModbusPDU

from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout
from drivers.lines.modbus_wire import LostError, ModbusWire, RefusalError
from drivers.lines.patience import Patience
from drivers.lines.settings import SerialLine, TcpLine
from drivers.lines.shared_line import Place, SharedLine
from drivers.protocols.modbus import Request, WrongAnswerError, exception_text

# A TCP connection that brings nothing this many times in a row is made anew: its other end may be long gone.
MOST_SILENCES = 2


class ModbusRefused(DeviceRefused):
    """An exception reply; `exception_code` is the code in it."""

    def __init__(self, device: str, message: str, exception_code: int) -> None:
        super().__init__(device, message)
        self.exception_code = exception_code


class Member(Place):
    """One device's place on a line.

    Parameters
    ----------
    line : ModbusLine
        The line it hangs on.
    name : str
        Of the device, for messages.
    address : int
        Unit id, 1..247.
    fence : Request
        Request whose answer can be taken for no other of this device.
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
            raise DeviceGarbled(self.name, f"asked {request}, got {len(words)} registers")
        return words

    async def bits(self, request: Request) -> list[bool]:
        """Read coils or discrete inputs. Only within `serve`."""
        answer = await self.line.ask(self, request)
        if len(answer.bits) < request.count:
            raise DeviceGarbled(self.name, f"asked {request}, got {len(answer.bits)} bits")
        return list(answer.bits[: request.count])


class ModbusLine(SharedLine[Member]):
    """One Modbus connection and the devices on it.

    Parameters
    ----------
    about : SerialLine or TcpLine
        Settings; nothing is opened before the first request.
    """

    def __init__(self, about: SerialLine | TcpLine) -> None:
        super().__init__(about.timeout_s)
        self.about = about
        self._where = about.port if isinstance(about, SerialLine) else f"{about.host}:{about.tcp_port}"
        self._numbered = about.protocol == "modbus-tcp"
        self._wire: ModbusWire | None = None
        self._patience = Patience(about.timeout_s)
        self._no_host_since_s = 0.0
        self._silences = 0

    def join(self, name: str, address: int, fence: Request) -> Member:
        """Give a device its place."""
        member = Member(self, name, address, fence)
        self._places.append(member)
        return member

    def close(self) -> None:
        """Close the connection; a waiting request fails at once."""
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    def _patiences(self, member: Member) -> list[Patience]:
        return [member.patience, self._patience]

    def _check_turn(self, member: Member, asked_at_s: float) -> None:
        if self._no_host_since_s > asked_at_s:
            raise DeviceTimeout(member.name, f"no connection to {self._where} within {self.timeout_s} s")

    def _heard_at_s(self) -> float | None:
        return self._wire.heard_at_s if self._wire is not None else None

    async def _open(self, member: Member) -> None:
        if member.closed:
            raise DeviceDisconnected(member.name, "is closed")
        if self._wire is not None and self._wire.connected:
            return
        self.close()
        wire = self._wire = ModbusWire(self.about)
        loop = asyncio.get_running_loop()
        try:
            await wire.connect()
        except LostError as error:
            raise DeviceDisconnected(member.name, f"cannot open {self._where}: {error}") from None
        except TimeoutError:
            self._no_host_since_s = loop.time()
            self._patience.failed(loop.time())
            raise DeviceTimeout(member.name, f"no connection to {self._where} within {self.timeout_s} s") from None
        if self._wire is not wire:  # closed meanwhile
            wire.close()
            raise DeviceDisconnected(member.name, "is closed")
        self._patience.succeeded()
        self._silences = 0
        self.generation += 1

    async def _settle(self, member: Member) -> None:
        if self._numbered:
            return
        await self._be_quiet()
        # A refusal is an answer as well. If it is the late one, the fence's data still come, and fit nothing.
        with contextlib.suppress(DeviceRefused):
            await self.ask(member, member.fence)
        member.unsettled = False
        member.settlings += 1

    async def ask(self, member: Member, request: Request) -> ModbusPDU:
        """Ask one request and turn what goes wrong into the errors of the drivers."""
        wire = self._wire
        if wire is None:
            raise DeviceDisconnected(member.name, "is closed")
        settled, member.unsettled = member.unsettled, True
        try:
            answer = await wire.ask(member.address, request)
        except RefusalError as error:
            self._silences = 0
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
            self._silences += 1
            if self._silences >= MOST_SILENCES and self._where_is_tcp:
                self.close()
            text = f"no answer from unit {member.address} on {self._where} within {self.timeout_s} s"
            raise DeviceTimeout(member.name, text) from None
        self._silences = 0
        member.unsettled = settled
        return answer

    @property
    def _where_is_tcp(self) -> bool:
        return isinstance(self.about, TcpLine)
