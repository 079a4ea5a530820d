"""Moxa ioLogik E1262: eight thermocouple inputs over Modbus TCP.

Two register blocks give the same temperatures, both with two words for each input: a float, or a count of
0.1 °C. Manual and field reports differ on the order of the words, so it must be set: compare a reading with
a thermometer. The manual does not say what an open couple reads; anything outside the couple's range is
marked bad.

Source: ioLogik E1200 series user's manual, appendix on the E1262's Modbus map.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from drivers.families.base import MODBUS_TCP, Family, ModbusDevice, ModbusSettings
from drivers.families.inputs import thermocouples
from drivers.lines.modbus_line import ModbusLine
from drivers.protocols.couples import STANDARD
from drivers.protocols.modbus import READ_INPUT, Request
from drivers.protocols.registers import WordOrder, decode
from drivers.reading import Reading
from drivers.settings import Where

INPUTS = 8
_BLOCKS = {"scaled": 2064, "multiplied": 2048}


class MoxaSettings(ModbusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of an E1262.

    Parameters
    ----------
    couple : str, optional
        Couple of the inputs that name none.
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

    def __init__(self, about: MoxaSettings, line: ModbusLine, where: Where) -> None:
        self._couples = thermocouples(about, STANDARD, INPUTS, where, about.couple)
        self._about = about
        super().__init__(
            about,
            line,
            units=dict.fromkeys(self._couples, "degc"),
            polls=[Request(function=READ_INPUT, address=_BLOCKS[about.register], count=2 * INPUTS)],
        )

    def readings(self, answers: Sequence[Sequence[int]]) -> dict[int, Reading]:
        """Decode the word pairs of the configured inputs."""
        about, words = self._about, answers[0]
        kind, scale = ("float32", 1.0) if about.register == "scaled" else ("int32", 0.1)
        return {
            number: STANDARD[letter].judged(decode(words[2 * number : 2 * number + 2], kind, about.word_order) * scale)
            for number, letter in self._couples.items()
        }


MODELS = {"moxa-e1262": Family(protocols=MODBUS_TCP, kind=MoxaSettings, make=MoxaE1262)}
