"""ICP DAS modules: M-7018/7018R/7019R, tM-TH8, M-7017 (RTU) and ET-7017/7018Z (TCP).

Register maps from the Modbus tables of the I-7018/M-7018 and tM-TH8 manuals and of the "ET-7000/PET-7000
Register Table" 1.0.3. Assumptions where they are silent are in the README.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from sim_hardware.wire.module import ILLEGAL_VALUE, Cell, RefusalError, Sample, Source, State
from sim_hardware.wire.ranges import (
    ICP_HIGH_VOLTS,
    ICP_LOW_VOLTS,
    ICP_THERMOCOUPLES,
    RangedModule,
    Wanted,
    decode_hex,
    encode_hex,
)

OPEN_WORD = 0x7FFF
UNDER_WORD = 0x8000
READ_SETTINGS = 0x46


@dataclass(frozen=True, slots=True, kw_only=True)
class _Model:
    channels: int
    name_bytes: bytes
    thermocouples: bool
    map: Literal["m-7000", "et-7000"]
    detects_open: bool = True
    type_per_channel: bool = False
    status_bits: bool = False


_M18 = bytes.fromhex("00701800")
_M19 = bytes.fromhex("00701900")
_MODELS = {
    "m-7018": _Model(channels=8, name_bytes=_M18, thermocouples=True, map="m-7000", detects_open=False),
    "m-7018r": _Model(channels=8, name_bytes=_M18, thermocouples=True, map="m-7000"),
    "m-7019r": _Model(
        channels=8, name_bytes=_M19, thermocouples=True, map="m-7000", type_per_channel=True, status_bits=True
    ),
    "tm-th8": _Model(
        channels=8,
        name_bytes=bytes.fromhex("07550000"),
        thermocouples=True,
        map="m-7000",
        type_per_channel=True,
        status_bits=True,
    ),
    "m-7017": _Model(channels=8, name_bytes=bytes.fromhex("00701700"), thermocouples=False, map="m-7000"),
    "et-7018z": _Model(channels=10, name_bytes=_M18, thermocouples=True, map="et-7000"),
    "et-7017": _Model(channels=8, name_bytes=bytes.fromhex("00701700"), thermocouples=False, map="et-7000"),
}


class IcpDas(RangedModule):
    """Simulate an ICP DAS analogue input module.

    In hexadecimal format a word is ``value / full_scale * 32767`` for positive and ``* 32768`` for negative
    values; in engineering format it counts 0.1 °C (0.01 °C for type M), or the decimals of a voltage range.

    Parameters
    ----------
    model : str
        `m-7018`, `m-7018r`, `m-7019r`, `tm-th8`, `m-7017`, `et-7018z` or `et-7017`; an `i-` for the `m-` is
        the same module.
    ranges : str, int, sequence or mapping, optional
        Range of the channels by name ("K", "10V") or type code. The factory setting is
        ±2.5 V for thermocouple modules and ±10 V for analogue ones.
    sources : Mapping[int, Source]
        Source of each wired input: °C, V or mA.
    data_format : {"hex", "engineering"}
        State of the data-format coil; Modbus only.
    cjc_degc : float
        Temperature of the terminals, °C.

    Raises
    ------
    ValueError
        If the model, a range or a channel does not exist.
    """

    def __init__(
        self,
        model: str,
        *,
        sources: Mapping[int, Source],
        ranges: Wanted = None,
        data_format: Literal["hex", "engineering"] = "hex",
        cjc_degc: float = 25.0,
    ) -> None:
        self.model = model.lower()
        key = self.model.replace("i-", "m-", 1) if self.model.startswith("i-") else self.model
        if key not in _MODELS:
            raise ValueError(f"no ICP DAS model {model!r}: {', '.join(_MODELS)}")
        spec = self._spec = _MODELS[key]
        super().__init__(
            sources,
            spec.channels,
            float("nan") if spec.thermocouples else 0.0,
            offered=ICP_LOW_VOLTS + ICP_THERMOCOUPLES if spec.thermocouples else ICP_HIGH_VOLTS,
            ranges=ranges,
            default=0x05 if spec.thermocouples else 0x08,
        )
        if data_format not in {"hex", "engineering"}:
            raise ValueError(f"data_format must be hex or engineering, not {data_format!r}")
        self.data_format = data_format
        self.cjc_degc = cjc_degc
        self.enabled = (1 << self.channels) - 1
        self.cjc_enabled = True
        self.filter_50hz = True
        self.name = f"{self.model[2:] if key[1] == '-' else self.model}".upper()
        self.firmware = "A2.0"
        self._cjc_offsets = [0] * self.channels
        if self._spec.map == "m-7000":
            self._build_m7000()
        else:
            self._build_et7000()

    @property
    def type_per_channel(self) -> bool:
        """Whether each channel has its own type code."""
        return self._spec.type_per_channel

    def bad(self, channel: int) -> bool:
        """Return whether the module sees an input outside its range or open."""
        state = self.sample(channel).state
        if state is State.OPEN:
            return self._spec.detects_open and self.ranges[channel].thermocouple
        return state is not State.GOOD

    def displayed(self, channel: int) -> Sample:
        """Return a conversion in the displayed unit, as far as the module can tell what it sees.

        A module without wire detection reads an open thermocouple as the temperature of its terminals.
        Voltage and current inputs have no out-of-range state: they stop at their limits.
        """
        span, sample = self.ranges[channel], self.sample(channel)
        state, value = sample.state, sample.value * span.per_source_unit
        if state is State.OPEN and not (span.thermocouple and self._spec.detects_open):
            value, state = (self.cjc_degc if span.thermocouple else 0.0), State.GOOD
        if not span.thermocouple:
            value = span.high if state is State.OVER else span.low if state is State.UNDER else value
            return Sample(min(max(value, span.low), span.high), State.GOOD)
        return Sample(value, state)

    def hex_word(self, channel: int) -> int:
        """Return the 16-bit word of an input in hexadecimal format."""
        span, sample = self.ranges[channel], self.displayed(channel)
        if sample.state is not State.GOOD:
            return UNDER_WORD if sample.state is State.UNDER else OPEN_WORD
        return encode_hex(sample.value, span)

    def quantised(self, channel: int) -> Sample:
        """Return the displayed value as the 16-bit converter resolves it."""
        span, sample = self.ranges[channel], self.displayed(channel)
        if sample.state is not State.GOOD:
            return sample
        return Sample(decode_hex(encode_hex(sample.value, span), span), State.GOOD)

    def private(self, pdu: bytes) -> bytes | None:
        """Answer function 0x46: sub-function 00 reads the module name, others are refused."""
        if pdu[0] != READ_SETTINGS or self._spec.map != "m-7000":
            return None
        if pdu[1:] == b"\x00":
            return bytes((READ_SETTINGS, 0)) + self._spec.name_bytes
        # The manuals give 02 for a sub-function that the module does not have.
        return bytes((READ_SETTINGS | 0x80, 2))

    def _word(self, channel: int) -> int:
        if not self.enabled >> channel & 1:
            return 0
        if self.data_format == "hex":
            return self.hex_word(channel)
        span, sample = self.ranges[channel], self.quantised(channel)
        if sample.state is not State.GOOD:
            return UNDER_WORD if sample.state is State.UNDER else OPEN_WORD
        return round(sample.value * span.engineering_per_unit) & 0xFFFF

    def _build_m7000(self) -> None:
        both: dict[int, Cell] = {}
        bits: dict[int, Cell] = {}
        for i in range(self.channels):
            both[i] = Cell(functools.partial(self._word, i))
            both[352 + i] = self._cjc_offset(i)
            if self._spec.type_per_channel:
                both[256 + i] = self._type(i)
            if self._spec.status_bits:
                bits[128 + i] = Cell(functools.partial(self._flag, i))
        if self._spec.thermocouples:
            both[128] = Cell(lambda: round(self.cjc_degc * 100.0) & 0xFFFF)
            bits[267] = self._attribute("cjc_enabled")
        both[480], both[481] = Cell(lambda: 0x0200), Cell(lambda: 0x000A)
        name = self._spec.name_bytes
        both[482] = Cell(lambda: int.from_bytes(name[2:], "big"))
        both[483] = Cell(lambda: int.from_bytes(name[:2], "big"))
        if not self._spec.type_per_channel:
            both[486] = Cell(lambda: self.ranges[0].code, self.set_type)
        both[489] = self._attribute("enabled", (1 << self.channels) - 1)
        bits[256] = Cell(lambda: 1)
        bits[258] = self._attribute("filter_50hz")
        bits[268] = Cell(lambda: int(self.data_format == "engineering"), self._set_format)
        self.holding = self.inputs = both
        self.coils = self.discrete = bits

    def _build_et7000(self) -> None:
        for i in range(self.channels):
            self.inputs[i] = Cell(functools.partial(self._word, i))
            self.holding[427 + i] = self._type(i)
            self.holding[491 + i] = self._cjc_offset(i)
            self.coils[595 + i] = self._enable(i)
        self.inputs[143] = Cell(lambda: round(self.cjc_degc * 10.0) & 0xFFFF)
        self.inputs[320] = Cell(lambda: self.channels)
        self.inputs[351] = Cell(lambda: 0x0123)
        self.holding[271] = Cell(lambda: 1)
        self.holding[559] = Cell(lambda: int.from_bytes(self._spec.name_bytes[1:3], "big"))
        self.coils[627] = self._attribute("cjc_enabled")
        self.coils[629] = self._attribute("filter_50hz")
        self.coils[631] = Cell(lambda: int(self.data_format == "engineering"), self._set_format)

    def _attribute(self, name: str, largest: int = 1) -> Cell:
        def write(value: int) -> None:
            if value > largest:
                raise RefusalError(ILLEGAL_VALUE)
            setattr(self, name, value)

        return Cell(lambda: int(getattr(self, name)), write)

    def _cjc_offset(self, channel: int) -> Cell:
        offsets = self._cjc_offsets
        return Cell(lambda: offsets[channel], functools.partial(offsets.__setitem__, channel))

    def _type(self, channel: int) -> Cell:
        return Cell(lambda: self.ranges[channel].code, lambda code: self.set_type(code, channel))

    def _enable(self, channel: int) -> Cell:
        def write(value: int) -> None:
            self.enabled = self.enabled & ~(1 << channel) | value << channel

        return Cell(lambda: self.enabled >> channel & 1, write)

    def _flag(self, channel: int) -> int:
        return int(self.bad(channel))

    def _set_format(self, value: int) -> None:
        self.data_format = "engineering" if value else "hex"
