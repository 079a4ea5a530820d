"""Changes the model of the running service: prepared on a separate thread, swapped in between two samples.

The thread checks the model, warms it up on the recordings, compares it with the present one by the measured Y on
record (`second_opinion`) and stores it for the next start; samples have priority.
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import msgspec

from compensator.clock import Clock
from compensator.config import Config
from compensator.errors import CompensatorError, DataError, ServiceError
from compensator.events import CommandName, ComparisonData, EventKind, NotJudged
from compensator.model.effects.names import effect_names
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome, slowest_min
from compensator.service.event_log import EventLog
from compensator.service.journal import Journal
from compensator.service.publisher import Sender, refusal
from compensator.service.status import Zero
from compensator.service.transfer.model_store import ModelStore, check_model, sha256_of
from compensator.service.transfer.second_opinion import (
    described,
    refuse_if_worse,
    second_opinion,
    without_move,
    worse_axes,
)
from compensator.service.transfer.turns import give_way
from compensator.service.transfer.two_models import not_judged
from compensator.service.transfer.warm_up import WARM_UP, Successor, warm_up

log = logging.getLogger("compensator")

#: How long the end of the service waits for a model that is being prepared, and for its thread to notice the end, s.
GRACE_S, NOTICE_S = 5.0, 5.0
T = TypeVar("T")
_ENDING = "the service is ending"
_ADVICE = "wait, zero the machine at rest, or use --force"


class ModelRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Arguments of the commands `adopt` and `back`.

    Parameters
    ----------
    sha256 : str
        Hash of the model file; empty if the command does not contain one.
    model : str
        The model file; empty if it is already in the store.
    force : bool
        Adopt it even if the recordings do not determine its state, or it is clearly worse than the present one.
    candidate : bool
        Adopt the candidate of the loop.
    """

    sha256: str = ""
    model: str = ""
    force: bool = False
    candidate: bool = False

    @classmethod
    def of(cls, action: str, arguments: dict[str, Any]) -> ModelRequest:
        """Read the arguments of a command.

        Raises
        ------
        ServiceError
            If the arguments are invalid; the message states what was expected.
        """
        try:
            request = msgspec.convert(arguments, cls)
        except msgspec.ValidationError as error:
            expected = "sha256 and model (texts), force (true or false)"
            raise ServiceError(f"{action}: {error}; expected {expected}") from error
        if action == CommandName.ADOPT and not (request.sha256 or request.model or request.candidate):
            raise ServiceError("adopt: expected model, the text of a model file, or sha256, that of one adopted before")
        if request.model and request.sha256 not in ("", found := sha256_of(request.model.encode())):
            raise ServiceError(f"adopt: the model's sha256 is {found}, not {request.sha256}")
        return request


@dataclass(frozen=True, slots=True, kw_only=True)
class _Prepared:
    """The file of a model, its compensation, and how it compares with the present model."""

    data: bytes
    successor: Successor
    comparison: ComparisonData


@dataclass(slots=True)
class _Order:
    """A command that is being executed, with the samples since its arrival, and the comparison once it is made."""

    action: str
    request: ModelRequest
    reply: Future[dict[str, Any]]
    since: list[Outcome] = field(default_factory=list)
    ready: _Prepared | None = None
    comparison: ComparisonData | None = None
    task: asyncio.Task[None] | None = None


class Exchanger(Protocol):
    """What changes the model of the service by itself."""

    @property
    def is_exchanging(self) -> bool:
        """Whether a decided exchange has not happened yet: another change of the model has to wait."""
        ...

    @property
    def waits_for(self) -> str:
        """Why a decided exchange does not happen yet; empty if nothing keeps it."""
        ...

    def model_changed(self, present: Compensation, model: bytes, *, back: bool) -> None:
        """Begin anew after a command has changed the model."""
        ...


class Adoption:
    """Executes `adopt` and `back`, one at a time.

    Parameters
    ----------
    config : Config
        Settings with which the model must be compatible.
    recordings : pathlib.Path
        Folder of the recordings for the warm-up.
    store : ModelStore or None
        Adopted models; without it every command is refused.
    events, journal, clock
        For events, the recording of another model, and the history of models.
    running : callable
        Returns the running compensation.
    loop : Exchanger, optional
        The loop, which changes the model, too, and begins anew after a command has.
    """

    def __init__(
        self,
        config: Config,
        recordings: Path,
        store: ModelStore | None,
        events: EventLog,
        journal: Journal,
        *,
        clock: Clock,
        running: Callable[[], Compensation],
        loop: Exchanger | None = None,
    ) -> None:
        self._config = config
        self._recordings = recordings
        self._store = store
        self._events = events
        self._journal = journal
        self._clock = clock
        self._running = running
        self._loop = loop
        self._order: _Order | None = None
        self._ended = False
        #: Set when a model that is being prepared must no longer be stored.
        self._given_up = threading.Event()

    @property
    def is_under_way(self) -> bool:
        """Whether a model is being prepared."""
        return self._order is not None

    def begin(self, action: str, request: ModelRequest, reply: Future[dict[str, Any]], sender: Sender) -> None:
        """Begin to prepare a model; the reply comes once it is ready or refused. In the loop only."""
        exchanging = self._loop is not None and self._loop.is_exchanging
        if self._store is None or self._ended or self._order is not None or exchanging:
            why = f"{action}: this service cannot change its model now"
            if self._order is not None or exchanging:
                why = f"{action}: another model is being prepared; retry after the next sample"
            if exchanging and self._loop is not None and self._loop.waits_for:
                why = f"{action}: the loop goes back to another model, which waits: {self._loop.waits_for}"
            self._events.note(EventKind.COMMAND_REFUSED, why, {"name": action, "ok": False} | sender.data())
            reply.set_result(refusal(why))
            return
        # The event does not contain the model's text: it is attached to the recording that starts with it.
        data = {"sha256": request.sha256, "force": request.force}
        self._events.note(EventKind.COMMAND, action, data | {"command": action} | sender.data())
        self._order = _Order(action, request, reply)
        self._order.task = asyncio.create_task(self._prepare(self._store, self._order))
        self._order.task.add_done_callback(self._answer_refusal)

    def follow(self, outcome: Outcome) -> None:
        """Keep a sample that arrives while a model is prepared."""
        if self._order is not None:
            self._order.since.append(outcome)

    def swap(self) -> Compensation:
        """Return the compensation for the next sample: the running one, or the prepared one once it is ready."""
        order, old = self._order, self._running()
        if order is None or order.ready is None:
            return old
        self._order = None
        successor, comparison = order.ready.successor, order.ready.comparison
        new, before = successor.compensation, old.status
        has_offset = not math.isnan(before.target_um)
        try:
            for outcome in order.since:
                successor.follow(outcome)
            new.continue_from(msgspec.structs.replace(before.handover, model_changed=has_offset))
        except Exception as error:
            log.exception("internal error of a model that is adopted")
            self._take_back(order, old.model, error)
            return old
        after = new.status
        difference = after.target_um - before.target_um
        self._journal.start_new_file(order.ready.data)
        if self._loop is not None:
            self._loop.model_changed(new, order.ready.data, back=order.action == CommandName.BACK)
        named = [f"{one.model.name} ({one.model.sha256[:12]})" for one in (new, old)]
        self._events.note(
            EventKind.ADOPT,
            f"model {named[0]} replaces {named[1]}, warm-up {successor.minutes / 60.0:.1f} h, "
            f"the offset moves by {difference:+.2f} µm; {described(without_move(comparison))}{_unwatched(new, old)}",
            {
                "ok": True,
                "action": order.action,
                "old_sha256": old.model.sha256,
                "new_sha256": new.model.sha256,
                "effects": effect_names(new.model.effects),
                **successor.figures(),
                "difference_um": difference,
                "y_std_um": after.std_um,
                "comparison": comparison.table(),
            },
        )
        return new

    def _take_back(self, order: _Order, present: ThermalModel, error: Exception) -> None:
        """Go on with the present model, now and at the next start: the new one failed after the command's answer."""
        text = f"refused: internal error: {type(error).__name__}: {error}; model {present.name} goes on"
        try:
            assert self._store is not None
            self._store.go_on_with(present.sha256, name=present.name, time_utc_ns=self._clock.utc_ns())
        except ServiceError as not_stored:
            text += f"; the next start uses the other one: {not_stored}"
        self._events.note(EventKind.ADOPT, text, {"ok": False, "action": order.action})

    async def end(self) -> None:
        """Wait briefly until a command in progress is answered, then refuse it: the service must end.

        A model that was stored is used at the next start.
        """
        self._ended = True
        await asyncio.sleep(0)  # a command that has just arrived is refused
        order = self._order
        if order is None or order.task is None:
            return
        for grace_s in (GRACE_S, NOTICE_S):
            done, _ = await asyncio.wait({order.task}, timeout=grace_s)
            if done:
                return
            self._given_up.set()
        order.task.cancel()
        await asyncio.wait({order.task})

    async def _prepare(self, store: ModelStore, order: _Order) -> None:
        """Prepare the model on another thread, then answer; the swap follows at the next sample."""
        running, now_ns = self._running(), self._clock.utc_ns()
        order.ready = await _in_thread(lambda: self._prepared(store, order, running.model, running.status.zero, now_ns))
        successor, comparison = order.ready.successor, order.ready.comparison
        model = successor.compensation.model
        how = f"warmed up on {successor.samples} sample(s) of {successor.minutes / 60.0:.1f} h"
        if not successor.is_known:
            std_um = successor.compensation.status.std_um
            how += f", too little to determine its state: standard deviation {std_um:.1f} µm for now"
        order.reply.set_result(
            {
                "ok": True,
                "text": f"model {model.name} ({model.sha256[:12]}) is adopted with the next sample"
                f"{' against measured Y' if worse_axes(comparison) else ''}, {how}; {described(comparison)}",
                "model": model.name,
                "model_sha256": model.sha256,
                **successor.figures(),
                "comparison": comparison.table(),
            }
        )

    def _answer_refusal(self, task: asyncio.Task[None]) -> None:
        """Answer with the reason if a model could not be prepared; the running one remains."""
        order = self._order
        error = ServiceError(_ENDING) if task.cancelled() else task.exception()
        if order is None or error is None:
            return
        self._order = None
        text = str(error)
        if not isinstance(error, CompensatorError):
            log.error("internal error", exc_info=error)
            text = f"internal error: {type(error).__name__}: {error}"
        figures = {"comparison": order.comparison.table()} if order.comparison is not None else {}
        self._events.note(EventKind.ADOPT, f"refused: {text}", {"ok": False, "action": order.action} | figures)
        order.reply.set_result(refusal(text) | figures)

    # ------------------------------------------------------------------ on a separate thread

    def _prepared(
        self, store: ModelStore, order: _Order, running: ThermalModel, zero: Zero | None, now_ns: int
    ) -> _Prepared:
        """Return the file of a model, its compensation and its comparison; store it for the next start; takes time."""
        data = _model_file(store, order)
        model = check_model(self._config, data, source=f"model {sha256_of(data)[:12]}")
        if model.sha256 == running.sha256:
            raise ServiceError(f"model {model.name} ({model.sha256[:12]}) is already the service's model")
        if model.period_s != running.period_s:
            raise ServiceError(
                f"model {model.name}: sample_period_s = {model.period_s:g}, the service runs at {running.period_s:g} s"
            )
        successor = self._successor(model, zero, order.request.force)
        comparison = order.comparison = self._compared(running, model, zero)
        refuse_if_worse(comparison, model, force=order.request.force or order.action == CommandName.BACK)
        self._check_not_given_up()
        if order.action == CommandName.BACK:
            store.back(name=model.name, time_utc_ns=now_ns)
        else:
            store.adopt(data, name=model.name, time_utc_ns=now_ns)
        return _Prepared(data=data, successor=successor, comparison=comparison)

    def _compared(self, running: ThermalModel, model: ThermalModel, zero: Zero | None) -> ComparisonData:
        if zero is None:
            return not_judged(NotJudged.NO_ZERO)
        return second_opinion(self._recordings, self._config, running, model, between_samples=self._turns())

    def _turns(self) -> Callable[[], None]:
        """Return what lets the thread of the service run first, and ends the work when the service ends."""
        pause = give_way()

        def turn() -> None:
            pause()
            self._check_not_given_up()

        return turn

    def _check_not_given_up(self) -> None:
        if self._given_up.is_set():
            raise ServiceError(_ENDING)

    def _successor(self, model: ThermalModel, zero: Zero | None, force: bool) -> Successor:
        if zero is None:
            return Successor(compensation=Compensation(self._config, model))
        try:
            successor = warm_up(self._recordings, self._config, model, between_samples=self._turns())
        except DataError as error:
            if not force:
                raise ServiceError(f"model {model.name}: no warm-up: {error}; {_ADVICE}") from error
            compensation = Compensation(self._config, model)
            compensation.begin(zero)
            return Successor(compensation=compensation)
        if not successor.is_known and not force:
            raise ServiceError(
                f"model {model.name}: the recordings without a gap cover {successor.minutes / 60.0:.1f} h, but "
                f"{WARM_UP:g} times the slowest time constant of {slowest_min(model) / 60.0:.1f} h is needed; the "
                f"standard deviation of its offset would be {successor.compensation.status.std_um:.1f} µm; "
                f"{_ADVICE}"
            )
        return successor


async def _in_thread(work: Callable[[], T]) -> T:
    """Run work on a thread that does not keep the process from ending, as those of `asyncio.to_thread` do."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def finish(result: T | None, error: BaseException | None) -> None:
        if done.done():
            return
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result: T | None = None
        error: BaseException | None = None
        try:
            result = work()
        except Exception as raised:  # noqa: BLE001  the task that waits raises it
            error = raised
        with suppress(RuntimeError):  # the loop is closed: the work was given up
            loop.call_soon_threadsafe(finish, result, error)

    threading.Thread(target=run, name="prepares a model", daemon=True).start()
    return await done


def _model_file(store: ModelStore, order: _Order) -> bytes:
    if order.action == CommandName.BACK:
        return store.before()
    return order.request.model.encode() if order.request.model else store.load(order.request.sha256)


def _unwatched(new: Compensation, old: Compensation) -> str:
    """Return the remark that a check ends with a model that states no error."""
    if new.plausibility.watches_residual or not old.plausibility.watches_residual:
        return ""
    return "; measured and predicted Y are not compared any more: the model states no error (y_std_um)"
