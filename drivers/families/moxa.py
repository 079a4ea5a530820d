"""Moxa ioLogik E1262: eight thermocouple inputs over Modbus TCP.

Two register blocks hold the same temperatures, both with two words for each input: a float, or a count of
0.1 °C. Manual and field reports differ on the order of the words, so it must be set: compare a reading with
a thermometer. The manual does not say what an open thermocouple reads; anything outside the type's range is
marked bad.

Source: ioLogik E1200 series user's manual, appendix on the E1262's Modbus map.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from drivers.families.base import MODBUS_TCP, Family, ModbusDevice, ModbusSettings
from drivers.families.inputs import thermocouples
from drivers.lines.modbus_line import ModbusLine
from drivers.protocols.modbus import READ_INPUT, Request
from drivers.protocols.registers import WordOrder, decode
from drivers.protocols.thermocouples import STANDARD
from drivers.reading import Reading
from drivers.settings import Where

INPUTS = 8
_BLOCKS = {"scaled": 2064, "multiplied": 2048}


class MoxaSettings(ModbusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of an E1262.

    Parameters
    ----------
    couple : str, optional
        Thermocouple type of the inputs that name none.
    register : str
        `scaled`: float, °C. `multiplied`: 32-bit count of 0.1 °C.
    word_order : str
        `big` (high word first, as the manual prints it) or `little`.
    """

    word_order: WordOrder
    couple: str | None = None
    register: Literal["scaled", "multiplied"] = "scaled"


class MoxaE1262(ModbusDevice):
    """An ioLogik E1262."""

    def __init__(self, config: MoxaSettings, line: ModbusLine, where: Where) -> None:
        self._types = thermocouples(config, STANDARD, INPUTS, where, config.couple)
        self._config = config
        super().__init__(
            config,
            line,
            units=dict.fromkeys(self._types, "degc"),
            polls=[Request(function=READ_INPUT, address=_BLOCKS[config.register], count=2 * INPUTS)],
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Decode the word pairs of the configured inputs."""
        config, words = self._config, answers[0]
        kind, scale = ("float32", 1.0) if config.register == "scaled" else ("int32", 0.1)
        return {
            number: STANDARD[letter].reading(
                decode(words[2 * number : 2 * number + 2], kind, config.word_order) * scale
            )
            for number, letter in self._types.items()
        }


MODELS = {"moxa-e1262": Family(protocols=MODBUS_TCP, kind=MoxaSettings, make=MoxaE1262)}
