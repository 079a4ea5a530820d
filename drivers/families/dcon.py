"""Thermocouple modules that speak DCON, also called ADAM ASCII.

ICP DAS I-7018, I-7018R, I-7019R; Advantech ADAM-4018, 4018+, 4118.

`#AA` returns all inputs at once. After connecting the module's name, data format and types are compared with
the configuration (`$AAM`, `$AA2`, `$AA8Ci`).

Sources: ICP DAS I-7018 user manual; Advantech ADAM-4000 series user's manual.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec

from drivers.errors import DeviceGarbled, DeviceRefused
from drivers.families.base import DeviceSettings, Family, Module
from drivers.families.inputs import thermocouples
from drivers.lines.dcon_line import DconLine, DconMember
from drivers.protocols.dcon import BadTextError, split_values, thermocouple
from drivers.protocols.thermocouples import ADVANTECH, ICPDAS, STANDARD, Span, type_of_code
from drivers.reading import Quality, Reading
from drivers.settings import Where

Vendor = Literal["icpdas", "advantech"]

# By name: modules with a type for each input ($AA8Ci), and modules with one for all (in $AA2). The types of others
# are not compared.
_TYPE_EACH = re.compile(r"4018P|4019|4118|7019|7018Z")
_TYPE_FOR_ALL = re.compile(r"4011|4018$|7011|7018(?!Z)")
LOG = logging.getLogger(__name__)
_FORMATS = {"engineering": 0, "percent": 1, "hex": 2}
_TABLES: Mapping[str | None, dict[str, Span]] = {"icpdas": ICPDAS, "advantech": ADVANTECH, None: STANDARD}


class DconSettings(DeviceSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a DCON module.

    Parameters
    ----------
    address : int
        0..255.
    checksum : bool
        Whether the module is set to send and expect a checksum.
    format : str
        `engineering`, `percent` or `hex`, as the module is set.
    vendor : str, optional
        `icpdas` or `advantech`: their ranges differ. Needed for `percent` and `hex`.
    channels : int
        Inputs of the module: values in a `#AA` reply.
    couple : str, optional
        Thermocouple type of the inputs that name none.
    diagnose : bool
        Whether `$AAB` is queried each time (4018+ and others): a set bit is an open thermocouple or out of range.
    verify : bool
        Whether, after connecting, the module's own settings are compared with these.
    """

    address: Annotated[int, msgspec.Meta(ge=0, le=255)]
    checksum: bool = False
    format: Literal["engineering", "percent", "hex"] = "engineering"
    vendor: Vendor | None = None
    channels: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8
    couple: str | None = None
    diagnose: bool = False
    verify: bool = True


class DconModule(Module[str]):
    """A thermocouple module on a DCON line."""

    _member: DconMember

    def __init__(self, config: DconSettings, line: DconLine, where: Where) -> None:
        if config.format != "engineering" and config.vendor is None:
            raise where.error(f"key 'vendor' is missing, format = \"{config.format}\" needs it: icpdas or advantech")
        self._table = _TABLES[config.vendor]
        self._types = thermocouples(config, self._table, config.channels, where, config.couple)
        self._config = config
        self._type_for_all = False
        units = dict.fromkeys(self._types, "degc")
        member = line.join(config.name, config.address, with_checksum=config.checksum)
        super().__init__(config.name, units, member, ("M", "2") if config.verify else ())

    async def _poll(self) -> dict[int, Reading]:
        config = self._config
        body = await self._member.data("#")
        try:
            texts = split_values(body, config.channels, config.format)
            readings = {
                number: thermocouple(texts[number], config.format, self._table[letter], config.vendor)
                for number, letter in self._types.items()
            }
        except BadTextError as error:
            raise DeviceGarbled(config.name, str(error)) from None
        if config.diagnose:
            self._mark(readings, await self._member.ask("$B"))
        return readings

    def _mark(self, readings: dict[int, Reading], answer: str) -> None:
        """Mark the inputs whose diagnosis bit is set."""
        bits = self._number(answer, r"([0-9A-F]{2})", "diagnosis $AAB")
        for number, reading in readings.items():
            if bits >> number & 1 and reading.quality is Quality.GOOD:
                readings[number] = Reading.bad(Quality.OPEN, "open thermocouple or out of range (diagnosis)")

    async def _check(self, check: str) -> list[str]:
        try:
            answer = await self._member.ask(f"${check}")
        except DeviceRefused as error:
            LOG.info("%s: $AA%s cannot be verified: %s", self.name, check, error.message)
            return []
        if check == "M":
            self._type_for_all = _TYPE_FOR_ALL.match(answer) is not None
            return [f"8C{number:X}" for number in sorted(self._types)] if _TYPE_EACH.match(answer) else []
        if check == "2":
            self._check_format(self._number(answer, r"[0-9A-F]{4}([0-9A-F]{2})", "configuration $AA2"))
            if self._type_for_all:
                for number in self._types:
                    self._check_type("$AA2", number, int(answer[:2], 16))
            return []
        number = int(check[2:], 16)
        self._check_type(f"$AA{check}", number, self._number(answer, rf"C{number:X}R([0-9A-F]{{2}})", f"$AA{check}"))
        return []

    def _check_format(self, flags: int) -> None:
        """Compare the format bits of the configuration."""
        words = {place: form for form, place in _FORMATS.items()}
        found, expected = flags & 3, _FORMATS[self._config.format]
        if found != expected:
            raise DeviceRefused(
                self.name,
                f"data format in $AA2 is {words.get(found, 'ohms')}, the configuration expects {words[expected]}",
            )

    def _check_type(self, command: str, number: int, found: int) -> None:
        """Compare a type code; both makers have the same code for the same type."""
        expected = ICPDAS[self._types[number]].code
        if found != expected:
            raise DeviceRefused(
                self.name,
                f"type code of input {number} in {command} is 0x{found:02X} ({type_of_code(ICPDAS, found)}), "
                f"the configuration expects 0x{expected:02X} ({type_of_code(ICPDAS, expected)})",
            )

    def _number(self, answer: str, pattern: str, what: str) -> int:
        """Return the hexadecimal number in a reply."""
        match = re.fullmatch(pattern, answer)
        if match is None:
            raise DeviceGarbled(self.name, f"{what} answers {answer!r}, expected {pattern}")
        return int(match[1], 16)


MODELS = {"dcon": Family(protocols=("dcon",), kind=DconSettings, make=DconModule)}
