"""Log records with fields for systemd's journal, so that `journalctl MACHINE=vmc-07 STATE=hold` finds them.

The journal's own protocol (systemd.io/JOURNAL_NATIVE_PROTOCOL): one datagram of fields, each `NAME=value`, or where
the value has more than one line: the name, its length as 64 bits little-endian, the value.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
import sys
from collections.abc import Mapping

SOCKET = "/run/systemd/journal/socket"
#: Longest text of a field, characters; a datagram must fit into the socket's buffer.
LONGEST_TEXT = 16_000

_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))


def is_connected(environment: Mapping[str, str], descriptor: int) -> bool:
    """Tell whether a descriptor leads to the journal, as systemd says it in `JOURNAL_STREAM`.

    Parameters
    ----------
    environment : mapping of str to str
        Usually `os.environ`.
    descriptor : int
        Usually that of stderr.
    """
    try:
        status = os.fstat(descriptor)
    except OSError:
        return False
    return environment.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def datagram(fields: Mapping[str, object]) -> bytes:
    r"""Make the datagram of a record.

    Parameters
    ----------
    fields : mapping of str to object
        Names in capitals, and values.

    Examples
    --------
    >>> datagram({"MACHINE": "vmc-07", "SEQ": 7})
    b'MACHINE=vmc-07\nSEQ=7\n'
    >>> datagram({"MESSAGE": "one\ntwo"})
    b'MESSAGE\n\x07\x00\x00\x00\x00\x00\x00\x00one\ntwo\n'
    """
    parts = []
    for name, value in fields.items():
        text = str(value)[:LONGEST_TEXT].encode("utf-8", "replace")
        if b"\n" in text:
            parts.append(name.encode() + b"\n" + struct.pack("<Q", len(text)) + text + b"\n")
        else:
            parts.append(name.encode() + b"=" + text + b"\n")
    return b"".join(parts)


class JournalHandler(logging.Handler):
    """Sends log records to the journal; the dict `fields` of a record goes along as fields of their own.

    Parameters
    ----------
    address : str
        The journal's socket.
    """

    def __init__(self, address: str = SOCKET) -> None:
        super().__init__()
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record; what the journal does not take goes to stderr. Never waits."""
        text = self.format(record)
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), 7)
        fields = {"MESSAGE": text, "PRIORITY": priority, "SYSLOG_IDENTIFIER": "compensator", "LOGGER": record.name}
        try:
            self._socket.sendto(datagram(fields | getattr(record, "fields", {})), socket.MSG_DONTWAIT, self._address)
        except OSError:
            sys.stderr.write(text + "\n")

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        super().close()
