"""Commands from outside: checked on the thread that brings them, obeyed between two samples."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from typing import Any

import msgspec

from compensator.errors import ServiceError
from compensator.service.adoption import LONGEST_MODEL, Wanted
from compensator.service.compensation import Compensation
from compensator.service.journal import Journal
from compensator.service.publisher import COMMANDS, Reply
from compensator.service.retrace import obey
from compensator.service.takeover import Takeover, refusal

#: Longest payload of a command that brings no model, bytes.
LONGEST_COMMAND = 10_000
#: So many commands wait for the next sample at most.
WAITING_COMMANDS = 100


class Commands:
    """Takes commands from other threads.

    Parameters
    ----------
    journal : Journal
        Where each command is noted.
    takeover : Takeover
        Takes `adopt` and `back`.
    """

    def __init__(self, journal: Journal, takeover: Takeover) -> None:
        self._journal = journal
        self._takeover = takeover
        self._waiting: asyncio.Queue[tuple[str, dict[str, Any]]] = asyncio.Queue(maxsize=WAITING_COMMANDS)
        self._loop: asyncio.AbstractEventLoop | None = None

    def open(self) -> None:
        """Take commands from now on, in the loop that runs."""
        self._loop = asyncio.get_running_loop()

    def close(self) -> None:
        """Take none any more."""
        self._loop = None

    def take(self, name: str, payload: bytes) -> Reply:
        """Take a command from another thread; see `Daemon.command`."""
        brings_model = name in ("adopt", "back")
        if len(payload) > (LONGEST_MODEL if brings_model else LONGEST_COMMAND):
            return refusal(f"{name}: the payload has {len(payload)} bytes, more than a command may have")
        try:
            arguments = msgspec.json.decode(payload, type=dict[str, Any]) if payload else {}
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return refusal(f"{name}: the payload is no JSON object")
        mode = arguments.get("mode", "auto")
        if name not in COMMANDS or (name == "zero" and mode not in ("auto", "rest", "warm")):
            return refusal(
                f"{name} {mode!r}: expected zero with mode auto, rest or warm, hold, resume, adopt with a model, back"
            )
        loop = self._loop
        if loop is None or self._waiting.full():
            return refusal("the service cannot take a command now")
        if brings_model:
            return self._take_model(loop, name, arguments)
        loop.call_soon_threadsafe(self._enqueue, name, arguments)
        return {"ok": True, "text": f"{name}: acts at the next sample"}

    def obey(self, compensation: Compensation) -> None:
        """Let the compensation obey what came since the last sample."""
        while not self._waiting.empty():
            name, arguments = self._waiting.get_nowait()
            self._journal.note("command", name, arguments)
            obey(compensation, name, arguments)

    def _enqueue(self, name: str, arguments: dict[str, Any]) -> None:
        if not self._waiting.full():
            self._waiting.put_nowait((name, arguments))

    def _take_model(self, loop: asyncio.AbstractEventLoop, name: str, arguments: dict[str, Any]) -> Reply:
        try:
            wanted = Wanted.of(name, arguments)
        except ServiceError as error:
            return refusal(str(error))
        reply: Future[dict[str, Any]] = Future()
        loop.call_soon_threadsafe(self._takeover.begin, wanted, reply)
        return reply
