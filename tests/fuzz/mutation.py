"""Valid inputs made wrong in the ways in which inputs go wrong, from a seed."""

from __future__ import annotations

import random
from collections.abc import Callable

#: What people, editors, disks and attackers put into files.
PIECES = (
    b"\x00",
    b"\xef\xbb\xbf",
    b"\xff\xfe",
    "µ°é".encode("latin-1"),
    "µ°é∞".encode(),
    b"\r",
    b"\n\n",
    b"\t",
    b'"',
    b"'",
    b"nan",
    b"NaN",
    b"inf",
    b"-inf",
    b"1e308",
    b"-1e308",
    b"1e999",
    b"9" * 400,
    b"0x10",
    b"-0.0",
    b"1_0",
    b"1,5",
    b"5e-324",
    b"99999999999999999999",
    b"9223372036854775808",
    b"true",
    b"null",
    b"[]",
    b"{}",
    b"[" * 300,
    b"{" * 300,
    b'{"a":' * 300,
    b"../../../etc/passwd",
    b"%s%n",
    b"\\u0000",
    b"\xed\xa0\x80",
    b"x" * 5000,
)


def _flip(rng: random.Random, data: bytearray) -> None:
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _cut(rng: random.Random, data: bytearray) -> None:
    del data[rng.randrange(len(data)) :]


def _drop(rng: random.Random, data: bytearray) -> None:
    at = rng.randrange(len(data))
    del data[at : at + rng.randrange(1, 60)]


def _double(rng: random.Random, data: bytearray) -> None:
    at = rng.randrange(len(data))
    data[at:at] = data[at : at + rng.randrange(1, 400)]


def _insert(rng: random.Random, data: bytearray) -> None:
    at = rng.randrange(len(data) + 1)
    data[at:at] = rng.choice(PIECES)


def _number(rng: random.Random, data: bytearray) -> None:
    """Put something else in the place of a number."""
    digits = [i for i, byte in enumerate(data) if 48 <= byte <= 57]
    if digits:
        begin = rng.choice(digits)
        end = begin
        while end < len(data) and data[end] in b"0123456789.eE+-":
            end += 1
        data[begin:end] = rng.choice(PIECES)


def _noise(rng: random.Random, data: bytearray) -> None:
    at = rng.randrange(len(data))
    data[at : at + 40] = rng.randbytes(rng.randrange(1, 80))


def _exchange(rng: random.Random, data: bytearray) -> None:
    """Exchange two lines."""
    lines = bytes(data).split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[i], lines[j] = lines[j], lines[i]
    data[:] = b"\n".join(lines)


_WAYS: tuple[Callable[[random.Random, bytearray], None], ...] = (
    _flip,
    _cut,
    _drop,
    _double,
    _insert,
    _number,
    _number,
    _noise,
    _exchange,
)


def mutated(seed: int, data: bytes) -> bytes:
    """Return the data, changed in one to three ways; one in thirty is noise alone."""
    rng = random.Random(seed)
    if rng.randrange(30) == 0:
        return rng.randbytes(rng.randrange(200))
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if changed:
            rng.choice(_WAYS)(rng, changed)
    return bytes(changed)
