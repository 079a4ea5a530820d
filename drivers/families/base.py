"""What the families share: the settings of a module, and the poll of a Modbus module."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec

from drivers.errors import DeviceRefused
from drivers.lines.capancdt_link import CapancdtLink
from drivers.lines.dcon_line import DconLine
from drivers.lines.modbus_line import Member, ModbusLine, ModbusRefused
from drivers.protocols.modbus import READ_COILS, Request, fence_for
from drivers.reading import Device, Reading
from drivers.settings import Name, Where

LOG = logging.getLogger(__name__)

MODBUS = ("modbus-tcp", "modbus-rtu", "modbus-rtu-over-tcp")
MODBUS_TCP = ("modbus-tcp",)

# Exceptions by which a device says that it does not have what it was asked for.
_NOT_THERE = {1, 2, 3}


class DeviceSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys that every `[[device]]` table has.

    Parameters
    ----------
    name, line, model : str
        Name of the device, name of its line, and its model.
    inputs : list of dict
        One table for each input that is read.
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
        Of the lines it can hang on.
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
    """Something a module says of itself that must agree with the configuration.

    Parameters
    ----------
    request : Request
        Registers or coils to read.
    expected : Mapping
        Expected value by place in the answer.
    what : str
        What the register holds, in words.
    mask : int
        Bits of the register that count.
    words : callable
        Puts a value in words.
    """

    request: Request
    expected: Mapping[int, int]
    what: str
    mask: int = 0xFFFF
    words: Callable[[int], str] = "0x{:02X}".format


class ModbusDevice:
    """A Modbus module that is polled with a fixed set of requests.

    Parameters
    ----------
    about : ModbusSettings
        Its settings.
    line : ModbusLine
        The line it hangs on.
    units : Mapping
        Unit of each input.
    polls : sequence of Request
        What is read each time; the first one also serves to tell late answers apart.
    checks : sequence of Check
        What is compared after connecting.
    """

    def __init__(
        self,
        about: ModbusSettings,
        line: ModbusLine,
        *,
        units: Mapping[int, str],
        polls: Sequence[Request],
        checks: Sequence[Check] = (),
    ) -> None:
        self._name = about.name
        self._units = dict(units)
        self._polls = tuple(polls)
        self._checks = tuple(checks) if about.verify else ()
        self._to_check: list[Check] = []
        self._checked: tuple[int, int] | None = None
        everything = (*self._polls, *(check.request for check in self._checks))
        self._member: Member = line.join(about.name, about.address, fence_for(everything))

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
        return await self._member.serve(self._poll)

    async def close(self) -> None:
        """Leave the line; the last device on it closes it."""
        await self._member.close()

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Turn the answers to the polls into readings."""
        raise NotImplementedError

    async def _poll(self) -> dict[int, Reading]:
        await self._verify()
        return self.readings([await self._take(request) for request in self._polls])

    async def _take(self, request: Request) -> list[int]:
        if request.function == READ_COILS:
            return [int(bit) for bit in await self._member.bits(request)]
        return await self._member.registers(request)

    async def _verify(self) -> None:
        """Compare what the module says with the configuration, once after each connecting or silence."""
        if self._checked != self._member.generation:
            self._to_check = list(self._checks)
            self._checked = self._member.generation
        while self._to_check:
            check = self._to_check[0]
            try:
                self._compare(check, await self._take(check.request))
            except ModbusRefused as error:
                if error.exception_code not in _NOT_THERE:
                    raise
                LOG.info("%s: %s cannot be verified: %s", self._name, check.what, error.message)
            self._to_check.pop(0)

    def _compare(self, check: Check, answer: Sequence[int]) -> None:
        """Raise where the module is set otherwise than configured."""
        for place, expected in check.expected.items():
            found = answer[place] & check.mask
            if found != expected:
                kind = "coil" if check.request.function == READ_COILS else "register"
                raise DeviceRefused(
                    self._name,
                    f"{check.what} in {kind} {check.request.address + place} is {check.words(found)}, "
                    f"the configuration expects {check.words(expected)}",
                )
