"""Base classes of the families: settings of a module, its verification, and the poll of a Modbus module."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Generic, TypeVar

import msgspec

from drivers.errors import DeviceRefused
from drivers.lines.capancdt_link import CapancdtLink
from drivers.lines.dcon_line import DconLine
from drivers.lines.modbus_line import ModbusLine, ModbusMember, ModbusRefused
from drivers.lines.shared_line import LineMember
from drivers.protocols.modbus import READ_COILS, Request, fence_for
from drivers.reading import Device, Reading
from drivers.settings import Name, Where

LOG = logging.getLogger(__name__)

CheckT = TypeVar("CheckT")

MODBUS = ("modbus-tcp", "modbus-rtu", "modbus-rtu-over-tcp")
MODBUS_TCP = ("modbus-tcp",)

# Exceptions by which a device reports that it does not have the register.
_NOT_THERE = {1, 2, 3}


class DeviceSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys that every `[[device]]` table has.

    Parameters
    ----------
    name, line, model : str
        Name of the device, name of its line, and its model.
    inputs : list of dict
        One table for each input read.
    """

    name: Name
    line: Name
    model: Name
    inputs: list[dict[str, object]]


class ModbusSettings(DeviceSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a Modbus module.

    Parameters
    ----------
    address : int
        Unit id, 1..247.
    verify : bool
        Whether, after connecting, the module's own settings are compared with these.
    """

    address: Annotated[int, msgspec.Meta(ge=1, le=247)]
    verify: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """A model that can be configured.

    Parameters
    ----------
    protocols : tuple of str
        Protocols of the lines that it supports.
    kind : type
        Class of its settings.
    make : callable
        Makes the device from settings, line and place in the configuration; opens nothing.
    """

    protocols: tuple[str, ...]
    kind: type[DeviceSettings]
    make: Callable[[Any, Any, Where], Device]


Line = ModbusLine | DconLine | CapancdtLink


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A setting of a module that must agree with the configuration.

    Parameters
    ----------
    request : Request
        Registers or coils to read.
    expected : Mapping
        Expected value by place in the answer.
    what : str
        Content of the register, as text.
    mask : int
        Bits of the register that are compared.
    words : callable
        Returns a value as text.
    """

    request: Request
    expected: Mapping[int, int]
    what: str
    mask: int = 0xFFFF
    words: Callable[[int], str] = "0x{:02X}".format


class Module(Generic[CheckT]):
    """A module on a shared line, read and verified with exclusive use of the line.

    Parameters
    ----------
    name : str
        Of the device, in the configuration.
    units : Mapping
        Unit of each configured input.
    member : LineMember
        The device on its line.
    checks : sequence
        Settings of the module that are verified after connecting.
    """

    def __init__(self, name: str, units: Mapping[int, str], member: LineMember, checks: Sequence[CheckT]) -> None:
        self._name = name
        self._units = dict(units)
        self._member = member
        self._checks = tuple(checks)
        self._to_check: list[CheckT] = []
        self._checked: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """Name of the device in the configuration."""
        return self._name

    @property
    def units(self) -> Mapping[int, str]:
        """Unit of each configured input."""
        return self._units

    async def read(self) -> Mapping[int, Reading]:
        """Read every configured input once.

        Raises
        ------
        DriverError
            Naming the device, within about twice the line's `timeout_s` from when the device gets the line.
        """
        return await self._member.serve(self._verify_and_poll)

    async def close(self) -> None:
        """Release the line; the last device closes it."""
        await self._member.close()

    async def _verify_and_poll(self) -> dict[int, Reading]:
        """Verify once after each connection or timeout, continuing a verification that ran out of time; then poll."""
        if self._checked != self._member.generation:
            self._to_check = list(self._checks)
            self._checked = self._member.generation
        while self._to_check:
            more = await self._check(self._to_check[0])
            self._to_check.pop(0)
            self._to_check.extend(more)
        return await self._poll()

    async def _check(self, check: CheckT) -> Sequence[CheckT]:
        """Compare one setting of the module with the configuration; return the checks that follow from it."""
        raise NotImplementedError

    async def _poll(self) -> dict[int, Reading]:
        raise NotImplementedError


class ModbusDevice(Module[Check]):
    """A Modbus module that is polled with a fixed set of requests.

    Parameters
    ----------
    config : ModbusSettings
        Its settings.
    line : ModbusLine
        Its line.
    units : Mapping
        Unit of each input.
    polls : sequence of Request
        Read each time; the first one also serves to recognise late answers.
    checks : sequence of Check
        Compared after connecting.
    """

    _member: ModbusMember

    def __init__(
        self,
        config: ModbusSettings,
        line: ModbusLine,
        *,
        units: Mapping[int, str],
        polls: Sequence[Request],
        checks: Sequence[Check] = (),
    ) -> None:
        checks = checks if config.verify else ()
        self._polls = tuple(polls)
        fence = fence_for((*self._polls, *(check.request for check in checks)))
        super().__init__(config.name, units, line.join(config.name, config.address, fence), checks)
        self._absent: list[Check] = []
        self._absent_on: int | None = None

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Convert the answers to the polls to readings."""
        raise NotImplementedError

    async def _poll(self) -> dict[int, Reading]:
        return self.readings([await self._request(request) for request in self._polls])

    async def _request(self, request: Request) -> list[int]:
        if request.function == READ_COILS:
            return [int(bit) for bit in await self._member.bits(request)]
        return await self._member.registers(request)

    async def _check(self, check: Check) -> Sequence[Check]:
        # On a serial line a refusal puts the device out of sync, after which it is verified again: what it does not
        # have would be asked for at every read.
        if self._absent_on != self._member.line.generation:
            self._absent, self._absent_on = [], self._member.line.generation
        if check in self._absent:
            return ()
        try:
            answer = await self._request(check.request)
        except ModbusRefused as error:
            if error.exception_code not in _NOT_THERE:
                raise
            LOG.info("%s: %s cannot be verified: %s", self._name, check.what, error.message)
            self._absent.append(check)
            return ()
        for place, expected in check.expected.items():
            found = answer[place] & check.mask
            if found != expected:
                kind = "coil" if check.request.function == READ_COILS else "register"
                raise DeviceRefused(
                    self._name,
                    f"{check.what} in {kind} {check.request.address + place} is {check.words(found)}, "
                    f"the configuration expects {check.words(expected)}",
                )
        return ()
