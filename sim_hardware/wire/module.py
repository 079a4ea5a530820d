"""A Modbus slave's memory, and the inputs of all measuring modules."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from sim_hardware.wire.faults import Faults, number

Source = Callable[[], float]
"""Give the present true value plus noise of an input, in °C, V, mA, µm or rpm; called at each request."""

ILLEGAL_FUNCTION = 1
ILLEGAL_ADDRESS = 2
ILLEGAL_VALUE = 3


class RefusalError(Exception):
    """Refuse a request with a Modbus exception reply.

    Parameters
    ----------
    code : int
        Exception code of the Modbus application protocol: 1 function, 2 address, 3 value.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Cell:
    """One coil or register: how it is read and, where allowed, written."""

    read: Callable[[], int]
    write: Callable[[int], None] | None = None


Table = dict[int, Cell]


class State(enum.Enum):
    """State of an input, as detected by the module."""

    GOOD = enum.auto()
    OPEN = enum.auto()
    OVER = enum.auto()
    UNDER = enum.auto()


@dataclass(frozen=True, slots=True)
class Sample:
    """One conversion of an input: the value in the input's unit, and its state."""

    value: float
    state: State


class Module:
    """Hold the four Modbus tables of a slave; addresses are those on the wire, counted from 0.

    Attributes
    ----------
    coils, discrete, holding, inputs : Table
        What functions 01/05/15, 02, 03/06/16 and 04 reach.
    faults : Faults
        The module's faults.
    """

    def __init__(self) -> None:
        self.coils: Table = {}
        self.discrete: Table = {}
        self.holding: Table = {}
        self.inputs: Table = {}
        self.faults = Faults()

    def begin(self) -> None:
        """Start a request: all its registers come from the same conversion."""

    def read(self, table: Table, address: int, count: int) -> list[int]:
        """Return `count` words or bits of a table.

        Raises
        ------
        RefusalError
            Code 2 if any address is not defined.
        """
        try:
            return [table[i].read() for i in range(address, address + count)]
        except KeyError:
            raise RefusalError(ILLEGAL_ADDRESS) from None

    def write(self, table: Table, address: int, values: list[int]) -> None:
        """Write words or bits to a table.

        Raises
        ------
        RefusalError
            Code 2 if any address is not defined or read-only; 3 if a value is not allowed there.
        """
        writers = []
        for i in range(address, address + len(values)):
            cell = table.get(i)
            if cell is None or cell.write is None:
                raise RefusalError(ILLEGAL_ADDRESS)
            writers.append(cell.write)
        for writer, value in zip(writers, values, strict=True):
            writer(value)

    def private(self, pdu: bytes) -> bytes | None:
        """Answer a function outside the Modbus standard; None if the module has no such function."""
        return None


class MeasuringModule(Module):
    """Add inputs to a module: sources, faults of inputs, and one conversion for each request.

    Parameters
    ----------
    sources : Mapping[int, Source]
        Source of each wired input, in the input's unit.
    channels : int
        Number of inputs, counted from 0.
    unwired : float
        Reading of an input without a source; NaN means an open circuit.
    """

    def __init__(self, sources: Mapping[int, Source], channels: int, unwired: float) -> None:
        super().__init__()
        alien = [i for i in sources if not 0 <= i < channels]
        if alien:
            raise ValueError(f"inputs {alien} do not exist: the module has 0..{channels - 1}")
        self.sources = dict(sources)
        self.channels = channels
        self._unwired = unwired
        self._now: dict[int, Sample] = {}
        self._last: dict[int, Sample] = {}

    def begin(self) -> None:
        """Start a request: forget the conversion of the last one."""
        self._now.clear()

    def sample(self, channel: int) -> Sample:
        """Return this request's conversion of an input, faults included."""
        sample = self._now.get(channel)
        if sample is None:
            sample = self._convert(channel)
            self._now[channel] = self._last[channel] = sample
        return sample

    def limits(self, channel: int) -> tuple[float, float]:
        """Return the range of an input, in the unit of its source."""
        raise NotImplementedError

    def _convert(self, channel: int) -> Sample:
        faults = self.faults.of_input(channel)
        if faults:
            if "frozen" in faults and channel in self._last:
                return self._last[channel]
            for name, state in _FORCED:
                if name in faults:
                    return Sample(math.nan, state)
            if "wild" in faults:
                return self._classify(channel, number(faults["wild"], "value", math.nan))
        source = self.sources.get(channel)
        return self._classify(channel, self._unwired if source is None else source())

    def _classify(self, channel: int, value: float) -> Sample:
        if value != value:  # NaN: the source has a broken wire  # noqa: PLR0124
            return Sample(value, State.OPEN)
        low, high = self.limits(channel)
        if value > high:
            return Sample(value, State.OVER)
        return Sample(value, State.UNDER if value < low else State.GOOD)


_FORCED = (("open", State.OPEN), ("over", State.OVER), ("under", State.UNDER))
