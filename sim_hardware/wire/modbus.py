"""The slave's side of Modbus: functions, CRC and the two framings.

Sources: "MODBUS Application Protocol Specification" V1.1b3, "MODBUS over Serial Line" V1.02, "MODBUS
Messaging on TCP/IP" V1.0b.
"""

from __future__ import annotations

import struct

from sim_hardware.wire.faults import Layers, number
from sim_hardware.wire.module import ILLEGAL_FUNCTION, ILLEGAL_VALUE, Module, RefusalError

GATEWAY_NO_RESPONSE = 0x0B
MOST_WORDS = 125
MOST_BITS = 2000
MOST_WRITTEN_WORDS = 123
MOST_WRITTEN_BITS = 1968


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
        table.append(crc)
    return tuple(table)


_CRC = _crc_table()


def crc16(data: bytes) -> bytes:
    """Return the CRC of an RTU frame as it follows on the wire, low byte first.

    Examples
    --------
    >>> crc16(bytes.fromhex("010400000008")).hex()
    'f1cc'
    """
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC[(crc ^ byte) & 0xFF]
    return struct.pack("<H", crc)


def answer(module: Module, pdu: bytes, layers: Layers) -> bytes:
    """Return the reply PDU to a request PDU.

    Faults that change the content of the reply ("exception", "wrong_length") are applied here; those that change how
    it travels act in `sim_hardware.wire.outlet`.
    """
    if not layers.quiet:
        fault = layers.use("exception")
        if fault is not None:
            return bytes((pdu[0] | 0x80, int(number(fault, "code", 4)) & 0xFF))
    module.begin()
    try:
        reply = _dispatch(module, pdu)
    except RefusalError as refusal:
        return bytes((pdu[0] | 0x80, refusal.code))
    except struct.error:
        return bytes((pdu[0] | 0x80, ILLEGAL_VALUE))
    if not layers.quiet and layers.use("wrong_length") is not None:
        return _one_register_short(reply)
    return reply


def _dispatch(module: Module, pdu: bytes) -> bytes:
    function = pdu[0]
    if function in {3, 4}:
        address, count = struct.unpack(">HH", pdu[1:])
        if not 1 <= count <= MOST_WORDS:
            raise RefusalError(ILLEGAL_VALUE)
        words = module.read(module.holding if function == 3 else module.inputs, address, count)
        return struct.pack(f">BB{count}H", function, 2 * count, *words)
    if function in {1, 2}:
        address, count = struct.unpack(">HH", pdu[1:])
        if not 1 <= count <= MOST_BITS:
            raise RefusalError(ILLEGAL_VALUE)
        bits = module.read(module.coils if function == 1 else module.discrete, address, count)
        size = (count + 7) // 8
        packed = sum(bit << i for i, bit in enumerate(bits)).to_bytes(size, "little")
        return bytes((function, size)) + packed
    if function in {5, 6}:
        return _write_one(module, pdu)
    if function in {15, 16}:
        return _write_many(module, pdu)
    reply = module.private(pdu)
    if reply is None:
        raise RefusalError(ILLEGAL_FUNCTION)
    return reply


def _write_one(module: Module, pdu: bytes) -> bytes:
    address, value = struct.unpack(">HH", pdu[1:])
    if pdu[0] == 6:
        module.write(module.holding, address, [value])
        return pdu
    if value not in {0x0000, 0xFF00}:
        raise RefusalError(ILLEGAL_VALUE)
    module.write(module.coils, address, [int(value == 0xFF00)])
    return pdu


def _write_many(module: Module, pdu: bytes) -> bytes:
    function, address, count, size = struct.unpack(">BHHB", pdu[:6])
    data = pdu[6:]
    if function == 16:
        if not 1 <= count <= MOST_WRITTEN_WORDS or size != 2 * count or len(data) != size:
            raise RefusalError(ILLEGAL_VALUE)
        module.write(module.holding, address, list(struct.unpack(f">{count}H", data)))
    else:
        if not 1 <= count <= MOST_WRITTEN_BITS or size != (count + 7) // 8 or len(data) != size:
            raise RefusalError(ILLEGAL_VALUE)
        packed = int.from_bytes(data, "little")
        module.write(module.coils, address, [packed >> i & 1 for i in range(count)])
    return pdu[:5]


def _one_register_short(reply: bytes) -> bytes:
    """Return a valid reply that holds less than was requested."""
    if reply[0] not in {1, 2, 3, 4}:
        return reply[:-1]
    drop = 2 if reply[0] in {3, 4} else 1
    return bytes((reply[0], reply[1] - drop)) + reply[2:-drop]
