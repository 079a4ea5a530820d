"""systemd: status of the service, and log records with fields.

Messages to the service manager use the notify protocol, see sd_notify(3): one datagram of `KEY=value` lines to the
socket named by `NOTIFY_SOCKET`; without that variable nothing is sent. Log records use the journal's native protocol
(systemd.io/JOURNAL_NATIVE_PROTOCOL), so that `journalctl MACHINE=vmc-07 STATE=hold` finds them. Sending never blocks: a
manager or journal that does not read must not delay a sample.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import struct
import sys
from collections.abc import Mapping
from contextlib import suppress

#: Polls that may be missed before the manager considers the service stuck.
POLLS_TO_MISS = 3
#: Longest time between two polls for which the time limit of a start in the unit is made, s.
LONGEST_START_S = 60.0


class ServiceManager:
    """Client of systemd's notify protocol.

    Parameters
    ----------
    environment : mapping of str to str
        Contains `NOTIFY_SOCKET`, `WATCHDOG_USEC` and `WATCHDOG_PID`; usually `os.environ`.

    Examples
    --------
    >>> with ServiceManager({}) as manager:
    ...     manager.ready()
    >>> manager.watchdog_s is None
    True
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # "@" stands for the zero byte of an abstract address.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        #: Messages that must arrive and were not yet accepted.
        self._unsent: list[str] = []
        for_us = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        microseconds = environment.get("WATCHDOG_USEC", "")
        #: Watchdog timeout, s; None without a watchdog.
        self.watchdog_s = int(microseconds) / 1e6 if address and for_us and microseconds.isdecimal() else None

    def watch(self, poll_interval_s: float) -> None:
        """Extend the time limits of the start and of the watchdog for slow polls; never shorten them.

        Parameters
        ----------
        poll_interval_s : float
            Time between two calls of `alive`, s.
        """
        needed_s = POLLS_TO_MISS * poll_interval_s
        if poll_interval_s > LONGEST_START_S:
            self._send_surely(f"EXTEND_TIMEOUT_USEC={round(needed_s * 1e6)}")
        if self.watchdog_s is not None and self.watchdog_s < needed_s:
            self.watchdog_s = needed_s
            self._send_surely(f"WATCHDOG_USEC={round(needed_s * 1e6)}")

    def ready(self) -> None:
        """Report that the service works."""
        self._send_surely("READY=1")

    def alive(self) -> None:
        """Feed the watchdog; to be called only after a complete poll."""
        self._flush()
        if self.watchdog_s is not None:
            self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Report the state in one line."""
        self._send(f"STATUS={' '.join(text.split())}")

    def stopping(self) -> None:
        """Report that the service ends."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Close the socket; may be called twice."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def __enter__(self) -> ServiceManager:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _send_surely(self, message: str) -> None:
        self._unsent.append(message)
        self._flush()

    def _flush(self) -> None:
        while self._unsent and self._send(self._unsent[0]):
            del self._unsent[0]

    def _send(self, message: str) -> bool:
        if self._socket is None:
            return True
        try:
            self._socket.sendto(message.encode(), socket.MSG_DONTWAIT, self._address)
        except OSError:
            # The manager is not reachable, or its queue is full: the next poll retries.
            return False
        return True


# ---------------------------------------------------------------------- journal

#: The journal's socket.
JOURNAL = "/run/systemd/journal/socket"
#: Longest text of a field, characters; a datagram must fit into the socket's buffer.
LONGEST_TEXT = 16_000

_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))


def is_connected(environment: Mapping[str, str], descriptor: int) -> bool:
    """Return whether a descriptor is connected to the journal, according to `JOURNAL_STREAM`.

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
    """Sends log records to the journal; the items of a record's dict `fields` become journal fields.

    Parameters
    ----------
    address : str
        The journal's socket.
    """

    def __init__(self, address: str = JOURNAL) -> None:
        super().__init__()
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record without blocking; one that the journal refuses goes to stderr, if that takes it at once."""
        try:
            text = self.format(record)
            priority = next((number for level, number in _PRIORITIES if record.levelno >= level), 7)
            fields = {"MESSAGE": text, "PRIORITY": priority, "SYSLOG_IDENTIFIER": "compensator", "LOGGER": record.name}
            data = datagram(fields | getattr(record, "fields", {}))
            try:
                self._socket.sendto(data, socket.MSG_DONTWAIT, self._address)
            except OSError:
                _to_stderr(text)
        except Exception:  # noqa: BLE001  as every handler: a wrong line must not end the service
            self.handleError(record)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        super().close()


def _to_stderr(text: str) -> None:
    """Write a line to stderr, unless it is closed or nobody reads it: a write to a full pipe waits for its reader."""
    with suppress(OSError, ValueError):
        stream = sys.stderr.fileno()
        if select.select([], [stream], [], 0.0)[1]:
            os.write(stream, text.encode("utf-8", "replace")[: select.PIPE_BUF - 1] + b"\n")
