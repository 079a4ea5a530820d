"""Publishes over Zenoh: offset, sample, estimate, status and event, and answers queries with the latest offset.

Zenoh calls back on threads of its own. What happens there is kept to answering from a value that is replaced
as a whole, and to handing commands over to the service's loop.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import msgspec
import zenoh

from compensator.config import Zenoh
from compensator.errors import ServiceError

#: Commands that the service takes, each a query on `thermal/command/<name>`.
COMMANDS = ("zero", "hold", "resume", "adopt", "back")

_KEYS = {
    "offset": "thermal/y/offset",
    "sample": "thermal/sample",
    "estimate": "thermal/estimate",
    "status": "thermal/status",
    "event": "thermal/event",
}

#: What a command is answered with, or a promise of it where it takes longer than Zenoh's thread may wait.
Reply = dict[str, Any] | Future[dict[str, Any]]
#: name, payload → reply
CommandHandler = Callable[[str, bytes], Reply]


def session_config(settings: Zenoh) -> zenoh.Config:
    """Make a Zenoh configuration that listens and scouts for nothing that is not configured.

    Parameters
    ----------
    settings : Zenoh
        Mode and endpoints.
    """
    config = zenoh.Config()

    def put(key: str, value: object) -> None:
        config.insert_json5(key, json.dumps(value))

    put("mode", settings.mode)
    put("listen/endpoints", settings.listen)
    put("connect/endpoints", settings.connect)
    put("scouting/multicast/enabled", False)
    put("scouting/gossip/enabled", False)
    # A router that comes back is found within a second, not within the default's four.
    put("connect/retry", {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5})
    # A dead service loses its liveliness token after this, where the network gives no sign.
    put("transport/link/tx/lease", 4000)
    return config


class Publisher:
    """The service's side of Zenoh. Use it as a context manager: an open session would hang the exit.

    Parameters
    ----------
    settings : Zenoh
        Prefix, mode and endpoints.
    on_command : callable
        Called on a Zenoh thread with the name and payload of a command; returns the reply.

    Raises
    ------
    ServiceError
        From `open`, when an endpoint cannot be listened on or a client finds no router.
    """

    def __init__(self, settings: Zenoh, on_command: CommandHandler) -> None:
        self._settings = settings
        self._on_command = on_command
        self._latest: dict[str, bytes] = {}
        self._session: Any = None
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []

    def key(self, name: str) -> str:
        """Return the full key of a message or command."""
        return f"{self._settings.prefix}/{_KEYS.get(name, f'thermal/command/{name}')}"

    def open(self) -> None:
        """Open the session and declare everything."""
        try:
            self._session = zenoh.open(session_config(self._settings))
        except zenoh.ZError as error:
            endpoints = ", ".join(self._settings.listen + self._settings.connect) or "no endpoints"
            raise ServiceError(f"zenoh: {error} ({self._settings.mode}, {endpoints})") from error
        session = self._session
        for name in _KEYS:
            self._publishers[name] = session.declare_publisher(
                self.key(name),
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH if name == "offset" else zenoh.Priority.DATA,
                express=name == "offset",
            )
        for name in ("offset", "status"):
            self._declared.append(session.declare_queryable(self.key(name), self._answer_latest(name)))
        for name in COMMANDS:
            self._declared.append(session.declare_queryable(self.key(name), self._answer_command(name)))
        token = f"{self._settings.prefix}/thermal/alive"
        self._declared.append(session.liveliness().declare_token(token))

    def publish(self, name: str, data: bytes) -> None:
        """Publish one message; never waits."""
        self._latest[name] = data
        if self._session is not None:
            self._publishers[name].put(data)

    def close(self) -> None:
        """Undeclare everything and close the session; may be called twice."""
        session, self._session = self._session, None
        if session is None:
            return
        for declared in self._declared:
            declared.undeclare()
        session.close()

    def __enter__(self) -> Publisher:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer_latest(self, name: str) -> Callable[[Any], None]:
        def answer(query: Any) -> None:
            with query:
                data = self._latest.get(name)
                if data is not None:
                    query.reply(self.key(name), data, encoding=zenoh.Encoding.APPLICATION_JSON)

        return answer

    def _answer_command(self, name: str) -> Callable[[Any], None]:
        def send(query: Any, reply: dict[str, Any]) -> None:
            with query:
                query.reply(self.key(name), json.dumps(reply).encode(), encoding=zenoh.Encoding.APPLICATION_JSON)

        def answer(query: Any) -> None:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            reply = self._on_command(name, payload)
            if isinstance(reply, Future):
                reply.add_done_callback(lambda done: send(query, done.result()))
            else:
                send(query, reply)

        return answer


def ask(settings: Zenoh, command: str, payload: bytes, *, timeout_s: float) -> dict[str, Any] | None:
    """Send a command to the running service of a configuration, as an operator's program does.

    Parameters
    ----------
    settings : Zenoh
        Settings of the service: it is looked for where it listens, and at the routers that it connects to.
    command : str
        One of `COMMANDS`.
    payload : bytes
        JSON.
    timeout_s : float
        How long to wait for the reply, s.

    Returns
    -------
    dict or None
        `ok` and `text`; None where no service answers.
    """
    listened = [re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", endpoint) for endpoint in settings.listen]
    endpoints = [endpoint for endpoint in listened if not endpoint.endswith(":0")] + settings.connect
    if not endpoints:
        return None
    config = session_config(msgspec.structs.replace(settings, mode="client", listen=[], connect=endpoints))
    config.insert_json5("connect/timeout_ms", "0")  # one attempt: a service that runs is there
    config.insert_json5("connect/exit_on_failure", "true")
    key = f"{settings.prefix}/thermal/command/{command}"
    try:
        with zenoh.open(config) as session:
            for answer in session.get(key, payload=payload, timeout=timeout_s):
                if answer.ok is not None:
                    reply: dict[str, Any] = json.loads(answer.ok.payload.to_bytes())
                    return reply
    except (zenoh.ZError, ValueError):
        return None
    return None
