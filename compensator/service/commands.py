"""Commands of operators: checked on the thread that receives them, applied between two samples."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from typing import Any

import msgspec

from compensator.errors import ServiceError
from compensator.events import CommandName, EventKind
from compensator.service.compensation import Compensation
from compensator.service.event_log import EventLog
from compensator.service.publisher import COMMANDS, Reply, Sender, refusal
from compensator.service.replay import execute
from compensator.service.transfer.adoption import LONGEST_MODEL, Adoption, ModelRequest

#: Longest payload of a command without a model, bytes.
LONGEST_COMMAND = 10_000
#: Largest number of commands that wait for the next sample.
WAITING_COMMANDS = 100
#: Largest number of refused commands noted between two samples; a flood must not displace other events.
NOTED_REFUSALS = 10


class Commands:
    """Receives commands from other threads; `unproven`: whether unauthenticated senders are accepted."""

    def __init__(self, events: EventLog, adoption: Adoption, *, unproven: bool) -> None:
        self._events = events
        self._adoption = adoption
        self._unproven = unproven
        self._waiting: asyncio.Queue[tuple[str, dict[str, Any], Sender]] = asyncio.Queue(maxsize=WAITING_COMMANDS)
        self._refused = 0
        self._loop: asyncio.AbstractEventLoop | None = None

    def open(self) -> None:
        """Accept commands from now on, in the running loop."""
        self._loop = asyncio.get_running_loop()

    def close(self) -> None:
        """Refuse commands from now on."""
        self._loop = None

    def receive(self, name: str, payload: bytes, sender: Sender) -> Reply:
        """Accept or refuse a command from another thread; see `Daemon.command`."""
        loop = self._loop
        try:
            arguments = self._checked(name, payload, sender)
            if loop is None or self._waiting.full():
                raise ServiceError("the service cannot accept a command now")
            if name in (CommandName.ADOPT, CommandName.BACK):
                request = ModelRequest.of(name, arguments)
                reply: Future[dict[str, Any]] = Future()
                loop.call_soon_threadsafe(self._adoption.begin, name, request, reply, sender)
                return reply
        except ServiceError as error:
            if loop is not None:
                loop.call_soon_threadsafe(self._note_refusal, name, str(error), sender)
            return refusal(str(error))
        loop.call_soon_threadsafe(self._enqueue, name, arguments, sender)
        return {"ok": True, "text": f"{name}: acts at the next sample"}

    def apply(self, compensation: Compensation) -> None:
        """Apply the commands that arrived since the last sample."""
        self._refused = 0
        while not self._waiting.empty():
            name, arguments, sender = self._waiting.get_nowait()
            self._events.note(EventKind.COMMAND, name, arguments | {"command": name} | sender.data())
            execute(compensation, name, arguments)

    def _checked(self, name: str, payload: bytes, sender: Sender) -> dict[str, Any]:
        """Return the arguments of an acceptable command."""
        if len(payload) > (LONGEST_MODEL if name in (CommandName.ADOPT, CommandName.BACK) else LONGEST_COMMAND):
            raise ServiceError(f"{name}: the payload of {len(payload)} bytes is longer than permitted")
        try:
            arguments = msgspec.json.decode(payload, type=dict[str, Any]) if payload else {}
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise ServiceError(f"{name}: the payload is not a JSON object") from error
        mode = arguments.get("mode", "auto")
        if name not in COMMANDS or (name == CommandName.ZERO and mode not in ("auto", "rest", "warm")):
            raise ServiceError(
                f"{name} {mode!r}: expected zero with mode auto, rest or warm, hold, resume, adopt with a model, back"
            )
        if sender.proof == "none" and not self._unproven:
            raise ServiceError(
                f"{name}: the sender {sender.name} is not authenticated; expected a router with TLS and the key "
                f"thermal/command/{name}/<common name of the certificate>, or zenoh.unproven_commands = true"
            )
        return arguments

    def _enqueue(self, name: str, arguments: dict[str, Any], sender: Sender) -> None:
        if self._waiting.full():
            self._note_refusal(name, "too many commands are waiting", sender)
        else:
            self._waiting.put_nowait((name, arguments, sender))

    def _note_refusal(self, name: str, why: str, sender: Sender) -> None:
        self._refused += 1
        if self._refused <= NOTED_REFUSALS:
            self._events.note(EventKind.COMMAND_REFUSED, why, {"name": name, "ok": False} | sender.data())
