"""Moxa ioLogik E1262: eight thermocouple inputs on Modbus TCP.

Register map: E1200 series manual, appendix "E1262 Modbus Address and Register Map".
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping
from typing import Literal

from sim_hardware.wire.module import Cell, MeasuringModule, Source, State

MULTIPLIED = 2048
SCALED = 2064
MODEL = 5000
# Limits of a type K input; the data sheet gives a narrower range for other types.
LOW_DEGC, HIGH_DEGC = -200.0, 1300.0


class MoxaE1262(MeasuringModule):
    """Simulate an ioLogik E1262.

    Parameters
    ----------
    sources : Mapping[int, Source]
        Source of each wired input, °C.
    word_order : {"big", "little"}
        Which half of a 32-bit value comes first: the manual lists the high word first, software in the
        field reads the low word first.
    open_degc : float
        Reading of an open thermocouple, °C. The manual does not say; the default is the top of the range.
    """

    def __init__(
        self,
        *,
        sources: Mapping[int, Source],
        word_order: Literal["big", "little"] = "big",
        open_degc: float = HIGH_DEGC,
    ) -> None:
        if word_order not in {"big", "little"}:
            raise ValueError(f"word_order must be big or little, not {word_order!r}")
        super().__init__(sources, 8, float("nan"))
        self._high_first = word_order == "big"
        self._open_degc = open_degc
        for i in range(self.channels):
            for half in (0, 1):
                at = 2 * i + half
                self.inputs[MULTIPLIED + at] = Cell(functools.partial(self._multiplied, i, half))
                self.inputs[SCALED + at] = Cell(functools.partial(self._scaled, i, half))
        self.inputs[MODEL] = Cell(lambda: 0x1262)

    def limits(self, channel: int) -> tuple[float, float]:
        """Return the range of the inputs, °C."""
        return LOW_DEGC, HIGH_DEGC

    def _degc(self, channel: int) -> float:
        sample = self.sample(channel)
        if sample.state is State.OPEN:
            return self._open_degc
        if sample.state is State.GOOD:
            return sample.value
        return HIGH_DEGC if sample.state is State.OVER else LOW_DEGC

    def _half(self, packed: bytes, half: int) -> int:
        high, low = struct.unpack(">HH", packed)
        first, second = (high, low) if self._high_first else (low, high)
        return int(second if half else first)

    def _multiplied(self, channel: int, half: int) -> int:
        return self._half(struct.pack(">i", round(self._degc(channel) * 10.0)), half)

    def _scaled(self, channel: int, half: int) -> int:
        # The converter resolves 0.1 °C; the float carries no more than the integer does.
        return self._half(struct.pack(">f", round(self._degc(channel) * 10.0) / 10.0), half)
