"""The `inputs` of a device table: thermocouples and voltages; modules with voltage inputs.

Displacement of a capacitive amplifier with a linear output, read through a voltage input:

`displacement_um = standoff_um + polarity × um_per_v × U`

`um_per_v` is the probe's sensitivity (> 0) from its calibration sheet. `polarity` is +1 where the voltage
rises with the gap and −1 where it falls. `standoff_um` is the reading at 0 V: the stand-off at which the
probe was calibrated to 0 V where the reading is the gap itself, or 0 where it is the change from there.

An amplifier off its range, or a probe that touches, drives the output to its limit. Such a voltage is valid as
a voltage, so the limits of the linear output are given with the probe: `volt_min`, `volt_max`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal

import msgspec

from drivers.families.base import Check, DeviceSettings, ModbusDevice, ModbusSettings
from drivers.lines.modbus_line import ModbusLine
from drivers.protocols.analogue import RANGE_CODES
from drivers.protocols.modbus import Request
from drivers.protocols.thermocouples import Span, type_of_code
from drivers.reading import Quality, Reading
from drivers.settings import Where, one_of, settings

Volt = Annotated[float, msgspec.Meta(ge=-100.0, le=100.0)]


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


class CapacitiveProbe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A capacitive probe with its amplifier; see the equation of this module.

    Parameters
    ----------
    um_per_v : float
        Sensitivity, µm/V, above 0.
    polarity : int
        +1: the voltage rises with the gap; −1: it falls.
    standoff_um : float
        Reading at 0 V, µm.
    volt_min, volt_max : float
        Limits of the output between which it is linear, V. Beyond them a reading is under or over range.
    """

    um_per_v: Annotated[float, msgspec.Meta(gt=0.0, le=10000.0)]
    polarity: Literal[-1, 1]
    standoff_um: Annotated[float, msgspec.Meta(ge=-1.0e5, le=1.0e5)]
    volt_min: Volt
    volt_max: Volt


class AnalogueInput(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One input: a plain voltage, or a probe.

    Parameters
    ----------
    input : int
        Number on the module, from 0.
    probe : dict, optional
        See `CapacitiveProbe`; without it the reading is in V.
    """

    input: Annotated[int, msgspec.Meta(ge=0)]
    probe: dict[str, object] | None = None


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


def analogue_inputs(config: DeviceSettings, count: int, where: Where) -> dict[int, CapacitiveProbe | None]:
    """Convert the voltage inputs of a module; None means a plain voltage.

    Raises
    ------
    DriverConfigError
        An input that the module does not have, an input twice, or a wrong probe.
    """
    probes: dict[int, CapacitiveProbe | None] = {}
    for place, spot in input_tables(config, where):
        given = settings(place, AnalogueInput, spot)
        check_input(given.input, probes, count, config.model, spot)
        probes[given.input] = probe_settings(given.probe, spot.inside("probe"))
    return probes


def probe_settings(table: dict[str, object] | None, where: Where) -> CapacitiveProbe | None:
    """Convert the `probe` table of an input.

    Raises
    ------
    DriverConfigError
        A key is wrong, or the limits are reversed.
    """
    if table is None:
        return None
    probe = settings(table, CapacitiveProbe, where)
    if probe.volt_min >= probe.volt_max:
        raise where.wrong("volt_max", probe.volt_max, f"more than volt_min ({probe.volt_min})")
    return probe


def reading_of(volts: float | Reading, probe: CapacitiveProbe | None) -> Reading:
    """Make the reading of an input from its voltage, V or µm.

    Examples
    --------
    >>> probe = CapacitiveProbe(um_per_v=5.0, polarity=-1, standoff_um=50.0, volt_min=-9.9, volt_max=9.9)
    >>> reading_of(2.0, probe).value
    40.0
    """
    if isinstance(volts, Reading):
        return volts
    if probe is None:
        return Reading.good(volts)
    if volts > probe.volt_max:
        return Reading.bad(Quality.OVER, f"{volts:.3f} V, the probe is linear up to {probe.volt_max:g} V")
    if volts < probe.volt_min:
        return Reading.bad(Quality.UNDER, f"{volts:.3f} V, the probe is linear down to {probe.volt_min:g} V")
    return Reading.good(probe.standoff_um + probe.polarity * probe.um_per_v * volts)


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
