"""Micro-Epsilon capaNCDT 6200: blocks of the data port, replies of the command port.

A block is a header of 32 bytes and M frames, everything little-endian:

| field | bytes |
| --- | --- |
| `MEAS` | 4 |
| order number, serial number | 4 + 4 |
| channels present, two bits each from the lowest, 01 = present | 8 |
| status, unused | 4 |
| frames M, bytes for each frame (4 × channels) | 2 + 2 |
| counter of the first frame | 4 |
| M frames of one int32 for each present channel | |

`µm = value / 0xFFFFFF × measuring range`. Source: capaNCDT 6200 operating instructions, Ethernet interface.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

PREAMBLE = b"MEAS"
FULL_SCALE = 0xFFFFFF
MOST_CHANNELS = 32
# A block never holds this many frames; a greater length means a preamble found in measurements.
MOST_FRAMES = 4096
_HEADER = struct.Struct("<4siiQIHHI")
# Order number, serial number and channels: the same in every block of a controller.
_SENDER = slice(4, 20)
_ODD_BITS = 0xAAAAAAAAAAAAAAAA


class BadReplyError(ValueError):
    """A reply of the command port that cannot be used; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """One block of frames.

    Parameters
    ----------
    counter : int
        Of the first frame, 32 bits.
    channels : tuple of int
        Numbers of the channels present, from 0.
    values : tuple of int
        Frame after frame, one value for each channel.
    """

    counter: int
    channels: tuple[int, ...]
    values: tuple[int, ...]

    @property
    def frames(self) -> int:
        """Frames in the block."""
        return len(self.values) // len(self.channels)

    def of(self, channel: int) -> tuple[int, ...]:
        """Return the values of one channel; empty when it is absent."""
        if channel not in self.channels:
            return ()
        return self.values[self.channels.index(channel) :: len(self.channels)]


class Blocks:
    """Cut a stream of bytes into blocks, which may come split, joined, or between other bytes.

    Attributes
    ----------
    skipped : int
        Bytes skipped because they belong to no block.
    """

    def __init__(self) -> None:
        self._rest = bytearray()
        self.skipped = 0

    def feed(self, data: bytes) -> list[Block]:
        """Add received bytes; return the blocks that are now complete."""
        self._rest += data
        blocks: list[Block] = []
        while True:
            start = self._rest.find(PREAMBLE)
            if start < 0:
                # The tail may be the beginning of a preamble.
                self._skip(max(0, len(self._rest) - len(PREAMBLE) + 1))
                return blocks
            self._skip(start)
            if len(self._rest) < _HEADER.size:
                return blocks
            _, _, _, present, _, frames, width, counter = _HEADER.unpack_from(self._rest)
            channels = tuple(n for n in range(MOST_CHANNELS) if present >> 2 * n & 1)
            plausible = not present & _ODD_BITS and channels and 4 * len(channels) == width
            if not plausible or not 1 <= frames <= MOST_FRAMES:
                self._skip(len(PREAMBLE))
                continue
            size = _HEADER.size + frames * width
            # Another block begins within this one: it was truncated, continue there.
            inner, certain = self._inner_header(size)
            if inner and certain:
                self._skip(inner)
                continue
            if inner or len(self._rest) < size:
                return blocks
            values = struct.unpack_from(f"<{frames * len(channels)}i", self._rest, _HEADER.size)
            blocks.append(Block(counter=counter, channels=channels, values=values))
            del self._rest[:size]

    def _inner_header(self, size: int) -> tuple[int, bool]:
        """Find a header like the first one before the block's end.

        Returns
        -------
        int
            Its start; 0 where there is none.
        bool
            False while too little of it has come to exclude measurements.
        """
        sender = bytes(self._rest[_SENDER])
        reach = size + len(PREAMBLE) - 1
        start = self._rest.find(PREAMBLE, len(PREAMBLE), reach)
        while start > 0:
            other = bytes(self._rest[start + _SENDER.start : start + _SENDER.stop])
            if other == sender[: len(other)]:
                return start, len(other) == len(sender)
            start = self._rest.find(PREAMBLE, start + 1, reach)
        for start in range(size - 1, size - len(PREAMBLE), -1):
            begun = bytes(self._rest[start:reach])
            if begun and len(begun) < len(PREAMBLE) and PREAMBLE.startswith(begun):
                return start, False
        return 0, False

    def _skip(self, count: int) -> None:
        self.skipped += count
        del self._rest[:count]


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """A channel, as the controller describes it.

    Parameters
    ----------
    range_um : float
        Measuring range, µm.
    sensor : str
        Name of the sensor or demodulator.
    """

    range_um: float
    sensor: str


_UNITS_UM = {"nm": 1e-3, "um": 1.0, "µm": 1.0, "μm": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6, "in": 25400.0}


def channel_info(reply: str) -> Channel:
    r"""Read the reply to `$CHIm`.

    Raises
    ------
    BadReplyError
        It has no range, or a unit that is not a length.

    Examples
    --------
    >>> channel_info("$CHI1:ANO2303024,NAMDL6222,SNO1001,OFS0,RNG2000,UNTumOK").range_um
    2000.0
    """
    fields = dict(re.findall(r"(ANO|NAM|SNO|OFS|RNG|UNT)([^,\r\n]*)", reply.strip().removesuffix("OK")))
    unit = fields.get("UNT", "").strip()
    if unit not in _UNITS_UM:
        raise BadReplyError(f"unit {unit!r} of {reply.strip()!r} is not a length")
    try:
        range_um = float(fields["RNG"]) * _UNITS_UM[unit]
    except (KeyError, ValueError):
        raise BadReplyError(f"no range in {reply.strip()!r}") from None
    if not 0.0 < range_um < 1e7:
        raise BadReplyError(f"range {range_um:g} µm in {reply.strip()!r}")
    return Channel(range_um=range_um, sensor=fields.get("NAM", ""))


def micrometres(value: float, range_um: float) -> float:
    """Scale a value of the stream.

    Examples
    --------
    >>> round(micrometres(0x7FFFFF, 2000.0), 4)
    999.9999
    """
    return value / FULL_SCALE * range_um
