"""ICP DAS modules: M-7018R, M-7019R and ET-7018Z for thermocouples, M-7017 and ET-7017 for ±10 V.

Channels are input registers from 0, one signed word each, in one of two formats, selected by a coil:

- *hex*: both signs scaled by the positive full scale; 7FFF is an open thermocouple. ET modules are delivered in it.
- *engineering*: a count of steps, 0.1 °C as a rule (type M 0.01 °C), 1 mV on ±10 V.

Sources: I-7018/M-7018 quick start, Modbus address table; ET-7000/PET-7000 register table v1.0.3; ICP DAS
FAQ-030 (which modules detect an open thermocouple: M-7018R and M-7019R do, the plain M-7018 does not).
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
from drivers.protocols.analogue import icpdas_volts
from drivers.protocols.modbus import READ_COILS, READ_HOLDING, READ_INPUT, Request
from drivers.protocols.thermocouples import ICPDAS
from drivers.reading import Reading
from drivers.settings import Where

Format = Literal["hex", "engineering"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layout:
    """Registers of a model.

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
        Thermocouple type of the inputs that name none.
    step_degc : float, optional
        One step of the engineering format, °C. 0.1, and 0.01 for type M, unless the module's manual says
        otherwise (for type T some print 0.01).
    """

    format: Format = "hex"
    couple: str | None = None
    step_degc: Annotated[float, msgspec.Meta(ge=0.001, le=1.0)] | None = None


class IcpdasVoltageSettings(VoltageSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a voltage module.

    Parameters
    ----------
    format : str
        `hex` or `engineering`, as the module is set; in engineering format `range_v` is 10.
    """

    format: Format = "hex"


class IcpdasThermocouples(ModbusDevice):
    """A thermocouple module."""

    def __init__(self, config: IcpdasThermocoupleSettings, line: ModbusLine, where: Where) -> None:
        layout = _LAYOUTS[config.model]
        self._types = thermocouples(config, ICPDAS, layout.inputs, where, config.couple)
        letters = set(self._types.values())
        if not layout.type_each and len(letters) > 1:
            raise where.error(f"{config.model} has one type for all inputs, the inputs name {sorted(letters)}")
        self._config = config
        super().__init__(
            config,
            line,
            units=dict.fromkeys(self._types, "degc"),
            polls=[Request(function=READ_INPUT, address=0, count=layout.inputs)],
            checks=_checks(layout, config.format, {i: ICPDAS[c].code for i, c in self._types.items()}),
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Scale the words of the configured inputs."""
        return {number: self._scaled(answers[0][number], letter) for number, letter in self._types.items()}

    def _scaled(self, raw: int, letter: str) -> Reading:
        if self._config.format == "hex":
            return ICPDAS[letter].icp_hex(raw)
        step_degc = self._config.step_degc or (0.01 if letter == "M" else 0.1)
        return ICPDAS[letter].icp_engineering(raw, step_degc)


class IcpdasVoltages(VoltageModule):
    """A voltage module."""

    def __init__(self, config: IcpdasVoltageSettings, line: ModbusLine, where: Where) -> None:
        layout = _LAYOUTS[config.model]
        if config.format == "engineering" and config.range_v != 10.0:
            raise where.wrong("range_v", config.range_v, '10 in engineering format, or format = "hex"')
        self._config = config
        poll = Request(function=READ_INPUT, address=0, count=layout.inputs)
        super().__init__(config, line, where, poll=poll, checks=functools.partial(_checks, layout, config.format))

    def volts(self, word: int) -> float | Reading:
        """Return the voltage of a word, by the module's format."""
        return icpdas_volts(word, self._config.range_v, self._config.format)


def _checks(layout: _Layout, form: str, codes: Mapping[int, int]) -> list[Check]:
    """List the checks of a module: name, format, types."""
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
    request = Request(function=READ_HOLDING, address=layout.types, count=layout.inputs if layout.type_each else 1)
    checks.append(type_check(request, codes if layout.type_each else {0: next(iter(codes.values()))}, ICPDAS))
    return checks


MODELS = {
    "icpdas-m7018r": Family(protocols=MODBUS, kind=IcpdasThermocoupleSettings, make=IcpdasThermocouples),
    "icpdas-m7019r": Family(protocols=MODBUS, kind=IcpdasThermocoupleSettings, make=IcpdasThermocouples),
    "icpdas-et7018z": Family(protocols=MODBUS_TCP, kind=IcpdasThermocoupleSettings, make=IcpdasThermocouples),
    "icpdas-m7017": Family(protocols=MODBUS, kind=IcpdasVoltageSettings, make=IcpdasVoltages),
    "icpdas-et7017": Family(protocols=MODBUS_TCP, kind=IcpdasVoltageSettings, make=IcpdasVoltages),
}
