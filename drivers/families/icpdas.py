"""ICP DAS modules: M-7018R, M-7019R and ET-7018Z for thermocouples, M-7017 and ET-7017 for ±10 V.

Channels are input registers from 0, one signed word each, in one of two formats that a coil chooses:

- *hex*: both signs scaled by the positive full scale; 7FFF is an open couple. ET modules are delivered so.
- *engineering*: a count of steps, 0.1 °C as a rule (type M 0.01 °C), 1 mV on ±10 V.

Sources: I-7018/M-7018 quick start, Modbus address table; ET-7000/PET-7000 register table v1.0.3; ICP DAS
FAQ-030 (which modules detect an open couple: M-7018R and M-7019R do, the plain M-7018 does not).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

from drivers.families.base import MODBUS, MODBUS_TCP, Check, Family, ModbusDevice, ModbusSettings
from drivers.families.inputs import analogue_inputs, thermocouples
from drivers.lines.modbus_line import ModbusLine
from drivers.protocols.analogue import RANGE_CODES, Probe, icpdas_volts, reading_of
from drivers.protocols.couples import ICPDAS, couple_of_code
from drivers.protocols.modbus import READ_COILS, READ_HOLDING, READ_INPUT, Request
from drivers.reading import Reading
from drivers.settings import Where

Format = Literal["hex", "engineering"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layout:
    """Where a model keeps what.

    `types` is the register of the type codes, one for the module or one for each input; `name` is register
    and value of the module's name where both are documented.
    """

    inputs: int
    types: int
    type_each: bool
    format_coil: int
    name: tuple[int, int] | None = None


_LAYOUTS = {
    "icpdas-m7018r": _Layout(inputs=8, types=486, type_each=False, format_coil=268),
    "icpdas-m7019r": _Layout(inputs=8, types=256, type_each=True, format_coil=268),
    "icpdas-et7018z": _Layout(inputs=10, types=427, type_each=True, format_coil=631, name=(559, 0x7018)),
    "icpdas-m7017": _Layout(inputs=8, types=486, type_each=False, format_coil=268),
    "icpdas-et7017": _Layout(inputs=8, types=427, type_each=True, format_coil=631, name=(559, 0x7017)),
}


class IcpdasThermocoupleSettings(ModbusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a thermocouple module.

    Parameters
    ----------
    format : str
        `hex` or `engineering`, as the module is set.
    couple : str, optional
        Couple of the inputs that name none.
    step_degc : float, optional
        One step of the engineering format, °C. 0.1, and 0.01 for type M, unless the module's manual says
        otherwise (for type T some print 0.01).
    """

    format: Format = "hex"
    couple: str | None = None
    step_degc: Annotated[float, msgspec.Meta(ge=0.001, le=1.0)] | None = None


class IcpdasVoltageSettings(ModbusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a voltage module.

    Parameters
    ----------
    format : str
        `hex` or `engineering`, as the module is set.
    range_v : float
        Full scale of the range it is set to, V: 10, 5, 1, 0.5 or 0.15; in engineering format 10.
    """

    format: Format = "hex"
    range_v: float = 10.0


class IcpdasThermocouples(ModbusDevice):
    """A thermocouple module."""

    def __init__(self, about: IcpdasThermocoupleSettings, line: ModbusLine, where: Where) -> None:
        layout = _LAYOUTS[about.model]
        self._couples = thermocouples(about, ICPDAS, layout.inputs, where, about.couple)
        letters = set(self._couples.values())
        if not layout.type_each and len(letters) > 1:
            raise where.error(f"{about.model} has one type for all inputs, the inputs name {sorted(letters)}")
        self._about = about
        super().__init__(
            about,
            line,
            units=dict.fromkeys(self._couples, "degc"),
            polls=[Request(function=READ_INPUT, address=0, count=layout.inputs)],
            checks=_checks(layout, about.format, {i: ICPDAS[c].code for i, c in self._couples.items()}),
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Scale the words of the configured inputs."""
        return {number: self._scaled(answers[0][number], letter) for number, letter in self._couples.items()}

    def _scaled(self, raw: int, letter: str) -> Reading:
        if self._about.format == "hex":
            return ICPDAS[letter].icp_hex(raw)
        step_degc = self._about.step_degc or (0.01 if letter == "M" else 0.1)
        return ICPDAS[letter].icp_engineering(raw, step_degc)


class IcpdasVoltages(ModbusDevice):
    """A voltage module, with or without capacitive amplifiers on it."""

    def __init__(self, about: IcpdasVoltageSettings, line: ModbusLine, where: Where) -> None:
        layout = _LAYOUTS[about.model]
        if about.range_v not in RANGE_CODES:
            raise where.wrong("range_v", about.range_v, f"one of {', '.join(f'{v:g}' for v in RANGE_CODES)}")
        if about.format == "engineering" and about.range_v != 10.0:
            raise where.wrong("range_v", about.range_v, '10 in engineering format, or format = "hex"')
        self._probes: Mapping[int, Probe | None] = analogue_inputs(about, layout.inputs, where)
        self._about = about
        super().__init__(
            about,
            line,
            units={number: "um" if probe else "v" for number, probe in self._probes.items()},
            polls=[Request(function=READ_INPUT, address=0, count=layout.inputs)],
            checks=_checks(layout, about.format, dict.fromkeys(self._probes, RANGE_CODES[about.range_v])),
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Scale the words of the configured inputs."""
        about, words = self._about, answers[0]
        return {
            number: reading_of(icpdas_volts(words[number], about.range_v, about.format), probe)
            for number, probe in self._probes.items()
        }


def _checks(layout: _Layout, form: str, codes: Mapping[int, int]) -> list[Check]:
    """List what a module can say of itself: name, format, types."""
    checks = []
    if layout.name is not None:
        register, name = layout.name
        request = Request(function=READ_HOLDING, address=register, count=1)
        checks.append(Check(request=request, expected={0: name}, what="module name"))
    checks.append(
        Check(
            request=Request(function=READ_COILS, address=layout.format_coil, count=1),
            expected={0: int(form == "engineering")},
            what="data format",
            words=lambda bit: "engineering" if bit else "hex",
        )
    )
    count = layout.inputs if layout.type_each else 1
    checks.append(
        Check(
            request=Request(function=READ_HOLDING, address=layout.types, count=count),
            expected=dict(codes) if layout.type_each else {0: next(iter(codes.values()))},
            what="type code",
            mask=0xFF,
            words=_code_words,
        )
    )
    return checks


def _code_words(code: int) -> str:
    """Put a type code in words."""
    volts = next((f"±{range_v:g} V" for range_v, known in RANGE_CODES.items() if known == code), None)
    return f"0x{code:02X} ({volts or couple_of_code(ICPDAS, code)})"


MODELS = {
    **{
        model: Family(protocols=protocols, kind=IcpdasThermocoupleSettings, make=IcpdasThermocouples)
        for model, protocols in {
            "icpdas-m7018r": MODBUS,
            "icpdas-m7019r": MODBUS,
            "icpdas-et7018z": MODBUS_TCP,
        }.items()
    },
    "icpdas-m7017": Family(protocols=MODBUS, kind=IcpdasVoltageSettings, make=IcpdasVoltages),
    "icpdas-et7017": Family(protocols=MODBUS_TCP, kind=IcpdasVoltageSettings, make=IcpdasVoltages),
}
