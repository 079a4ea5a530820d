"""Blocks of the capaNCDT data port: finding them in a TCP stream, and running sums of their values.

Source: Micro-Epsilon capaNCDT 6200 operating instructions, "Ethernet Interface".
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.errors import DeviceGarbled, DeviceRefused
from drivers.reading import Quality, Reading

PREAMBLE = b"MEAS"
HEADER = struct.Struct("<4siiQIHHI")
"""Preamble, order and serial number, channels, status, frames, bytes per frame, counter."""
FULL_SCALE = 0xFFFFFF
MOST_FRAMES = 4096
MOST_CHANNELS = 8
_UM_PER_UNIT = {"um": 1.0, "µm": 1.0, "μm": 1.0, "mm": 1000.0}


@dataclass(frozen=True, slots=True)
class Block:
    """One block.

    Parameters
    ----------
    channels : tuple of int
        Numbers of the channels present, from 1, in the order of the columns.
    counter : int
        Measuring-value counter of the first frame, 32 bits.
    frames : array of int32
        Raw values, one row per frame.
    """

    channels: tuple[int, ...]
    counter: int
    frames: npt.NDArray[np.int32]


class BlockReader:
    """Cut a stream of bytes into blocks, whatever pieces it comes in.

    A block is believed when its header is plausible and no preamble is inside its values. Neither can a sound
    block fail: a value has 24 bits in 32, so that no four bytes of values can read `MEAS`. Hence a block
    shorter than its header says is dropped and the next one is not.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.garbled_bytes = 0

    def feed(self, data: bytes) -> list[Block]:
        """Take bytes as they come and return the blocks that they complete.

        Examples
        --------
        >>> reader = BlockReader()
        >>> data = HEADER.pack(b"MEAS", 1, 2, 0b01, 0, 1, 4, 7) + (0x7FFFFF).to_bytes(4, "little")
        >>> reader.feed(b"junk" + data[:20]), reader.feed(data[20:])[0].frames.tolist(), reader.garbled_bytes
        ([], [[8388607]], 4)
        """
        self._buffer += data
        blocks = []
        while (block := self._next()) is not None:
            blocks.append(block)
        return blocks

    def _next(self) -> Block | None:
        buffer = self._buffer
        while True:
            start = buffer.find(PREAMBLE)
            if start < 0:
                # The last three bytes may be the beginning of a preamble.
                self._drop(max(len(buffer) - len(PREAMBLE) + 1, 0))
                return None
            self._drop(start)
            if len(buffer) < HEADER.size:
                return None
            _, _, _, bits, _, n_frames, n_bytes, counter = HEADER.unpack_from(buffer)
            channels = _channels(bits)
            if not channels or n_bytes != 4 * len(channels) or not 1 <= n_frames <= MOST_FRAMES:
                self._drop(len(PREAMBLE))
                continue
            end = HEADER.size + n_frames * n_bytes
            inside = buffer.find(PREAMBLE, len(PREAMBLE), end)
            if inside >= 0:
                self._drop(inside)
                continue
            if len(buffer) < end:
                return None
            frames = np.frombuffer(bytes(buffer[HEADER.size : end]), dtype="<i4").astype(np.int32)
            del buffer[:end]
            return Block(channels, counter, frames.reshape(n_frames, len(channels)))

    def _drop(self, count: int) -> None:
        self.garbled_bytes += count
        del self._buffer[:count]


def _channels(bits: int) -> tuple[int, ...]:
    pairs = [bits >> 2 * n & 0b11 for n in range(32)]
    if any(pair > 1 for pair in pairs) or any(pairs[MOST_CHANNELS:]):
        return ()
    return tuple(n + 1 for n, pair in enumerate(pairs) if pair)


class ChannelSums:
    """Running sums of one channel since they were last taken.

    Parameters
    ----------
    range_um : float
        Measuring range, µm.
    polarity : int
        1 or −1.
    zero_um : float
        Added to the value, µm.
    """

    def __init__(self, range_um: float, polarity: int, zero_um: float) -> None:
        self._per_count_um = polarity * range_um / FULL_SCALE
        self._zero_um = zero_um
        self.count = 0
        self._clear()

    def _clear(self) -> None:
        self.count = self._over = self._under = self._sum = 0
        self._least, self._most = FULL_SCALE, 0

    def add(self, values: npt.NDArray[np.int32]) -> None:
        """Add raw values."""
        self.count += len(values)
        self._over += int(np.count_nonzero(values >= FULL_SCALE))
        self._under += int(np.count_nonzero(values <= 0))
        self._sum += int(values.sum(dtype=np.int64))
        self._least = min(self._least, int(values.min()))
        self._most = max(self._most, int(values.max()))

    def take(self) -> Reading:
        """Return mean, extremes and count since the last call, µm; start anew.

        One frame at an end of the range spoils the reading: the mean of a movement that has been cut off is
        not its mean.
        """
        count, over, under = self.count, self._over, self._under
        mean, least, most = self._sum / max(count, 1), self._least, self._most
        self._clear()
        if not count:
            return Reading.bad(Quality.INVALID, "channel is not in the stream")
        if over:
            return Reading.bad(Quality.OVER, f"{over} of {count} frames at the far end of the range")
        if under:
            return Reading.bad(Quality.UNDER, f"{under} of {count} frames at the near end of the range")
        ends = sorted((self._um(least), self._um(most)))
        return Reading(
            value=self._um(mean), quality=Quality.GOOD, minimum=ends[0], maximum=ends[1], count=count
        )

    def _um(self, raw: float) -> float:
        return self._zero_um + self._per_count_um * raw


class StreamSums:
    """Add up the blocks of a stream, channel by channel, and watch its counter.

    Parameters
    ----------
    channels : dict of int to ChannelSums
        Channels that are wanted, by number from 1.
    """

    def __init__(self, channels: dict[int, ChannelSums]) -> None:
        self._channels = channels
        self._expected: int | None = None
        self._last: int | None = None
        self.frames = 0
        self.repeated = 0
        self.lost_frames = 0

    def add(self, block: Block) -> None:
        """Add a block, unless its counter is that of the last one: the controller then repeats itself."""
        if block.counter == self._last:
            self.repeated += 1
            return
        if self._expected is not None:
            # Backwards is a restarted counter, not four thousand million lost frames.
            gap = (block.counter - self._expected) & 0xFFFFFFFF
            self.lost_frames += gap if gap < 1 << 31 else 0
        self._last = block.counter
        self._expected = (block.counter + len(block.frames)) & 0xFFFFFFFF
        self.frames += len(block.frames)
        for column, number in enumerate(block.channels):
            if number in self._channels:
                self._channels[number].add(block.frames[:, column])

    def take(self, order: Sequence[int]) -> list[Reading]:
        """Return the reading of each channel in `order` since the last call; start anew."""
        stale = self.repeated and not self.frames
        self.frames = self.repeated = 0
        if stale:
            return [Reading.bad(Quality.STALE, "counter of measurements stands still") for _ in order]
        return [self._channels[number].take() for number in order]


def range_um(device: str, channel: int, answer: str) -> float:
    """Return the measuring range of a channel from the answer to `$CHIm`, µm.

    Raises
    ------
    DeviceRefused
        If the answer is an error.
    DeviceGarbled
        If it has no range and unit.

    Examples
    --------
    >>> range_um("spindle", 1, ":ANO2303024,NAMDL6222,SNO1001,OFS0,RNG2000,UNTumOK")
    2000.0
    """
    if not answer.endswith("OK"):
        raise DeviceRefused(device, f"channel {channel}: {answer[:80]!r}")
    span = re.search(r",RNG([0-9]{1,9}(?:\.[0-9]{1,9})?)(?:,|OK)", answer, re.ASCII)
    unit = re.search(r",UNT([^,]*?)(?:,|OK)", answer)
    if span is None or unit is None or unit[1] not in _UM_PER_UNIT or not float(span[1]) > 0.0:
        raise DeviceGarbled(device, f"channel {channel}: no range in µm or mm in {answer[:80]!r}")
    return float(span[1]) * _UM_PER_UNIT[unit[1]]
