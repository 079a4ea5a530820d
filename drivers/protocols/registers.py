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


def as_decoded(number: float, kind: str) -> float:
    """Return what `decode` makes of the registers that hold a number.

    A whole number may also be given by the bits of its registers, such as 0x8000 of an `int16`; a `float32` holds
    -999.9 only nearly.

    Parameters
    ----------
    number : float
        A number as a manual states it.
    kind : str
        As in `decode`.

    Raises
    ------
    ValueError, OverflowError
        If the registers cannot hold it.

    Examples
    --------
    >>> as_decoded(0x8000, "int16"), as_decoded(-1, "uint16"), as_decoded(-999.9, "float32")
    (-32768.0, 65535.0, -999.9000244140625)
    """
    form = _FORMATS[kind]
    if kind == "float32":
        return float(struct.unpack(form, struct.pack(form, number))[0])
    bits = 8 * struct.calcsize(form)
    if number != int(number) or not -(1 << bits - 1) <= number < 1 << bits:
        raise ValueError(f"{kind} cannot hold {number:g}")
    (value,) = struct.unpack(form, (int(number) % (1 << bits)).to_bytes(bits // 8, "big"))
    return float(value)
