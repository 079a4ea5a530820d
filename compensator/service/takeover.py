"""Replaces the running model by another one: prepared on a thread, swapped in between two samples."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from compensator.clock import Clock
from compensator.errors import CompensatorError
from compensator.events import EventKind
from compensator.service.adoption import Adoption, Prepared, Wanted
from compensator.service.compensation import Compensation, Outcome
from compensator.service.journal import Journal
from compensator.service.publisher import Sender

log = logging.getLogger("compensator")


@dataclass(slots=True)
class _Adopting:
    """A model that is being adopted, with the samples that came meanwhile."""

    wanted: Wanted
    reply: Future[dict[str, Any]]
    since: list[Outcome] = field(default_factory=list)
    prepared: Prepared | None = None
    task: asyncio.Task[None] | None = None


class Takeover:
    """Adopts one model at a time.

    Parameters
    ----------
    adoption : Adoption or None
        Prepares models; without it every one is refused.
    journal : Journal
        Where it is noted.
    clock : Clock
        For the history of models.
    running : callable
        Returns the compensation that runs.
    """

    def __init__(
        self, adoption: Adoption | None, journal: Journal, clock: Clock, running: Callable[[], Compensation]
    ) -> None:
        self._adoption = adoption
        self._journal = journal
        self._clock = clock
        self._running = running
        self._adopting: _Adopting | None = None
        self._ended = False

    def begin(self, wanted: Wanted, reply: Future[dict[str, Any]], sender: Sender) -> None:
        """Begin to prepare a model; the reply comes once it is ready or refused. In the loop only."""
        if self._adoption is None or self._ended or self._adopting is not None:
            why = f"{wanted.action}: this service adopts no model now"
            if self._adopting is not None:
                why = f"{wanted.action}: another model is under way until the next sample; ask again then"
            self._journal.note(EventKind.COMMAND_REFUSED, why, {"name": wanted.action, "ok": False} | sent_by(sender))
            reply.set_result(refusal(why))
            return
        # The text of the model is not repeated here: it travels in the recording that begins with it.
        data = {"sha256": wanted.sha256, "force": wanted.force}
        self._journal.note(EventKind.COMMAND, wanted.action, data | {"command": wanted.action} | sent_by(sender))
        self._adopting = _Adopting(wanted, reply)
        self._adopting.task = asyncio.create_task(self._prepare(self._adoption, self._adopting))
        self._adopting.task.add_done_callback(self._answer_refusal)

    def follow(self, outcome: Outcome) -> None:
        """Keep a sample that comes while a model is prepared."""
        if self._adopting is not None:
            self._adopting.since.append(outcome)

    def swap(self) -> Compensation:
        """Return the compensation for the next sample: the running one, or one with a model that is ready."""
        adopting, old = self._adopting, self._running()
        if adopting is None or adopting.prepared is None:
            return old
        self._adopting = None
        prepared = adopting.prepared
        new = prepared.warm.compensation
        for outcome in adopting.since:
            zero = next((note.data["mode"] for note in outcome.notes if note.kind == EventKind.ZERO), None)
            prepared.catch_up(outcome.sample, zero)
        difference = new.target_um - old.target_um
        new.succeed(old)
        self._journal.start_new_file(prepared.data)
        named = [f"{one.model.name} ({one.model.sha256[:12]})" for one in (new, old)]
        self._journal.note(
            EventKind.ADOPT,
            f"model {named[0]} replaces {named[1]}, "
            f"warm-up {prepared.warm.minutes / 60.0:.1f} h, the offset moves by {difference:+.2f} µm",
            {
                "ok": True,
                "action": adopting.wanted.action,
                "old_sha256": old.model.sha256,
                "new_sha256": new.model.sha256,
                **prepared.warm.figures(),
                "difference_um": difference,
                "y_std_um": new.std_um,
            },
        )
        return new

    async def end(self) -> None:
        """Wait until a model under way is answered: one that was stored is used at the next start."""
        self._ended = True
        await asyncio.sleep(0)  # one that was asked for just now is refused
        adopting = self._adopting
        if adopting is not None and adopting.task is not None:
            await asyncio.gather(adopting.task, return_exceptions=True)

    async def _prepare(self, adoption: Adoption, adopting: _Adopting) -> None:
        """Have the model prepared on another thread, then answer; the swap comes with the next sample."""
        running = self._running()
        zero = running.zero_that_stands if running.has_reference else None
        prepared = await asyncio.to_thread(adoption.prepare, adopting.wanted, running.model, zero, self._clock.utc_ns())
        adopting.prepared = prepared
        warm, model = prepared.warm, prepared.warm.compensation.model
        how = f"warmed up on {warm.samples} sample(s) of {warm.minutes / 60.0:.1f} h"
        if not warm.known:
            how += f", too little to know its state: standard deviation {warm.compensation.std_um:.1f} µm for now"
        adopting.reply.set_result(
            {
                "ok": True,
                "text": f"model {model.name} ({model.sha256[:12]}) is adopted with the next sample, {how}",
                "model": model.name,
                "model_sha256": model.sha256,
                **prepared.warm.figures(),
            }
        )

    def _answer_refusal(self, task: asyncio.Task[None]) -> None:
        """Answer with the reason where a model could not be prepared; the running one stays."""
        adopting, error = self._adopting, None if task.cancelled() else task.exception()
        if adopting is None or error is None:
            return
        self._adopting = None
        text = str(error)
        if not isinstance(error, CompensatorError):
            log.error("internal error", exc_info=error)
            text = f"internal error: {type(error).__name__}: {error}"
        self._journal.note(EventKind.ADOPT, f"refused: {text}", {"ok": False, "action": adopting.wanted.action})
        adopting.reply.set_result(refusal(text))


def refusal(text: str) -> dict[str, Any]:
    """Return the answer to a command that is refused."""
    return {"ok": False, "text": text}


def sent_by(sender: Sender) -> dict[str, Any]:
    """Return the sender of a command for its event; it replaces what the payload claims."""
    return {"by": sender.name, "by_proof": sender.proof}
