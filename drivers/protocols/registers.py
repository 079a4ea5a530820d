"""Numbers in Modbus registers."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Literal

NumberType = Literal["int16", "uint16", "int32", "uint32", "float32"]
WordOrder = Literal["big", "little"]

_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}


def words_of(kind: str) -> int:
    """Return how many registers a number takes.

    Examples
    --------
    >>> words_of("int16"), words_of("float32")
    (1, 2)
    """
    return struct.calcsize(_FORMATS[kind]) // 2


def decode(words: Sequence[int], kind: str, word_order: str) -> float:
    """Decode a number from its registers.

    Parameters
    ----------
    words : sequence of int
        Unsigned 16-bit words, as received.
    kind : str
        `int16`, `uint16`, `int32`, `uint32` or `float32`.
    word_order : str
        `big`: high word first; `little`: low word first. Within a word the high byte always comes first.

    Examples
    --------
    >>> decode([0x41A0, 0x0000], "float32", "big"), decode([0xFFFE, 0xFFFF], "int32", "little")
    (20.0, -2.0)
    """
    ordered = words if word_order == "big" else list(reversed(words))
    (value,) = struct.unpack(_FORMATS[kind], struct.pack(f">{len(ordered)}H", *ordered))
    return float(value)
