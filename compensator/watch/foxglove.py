"""A live connection for the Foxglove application: forwards messages over its WebSocket protocol.

Needs the extra `foxglove`. The topics of the watched machine are those of its recordings (`/sample`, `/estimate`,
`/offset`, `/event`), so one layout opens both; topics of machines below the prefix begin with the machine.
"""

from __future__ import annotations

import json
import secrets
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from compensator.errors import ServiceError
from compensator.messages import shipped_schema
from compensator.watch.machine import KINDS, Malformed, decoded
from compensator.watch.origin_gate import VIEWERS, OriginGate
from compensator.watch.shop import MACHINES

#: The only address to which the server is bound.
HOST = "127.0.0.1"
#: Number of past events that a new viewer receives.
EVENTS = 20


def topic_of(key: str, prefix: str) -> tuple[str, str] | None:
    """Return topic and kind of a key; None if it is unknown.

    Examples
    --------
    >>> topic_of("shop/vmc-07/thermal/y/offset", "shop/vmc-07"), topic_of("shop/vmc-07/thermal/sample", "shop")
    (('/offset', 'offset'), ('/vmc-07/sample', 'sample'))
    """
    before, _, rest = key.rpartition("/thermal/")
    kind = KINDS.get(rest)
    if kind is None:
        return None
    below = before if not prefix else before.removeprefix(prefix).strip("/")
    return (f"/{below}/{kind}" if below else f"/{kind}"), kind


class FoxgloveServer:
    """A server for viewers on loopback. Use it as a context manager.

    Parameters
    ----------
    prefix : str
        Watched prefix.
    port : int
        0 selects a free port.
    origins : sequence of str
        Further origins of pages that may connect, such as a viewer that a company hosts itself.

    Raises
    ------
    ServiceError
        If the extra is not installed, or the port is in use.
    """

    def __init__(self, prefix: str, port: int, origins: Sequence[str] = ()) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise ServiceError("--foxglove: not installed: pip install quill-compensator[foxglove]") from error
        self._foxglove: Any = foxglove
        self._prefix, self._port = prefix, port
        self._origins = (*VIEWERS, *origins)
        self._context: Any = foxglove.Context()
        self._lock = threading.Lock()
        #: Prefixes of the machines that have channels, at most `MACHINES`.
        self._machines: set[str] = set()
        self._channels: dict[str, Any] = {}
        #: Messages for a new viewer, by topic: the latest message, the last events.
        self._latest: dict[str, list[tuple[bytes, int]]] = {}
        self._gate: OriginGate | None = None
        self._stack = ExitStack()

    @property
    def port(self) -> int:
        """Port of the server."""
        return self._gate.port if self._gate is not None else self._port

    def __enter__(self) -> FoxgloveServer:
        # Behind the gate: at an address of loopback that no page can guess.
        inner = ".".join(("127", *(str(1 + secrets.randbelow(254)) for _ in range(3))))
        try:
            server = self._foxglove.start_server(
                name="quill-compensator",
                host=inner,
                port=0,
                context=self._context,
                server_listener=_Listener(self._join),
            )
            self._stack.callback(server.stop)
            gate = OriginGate((HOST, self._port), (inner, int(server.port)), self._origins)
            self._gate = self._stack.enter_context(gate)
        except (RuntimeError, OSError, OverflowError) as error:
            self._stack.close()
            raise ServiceError(f"--foxglove-port {self._port}: {error}; 0 selects a free port") from error
        return self

    def __exit__(self, *_: object) -> None:
        self._gate = None
        self._stack.close()

    def receive(self, key: str, payload: bytes, *, asked: bool = False) -> None:
        """Forward a message with its own time; malformed messages and those of further machines are dropped."""
        found = topic_of(key, self._prefix)
        if found is None:
            return
        topic, kind = found
        try:
            message = decoded(kind, payload)
        except Malformed:
            return
        machine = key.rpartition("/thermal/")[0]
        with self._lock:
            if machine not in self._machines and len(self._machines) >= MACHINES:
                return
            self._machines.add(machine)
            kept = self._latest.setdefault(topic, [])
            if asked and kept:
                return
            kept.append((payload, message.time_utc_ns))
            del kept[: -(EVENTS if kind == "event" else 1)]
            channel = self._channels.get(topic)
            if channel is None:
                schema = json.loads(shipped_schema(kind))
                channel = self._channels[topic] = self._foxglove.Channel(topic, schema=schema, context=self._context)
        channel.log(payload, log_time=message.time_utc_ns)

    def set_alive(self, key: str, alive: bool) -> None:
        """Ignore liveliness, which recordings do not contain either."""

    def _join(self, topic: str) -> None:
        """Send a new viewer the latest messages, so that it need not wait for the next sample.

        The library cannot address a single viewer: other viewers receive the same messages again, with the same times.
        """
        with self._lock:
            known, channel = list(self._latest.get(topic, ())), self._channels.get(topic)
        if channel is not None:
            for payload, time_ns in known:
                channel.log(payload, log_time=time_ns)


class _Listener:
    """Callbacks of the server; it offers no capabilities, so viewers cannot send anything."""

    def __init__(self, join: Callable[[str], None]) -> None:
        self._join = join

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Handle a new subscription of a viewer."""
        self._join(str(channel.topic))
