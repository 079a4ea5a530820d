"""Replaces the running model by another one: prepared on a thread, swapped in between two samples."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any

from compensator.clock import Clock
from compensator.errors import CompensatorError
from compensator.events import EventKind
from compensator.service.compensation import Compensation, Outcome
from compensator.service.journal import Journal
from compensator.service.publisher import Sender, refusal
from compensator.service.transfer.adoption import Adoption, ModelRequest
from compensator.service.transfer.candidate import ModelCandidate

log = logging.getLogger("compensator")


@dataclass(slots=True)
class _Order:
    """A command that is being carried out, with the samples that came meanwhile."""

    action: str
    request: ModelRequest
    reply: Future[dict[str, Any]]
    since: list[Outcome] = field(default_factory=list)
    ready: tuple[bytes, ModelCandidate] | None = None
    task: asyncio.Task[None] | None = None


class ModelSwap:
    """Carries out `adopt` and `back`, one at a time.

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
        self._order: _Order | None = None
        self._ended = False

    def begin(self, action: str, request: ModelRequest, reply: Future[dict[str, Any]], sender: Sender) -> None:
        """Begin to prepare a model; the reply comes once it is ready or refused. In the loop only."""
        if self._adoption is None or self._ended or self._order is not None:
            why = f"{action}: this service adopts no model now"
            if self._order is not None:
                why = f"{action}: another model is under way until the next sample; ask again then"
            self._journal.note(EventKind.COMMAND_REFUSED, why, {"name": action, "ok": False} | sender.data())
            reply.set_result(refusal(why))
            return
        # The text of the model is not repeated here: it travels in the recording that begins with it.
        data = {"sha256": request.sha256, "force": request.force}
        self._journal.note(EventKind.COMMAND, action, data | {"command": action} | sender.data())
        self._order = _Order(action, request, reply)
        self._order.task = asyncio.create_task(self._prepare(self._adoption, self._order))
        self._order.task.add_done_callback(self._answer_refusal)

    def follow(self, outcome: Outcome) -> None:
        """Keep a sample that comes while a model is prepared."""
        if self._order is not None:
            self._order.since.append(outcome)

    def swap(self) -> Compensation:
        """Return the compensation for the next sample: the running one, or one with a model that is ready."""
        order, old = self._order, self._running()
        if order is None or order.ready is None:
            return old
        self._order = None
        data, candidate = order.ready
        for outcome in order.since:
            candidate.update(outcome)
        new = candidate.compensation
        before, after = old.status, new.status
        has_offset = not math.isnan(before.target_um)
        new.continue_from(replace(before.handover, model_changed=has_offset))
        difference = after.target_um - before.target_um
        self._journal.start_new_file(data)
        named = [f"{one.model.name} ({one.model.sha256[:12]})" for one in (new, old)]
        self._journal.note(
            EventKind.ADOPT,
            f"model {named[0]} replaces {named[1]}, "
            f"warm-up {candidate.minutes / 60.0:.1f} h, the offset moves by {difference:+.2f} µm",
            {
                "ok": True,
                "action": order.action,
                "old_sha256": old.model.sha256,
                "new_sha256": new.model.sha256,
                **candidate.figures(),
                "difference_um": difference,
                "y_std_um": after.std_um,
            },
        )
        return new

    async def end(self) -> None:
        """Wait until a model under way is answered: one that was stored is used at the next start."""
        self._ended = True
        await asyncio.sleep(0)  # one that was asked for just now is refused
        order = self._order
        if order is not None and order.task is not None:
            await asyncio.gather(order.task, return_exceptions=True)

    async def _prepare(self, adoption: Adoption, order: _Order) -> None:
        """Have the model prepared on another thread, then answer; the swap comes with the next sample."""
        running, now_ns = self._running(), self._clock.utc_ns()
        order.ready = await asyncio.to_thread(
            adoption.prepare, order.action, order.request, running.model, running.status.zero, now_ns
        )
        _, candidate = order.ready
        model = candidate.compensation.model
        how = f"warmed up on {candidate.samples} sample(s) of {candidate.minutes / 60.0:.1f} h"
        if not candidate.is_known:
            std_um = candidate.compensation.status.std_um
            how += f", too little to know its state: standard deviation {std_um:.1f} µm for now"
        order.reply.set_result(
            {
                "ok": True,
                "text": f"model {model.name} ({model.sha256[:12]}) is adopted with the next sample, {how}",
                "model": model.name,
                "model_sha256": model.sha256,
                **candidate.figures(),
            }
        )

    def _answer_refusal(self, task: asyncio.Task[None]) -> None:
        """Answer with the reason where a model could not be prepared; the running one stays."""
        order, error = self._order, None if task.cancelled() else task.exception()
        if order is None or error is None:
            return
        self._order = None
        text = str(error)
        if not isinstance(error, CompensatorError):
            log.error("internal error", exc_info=error)
            text = f"internal error: {type(error).__name__}: {error}"
        self._journal.note(EventKind.ADOPT, f"refused: {text}", {"ok": False, "action": order.action})
        order.reply.set_result(refusal(text))
