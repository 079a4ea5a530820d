"""Measurement blocks of the capaNCDT 6200 data port.

Source: Micro-Epsilon capaNCDT 6200 operating instructions, "Ethernet Interface".
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

HEADER = struct.Struct("<4siiQIHHI")
FULL_SCALE = 0xFFFFFF
ORDER_NUMBER = 2412058
SERIAL_NUMBER = 20061


def raw(value_um: float, range_um: float) -> int:
    """Return the 24-bit value of a distance; the converter stops at the ends of the range.

    Parameters
    ----------
    value_um, range_um : float
        Distance and measuring range, µm.

    Examples
    --------
    >>> hex(raw(1000.0, 2000.0)), raw(-3.0, 2000.0), hex(raw(2500.0, 2000.0))
    ('0x7fffff', 0, '0xffffff')
    """
    return int(min(max(value_um / range_um, 0.0), 1.0) * FULL_SCALE)


def block(channels: Iterable[int], frames: Sequence[Sequence[int]], counter: int) -> bytes:
    """Return one block.

    Parameters
    ----------
    channels : iterable of int
        Numbers of the channels present, from 1.
    frames : sequence of sequences of int
        One raw value per channel in each frame, the lowest channel first.
    counter : int
        Measuring-value counter of the first frame.
    """
    present = sum(1 << 2 * (number - 1) for number in channels)
    size = len(frames[0])
    header = HEADER.pack(
        b"MEAS",
        ORDER_NUMBER,
        SERIAL_NUMBER,
        present,
        0,
        len(frames),
        4 * size,
        counter & 0xFFFFFFFF,
    )
    return header + b"".join(struct.pack(f"<{size}i", *frame) for frame in frames)
