"""Modbus frames: the expected answer, and its place in a stream of bytes.

pymodbus decodes the answers. The frame is selected here first, because an RTU frame does not carry the number of its
request: only unit, function and length distinguish an answer from a late or foreign one.

Sources: Modbus Application Protocol V1.1b3; Modbus over Serial Line V1.02; Modbus Messaging on TCP/IP V1.0b.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

READ_COILS, READ_DISCRETE, READ_HOLDING, READ_INPUT = 1, 2, 3, 4
MOST_REGISTERS = 125

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledge",
    6: "device busy",
    7: "negative acknowledge",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target did not answer",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """One read request.

    Parameters
    ----------
    function : int
        1 coils, 2 discrete inputs, 3 holding registers, 4 input registers.
    address : int
        On the wire, from 0.
    count : int
        Of registers or bits.
    """

    function: int
    address: int
    count: int

    @property
    def data_bytes(self) -> int:
        """Bytes of data in the answer."""
        return (self.count + 7) // 8 if self.function in {READ_COILS, READ_DISCRETE} else 2 * self.count

    def __str__(self) -> str:
        what = {READ_COILS: "coil", READ_DISCRETE: "discrete input", READ_HOLDING: "holding register"}
        return f"{what.get(self.function, 'input register')} {self.address} (count {self.count})"


class WrongAnswerError(ValueError):
    """An answer that does not belong to the request; the text says why."""


def exception_text(code: int) -> str:
    """Return the code of an exception reply in words."""
    return f"exception {code} ({EXCEPTIONS.get(code, 'code not in the standard')})"


def fence_for(requests: tuple[Request, ...]) -> Request:
    """Choose a request whose answer cannot be confused with that of any of a device's requests.

    It is the first request after a missing answer. A device answers in order, so after the fence's own answer no
    earlier answer can arrive. The fence reads the start of the first block, with a length that no other request has.

    Parameters
    ----------
    requests : tuple of Request
        All requests to the device; the first is the block that is polled.

    Examples
    --------
    >>> fence_for((Request(function=3, address=0, count=8), Request(function=3, address=210, count=1)))
    Request(function=3, address=0, count=2)
    """
    first = requests[0]
    taken = {request.data_bytes for request in requests if request.function == first.function}
    for count in range(1, MOST_REGISTERS + 1):
        fence = Request(function=first.function, address=first.address, count=count)
        if fence.data_bytes not in taken:
            return fence
    raise ValueError("every length is taken")


def crc16(data: bytes) -> int:
    """Compute the CRC of an RTU frame (polynomial A001, start FFFF); it is sent low byte first.

    Examples
    --------
    >>> crc16(bytes.fromhex("010400000008")).to_bytes(2, "little").hex()
    'f1cc'
    """
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def find_rtu(data: bytes, unit: int, request: Request) -> bytes | None:
    """Find the answer to a request in the bytes of a serial line.

    Noise before it and answers of other length, function or unit are skipped.

    Returns
    -------
    bytes or None
        The frame with its CRC; None while it is not there.
    """
    lengths = {request.function: request.data_bytes + 5, request.function | 0x80: 5}
    start = data.find(unit)
    while 0 <= start <= len(data) - 5:
        size = lengths.get(data[start + 1])
        if size is not None and start + size <= len(data):
            frame = data[start : start + size]
            right_length = size == 5 or frame[2] == request.data_bytes
            if right_length and crc16(frame[:-2]) == int.from_bytes(frame[-2:], "little"):
                return frame
        start = data.find(unit, start + 1)
    return None


def describe_rtu(data: bytes, unit: int, request: Request) -> str | None:
    """Return why the bytes of a line are not an answer.

    Returns
    -------
    str or None
        None where they are valid frames of other units only, or where there are none: then the device was
        silent.
    """
    rest = data
    while len(rest) >= 5:
        size = 5 if rest[1] & 0x80 else rest[2] + 5
        frame = rest[:size]
        if len(frame) < size or crc16(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
            return f"no valid frame in {len(data)} bytes, CRC or length wrong: {data[:40].hex(' ')}"
        if frame[0] == unit:
            asked = f"asked for {request}, {request.data_bytes} bytes"
            return f"{asked}, the answer is function {frame[1]}, {size - 5} bytes"
        rest = rest[size:]
    return f"{len(rest)} stray bytes: {rest.hex(' ')}" if rest else None


def find_tcp(data: bytes, transaction: int, unit: int, request: Request) -> bytes | None:
    """Find the answer to a request in the bytes of a TCP connection.

    Returns
    -------
    bytes or None
        The frame with its header; None while it is not there. Late answers are skipped by their number.

    Raises
    ------
    WrongAnswerError
        The stream is out of step, or the answer to this request is a different one.
    """
    rest = data
    while len(rest) >= 8:
        number, protocol, length, answering = struct.unpack_from(">HHHB", rest)
        if protocol != 0 or not 3 <= length <= 254:
            raise WrongAnswerError(f"no Modbus TCP header: {rest[:20].hex(' ')}")
        frame = rest[: length + 6]
        if number == transaction:
            return _checked_tcp(frame, length + 6, answering, unit, request)
        if len(frame) < length + 6:
            return None
        rest = rest[length + 6 :]
    return None


def _checked_tcp(frame: bytes, size: int, answering: int, unit: int, request: Request) -> bytes | None:
    """Return the frame where it is complete and answers the request."""
    if answering != unit:
        raise WrongAnswerError(f"asked unit {unit}, unit {answering} answers")
    function = frame[7]
    if function not in {request.function, request.function | 0x80}:
        raise WrongAnswerError(f"asked function {request.function}, the answer is function {function}")
    due = 9 if function & 0x80 else 9 + request.data_bytes
    if size != due or (not function & 0x80 and len(frame) > 8 and frame[8] != request.data_bytes):
        raise WrongAnswerError(f"asked for {request}, {request.data_bytes} bytes, the answer has {max(0, size - 9)}")
    return frame if len(frame) == size else None
