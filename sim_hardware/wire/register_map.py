"""An arbitrary Modbus register map: drive, chiller, PLC."""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from sim_hardware.wire.module import Cell, MeasuringModule, Source, State

Kind = Literal["int16", "uint16", "int32", "uint32", "float32"]
_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}
_LIMITS = {
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Register:
    """One quantity in a register map.

    Parameters
    ----------
    source : Source
        The quantity, in its unit.
    per_unit : float
        Counts in one unit: 10 for a register of 0.1 °C.
    kind : str
        `int16`, `uint16`, `int32`, `uint32` or `float32`; the last three take two registers.
    word_order : {"big", "little"}
        Which half of a 32-bit value comes first.
    open_word : int
        What each of its registers holds while the input fault "open" is on.
    """

    source: Source
    per_unit: float = 1.0
    kind: Kind = "int16"
    word_order: Literal["big", "little"] = "big"
    open_word: int = 0x7FFF

    @property
    def words(self) -> int:
        """Number of registers it takes."""
        return struct.calcsize(_FORMATS[self.kind]) // 2


class RegisterMap(MeasuringModule):
    """Simulate a slave with an arbitrary map.

    Parameters
    ----------
    registers : Mapping[int, Register]
        Quantities by wire address; the address is also the number of the input for its faults.
    coils : Mapping[int, Source], optional
        Bits by wire address, on where the source is not 0.
    constants : Mapping[int, int], optional
        Words that do not change.
    tables : {"both", "holding", "input"}
        Whether function 03, 04 or both reach the registers.

    Raises
    ------
    ValueError
        If two entries share an address.
    """

    def __init__(
        self,
        registers: Mapping[int, Register],
        *,
        coils: Mapping[int, Source] | None = None,
        constants: Mapping[int, int] | None = None,
        tables: Literal["both", "holding", "input"] = "both",
    ) -> None:
        sources = {address: register.source for address, register in registers.items()}
        super().__init__(sources, max(sources, default=-1) + 1, 0.0)
        self._registers = dict(registers)
        cells: dict[int, Cell] = {}
        for address, register in registers.items():
            for half in range(register.words):
                if address + half in cells:
                    raise ValueError(f"two registers at address {address + half}")
                cells[address + half] = Cell(functools.partial(self._word, address, half))
        for address, word in (constants or {}).items():
            if address in cells:
                raise ValueError(f"two registers at address {address}")
            cells[address] = Cell(functools.partial(int, word))
        self.holding = cells if tables != "input" else {}
        self.inputs = cells if tables != "holding" else {}
        for address, source in (coils or {}).items():
            self.coils[address] = self.discrete[address] = Cell(functools.partial(_bit, source))

    def limits(self, channel: int) -> tuple[float, float]:
        """Return what the register can hold, in the unit of the quantity."""
        register = self._registers[channel]
        if register.kind == "float32":
            return -3.4e38, 3.4e38
        low, high = _LIMITS[register.kind]
        return low / register.per_unit, high / register.per_unit

    def _word(self, address: int, half: int) -> int:
        register, sample = self._registers[address], self.sample(address)
        if sample.state is State.OPEN:
            return register.open_word
        low, high = self.limits(address)
        value = high if sample.state is State.OVER else low if sample.state is State.UNDER else sample.value
        count: float = value * register.per_unit
        if register.kind != "float32":
            count = round(count)
        packed = struct.pack(_FORMATS[register.kind], count)
        if register.words == 2 and register.word_order == "little":
            half = 1 - half
        return int.from_bytes(packed[2 * half : 2 * half + 2], "big")


def _bit(source: Source) -> int:
    return int(source() != 0.0)
