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
from collections.abc import Awaitable, Callable
from typing import TypeVar

from pymodbus.pdu import ModbusPDU

from drivers.errors import DeviceDisconnected, DeviceGarbled, DeviceRefused, DeviceTimeout, DriverError
from drivers.lines.modbus_wire import LostError, ModbusWire, RefusalError
from drivers.lines.patience import Patience
from drivers.lines.settings import SerialLine, TcpLine
from drivers.protocols.modbus import Request, WrongAnswerError, exception_text

ResultT = TypeVar("ResultT")

# Silence after which a serial line counts as quiet, s. Adapters deliver in pieces up to 16 ms apart.
QUIET_S = 0.02
# A TCP connection that brings nothing this many times in a row is made anew: its other end may be long gone.
MOST_SILENCES = 2


class ModbusRefused(DeviceRefused):
    """An exception reply; `exception_code` is the code in it."""

    def __init__(self, device: str, message: str, exception_code: int) -> None:
        super().__init__(device, message)
        self.exception_code = exception_code


class Member:
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

    def __init__(self, line: ModbusLine, name: str, address: int, fence: Request) -> None:
        self.line = line
        self.name = name
        self.address = address
        self.fence = fence
        self.patience = Patience(line.timeout_s)
        self.unsettled = False
        self.settlings = 0
        self.closed = False

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

    async def serve(self, job: Callable[[], Awaitable[ResultT]]) -> ResultT:
        """Run a job of requests with the line to itself; see `ModbusLine.serve`."""
        return await self.line.serve(self, job)

    @property
    def generation(self) -> tuple[int, int]:
        """Connections and settlings so far; after others the device may be another one."""
        return self.line.generation, self.settlings

    async def close(self) -> None:
        """Leave the line; the last one closes it."""
        self.closed = True
        self.line.left()


class ModbusLine:
    """One Modbus connection and the devices on it.

    Parameters
    ----------
    about : SerialLine or TcpLine
        Settings; nothing is opened before the first request.
    """

    def __init__(self, about: SerialLine | TcpLine) -> None:
        self.about = about
        self.timeout_s = about.timeout_s
        self.generation = 0
        self._where = about.port if isinstance(about, SerialLine) else f"{about.host}:{about.tcp_port}"
        self._numbered = about.protocol == "modbus-tcp"
        self._members: list[Member] = []
        self._lock = asyncio.Lock()
        self._wire: ModbusWire | None = None
        self._patience = Patience(about.timeout_s)
        self._no_host_since_s = 0.0
        self._silences = 0

    def join(self, name: str, address: int, fence: Request) -> Member:
        """Give a device its place."""
        member = Member(self, name, address, fence)
        self._members.append(member)
        return member

    def left(self) -> None:
        """Close the connection when nobody is left."""
        if all(member.closed for member in self._members):
            self.close()

    def close(self) -> None:
        """Close the connection; a waiting request fails at once."""
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    async def serve(self, member: Member, job: Callable[[], Awaitable[ResultT]]) -> ResultT:
        """Run a job of requests of one device, with the line to itself.

        The time limit, twice the line's, runs from when the device gets the line.

        Raises
        ------
        DriverError
            Naming the device.
        """
        loop = asyncio.get_running_loop()
        self._check_patience(member, loop.time())
        asked_at_s = loop.time()
        async with self._lock:
            if self._no_host_since_s > asked_at_s:
                raise DeviceTimeout(member.name, f"no connection to {self._where} within {self.timeout_s} s")
            began_s = loop.time()
            try:
                async with asyncio.timeout(2.0 * self.timeout_s):
                    await self._connect(member)
                    await self._settle(member)
                    result = await job()
            except TimeoutError:
                member.patience.failed(loop.time())
                raise DeviceTimeout(member.name, f"not done within {2.0 * self.timeout_s} s") from None
            except (DeviceTimeout, DeviceGarbled):
                member.patience.failed(loop.time())
                raise
            except DriverError:
                # A gateway may take its time to say that a device is not there.
                slow = loop.time() - began_s > self.timeout_s / 2.0
                if slow:
                    member.patience.failed(loop.time())
                else:
                    member.patience.succeeded()
                raise
        member.patience.succeeded()
        return result

    def _check_patience(self, member: Member, now_s: float) -> None:
        """Refuse quickly while no try is due."""
        if member.closed:
            raise DeviceDisconnected(member.name, "is closed")
        hold_s = max(member.patience.hold_s(now_s), self._patience.hold_s(now_s))
        if hold_s > 0.0:
            failures = max(member.patience.failures, self._patience.failures)
            raise DeviceTimeout(member.name, f"silent {failures} times, next try in {hold_s:.1f} s")

    async def _connect(self, member: Member) -> None:
        """Connect if there is no connection."""
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
        """Make sure that no late answer of this device is left on the line."""
        if self._numbered or not member.unsettled:
            return
        loop = asyncio.get_running_loop()
        give_up_s = loop.time() + self.timeout_s / 2.0
        while self._wire is not None and loop.time() < give_up_s:
            quiet_s = loop.time() - self._wire.heard_at_s
            if quiet_s >= QUIET_S:
                break
            await asyncio.sleep(QUIET_S - quiet_s)
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
