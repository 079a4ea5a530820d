"""Publishes over Zenoh: offset, sample, estimate, status and event, and answers queries with the latest offset.

Zenoh's callbacks run on its own threads. They only answer from a value that is replaced atomically, and pass commands
on to the service's loop.
"""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from typing import Any, Literal, NamedTuple, Protocol

import zenoh

from compensator.codes import Remark, ServiceWarning
from compensator.config import Zenoh
from compensator.errors import ServiceError
from compensator.events import CommandName
from compensator.messages_axes import axis_of, topic_of
from compensator.service.presence import sole_publisher
from compensator.service.session import ALIVE, RETRY_S, error_text, log_links, session_config

log = logging.getLogger("compensator")

#: Commands of the service, each a query on `thermal/command/<name>/<sender>` or `thermal/command/<name>`.
COMMANDS = tuple(CommandName)
#: Characters of a sender's name, which is a chunk of a key.
SENDER = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
#: Longest payload of a command that contains a model, and of any other, bytes.
_LONGEST_MODEL, _LONGEST = 1_000_000, 10_000

_KEYS = {
    "offset": "thermal/y/offset",
    "sample": "thermal/sample",
    "estimate": "thermal/estimate",
    "status": "thermal/status",
    "event": "thermal/event",
}

#: Answer to a command, or a future of it if it takes longer than Zenoh's thread may wait.
Reply = dict[str, Any] | Future[dict[str, Any]]


def longest(command: str) -> int:
    """Return the longest payload of a command, bytes."""
    return _LONGEST_MODEL if command in (CommandName.ADOPT, CommandName.BACK) else _LONGEST


def refusal(text: str) -> dict[str, Any]:
    """Return the reply to a command that is refused."""
    return {"ok": False, "text": text}


class Sender(NamedTuple):
    """The sender of a command.

    Zenoh does not show the certificate of the sender of a query. The name is therefore part of the key, and the
    router's access list permits each certificate only its own name.

    Parameters
    ----------
    name : str
        `unnamed` if the key has none.
    proof : str
        `certificate`: the service is reached only through its router, over mutually authenticated links. `none`: the
        sender may use any name.
    """

    name: str = "unnamed"
    proof: Literal["certificate", "none"] = "none"

    def data(self) -> dict[str, Any]:
        """Return the sender for an event; it replaces any sender in the payload."""
        return {"by": self.name, "by_proof": self.proof}


#: Sender of a command without a name.
UNNAMED = Sender()
#: name, payload, sender → reply
CommandHandler = Callable[[str, bytes, Sender], Reply]


class _Declared(Protocol):
    """A token or queryable of a session."""

    def undeclare(self) -> None: ...


class Publisher:
    """The service's Zenoh session. Use it as a context manager: an open session would block the exit.

    Parameters
    ----------
    settings : Zenoh
        Prefix, mode and endpoints.
    on_command : callable
        Called on a Zenoh thread with the name and payload of a command; returns the reply.
    axes : sequence of str
        Axes of the machine; empty where it has Y alone.

    Raises
    ------
    ServiceError
        By `open`, if an endpoint cannot be listened on, or another service of the machine is alive.
    """

    def __init__(self, settings: Zenoh, on_command: CommandHandler, axes: Sequence[str] = ()) -> None:
        self._settings = settings
        self._keys = _KEYS | {topic_of(axis): f"thermal/{axis}/offset" for axis in axes}
        #: Names of the messages that are offsets.
        self._offsets = tuple(name for name in self._keys if axis_of(name) is not None)
        self._on_command = on_command
        self._latest: dict[str, bytes] = {}
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[_Declared] = []
        self._closing = threading.Event()
        self._waiting: threading.Thread | None = None

    def key(self, name: str) -> str:
        """Return the full key of a message or command."""
        return f"{self._settings.prefix}/{self._keys.get(name, f'thermal/command/{name}')}"

    def open(self) -> None:
        """Open the session and declare everything.

        A client that reaches no router retries in the background: compensation and recording do not wait for it.
        """
        try:
            self._begin()
        except zenoh.ZError as error:
            endpoints = ", ".join(self._settings.listen + self._settings.connect) or "no endpoints"
            words = f"zenoh: {error_text(error)} ({self._settings.mode}, {endpoints})"
            if self._settings.mode != "client":
                raise ServiceError(words) from error
            figures = f"{words.rstrip('.')}; retrying."
            log.warning("%s", Remark(ServiceWarning.ROUTER_NOT_REACHED, figures).marked)
            self._waiting = threading.Thread(target=self._begin_later, name="zenoh-router", daemon=True)
            self._waiting.start()

    def _begin(self) -> None:
        with ExitStack() as unfinished:  # if a step fails, everything is undone and retried
            # First: nothing may be published or answered for a machine that already has a service.
            with sole_publisher(self._settings):
                session = zenoh.open(session_config(self._settings))
                unfinished.callback(session.close)
                declared: list[_Declared] = [session.liveliness().declare_token(f"{self._settings.prefix}/{ALIVE}")]
            publishers = {name: self._publisher(session, name) for name in self._keys}
            for name in (*self._offsets, "status", "sample", "estimate"):
                declared.append(session.declare_queryable(self.key(name), self._answer_latest(name)))
            for name in COMMANDS:
                for key in (self.key(name), f"{self.key(name)}/*"):
                    declared.append(session.declare_queryable(key, self._answer_command(name)))
            log_links(session, self._settings.connect)
            unfinished.pop_all()
        self._publishers, self._declared = publishers, declared
        self._session = session  # last: from now on other threads publish

    def _publisher(self, session: zenoh.Session, name: str) -> zenoh.Publisher:
        return session.declare_publisher(
            self.key(name),
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH if name in self._offsets else zenoh.Priority.DATA,
            # Each express message takes a packet, and a router queues only a few packets: it would drop offsets if a
            # whole shop publishes at the same time. Express messages save no measurable time.
            express=False,
        )

    def _begin_later(self) -> None:
        """Retry until the router is reached, or the service ends."""
        logged = ""
        while not self._closing.wait(RETRY_S):
            try:
                self._begin()
            except zenoh.ZError:
                continue
            except ServiceError as error:  # the control must not receive offsets of two services
                if str(error) != logged:
                    log.error("%s; nothing is published here until that service has ended", error)
                    logged = str(error)
                continue
            return

    def publish(self, name: str, data: bytes) -> None:
        """Publish one message; never waits."""
        self._latest[name] = data
        if self._session is not None:
            self._publishers[name].put(data)

    def close(self) -> None:
        """Undeclare everything and close the session; may be called twice."""
        self._closing.set()
        if self._waiting is not None:
            self._waiting.join()
            self._waiting = None
        session, self._session = self._session, None
        if session is None:
            return
        for declared in self._declared:
            declared.undeclare()
        session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Publisher:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer_latest(self, name: str) -> Callable[[zenoh.Query], None]:
        def answer(query: zenoh.Query) -> None:
            with query:
                data = self._latest.get(name)
                if data is not None:
                    query.reply(self.key(name), data, encoding=zenoh.Encoding.APPLICATION_JSON)

        return answer

    def _answer_command(self, name: str) -> Callable[[zenoh.Query], None]:
        def send(query: zenoh.Query, key: str, reply: dict[str, Any]) -> None:
            with query:
                query.reply(key, json.dumps(reply).encode(), encoding=zenoh.Encoding.APPLICATION_JSON)

        def answer(query: zenoh.Query) -> None:
            key = str(query.key_expr)
            sender = self._sender(name, key)
            if sender is None:
                query.drop()  # type: ignore[no-untyped-call]
                return
            reply = self._on_command(name, _payload(query, longest(name)), sender)
            if isinstance(reply, Future):
                reply.add_done_callback(lambda done: send(query, key, done.result()))
            else:
                send(query, key, reply)

        return answer

    def _sender(self, name: str, key: str) -> Sender | None:
        """Return the sender of a command; None for a query on many keys at once, which is not a command.

        A query on `**` must not zero, hold and resume the machine.
        """
        if key == self.key(name):
            return UNNAMED
        sender = key.removeprefix(f"{self.key(name)}/")
        if not SENDER.fullmatch(sender):
            return None
        return Sender(sender, "certificate" if self._settings.secured() else "none")


def _payload(query: zenoh.Query, most: int) -> bytes:
    """Return the payload; of one that is longer only as much as shows that it is: it is not copied."""
    if query.payload is None:
        return b""
    return query.payload.to_bytes() if len(query.payload) <= most else bytes(most + 1)
