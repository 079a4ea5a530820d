"""Advantech modules: ADAM-4018+, 4118, 4117 (RTU, ADAM ASCII) and ADAM-6018, 6017 (TCP).

Register map from the Modbus mapping tables of the ADAM-4000/4100/6000 manuals; word scaling from
Advantech's published .NET library: ``value = low + raw / 65535 * (high - low)``, raw unsigned.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

from sim_hardware.wire.module import ILLEGAL_VALUE, Cell, RefusalError, Sample, Source, State
from sim_hardware.wire.ranges import ADAM_4118_VOLTS, ADAM_THERMOCOUPLES, ADAM_VOLTS, Range, RangedModule, Wanted


@dataclass(frozen=True, slots=True, kw_only=True)
class _Model:
    offered: tuple[Range, ...]
    default: str
    burn_out: int | None
    name: str
    name_words: tuple[int, int]


_MODELS = {
    "adam-4018+": _Model(
        offered=ADAM_THERMOCOUPLES, default="K", burn_out=0, name="4018P", name_words=(0x4018, 0x5000)
    ),
    "adam-4118": _Model(
        offered=ADAM_4118_VOLTS + ADAM_THERMOCOUPLES,
        default="K",
        burn_out=0,
        name="4118",
        name_words=(0x4118, 0x0000),
    ),
    "adam-6018": _Model(offered=ADAM_THERMOCOUPLES, default="K", burn_out=0, name="6018", name_words=(0x6018, 0x0000)),
    "adam-4117": _Model(offered=ADAM_VOLTS, default="10V", burn_out=None, name="4117", name_words=(0x4117, 0x0000)),
    "adam-6017": _Model(offered=ADAM_VOLTS, default="10V", burn_out=None, name="6017", name_words=(0x6017, 0x0000)),
}


class Adam(RangedModule):
    """Simulate an Advantech ADAM analogue input module with eight channels.

    Parameters
    ----------
    model : str
        `adam-4018+`, `adam-4118`, `adam-6018`, `adam-4117` or `adam-6017`.
    ranges : str, int, sequence or mapping, optional
        Range of the channels by name ("K", "10V") or type code. Default type K, or ±10 V.
    sources : Mapping[int, Source]
        Source of each wired input: °C, V or mA.
    burn_out_coil : int, optional
        Address of the burn-out flag of channel 0. The manuals consulted print 0 for the serial modules;
        for the 6018 no number was found, so it may be set.
    hundredths : bool
        Whether words count 0.01 in two's complement instead of 1/65535 of the range: modules configured
        for engineering units exist in the field.
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
        burn_out_coil: int | None = None,
        hundredths: bool = False,
        cjc_degc: float = 25.0,
    ) -> None:
        self.model = model.lower()
        if self.model not in _MODELS:
            raise ValueError(f"no ADAM model {model!r}: {', '.join(_MODELS)}")
        spec = _MODELS[self.model]
        unwired = 0.0 if spec.burn_out is None else float("nan")
        super().__init__(sources, 8, unwired, offered=spec.offered, ranges=ranges, default=spec.default)
        self.name = spec.name
        self.firmware = "A1.06"
        self.type_per_channel = True
        self.enabled = 0xFF
        self.cjc_degc = cjc_degc
        self._hundredths = hundredths
        self._build(spec, spec.burn_out if burn_out_coil is None else burn_out_coil)

    def bad(self, channel: int) -> bool:
        """Return whether the module sees a thermocouple outside its range or open."""
        return self.ranges[channel].thermocouple and self.sample(channel).state is not State.GOOD

    def displayed(self, channel: int) -> Sample:
        """Return a conversion in the displayed unit; voltages and currents stop at their limits."""
        span, sample = self.ranges[channel], self.sample(channel)
        value = sample.value * span.per_source_unit
        if span.thermocouple:
            return Sample(value, sample.state)
        if sample.state is State.OPEN:
            value = 0.0
        value = span.high if sample.state is State.OVER else span.low if sample.state is State.UNDER else value
        return Sample(min(max(value, span.low), span.high), State.GOOD)

    def quantised(self, channel: int) -> Sample:
        """Return the displayed value as the 16-bit word resolves it."""
        span, sample = self.ranges[channel], self.displayed(channel)
        if sample.state is not State.GOOD:
            return sample
        return Sample(span.low + _steps(sample.value, span) / 65535.0 * (span.high - span.low), State.GOOD)

    def hex_word(self, channel: int) -> int:
        """Return the word of ADAM ASCII's two's complement format, where 7FFF is the top of the range."""
        span, sample = self.ranges[channel], self.displayed(channel)
        if sample.state is not State.GOOD:
            return 0x0000 if sample.state is State.UNDER else 0xFFFF
        scale = 32767.0 if sample.value >= 0.0 else 32768.0
        return round(sample.value / span.full_scale * scale) & 0xFFFF

    def _word(self, channel: int) -> int:
        if not self.enabled >> channel & 1:
            return 0
        span, sample = self.ranges[channel], self.displayed(channel)
        if sample.state is not State.GOOD:
            return 0x0000 if sample.state is State.UNDER else 0xFFFF
        return round(sample.value * 100.0) & 0xFFFF if self._hundredths else _steps(sample.value, span)

    def _build(self, about: _Model, burn_out: int | None) -> None:
        for i in range(self.channels):
            self.holding[i] = self.inputs[i] = Cell(functools.partial(self._word, i))
            self.holding[200 + i] = self._type(i)
            if burn_out is not None:
                self.coils[burn_out + i] = self.discrete[burn_out + i] = Cell(functools.partial(self._open, i))
        words = (*about.name_words, 0xA106, 0x0000, 0, 0)
        for i, word in enumerate(words):
            self.holding[210 + i] = Cell(functools.partial(int, word))
        self.holding[220] = Cell(lambda: self.enabled, self._enable)

    def _type(self, channel: int) -> Cell:
        return Cell(lambda: self.ranges[channel].code, lambda code: self.set_type(code, channel))

    def _enable(self, mask: int) -> None:
        if mask > 0xFF:
            raise RefusalError(ILLEGAL_VALUE)
        self.enabled = mask

    def _open(self, channel: int) -> int:
        return int(self.ranges[channel].thermocouple and self.sample(channel).state is State.OPEN)


def _steps(value: float, span: Range) -> int:
    """Return the unsigned word of a displayed value: 0 at the bottom of the range, 65535 at the top."""
    return round(min(max((value - span.low) / (span.high - span.low), 0.0), 1.0) * 65535.0)
