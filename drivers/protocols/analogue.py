"""Voltage inputs, and the capacitive amplifiers that are read through them.

Displacement of an amplifier with a linear output:

`displacement_um = standoff_um + polarity × um_per_v × U`

`um_per_v` is the probe's sensitivity (> 0) from its calibration sheet. `polarity` is +1 where the voltage
rises with the gap and −1 where it falls. `standoff_um` is the reading at 0 V: the stand-off at which the
probe was calibrated to 0 V where the reading is the gap itself, or 0 where it is the change from there.

An amplifier off its range, or a probe that touches, drives the output to its limit. Such a voltage is valid as
a voltage, so the limits of the linear output are given with the probe: `volt_min`, `volt_max`.

Sources: ICP DAS ET-7000/PET-7000 register table, appendix A; Advantech ADAM-4000 manual (voltage ranges
report the clamped value out of range).
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from drivers.protocols.thermocouples import OPEN_WORD, UNDER_WORD
from drivers.reading import Quality, Reading
from drivers.settings import Where, settings

Volt = Annotated[float, msgspec.Meta(ge=-100.0, le=100.0)]

# Ranges by full scale in V, with their type code, the same for both makers.
RANGE_CODES = {10.0: 0x08, 5.0: 0x09, 1.0: 0x0A, 0.5: 0x0B, 0.15: 0x0C}


class Probe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
        See `Probe`; without it the reading is in V.
    """

    input: Annotated[int, msgspec.Meta(ge=0)]
    probe: dict[str, object] | None = None


def probe_settings(table: dict[str, object] | None, where: Where) -> Probe | None:
    """Convert the `probe` table of an input.

    Raises
    ------
    DriverConfigError
        A key is wrong, or the limits are reversed.
    """
    if table is None:
        return None
    probe = settings(table, Probe, where)
    if probe.volt_min >= probe.volt_max:
        raise where.wrong("volt_max", probe.volt_max, f"more than volt_min ({probe.volt_min})")
    return probe


def reading_of(volts: float | Reading, probe: Probe | None) -> Reading:
    """Make the reading of an input from its voltage, V or µm.

    Examples
    --------
    >>> probe = Probe(um_per_v=5.0, polarity=-1, standoff_um=50.0, volt_min=-9.9, volt_max=9.9)
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


def icpdas_volts(raw: int, range_v: float, form: str) -> float | Reading:
    """Scale a word of an ICP DAS module: two's complement of full scale, or mV in engineering format (±10 V).

    Returns
    -------
    float or Reading
        V, or a bad reading where the word is at an end of the range: the module clamps there.

    Examples
    --------
    >>> icpdas_volts(0xF060, 10.0, "engineering")
    -4.0
    """
    high, low = (10000, -10000) if form == "engineering" else (OPEN_WORD, UNDER_WORD - 0x10000)
    value = raw - (raw >> 15 << 16)
    if value >= high:
        return Reading.bad(Quality.OVER, f"at the top of the range of {range_v:g} V")
    if value <= low:
        return Reading.bad(Quality.UNDER, f"at the bottom of the range, -{range_v:g} V")
    return value / 1000.0 if form == "engineering" else value / 32767.0 * range_v


def advantech_volts(raw: int, range_v: float) -> float | Reading:
    """Scale a word of an Advantech module: `word / 65535 × 2 R − R`, offset binary.

    Returns
    -------
    float or Reading
        V, or a bad reading where the word is at an end of the range: the module clamps there.

    Examples
    --------
    >>> round(advantech_volts(33271, 0.15) * 1000, 2)
    2.3
    """
    if raw == 0xFFFF:
        return Reading.bad(Quality.OVER, f"at the top of the range of {range_v:g} V")
    if raw == 0:
        return Reading.bad(Quality.UNDER, f"at the bottom of the range, -{range_v:g} V")
    return raw / 65535.0 * 2.0 * range_v - range_v
