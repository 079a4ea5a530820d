"""Any Modbus device whose registers are given in the configuration: drives, chillers, transmitters.

`value = (number in the registers) × scale + offset`, in the input's unit. Numbers that mean a fault
(`bad_values`) and limits of what is plausible (`minimum`, `maximum`, in the unit) give the quality.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec

from drivers.families.base import MODBUS, Family, ModbusDevice, ModbusSettings
from drivers.families.inputs import check_input, input_tables
from drivers.lines.modbus_line import ModbusLine
from drivers.protocols.modbus import MOST_REGISTERS, Request
from drivers.protocols.registers import NumberType, WordOrder, as_decoded, decode, words_of
from drivers.reading import Quality, Reading
from drivers.settings import Name, Where, one_of, settings

MOST_INPUTS = 256
_BAD = {str(quality): quality for quality in Quality if quality is not Quality.GOOD}


class MapSettings(ModbusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a device given by its registers.

    Parameters
    ----------
    max_gap : int
        Unused registers between two inputs that may be read to save a request. 0: none, because many devices refuse
        a block with undefined registers.
    """

    max_gap: Annotated[int, msgspec.Meta(ge=0, le=32)] = 0


class MapInput(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One number in the registers.

    Parameters
    ----------
    input : int
        Number of the input.
    unit : str
        Of the value, such as `rpm` or `degc`.
    function : int
        3 holding registers, 4 input registers.
    address : int
        Of the first register, on the wire from 0.
    type : str
        `int16`, `uint16`, `int32`, `uint32` or `float32`.
    word_order : str
        `big` or `little`; 32-bit types only.
    scale, offset : float
        See the equation of this module.
    bad_values : dict
        Quality by number (`{"32767" = "open_circuit"}`), or numbers by quality (`{open_circuit = [32767]}`).
        Numbers are those in the registers, before scaling; whole ones also by their bits (`0x8000` of an `int16`).
    minimum, maximum : float, optional
        Limits of what is plausible, in the unit.
    """

    input: Annotated[int, msgspec.Meta(ge=0, lt=MOST_INPUTS)]
    unit: Name
    address: Annotated[int, msgspec.Meta(ge=0, le=65535)]
    type: NumberType
    function: Literal[3, 4] = 3
    word_order: WordOrder = "big"
    scale: float = 1.0
    offset: float = 0.0
    bad_values: dict[str, object] = {}
    minimum: float | None = None
    maximum: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Spot:
    """An input, its fault numbers, and the place of its words: poll, and first word in it."""

    config: MapInput
    bad: Mapping[float, Quality]
    poll: int
    start: int


class ModbusMap(ModbusDevice):
    """A device whose registers are given in its configuration."""

    def __init__(self, config: MapSettings, line: ModbusLine, where: Where) -> None:
        inputs: dict[int, MapInput] = {}
        bad: dict[int, dict[float, Quality]] = {}
        for table, spot in input_tables(config, where):
            given = settings(table, MapInput, spot)
            check_input(given.input, inputs, MOST_INPUTS, config.model, spot)
            _check(given, spot)
            inputs[given.input] = given
            bad[given.input] = _bad_values(given, spot)
        polls = group(list(inputs.values()), config.max_gap)
        self._spots = {
            number: _Spot(config=given, bad=bad[number], poll=poll, start=given.address - polls[poll].address)
            for number, given in inputs.items()
            for poll in [_poll_of(given, polls)]
        }
        units = {number: given.unit for number, given in inputs.items()}
        super().__init__(config, line, units=units, polls=polls)

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Decode, check and scale every input."""
        return {number: _reading(spot, answers[spot.poll]) for number, spot in self._spots.items()}


def group(inputs: Sequence[MapInput], max_gap: int) -> list[Request]:
    """Cover the inputs with few read requests.

    Parameters
    ----------
    inputs : sequence of MapInput
        In any order; they may overlap.
    max_gap : int
        Unused registers that may be read to save a request.
    """
    requests: list[Request] = []
    for given in sorted(inputs, key=lambda one: (one.function, one.address)):
        end = given.address + words_of(given.type)
        last = requests[-1] if requests else None
        if last is not None and last.function == given.function:
            stop = max(end, last.address + last.count)
            near = given.address <= last.address + last.count + max_gap
            if near and stop - last.address <= MOST_REGISTERS:
                requests[-1] = Request(function=last.function, address=last.address, count=stop - last.address)
                continue
        requests.append(Request(function=given.function, address=given.address, count=end - given.address))
    return requests


def _poll_of(given: MapInput, polls: Sequence[Request]) -> int:
    """Find the request that covers an input."""
    return next(
        index
        for index, poll in enumerate(polls)
        if poll.function == given.function
        and poll.address <= given.address
        and given.address + words_of(given.type) <= poll.address + poll.count
    )


def _check(given: MapInput, where: Where) -> None:
    """Raise where keys contradict each other."""
    if given.address + words_of(given.type) > 65536:
        raise where.wrong("address", given.address, f"room for {given.type} below 65536")
    for key in ("scale", "offset", "minimum", "maximum"):
        value = getattr(given, key)
        if value is not None and not math.isfinite(value):
            raise where.wrong(key, value, "a finite number")
    if given.scale == 0.0:
        raise where.wrong("scale", given.scale, "a number that is not 0")
    if given.minimum is not None and given.maximum is not None and given.minimum >= given.maximum:
        raise where.wrong("maximum", given.maximum, f"more than minimum ({given.minimum})")


def _bad_values(given: MapInput, where: Where) -> dict[float, Quality]:
    """Read the fault numbers in either of their two forms."""
    found: dict[float, Quality] = {}
    for key, value in given.bad_values.items():
        numbers, quality = (value, key) if key in _BAD else ([key], value)
        if not isinstance(quality, str) or quality not in _BAD:
            raise where.wrong(f"bad_values.{key}", value, one_of(_BAD))
        for number in numbers if isinstance(numbers, list) else [numbers]:
            try:
                # The bits of a float32 are no number: they would never be found.
                text = float if given.type == "float32" else lambda digits: int(digits, 0)
                raw: Any = text(number) if isinstance(number, str) else number
                decoded = as_decoded(float(raw), given.type)
                if not math.isfinite(decoded):
                    raise ValueError
                found[decoded] = _BAD[quality]
            except (TypeError, ValueError, OverflowError):
                expected = f"a number as in the registers, which {given.type} can hold"
                raise where.wrong(f"bad_values.{key}", number, expected) from None
    return found


def _reading(spot: _Spot, words: Sequence[int]) -> Reading:
    """Decode, check and scale one input."""
    given = spot.config
    number = decode(words[spot.start : spot.start + words_of(given.type)], given.type, given.word_order)
    if number in spot.bad:
        return Reading.bad(spot.bad[number], f"the device reports {number:g}")
    value = number * given.scale + given.offset
    if not math.isfinite(value):
        return Reading.bad(Quality.INVALID, f"not a finite number ({value})")
    if given.maximum is not None and value > given.maximum:
        return Reading.bad(Quality.OVER, f"{value:g} {given.unit}, plausible up to {given.maximum:g} {given.unit}")
    if given.minimum is not None and value < given.minimum:
        return Reading.bad(Quality.UNDER, f"{value:g} {given.unit}, plausible from {given.minimum:g} {given.unit}")
    return Reading.good(value)


MODELS = {"modbus-map": Family(protocols=MODBUS, kind=MapSettings, make=ModbusMap)}
