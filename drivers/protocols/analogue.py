"""Words of modules with voltage inputs.

Sources: ICP DAS ET-7000/PET-7000 register table, appendix A; Advantech ADAM-4000 manual (voltage ranges
report the clamped value out of range).
"""

from __future__ import annotations

from drivers.protocols.thermocouples import OPEN_WORD, UNDER_WORD
from drivers.reading import Quality, Reading

# Ranges by full scale in V, with their type code, the same for both makers.
RANGE_CODES = {10.0: 0x08, 5.0: 0x09, 1.0: 0x0A, 0.5: 0x0B, 0.15: 0x0C}


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
