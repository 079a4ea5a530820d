"""Advantech ADAM modules: 4018+, 4118 and 6018 for thermocouples, 4117 and 6017 for ±10 V.

Channels are holding registers from 0, one unsigned word each, 0..65535 over the range. Types J, K and E
begin at 0 °C, and below it such a module reports 0: a reading of 0 is therefore under range, not 0 °C. An
open thermocouple shows in a coil for each input (4018+ and 4118: from coil 0; 6018: see the unit's manual, key
`burnout_coil`).

Sources: ADAM-4000 and ADAM-6000 user's manuals, Modbus appendices; scaling as in Advantech's class library.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

from drivers.families.base import MODBUS, MODBUS_TCP, Check, Family, ModbusDevice, ModbusSettings
from drivers.families.inputs import VoltageModule, VoltageSettings, thermocouples, type_check
from drivers.lines.modbus_line import ModbusLine
from drivers.protocols.analogue import advantech_volts
from drivers.protocols.modbus import READ_COILS, READ_HOLDING, Request
from drivers.protocols.thermocouples import ADVANTECH
from drivers.reading import Quality, Reading
from drivers.settings import Where

INPUTS = 8
TYPES_REGISTER = 200
NAME_REGISTER = 210
NO_COILS = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layout:
    """Documented registers of a model: the first word of its name, and its first burn-out coil."""

    name: int | None = None
    burnout_coil: int = NO_COILS


_LAYOUTS = {
    "adam-4018p": _Layout(name=0x4018, burnout_coil=0),
    "adam-4118": _Layout(name=0x4118, burnout_coil=0),
    "adam-6018": _Layout(),
    "adam-4117": _Layout(name=0x4117),
    "adam-6017": _Layout(),
}


class AdamThermocoupleSettings(ModbusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a thermocouple module.

    Parameters
    ----------
    couple : str, optional
        Thermocouple type of the inputs that name none.
    burnout_coil : int, optional
        First of the eight burn-out coils, on the wire from 0; -1 reads none. 4018+ and 4118: 0 unless given;
        6018: none unless given.
    scaling : str
        `range`: 0..65535 over the type's range. `hundredths`: a signed count of 0.01 °C, as some 4018+
        are set.
    """

    couple: str | None = None
    burnout_coil: Annotated[int, msgspec.Meta(ge=-1, le=9999)] | None = None
    scaling: Literal["range", "hundredths"] = "range"


class AdamThermocouples(ModbusDevice):
    """A thermocouple module."""

    def __init__(self, config: AdamThermocoupleSettings, line: ModbusLine, where: Where) -> None:
        layout = _LAYOUTS[config.model]
        self._types = thermocouples(config, ADVANTECH, INPUTS, where, config.couple)
        self._config = config
        first = layout.burnout_coil if config.burnout_coil is None else config.burnout_coil
        polls = [Request(function=READ_HOLDING, address=0, count=INPUTS)]
        if first != NO_COILS:
            polls.append(Request(function=READ_COILS, address=first, count=INPUTS))
        codes = {number: ADVANTECH[letter].code for number, letter in self._types.items()}
        super().__init__(
            config,
            line,
            units=dict.fromkeys(self._types, "degc"),
            polls=polls,
            checks=_checks(layout, codes),
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Scale the words of the configured inputs; a burn-out coil overrides the word."""
        words = answers[0]
        burnt = answers[1] if len(answers) > 1 else [0] * INPUTS
        return {
            number: Reading.bad(Quality.OPEN, f"open thermocouple (burn-out coil of input {number})")
            if burnt[number]
            else self._scaled(words[number], letter)
            for number, letter in self._types.items()
        }

    def _scaled(self, raw: int, letter: str) -> Reading:
        if self._config.scaling == "hundredths":
            return ADVANTECH[letter].reading((raw - (raw >> 15 << 16)) / 100.0)
        return ADVANTECH[letter].advantech(raw)


class AdamVoltages(VoltageModule):
    """A voltage module."""

    def __init__(self, config: VoltageSettings, line: ModbusLine, where: Where) -> None:
        self._range_v = config.range_v
        poll = Request(function=READ_HOLDING, address=0, count=INPUTS)
        super().__init__(config, line, where, poll=poll, checks=functools.partial(_checks, _LAYOUTS[config.model]))

    def volts(self, word: int) -> float | Reading:
        """Return the voltage of an offset binary word."""
        return advantech_volts(word, self._range_v)


def _checks(layout: _Layout, codes: Mapping[int, int]) -> list[Check]:
    """List the checks of a module; nothing of the 6000 series is documented well enough."""
    if layout.name is None:
        return []
    return [
        Check(
            request=Request(function=READ_HOLDING, address=NAME_REGISTER, count=1),
            expected={0: layout.name},
            what="module name",
            words="0x{:04X}".format,
        ),
        type_check(Request(function=READ_HOLDING, address=TYPES_REGISTER, count=INPUTS), codes, ADVANTECH),
    ]


MODELS = {
    "adam-4018p": Family(protocols=MODBUS, kind=AdamThermocoupleSettings, make=AdamThermocouples),
    "adam-4118": Family(protocols=MODBUS, kind=AdamThermocoupleSettings, make=AdamThermocouples),
    "adam-6018": Family(protocols=MODBUS_TCP, kind=AdamThermocoupleSettings, make=AdamThermocouples),
    "adam-4117": Family(protocols=MODBUS, kind=VoltageSettings, make=AdamVoltages),
    "adam-6017": Family(protocols=MODBUS_TCP, kind=VoltageSettings, make=AdamVoltages),
}
