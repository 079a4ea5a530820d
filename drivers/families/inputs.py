"""The `inputs` of a device table: thermocouples, voltages, and what every list of inputs must keep to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import msgspec

from drivers.families.base import DeviceSettings
from drivers.protocols.analogue import AnalogueInput, Probe, probe_settings
from drivers.protocols.couples import Span
from drivers.settings import Where, one_of, settings


class ThermocoupleInput(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One thermocouple input.

    Parameters
    ----------
    input : int
        Number on the module, from 0.
    couple : str, optional
        Type letter; the module's `couple` where it is missing.
    """

    input: Annotated[int, msgspec.Meta(ge=0)]
    couple: str | None = None


def thermocouples(
    about: DeviceSettings,
    table: Mapping[str, Span],
    count: int,
    where: Where,
    couple: str | None = None,
) -> dict[int, str]:
    """Convert the thermocouple inputs of a module.

    Parameters
    ----------
    about : DeviceSettings
        The module's settings.
    table : Mapping
        The maker's ranges by couple letter.
    count : int
        Inputs of the module.
    couple : str, optional
        Couple of inputs that name none.

    Returns
    -------
    dict
        Couple letter by input.

    Raises
    ------
    DriverConfigError
        An input or a couple the module does not have, or an input twice.
    """
    couples: dict[int, str] = {}
    if couple is not None and couple not in table:
        raise where.wrong("couple", couple, one_of(table))
    for place, spot in input_tables(about, where):
        given = settings(place, ThermocoupleInput, spot)
        check_input(given.input, couples, count, about.model, spot)
        letter = given.couple if given.couple is not None else couple
        if letter is None:
            raise spot.error(f"key 'couple' is missing, expected {one_of(table)}")
        if letter not in table:
            raise spot.wrong("couple", letter, one_of(table))
        couples[given.input] = letter
    return couples


def analogue_inputs(about: DeviceSettings, count: int, where: Where) -> dict[int, Probe | None]:
    """Convert the voltage inputs of a module; None stands for a plain voltage.

    Raises
    ------
    DriverConfigError
        An input the module does not have, an input twice, or a wrong probe.
    """
    probes: dict[int, Probe | None] = {}
    for place, spot in input_tables(about, where):
        given = settings(place, AnalogueInput, spot)
        check_input(given.input, probes, count, about.model, spot)
        probes[given.input] = probe_settings(given.probe, spot.inside("probe"))
    return probes


def check_input(number: int, taken: Mapping[int, object], count: int, model: str, where: Where) -> None:
    """Raise where a module has no such input, or it stands twice."""
    if number >= count:
        raise where.wrong("input", number, f"0..{count - 1} on {model}")
    if number in taken:
        raise where.error(f"input {number} stands twice")


def input_tables(about: DeviceSettings, where: Where) -> list[tuple[dict[str, object], Where]]:
    """List the input tables with their places; there must be one at least."""
    if not about.inputs:
        raise where.wrong("inputs", about.inputs, "at least one input")
    return [(table, where.inside(f"inputs[{index}]")) for index, table in enumerate(about.inputs)]
