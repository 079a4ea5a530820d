"""Ports of loopback for what a test starts."""

from __future__ import annotations

import random
import socket

#: Below those that a system gives to outgoing connections: such a one may be taken before the test's server binds it.
_PORTS = range(10_000, 20_000)
_given: set[int] = set()


def free_port() -> int:
    """Return a port that nothing listens on, and that this process has not returned before."""
    while len(_given) < len(_PORTS):
        port = random.SystemRandom().choice(_PORTS)  # many test processes draw, and tests seed the common generator
        if port in _given:
            continue
        _given.add(port)
        with socket.socket() as free:
            try:
                free.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError(f"no free port in {_PORTS}")
