"""The `inputs` of a device table: thermocouples and voltages; modules with voltage inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated

import msgspec

from drivers.families.base import Check, DeviceSettings, ModbusDevice, ModbusSettings
from drivers.lines.modbus_line import ModbusLine
from drivers.protocols.analogue import RANGE_CODES, AnalogueInput, Probe, probe_settings, reading_of
from drivers.protocols.modbus import Request
from drivers.protocols.thermocouples import Span, type_of_code
from drivers.reading import Reading
from drivers.settings import Where, one_of, settings


class ThermocoupleInput(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One thermocouple input.

    Parameters
    ----------
    input : int
        Number on the module, from 0.
    couple : str, optional
        Type letter; by default the module's `couple`.
    """

    input: Annotated[int, msgspec.Meta(ge=0)]
    couple: str | None = None


def thermocouples(
    config: DeviceSettings,
    table: Mapping[str, Span],
    count: int,
    where: Where,
    couple: str | None = None,
) -> dict[int, str]:
    """Convert the thermocouple inputs of a module.

    Parameters
    ----------
    config : DeviceSettings
        The module's settings.
    table : Mapping
        The maker's ranges by type letter.
    count : int
        Inputs of the module.
    couple : str, optional
        Type of inputs that name none.

    Returns
    -------
    dict
        Type letter by input.

    Raises
    ------
    DriverConfigError
        An input or a type that the module does not have, or an input twice.
    """
    types: dict[int, str] = {}
    if couple is not None and couple not in table:
        raise where.wrong("couple", couple, one_of(table))
    for place, spot in input_tables(config, where):
        given = settings(place, ThermocoupleInput, spot)
        check_input(given.input, types, count, config.model, spot)
        letter = given.couple if given.couple is not None else couple
        if letter is None:
            raise spot.error(f"key 'couple' is missing, expected {one_of(table)}")
        if letter not in table:
            raise spot.wrong("couple", letter, one_of(table))
        types[given.input] = letter
    return types


def analogue_inputs(config: DeviceSettings, count: int, where: Where) -> dict[int, Probe | None]:
    """Convert the voltage inputs of a module; None means a plain voltage.

    Raises
    ------
    DriverConfigError
        An input that the module does not have, an input twice, or a wrong probe.
    """
    probes: dict[int, Probe | None] = {}
    for place, spot in input_tables(config, where):
        given = settings(place, AnalogueInput, spot)
        check_input(given.input, probes, count, config.model, spot)
        probes[given.input] = probe_settings(given.probe, spot.inside("probe"))
    return probes


def check_input(number: int, taken: Mapping[int, object], count: int, model: str, where: Where) -> None:
    """Raise an error if a module has no such input, or it is given twice."""
    if number >= count:
        raise where.wrong("input", number, f"0..{count - 1} on {model}")
    if number in taken:
        raise where.error(f"input {number} is given twice")


def input_tables(config: DeviceSettings, where: Where) -> list[tuple[dict[str, object], Where]]:
    """List the input tables with their places; there must be at least one."""
    if not config.inputs:
        raise where.wrong("inputs", config.inputs, "at least one input")
    return [(table, where.inside(f"inputs[{index}]")) for index, table in enumerate(config.inputs)]


def type_check(request: Request, codes: Mapping[int, int], table: Mapping[str, Span]) -> Check:
    """Make the check of a module's type codes, of thermocouples or voltage ranges.

    Parameters
    ----------
    request : Request
        Registers of the codes.
    codes : Mapping
        Expected code by place in the answer.
    table : Mapping
        The maker's thermocouple ranges by type letter.
    """

    def words(code: int) -> str:
        volts = next((f"±{range_v:g} V" for range_v, known in RANGE_CODES.items() if known == code), None)
        return f"0x{code:02X} ({volts or type_of_code(table, code)})"

    return Check(request=request, expected=dict(codes), what="type code", mask=0xFF, words=words)


class VoltageSettings(ModbusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a voltage module.

    Parameters
    ----------
    range_v : float
        Full scale of the range it is set to, V: 10, 5, 1, 0.5 or 0.15.
    """

    range_v: float = 10.0


class VoltageModule(ModbusDevice):
    """A module with voltage inputs, with or without capacitive amplifiers on them.

    Parameters
    ----------
    config, line, where
        As for every family.
    poll : Request
        All inputs.
    checks : callable
        Returns the checks for the expected type codes by input.
    """

    def __init__(
        self,
        config: VoltageSettings,
        line: ModbusLine,
        where: Where,
        *,
        poll: Request,
        checks: Callable[[Mapping[int, int]], Sequence[Check]],
    ) -> None:
        if config.range_v not in RANGE_CODES:
            raise where.wrong("range_v", config.range_v, one_of(tuple(f"{v:g}" for v in RANGE_CODES)))
        self._probes = analogue_inputs(config, poll.count, where)
        super().__init__(
            config,
            line,
            units={number: "um" if probe else "v" for number, probe in self._probes.items()},
            polls=[poll],
            checks=checks(dict.fromkeys(self._probes, RANGE_CODES[config.range_v])),
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Scale the words of the configured inputs."""
        return {number: reading_of(self.volts(answers[0][number]), probe) for number, probe in self._probes.items()}

    def volts(self, word: int) -> float | Reading:
        """Return the voltage of a word, V, or a bad reading where it is at an end of the range."""
        raise NotImplementedError
