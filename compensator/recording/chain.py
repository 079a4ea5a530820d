r"""The hash chain of a recording.

Every record has a value, the hash over the previous value and the record,

    value = SHA-256(value before ‖ topic ‖ 0x00 ‖ sequence ‖ log time ‖ publish time ‖ payload),

numbers little-endian (4, 8 and 8 bytes). The chain of a file begins with

    value = SHA-256("compensator chain 1\n" ‖ last value of the file before ‖ name ‖ 0x00 ‖ SHA-256(part) ‖ …)

over the parts at the start of the file: metadata, attachments, channels with their schemas. A `/chain` message after
each group of records lists the value of each. It is numbered like the records but not hashed, because its content
follows from the records. Nothing depends on the layout of the file, so a compacted file keeps its chain.
"""

from __future__ import annotations

import hashlib
import struct

import msgspec

from compensator.clock import HOUR_NS
from compensator.messages import SCHEMA, Chain, ChainLink, ChainPart, Seal, encode
from compensator.recording.container import Attachment, Contents, McapChannel

#: Value before the first file of a machine.
NOTHING = bytes(32)
#: How often the chain is signed within a file.
SEAL_EVERY_NS = HOUR_NS

_DOMAIN = b"compensator chain 1\n"
_BODY = struct.Struct("<IQQ")
_sha256 = hashlib.sha256


def body_of(sequence: int, time_ns: int, payload: bytes) -> bytes:
    """Return the bytes of a record that are hashed in addition to its topic."""
    return _BODY.pack(sequence, time_ns, time_ns) + payload


def link(before: bytes, topic: str, body: bytes) -> bytes:
    """Return the value of the chain at a record.

    Parameters
    ----------
    before : bytes
        Value at the record before it.
    topic : str
        Channel, without the slash.
    body : bytes
        Sequence, log time, publish time, payload, as in the file.
    """
    return _sha256(b"%b%b\0%b" % (before, topic.encode(), body)).digest()


def parts_of(contents: Contents) -> list[ChainPart]:
    """Return the parts at the start of a file, each with name and hash."""
    parts = [(f"metadata {name}", _texts(table)) for name, table in contents.metadata.items()]
    parts += [(f"attachment {name}", _attachment(part)) for name, part in contents.attachments.items()]
    parts += [(f"channel {channel.topic}", _channel(number, channel)) for number, channel in contents.channels.items()]
    return [ChainPart(name=name, sha256=_sha256(data).hexdigest()) for name, data in parts]


def opening(before: bytes, parts: list[ChainPart]) -> bytes:
    """Return the first value of the chain of a file.

    Parameters
    ----------
    before : bytes
        Last value of the previous file.
    parts : list of ChainPart
        Parts at the start of the file.
    """
    whole = b"".join(part.name.encode() + b"\0" + bytes.fromhex(part.sha256) for part in parts)
    return _sha256(_DOMAIN + before + whole).digest()


def _prefixed(*fields: bytes) -> bytes:
    return b"".join(len(part).to_bytes(8, "little") + part for part in fields)


def _texts(table: dict[str, str]) -> bytes:
    return _prefixed(*(text.encode() for pair in table.items() for text in pair))


def _attachment(part: Attachment) -> bytes:
    times = struct.pack("<QQ", part.log_time_ns, part.create_time_ns)
    return _prefixed(part.name.encode(), part.media_type.encode(), times, part.data)


def _channel(number: int, channel: McapChannel) -> bytes:
    texts = (str(number), channel.topic, channel.encoding, channel.schema_name, channel.schema_encoding)
    return _prefixed(*(text.encode() for text in texts), channel.schema, _texts(channel.metadata))


class ChainWriter:
    """Computes the chain of one file while it is written.

    Parameters
    ----------
    machine : str
        Name of the machine.
    before : bytes
        Last value of the previous file.

    Examples
    --------
    >>> chain = ChainWriter("vmc-07", NOTHING)
    >>> _ = chain.begin([], 0)
    >>> chain.add("event", body_of(1, 0, b"{}"))
    >>> chain.head == link(opening(NOTHING, []), "event", body_of(1, 0, b"{}"))
    True
    """

    def __init__(self, machine: str, before: bytes) -> None:
        self.machine = machine
        #: Value at the last record.
        self.head = before
        #: Records that are not listed by a message yet.
        self.links: list[ChainLink] = []
        self._before = before

    def begin(self, parts: list[ChainPart], time_ns: int) -> bytes:
        """Return the first message of a file."""
        message = Chain(
            schema=SCHEMA, machine=self.machine, time_utc_ns=time_ns, before=self.head.hex(), parts=parts, records=[]
        )
        self.head = self._before = opening(self.head, parts)
        return encode(message)

    def add(self, topic: str, body: bytes) -> None:
        """Add one record."""
        self.head = link(self.head, topic, body)
        (sequence,) = struct.unpack_from("<I", body)
        self.links.append(ChainLink(topic=topic, sequence=sequence, sha256=self.head.hex()))

    def message(self, time_ns: int) -> bytes:
        """Return the message that lists the records since the last one."""
        message = Chain(
            schema=SCHEMA,
            machine=self.machine,
            time_utc_ns=time_ns,
            before=self._before.hex(),
            parts=[],
            records=self.links,
        )
        self.listed()
        return encode(message)

    def listed(self) -> None:
        """Mark the records up to here as listed."""
        self.links, self._before = [], self.head


def seal(machine: str, time_ns: int, reason: str, sequence: int, head: bytes) -> Seal:
    """Return a seal that is not signed yet."""
    return Seal(
        schema=SCHEMA,
        machine=machine,
        time_utc_ns=time_ns,
        reason=reason,
        sequence=sequence,
        sha256=head.hex(),
        public_key="",
        signature="",
    )


def signed_bytes(message: Seal) -> bytes:
    """Return the signed bytes of a seal."""
    return encode(msgspec.structs.replace(message, signature=""))
