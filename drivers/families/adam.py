"""Advantech ADAM modules: 4018+, 4118 and 6018 for thermocouples, 4117 and 6017 for ±10 V.

Channels are holding registers from 0, one unsigned word each, 0..65535 over the range. Types J, K and E
begin at 0 °C, and below it such a module reports 0: a reading of 0 is therefore under range, not 0 °C. An
open couple shows in a coil for each input (4018+ and 4118: from coil 0; 6018: see the unit's manual, key
`burnout_coil`).

Sources: ADAM-4000 and ADAM-6000 user's manuals, Modbus appendices; scaling as in Advantech's class library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

from drivers.families.base import MODBUS, MODBUS_TCP, Check, Family, ModbusDevice, ModbusSettings
from drivers.families.inputs import analogue_inputs, thermocouples
from drivers.lines.modbus_line import ModbusLine
from drivers.protocols.analogue import RANGE_CODES, Probe, advantech_volts, reading_of
from drivers.protocols.couples import ADVANTECH, couple_of_code
from drivers.protocols.modbus import READ_COILS, READ_HOLDING, Request
from drivers.reading import Quality, Reading
from drivers.settings import Where

INPUTS = 8
TYPES_REGISTER = 200
NAME_REGISTER = 210
NO_COILS = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layout:
    """What a model can say of itself: its first name word, and where its burn-out coils begin."""

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
        Couple of the inputs that name none.
    burnout_coil : int, optional
        First of the eight burn-out coils, on the wire from 0; -1 reads none. 4018+ and 4118: 0 unless given;
        6018: none unless given.
    scaling : str
        `range`: 0..65535 over the couple's range. `hundredths`: a signed count of 0.01 °C, as some 4018+
        are set.
    """

    couple: str | None = None
    burnout_coil: Annotated[int, msgspec.Meta(ge=-1, le=9999)] | None = None
    scaling: Literal["range", "hundredths"] = "range"


class AdamVoltageSettings(ModbusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a voltage module.

    Parameters
    ----------
    range_v : float
        Full scale of the range it is set to, V: 10, 5, 1, 0.5 or 0.15.
    """

    range_v: float = 10.0


class AdamThermocouples(ModbusDevice):
    """A thermocouple module."""

    def __init__(self, about: AdamThermocoupleSettings, line: ModbusLine, where: Where) -> None:
        layout = _LAYOUTS[about.model]
        self._couples = thermocouples(about, ADVANTECH, INPUTS, where, about.couple)
        self._about = about
        first = layout.burnout_coil if about.burnout_coil is None else about.burnout_coil
        polls = [Request(function=READ_HOLDING, address=0, count=INPUTS)]
        if first != NO_COILS:
            polls.append(Request(function=READ_COILS, address=first, count=INPUTS))
        codes = {number: ADVANTECH[letter].code for number, letter in self._couples.items()}
        super().__init__(
            about,
            line,
            units=dict.fromkeys(self._couples, "degc"),
            polls=polls,
            checks=_checks(layout, codes),
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Scale the words of the configured inputs; a burn-out coil outweighs the word."""
        words = answers[0]
        burnt = answers[1] if len(answers) > 1 else [0] * INPUTS
        return {
            number: Reading.bad(Quality.OPEN, f"open couple (burn-out coil of input {number})")
            if burnt[number]
            else self._scaled(words[number], letter)
            for number, letter in self._couples.items()
        }

    def _scaled(self, raw: int, letter: str) -> Reading:
        if self._about.scaling == "hundredths":
            return ADVANTECH[letter].judged((raw - (raw >> 15 << 16)) / 100.0)
        return ADVANTECH[letter].advantech(raw)


class AdamVoltages(ModbusDevice):
    """A voltage module, with or without capacitive amplifiers on it."""

    def __init__(self, about: AdamVoltageSettings, line: ModbusLine, where: Where) -> None:
        if about.range_v not in RANGE_CODES:
            raise where.wrong("range_v", about.range_v, f"one of {', '.join(f'{v:g}' for v in RANGE_CODES)}")
        self._probes: Mapping[int, Probe | None] = analogue_inputs(about, INPUTS, where)
        self._about = about
        super().__init__(
            about,
            line,
            units={number: "um" if probe else "v" for number, probe in self._probes.items()},
            polls=[Request(function=READ_HOLDING, address=0, count=INPUTS)],
            checks=_checks(_LAYOUTS[about.model], dict.fromkeys(self._probes, RANGE_CODES[about.range_v])),
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Scale the words of the configured inputs."""
        range_v, words = self._about.range_v, answers[0]
        return {
            number: reading_of(advantech_volts(words[number], range_v), probe) for number, probe in self._probes.items()
        }


def _checks(layout: _Layout, codes: Mapping[int, int]) -> list[Check]:
    """List what a module can say of itself; of the 6000 series nothing is documented well enough."""
    if layout.name is None:
        return []
    return [
        Check(
            request=Request(function=READ_HOLDING, address=NAME_REGISTER, count=1),
            expected={0: layout.name},
            what="module name",
            words="0x{:04X}".format,
        ),
        Check(
            request=Request(function=READ_HOLDING, address=TYPES_REGISTER, count=INPUTS),
            expected=dict(codes),
            what="type code",
            mask=0xFF,
            words=_code_words,
        ),
    ]


def _code_words(code: int) -> str:
    """Put a type code in words."""
    volts = next((f"±{range_v:g} V" for range_v, known in RANGE_CODES.items() if known == code), None)
    return f"0x{code:02X} ({volts or couple_of_code(ADVANTECH, code)})"


MODELS = {
    "adam-4018p": Family(protocols=MODBUS, kind=AdamThermocoupleSettings, make=AdamThermocouples),
    "adam-4118": Family(protocols=MODBUS, kind=AdamThermocoupleSettings, make=AdamThermocouples),
    "adam-6018": Family(protocols=MODBUS_TCP, kind=AdamThermocoupleSettings, make=AdamThermocouples),
    "adam-4117": Family(protocols=MODBUS, kind=AdamVoltageSettings, make=AdamVoltages),
    "adam-6017": Family(protocols=MODBUS_TCP, kind=AdamVoltageSettings, make=AdamVoltages),
}
