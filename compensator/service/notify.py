"""Tells the service manager how the service is: ready, alive, its state in words, ending.

systemd's notify protocol, see sd_notify(3): one datagram of `KEY=value` lines to the socket that `NOTIFY_SOCKET` names.
Without that variable nothing is sent. The sending never waits: a manager that does not read must not hold up a sample.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

#: Polls that may be missed before the manager takes the service for stuck.
POLLS_TO_MISS = 3


class ServiceManager:
    """The service's side of systemd's notify protocol.

    Parameters
    ----------
    environment : mapping of str to str
        Where `NOTIFY_SOCKET`, `WATCHDOG_USEC` and `WATCHDOG_PID` are looked for; usually `os.environ`.

    Examples
    --------
    >>> with ServiceManager({}) as nobody:
    ...     nobody.ready()
    >>> nobody.watchdog_s is None
    True
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # "@" stands for the zero byte of an abstract address.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        #: What must arrive and has not been taken yet.
        self._owed: list[str] = []
        for_us = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        microseconds = environment.get("WATCHDOG_USEC", "")
        #: Longest time between two signs of life, s; None where nobody watches.
        self.watchdog_s = int(microseconds) / 1e6 if address and for_us and microseconds.isdecimal() else None

    def watch(self, poll_interval_s: float) -> None:
        """Have the watchdog wait long enough for slow polls; it is made longer, never shorter.

        Parameters
        ----------
        poll_interval_s : float
            Time between two signs of life, s.
        """
        needed_s = POLLS_TO_MISS * poll_interval_s
        if self.watchdog_s is not None and self.watchdog_s < needed_s:
            self.watchdog_s = needed_s
            self._owe(f"WATCHDOG_USEC={round(needed_s * 1e6)}")

    def ready(self) -> None:
        """Say that the service works."""
        self._owe("READY=1")

    def alive(self) -> None:
        """Give a sign of life; only for who has just done its work."""
        self._pay()
        if self.watchdog_s is not None:
            self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Say in one line how the service is."""
        self._send(f"STATUS={' '.join(text.split())}")

    def stopping(self) -> None:
        """Say that the service ends."""
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

    def _owe(self, message: str) -> None:
        self._owed.append(message)
        self._pay()

    def _pay(self) -> None:
        while self._owed and self._send(self._owed[0]):
            del self._owed[0]

    def _send(self, message: str) -> bool:
        if self._socket is None:
            return True
        try:
            self._socket.sendto(message.encode(), socket.MSG_DONTWAIT, self._address)
        except OSError:
            # A manager that is away, or whose queue is full: the next poll says it again.
            return False
        return True
