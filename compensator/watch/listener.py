"""Subscribes to everything below a prefix over Zenoh and queries the latest messages; sends nothing else.

Commands are queries, too: a query on `thermal/**` would zero and hold every machine of the shop. Therefore only the
keys in `ASKED` are queried.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import zenoh

from compensator.config import Zenoh
from compensator.errors import ServiceError, UsageError
from compensator.service.command_client import operator_of_file
from compensator.service.session import (
    RETRY_S,
    alive_services,
    client_config,
    error_text,
    get,
    local_endpoints,
)
from compensator.watch.machine import LONGEST

#: Largest number of messages that wait to be processed.
WAITING = 65_536
#: Longest wait for the answers to a query, s.
ANSWER_S = 3.0


class Sink(Protocol):
    """Receives messages and liveliness; called on Zenoh's threads."""

    def receive(self, key: str, payload: bytes, *, asked: bool = False) -> None:
        """Receive a message, or the answer to a query."""

    def set_alive(self, key: str, alive: bool) -> None:
        """Receive a change of a liveliness token."""


class Source(NamedTuple):
    """Where to listen.

    Parameters
    ----------
    prefix : str
        Prefix of the keys; empty for all.
    where : str
        Endpoints, as text.
    config : callable
        Returns the configuration of a Zenoh client that tries its endpoints once.
    """

    prefix: str
    where: str
    config: Callable[[], zenoh.Config]


#: Keys that are queried: services answer them with the latest message.
ASKED = ("*/offset", "status", "sample", "estimate")


def below(prefix: str, rest: str) -> str:
    """Return the key expression of a key for the machine at a prefix and all machines below it.

    Examples
    --------
    >>> below("shop", "sample"), below("", "sample")
    ('shop/**/thermal/sample', '**/thermal/sample')
    """
    return f"{prefix}/**/thermal/{rest}" if prefix else f"**/thermal/{rest}"


class Listener:
    """A listening Zenoh session. Use it as a context manager: an open session would block the exit.

    Parameters
    ----------
    source : Source
        Where to listen.
    sinks : sequence of Sink
        Receive all messages and liveliness changes.
    on_connection : callable
        Called with the state of the connection whenever it changes.
    """

    def __init__(self, source: Source, *sinks: Sink, on_connection: Callable[[bool], None] = lambda _: None) -> None:
        self._source = source
        self._sinks = sinks
        self._on_connection = on_connection
        self._session: Any = None
        self._thread: threading.Thread | None = None
        self._receiving: threading.Thread | None = None
        self._stop = threading.Event()
        self._wanted = threading.Event()

    def open(self) -> None:
        """Connect and listen.

        Raises
        ------
        ServiceError
            If there is no answer, or an endpoint cannot be used.
        """
        try:
            session = self._session = zenoh.open(self._source.config())
        except zenoh.ZError as error:
            raise ServiceError(f"zenoh: no answer at {self._source.where}: {error_text(error)}") from error
        prefix = self._source.prefix
        # Zenoh's threads fill the channel without waiting for Python: if they had to wait, the router would drop
        # messages when a whole shop publishes at the same time.
        subscriber = session.declare_subscriber(below(prefix, "**"), zenoh.handlers.FifoChannel(WAITING))
        self._receiving = threading.Thread(target=self._forward_all, args=(subscriber,), name="watch receives")
        self._receiving.start()
        session.liveliness().declare_subscriber(below(prefix, "alive"), self._token, history=True)
        session.info.declare_transport_events_listener(self._transport, history=False)
        self._on_connection(True)

    def query(self, *, tokens: bool = True) -> None:
        """Query the latest messages of all services, and wait for the answers.

        Parameters
        ----------
        tokens : bool
            Query liveliness tokens, too. Not needed while subscribed: the subscription reports them, and a late answer
            would show a service as alive that has ended since.
        """
        session = self._session
        if session is None:
            return
        prefix = self._source.prefix
        keys = [below(prefix, rest) for rest in ASKED]
        # Access control may permit a reader the keys of one machine only.
        keys += [f"{prefix}/thermal/{rest}" for rest in ASKED] if prefix else []
        asked = [session.get(key, timeout=ANSWER_S) for key in keys]
        alive = session.liveliness().get(below(prefix, "alive"), timeout=ANSWER_S) if tokens else ()
        for answers in asked:
            for answer in answers:
                if answer.ok is not None:
                    self._forward(answer.ok, asked=True)
        for answer in alive:
            if answer.ok is not None:
                self._token(answer.ok)

    def elsewhere(self) -> list[str]:
        """Return the prefixes of all services that are alive, subscribed or not."""
        return alive_services(self._session, ANSWER_S) if self._session is not None else []

    def start(self) -> None:
        """Connect in the background, with retries, and query after each new connection."""
        self._thread = threading.Thread(target=self._keep_connected, name="watch")
        self._thread.start()

    def close(self) -> None:
        """Close the session and end the threads; may be called twice."""
        self._stop.set()
        self._wanted.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        session, self._session = self._session, None
        if session is not None:
            session.close()
        if self._receiving is not None:
            self._receiving.join()

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------ on other threads

    def _forward_all(self, subscriber: Any) -> None:
        """Forward messages until the session is closed."""
        with suppress(zenoh.ZError):
            for sample in subscriber:
                self._forward(sample)

    def _keep_connected(self) -> None:
        while not self._stop.is_set():
            try:
                self.open()
                break
            except ServiceError:
                self._stop.wait(RETRY_S)
        while not self._stop.is_set():
            try:
                self.query(tokens=False)
            except zenoh.ZError:
                self._on_connection(False)
            self._wanted.wait()
            self._wanted.clear()

    def _transport(self, event: Any) -> None:
        """Query after each automatic reconnection of Zenoh."""
        came = event.kind == zenoh.SampleKind.PUT
        self._on_connection(came)
        if came:
            self._wanted.set()

    def _forward(self, sample: Any, asked: bool = False) -> None:
        key = str(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT or key.endswith("/alive"):
            return
        payload = sample.payload.to_bytes() if len(sample.payload) <= LONGEST else bytes(LONGEST + 1)
        for sink in self._sinks:
            sink.receive(key, payload, asked=asked)

    def _token(self, sample: Any) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        if alive:
            # A service declares its token last, so from now on it answers queries.
            self._wanted.set()
        for sink in self._sinks:
            sink.set_alive(str(sample.key_expr), alive)


def of_endpoints(prefix: str, endpoints: list[str]) -> Source:
    """Return the source for endpoints without TLS.

    Raises
    ------
    UsageError
        If one of them is not a valid endpoint.
    """
    for endpoint in endpoints:
        if not re.fullmatch(r"(tcp|tls|quic|ws|unixsock-stream)/\S+", endpoint):
            raise UsageError(f"--connect {endpoint!r}: expected an endpoint such as tcp/127.0.0.1:7447")
    return of_settings(Zenoh(prefix=prefix, mode="client", connect=endpoints))


def of_settings(settings: Zenoh) -> Source:
    """Return the source for the service of a configuration on this computer.

    Raises
    ------
    UsageError
        If it has no endpoint, or uses TLS: the machine's own certificate must not subscribe.
    """
    if settings.secured():
        raise UsageError(
            "--zenoh: missing; TLS needs a receiver's or operator's certificate, expected a Zenoh configuration such "
            "as receiver.json5"
        )
    endpoints = [*settings.connect, *local_endpoints(settings)]
    if not endpoints:
        raise UsageError("zenoh: expected an endpoint in listen or connect")
    return Source(settings.prefix, ", ".join(endpoints), lambda: client_config(settings, endpoints))


def of_file(path: Path, prefix: str) -> Source:
    """Return the source of a receiver's or operator's Zenoh configuration.

    Raises
    ------
    ConfigError
        If the file, or a file named in it, cannot be used.
    """
    endpoints = get(operator_of_file(path).config, "connect/endpoints")
    return Source(prefix, ", ".join(endpoints), lambda: operator_of_file(path).config)
