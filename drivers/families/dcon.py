"""Thermocouple modules that speak DCON, also called ADAM ASCII.

ICP DAS I-7018, I-7018R, I-7019R; Advantech ADAM-4018, 4018+, 4118.

`#AA` gives all inputs at once. After connecting the module's name, data format and types are compared with
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
from drivers.families.base import DeviceSettings, Family
from drivers.families.inputs import thermocouples
from drivers.lines.dcon_line import DconLine
from drivers.protocols.couples import ADVANTECH, ICPDAS, STANDARD, Span, couple_of_code
from drivers.protocols.dcon import BadTextError, split_values, thermocouple
from drivers.reading import Quality, Reading
from drivers.settings import Where

Vendor = Literal["icpdas", "advantech"]

# By name: modules with a type for each input ($AA8Ci), and modules with one for all (in $AA2). Of others
# neither is known, and their types are not compared.
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
        Whether the module is set to send and expect one.
    format : str
        `engineering`, `percent` or `hex`, as the module is set.
    vendor : str, optional
        `icpdas` or `advantech`: their ranges differ. Needed for `percent` and `hex`.
    channels : int
        Inputs of the module, that is values in a `#AA` reply.
    couple : str, optional
        Couple of the inputs that name none.
    diagnose : bool
        Whether `$AAB` is asked each time (4018+ and others): a set bit is an open couple or out of range.
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


class DconModule:
    """A thermocouple module on a DCON line."""

    def __init__(self, about: DconSettings, line: DconLine, where: Where) -> None:
        if about.format != "engineering" and about.vendor is None:
            raise where.error(f"key 'vendor' is missing, format = \"{about.format}\" needs it: icpdas or advantech")
        self._table = _TABLES[about.vendor]
        self._couples = thermocouples(about, self._table, about.channels, where, about.couple)
        self._about = about
        self._member = line.join(about.name, about.address, with_checksum=about.checksum)
        self._checked: tuple[int, int] | None = None
        self._to_check: list[str] = []
        self._type_for_all = False

    @property
    def name(self) -> str:
        """Name of the device in the configuration."""
        return self._about.name

    @property
    def units(self) -> Mapping[int, str]:
        """Unit of each configured input."""
        return dict.fromkeys(self._couples, "degc")

    async def read(self) -> Mapping[int, Reading]:
        """Read every configured input once.

        Raises
        ------
        DriverError
            Naming the device, within about twice the line's `timeout_s` from when the device gets the line.
        """
        return await self._member.serve(self._poll)

    async def close(self) -> None:
        """Leave the line; the last module on it closes it."""
        await self._member.close()

    async def _poll(self) -> dict[int, Reading]:
        about = self._about
        if about.verify:
            await self._verify()
        body = await self._member.data("#")
        try:
            texts = split_values(body, about.channels, about.format)
            readings = {
                number: thermocouple(texts[number], about.format, self._table[letter], about.vendor)
                for number, letter in self._couples.items()
            }
        except BadTextError as error:
            raise DeviceGarbled(about.name, str(error)) from None
        if about.diagnose:
            self._mark(readings, await self._member.ask("$B"))
        return readings

    def _mark(self, readings: dict[int, Reading], answer: str) -> None:
        """Mark the inputs whose diagnosis bit is set."""
        bits = self._number(answer, r"([0-9A-F]{2})", "diagnosis $AAB")
        for number, reading in readings.items():
            if bits >> number & 1 and reading.quality is Quality.GOOD:
                readings[number] = Reading.bad(Quality.OPEN, "open couple or out of range (diagnosis)")

    async def _verify(self) -> None:
        """Compare what the module says with the configuration; go on where the last call ran out of time."""
        if self._checked != self._member.generation:
            self._to_check = ["M", "2"]
            self._checked = self._member.generation
        while self._to_check:
            step = self._to_check[0]
            more = await self._check(step)
            self._to_check.pop(0)
            self._to_check.extend(more)

    async def _check(self, step: str) -> list[str]:
        """Take one step; return the steps that follow from it."""
        try:
            answer = await self._member.ask(f"${step}")
        except DeviceRefused as error:
            LOG.info("%s: $AA%s cannot be verified: %s", self.name, step, error.message)
            return []
        if step == "M":
            self._type_for_all = _TYPE_FOR_ALL.match(answer) is not None
            return [f"8C{number:X}" for number in sorted(self._couples)] if _TYPE_EACH.match(answer) else []
        if step == "2":
            self._check_format(self._number(answer, r"[0-9A-F]{4}([0-9A-F]{2})", "configuration $AA2"))
            if self._type_for_all:
                for number in self._couples:
                    self._check_type("$AA2", number, int(answer[:2], 16))
            return []
        number = int(step[2:], 16)
        self._check_type(f"$AA{step}", number, self._number(answer, r"C[0-9A-F]R([0-9A-F]{2})", f"$AA{step}"))
        return []

    def _check_format(self, flags: int) -> None:
        """Compare the format bits of the configuration."""
        words = {place: form for form, place in _FORMATS.items()}
        found, expected = flags & 3, _FORMATS[self._about.format]
        if found != expected:
            raise DeviceRefused(
                self.name,
                f"data format in $AA2 is {words.get(found, 'ohms')}, the configuration expects {words[expected]}",
            )

    def _check_type(self, asked: str, number: int, found: int) -> None:
        """Compare a type code; both makers give the same couple the same code."""
        expected = ICPDAS[self._couples[number]].code
        if found != expected:
            raise DeviceRefused(
                self.name,
                f"type code of input {number} in {asked} is 0x{found:02X} ({couple_of_code(ICPDAS, found)}), "
                f"the configuration expects 0x{expected:02X} ({couple_of_code(ICPDAS, expected)})",
            )

    def _number(self, answer: str, pattern: str, what: str) -> int:
        """Take a hexadecimal number out of a reply."""
        match = re.fullmatch(pattern, answer)
        if match is None:
            raise DeviceGarbled(self.name, f"{what} answers {answer!r}")
        return int(match[1], 16)


MODELS = {"dcon": Family(protocols=("dcon",), kind=DconSettings, make=DconModule)}
