"""Thermocouple modules that speak DCON (ADAM ASCII): ICP DAS I-7018(R), 7019R, Advantech ADAM-4018+, 4118.

Sources: ICP DAS I-7018 and Advantech ADAM-4000 user's manuals.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping
from typing import Annotated

import msgspec
from msgspec import Meta

from drivers.dcon_line import DconLine
from drivers.dcon_text import (
    CHECKSUM_BIT,
    FORMAT_BITS,
    RANGES_DEGC,
    TYPE_CODES,
    Couple,
    Format,
    Vendor,
    shown,
    split_values,
    to_reading,
)
from drivers.errors import DeviceGarbled, DeviceRefused, DeviceTimeout, DriverConfigError, DriverError
from drivers.family import DeviceSettings, Family
from drivers.reading import Quality, Reading

CHANNELS = 8
READ_TIMEOUTS = 2.0
"""Longest read, in time limits of the line: its own answers and one of another module."""
_CONFIGURATION = re.compile(r"!..([0-9A-F]{2})[0-9A-F]{2}([0-9A-F]{2})")
_CHANNEL_TYPE = re.compile(r"!..C([0-9A-F])R([0-9A-F]{2})")
_DIAGNOSIS = re.compile(r"!..([0-9A-F]{2})")
_TYPE_PER_CHANNEL = re.compile(r"40(15|18P|19)|411[789]|7019|87019")
"""Names of modules that have a type code for each channel; elsewhere there is one for all."""


class DconInput(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One input: its number, and the type of its thermocouple."""

    input: Annotated[int, Meta(ge=0, lt=CHANNELS)]
    couple: Couple = "K"


class DconSettings(DeviceSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `[[device]]` with `model = "dcon"`.

    Parameters
    ----------
    inputs : list of DconInput
        Inputs that are read.
    checksum : bool
        Whether the module is set to checksums.
    format : {"engineering", "percent", "hex"}
        Format of values that the module is set to.
    vendor : {"icpdas", "adam"}
        Whose table of ranges scales percent and hex, and tells what cannot be.
    verify : bool
        Whether checksum, format and type codes are asked of the module before its values are used, and again
        after each loss.
    """

    inputs: Annotated[list[DconInput], Meta(min_length=1, max_length=CHANNELS)]
    checksum: bool = False
    format: Format = "engineering"
    vendor: Vendor = "icpdas"
    verify: bool = True


class DconDevice:
    """Read all inputs of a module by one `#AA`.

    Parameters
    ----------
    settings : DconSettings
        Its table of the configuration.
    line : DconLine
        Line that it hangs on, shared with others.

    Raises
    ------
    DriverConfigError
        If the vendor's modules do not have a couple's type.
    """

    def __init__(self, settings: DconSettings, line: DconLine) -> None:
        offered = RANGES_DEGC[settings.vendor]
        for each in settings.inputs:
            if each.couple not in offered:
                raise DriverConfigError(
                    settings.name,
                    f"input {each.input}: couple = {each.couple!r}, "
                    f"{settings.vendor} modules have {', '.join(offered)}",
                )
        self._settings = settings
        self._line = line
        self._address = f"{settings.address:02X}"
        self._couples: dict[int, Couple] = {each.input: each.couple for each in settings.inputs}
        self._units = dict.fromkeys(self._couples, "degc")
        self._verified = not settings.verify
        self._types_seen: set[int] = set()
        self._diagnoses = True
        self._open: dict[int, bool] = {}

    @property
    def name(self) -> str:
        """Name of the device in the configuration."""
        return self._settings.name

    @property
    def units(self) -> Mapping[int, str]:
        """Unit of each configured input: `degc`."""
        return self._units

    async def read(self) -> Mapping[int, Reading]:
        """Read every configured input once, in °C.

        Returns or raises within twice the time limit of the line.

        Raises
        ------
        DeviceTimeout
            If the module did not answer in time, or the line was busy with others for too long.
        DeviceGarbled
            If its reply is not eight values, or its checksum is wrong.
        DeviceRefused
            If it answers `?AA`, or is set otherwise than configured.
        DeviceDisconnected
            If the port is gone.
        """
        limit_s = READ_TIMEOUTS * self._line.settings.timeout_s
        try:
            async with asyncio.timeout(limit_s):
                return await self._read()
        except TimeoutError:
            raise DeviceTimeout(self.name, f"no turn on its line within {limit_s:g} s") from None
        except DriverError:
            # It may come back as another module, or after somebody has set it.
            self._verified = not self._settings.verify
            raise

    async def close(self) -> None:
        """Do nothing: the line is closed by its owner. May be called twice."""

    async def _read(self) -> Mapping[int, Reading]:
        if not self._verified:
            await self._verify()
            self._verified = True
        settings = self._settings
        reply = await self._ask("#", "")
        texts = split_values(self.name, reply, count=CHANNELS, data_format=settings.format)
        readings = {
            n: to_reading(texts[n], couple=couple, data_format=settings.format, vendor=settings.vendor)
            for n, couple in self._couples.items()
        }
        return await self._tell_open(readings)

    async def _verify(self) -> None:
        reply = await self._ask("$", "2")
        match = _CONFIGURATION.fullmatch(reply)
        if match is None:
            raise DeviceGarbled(self.name, f"reply {shown(reply)} to $AA2 is not type, rate and format")
        code, flags = int(match[1], 16), int(match[2], 16)
        if flags & 0x03 != FORMAT_BITS[self._settings.format]:
            found = next((name for name, bits in FORMAT_BITS.items() if bits == flags & 0x03), "ohms")
            raise DeviceRefused(
                self.name, f"module is set to format {found!r}, not {self._settings.format!r}"
            )
        if bool(flags & CHECKSUM_BIT) != self._settings.checksum:
            is_on = bool(flags & CHECKSUM_BIT)
            raise DeviceRefused(self.name, f"module has checksum {is_on}, not {self._settings.checksum}")
        model = (await self._ask("$", "M"))[3:]
        if _TYPE_PER_CHANNEL.search(model):
            await self._verify_each()
            return
        for number in self._couples:
            self._check_type(number, code)

    async def _verify_each(self) -> None:
        # What has been seen is kept, so that a slow line gets through in more than one read.
        for number in self._couples.keys() - self._types_seen:
            reply = await self._ask("$", f"8C{number:X}")
            match = _CHANNEL_TYPE.fullmatch(reply)
            if match is None or int(match[1], 16) != number:
                raise DeviceGarbled(self.name, f"reply {shown(reply)} to $AA8C{number:X} is no type code")
            self._check_type(number, int(match[2], 16))
            self._types_seen.add(number)
        self._types_seen.clear()

    def _check_type(self, number: int, code: int) -> None:
        couple = self._couples[number]
        wanted = TYPE_CODES[couple]
        if code != wanted:
            found = next((name for name, each in TYPE_CODES.items() if each == code), "no couple")
            raise DeviceRefused(
                self.name,
                f"input {number} has type code {code:02X} ({found}), expected {wanted:02X} ({couple})",
            )

    async def _tell_open(self, readings: dict[int, Reading]) -> dict[int, Reading]:
        """Ask a module that can diagnose its inputs which are open; only when another one has gone off."""
        over = [n for n, reading in readings.items() if reading.quality is Quality.OVER]
        if not over:
            self._open.clear()
            return readings
        if self._diagnoses and any(n not in self._open for n in over):
            bits = await self._diagnose()
            self._open = {n: bool(bits >> n & 1) for n in over}
        for n in over:
            if self._open.get(n):
                readings[n] = Reading.bad(Quality.OPEN, "module reports an open couple or one out of range")
        return readings

    async def _diagnose(self) -> int:
        try:
            reply = await self._line.exchange(
                self.name, f"${self._address}B", checksum=self._settings.checksum, probe=True
            )
        except (DeviceTimeout, DeviceRefused):
            # The values are there all the same: a module that does not know the command is not asked again.
            self._diagnoses = False
            return 0
        match = _DIAGNOSIS.fullmatch(reply)
        return int(match[1], 16) if match else 0

    async def _ask(self, lead: str, rest: str) -> str:
        return await self._line.exchange(
            self.name, f"{lead}{self._address}{rest}", checksum=self._settings.checksum
        )


def _make(settings: DconSettings, line: DconLine) -> DconDevice:
    return DconDevice(settings, line)


FAMILIES: list[Family] = [
    Family(model="dcon", protocols=("dcon",), settings=DconSettings, input_count=CHANNELS, make=_make)
]
