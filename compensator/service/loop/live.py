"""The loop in the running service: diagnoses, warm-ups and stored models as tasks beside the samples.

Everything that reaches the loop from outside does so between two samples and is recorded as an event, so that a replay
can hand it over again. A defect of the loop ends the shadow, never a sample.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from compensator.clock import Clock
from compensator.config import Config
from compensator.errors import ServiceError
from compensator.events import ComparisonData, EventKind, LoopAction, LoopData, Note
from compensator.messages import Candidate, LoopStatus
from compensator.model.effects.names import effect_names
from compensator.service.compensation import Compensation, Outcome, model_of
from compensator.service.event_log import EventLog
from compensator.service.journal import Journal
from compensator.service.loop.core import Followed, ShadowedLoop
from compensator.service.loop.ending import FAILED_OUTSIDE
from compensator.service.loop.found import Found, diagnosed
from compensator.service.loop.place import role_of
from compensator.service.loop.process import Diagnose
from compensator.service.loop.status import loop_status
from compensator.service.loop.storing import Storing, calibrated_effects
from compensator.service.loop.words import named
from compensator.service.transfer.model_store import ModelStore
from compensator.service.transfer.second_opinion import described
from compensator.service.transfer.two_models import changed

log = logging.getLogger("compensator")

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Offer:
    """A candidate for an operator to adopt: its hash, its name with its effects, and its comparison."""

    sha256: str
    named: str
    comparison: ComparisonData


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopParts:
    """What the loop of a service is made of.

    Parameters
    ----------
    core : ShadowedLoop
        In its state after the last sample.
    model : bytes
        File of the present model.
    store : ModelStore
        Adopted models.
    diagnose : callable
        Makes a diagnosis.
    """

    core: ShadowedLoop
    model: bytes
    store: ModelStore
    diagnose: Diagnose


class ServiceLoop:
    """The loop of the running service; used in the service's event loop only.

    Parameters
    ----------
    config : Config
        Settings, with `[loop]`.
    parts : LoopParts
        What it is made of.
    recordings : pathlib.Path
        Folder of the recordings, on which a candidate is warmed up.
    events, journal, clock
        Of the service.
    is_adopting : callable, optional
        Returns whether a person's change of the model is being prepared: it ends what the loop has decided, whose model
        must not be stored meanwhile.
    """

    def __init__(
        self,
        config: Config,
        parts: LoopParts,
        recordings: Path,
        *,
        events: EventLog,
        journal: Journal,
        clock: Clock,
        is_adopting: Callable[[], bool] = lambda: False,
    ) -> None:
        self._config, self._model = config, parts.model
        self._is_adopting = is_adopting
        self._recordings, self._store = recordings, parts.store
        self._diagnose = parts.diagnose
        self._events, self._journal, self._clock = events, journal, clock
        #: None after an internal error of the loop: it stays off until the next start.
        self._core: ShadowedLoop | None = parts.core
        self._candidates: tuple[Candidate, ...] = ()
        #: The diagnosis or warm-up in progress, and what it gave.
        self._task: asyncio.Task[None] | None = None
        self._found: Found | None = None
        self._warming: Found | None = None
        self._storing = Storing(parts.store, clock)
        #: Why the last way back that was decided was not stored; empty if it was, or another one may be decided.
        self._back_waits_for = ""

    @property
    def is_exchanging(self) -> bool:
        """Whether a decided exchange has not happened yet: another change of the model has to wait."""
        return self._core is not None and bool(self._core.state.exchange)

    @property
    def waits_for(self) -> str:
        """Why a decided way back has not happened yet; empty if there is none, or nothing keeps it."""
        return self._back_waits_for if self._core is not None and self._core.state.exchange == "back" else ""

    @property
    def is_working(self) -> bool:
        """Whether a diagnosis, a warm-up or the storing of a model is in progress."""
        return self._task is not None or self._storing.is_working

    def opening(self) -> Mapping[str, bytes]:
        """Return what a recording that starts with the next sample begins with."""
        return self._guarded(ShadowedLoop.attachments, {}, again=ShadowedLoop.attachments)

    # ------------------------------------------------------------------ between two samples

    def before_sample(self, present: Compensation) -> Compensation:
        """Return the compensation for the next sample, after an exchange if one is due."""
        in_force = [present]

        def again(core: ShadowedLoop) -> None:
            core.drop_ended()
            self._journal.start_new_file()

        # What has been exchanged stays exchanged, whatever fails after it.
        self._guarded(lambda core: self._change(core, in_force), None, again=again)
        return in_force[-1]

    def _change(self, core: ShadowedLoop, in_force: list[Compensation]) -> None:
        """Let what has ended go, what is warmed up begin, and an exchange happen, which adds what is in force then."""
        present = in_force[-1]
        if core.drop_ended():
            self._journal.start_new_file()
        warmed = self._warming
        if warmed is not None and core.is_free:
            self._begin_shadow(core, warmed)
        if not (core.state.exchange and self._storing.is_done):
            return
        new, self._model, notes = core.exchange(present, self._model, present.status.time_utc_ns)
        in_force.append(new)
        self._storing.is_done, self._back_waits_for = False, ""
        self._warming = None  # its diagnosis has ended with the exchange
        self._journal.start_new_file(self._model)
        self._note(notes)

    def _begin_shadow(self, core: ShadowedLoop, warmed: Found) -> None:
        ready = warmed.catch_up()
        if ready is None:
            return
        self._warming = None
        assert warmed.weighed.candidate is not None
        compensation, error = ready
        role, now_ns = role_of(warmed.weighed.data), compensation.status.time_utc_ns
        core.begin_shadow(compensation, warmed.weighed.candidate, now_ns, role, error)
        self._journal.start_new_file()

    def hand_over(self, present: Compensation) -> None:
        """Hand over what has reached the loop since the last sample; the events are recorded with the next one."""
        self._guarded(lambda core: self._hand_over(core, present.status.time_utc_ns), None)

    def _hand_over(self, core: ShadowedLoop, now_ns: int) -> None:
        if core.state.exchange != "back":
            self._back_waits_for = ""
        found, self._found = self._found, None
        # Where a defect ended a diagnosis, another one may have begun meanwhile.
        if found is not None and found.wanted == core.loop.wanted:
            self._events.note(EventKind.DIAGNOSIS, found.text, found.weighed.data.table())
            self._note(core.receive(found.weighed.data, now_ns))
            if core.state.diagnosis is not None and found.weighed.candidate is not None:
                self._warming = found
                self._task = asyncio.create_task(self._warm_up(found, found.weighed.candidate))
        if self._warming is not None:
            self._weigh(core, self._warming)
        if self._storing.refused:
            self._end_not_stored(core)

    def _weigh(self, core: ShadowedLoop, warming: Found) -> None:
        """Let the loop decide about what is warmed up, if it still waits for that."""
        running = core.state.diagnosis
        if running is None or running.candidate_sha256 != warming.weighed.data.candidate_sha256:
            self._warming = None
            return
        ready = warming.catch_up()
        if warming.why:
            self._end_one(core, "", warming.why)
        elif ready is not None:
            self._note(core.loop.begin())
            if core.state.diagnosis is None:
                self._warming = None  # it does not get the place

    def resume(self) -> None:
        """Pass on an operator's `resume`."""
        self._guarded(ShadowedLoop.resume, None)

    def dismiss(self, present: Compensation, sha256: str) -> None:
        """End a candidate: an operator's command that acts with the next sample.

        Raises
        ------
        ServiceError
            If it is not there any longer.
        """
        self._guarded(lambda core: self._note(core.loop.dismiss(present.status.time_utc_ns, sha256)), None)

    def accept(self, sha256: str) -> None:
        """Adopt a candidate: an operator's command that acts with the next sample.

        Raises
        ------
        ServiceError
            If it is not there any longer.
        """
        self._guarded(lambda core: self._note(core.loop.accept(sha256)), None)

    def offer(self, present: Compensation, sha256: str, *, unproposed: str) -> Offer:
        """Return what an operator decides on, and by how much the offset would move.

        Parameters
        ----------
        present : Compensation
            The present one.
        sha256 : str
            The beginning of the hash of the candidate that is meant; empty: the one that is proposed.
        unproposed : str
            What to do about a candidate that is not proposed; empty where it can be decided on, too.

        Raises
        ------
        ServiceError
            If there is no such candidate, or it is not proposed and `unproposed` is given.
        """

        def offered(core: ShadowedLoop) -> Offer | None:
            if core.state.exchange:
                return None
            candidate = core.loop.meant(sha256)
            words = f"{candidate.sha256[:12]} ({named(candidate.effects)})"
            verdict = changed(candidate.verdict, offset_change_um=core.offset_change_um(present, candidate.sha256))
            if not candidate.is_proposed and unproposed:
                raise ServiceError(f"candidate {words} is not proposed yet: {described(verdict)}; {unproposed}")
            return Offer(candidate.sha256, words, verdict)

        offer = self._guarded(offered, None)
        if offer is None:
            raise ServiceError("there is no candidate now; see `compensator watch`")
        return offer

    def model_changed(self, present: Compensation, model: bytes, *, back: bool) -> None:
        """Begin anew after an operator has changed the model."""
        self._model = model

        def begin_anew(core: ShadowedLoop) -> None:
            self._cancel()
            core.present = present.model
            effects, now_ns = effect_names(present.model.effects), present.status.time_utc_ns
            calibrated = calibrated_effects(self._config, self._store, effects)
            self._note(core.loop.model_changed(effects, now_ns, calibrated=calibrated, back=back))
            core.drop_ended()

        self._guarded(begin_anew, None)

    def pause(self, samples: int | None) -> None:
        """Account for samples that were not measured."""
        self._guarded(lambda core: core.pause(samples), None)

    # ------------------------------------------------------------------ one sample

    def process(self, outcome: Outcome) -> tuple[Candidate, ...]:
        """Process a sample after the present compensation; return the records of the models in shadow."""

        def alone(core: ShadowedLoop) -> Followed:
            return Followed((), tuple(core.loop.step(outcome, {})))

        # The shadow is no part of what is published: its defect must neither hold the offset nor stop the service.
        followed = self._guarded(lambda core: core.process(outcome), Followed((), ()), again=alone)
        self._note(followed.notes)
        self._candidates = followed.candidates
        if self._warming is not None:
            self._warming.since.append(outcome)
        return followed.candidates

    def _guarded(
        self, act: Callable[[ShadowedLoop], T], otherwise: T, *, again: Callable[[ShadowedLoop], T] | None = None
    ) -> T:
        """Do something with the loop; a defect ends the shadow, or the loop if that fails too, and never a sample.

        Parameters
        ----------
        act : callable
            What is done.
        otherwise : T
            Returned without a loop, and after a defect.
        again : callable, optional
            What is done after a defect, without a shadow, instead of returning `otherwise`.

        Raises
        ------
        ServiceError
            As `act` does, which is an answer to a person.
        """
        core = self._core
        if core is None:
            return otherwise
        try:
            return act(core)
        except ServiceError:
            raise
        except Exception as error:
            log.exception("internal error of the loop")
            why = f"internal error: {type(error).__name__}: {error}"
        try:
            self._give_up(core, why)
            return again(core) if again is not None else otherwise
        except Exception:
            log.exception("internal error of the loop; it is off until the next start")
        stored = self._storing.is_done
        self._cancel()
        self._core, self._storing.is_done = None, stored
        self._journal.start_new_file()
        self._events.note(*_failed(f"{why}; the loop is off until the next start"))
        return otherwise

    def after_sample(self) -> None:
        """Begin what was decided with a sample that is published."""
        storing = self._storing
        if storing.is_done and not (storing.is_working or self.is_exchanging or self._is_adopting()):
            # An exchange that a defect has ended: the next start must find the model that goes on.
            storing.begin_again(self._model, model_of(self._config, self._model, source="present model").name)
        self._guarded(self._begin_decided, None)

    def _begin_decided(self, core: ShadowedLoop) -> None:
        """Begin a diagnosis that is wanted, and to store the model of a decided exchange."""
        if core.loop.wanted is not None and self._task is None and self._found is None:
            self._task = asyncio.create_task(self._make_diagnosis(core))
        storing = self._storing
        if core.state.exchange and not (storing.is_working or storing.is_done or self._is_adopting()):
            storing.begin(core)

    def status(self) -> LoopStatus | None:
        """Return how the loop is, for `thermal/status`; None if it is off."""
        return self._guarded(lambda core: loop_status(core, self._candidates), None)

    async def end(self) -> None:
        """End what is in progress: a diagnosis is begun again at the next start, a stored model is used then."""
        task = self._task
        await self._storing.end()
        self._cancel()
        if task is not None:
            await asyncio.gather(task, return_exceptions=True)

    # ------------------------------------------------------------------ tasks

    async def _make_diagnosis(self, core: ShadowedLoop) -> None:
        self._found = await diagnosed(core, self._model, self._diagnose, self._store, self._clock)
        self._task = None

    async def _warm_up(self, found: Found, data: bytes) -> None:
        await found.warm_up(self._recordings, self._config, data)
        self._task = None

    def _cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()
        self._task = self._found = self._warming = None
        self._storing.cancel()
        self._back_waits_for = ""

    def _give_up(self, core: ShadowedLoop, why: str) -> None:
        """End everything in shadow."""
        self._warming = None
        ended = core.loop.give_up(FAILED_OUTSIDE, why)
        self._note(ended or [_failed(why)])

    def _end_one(self, core: ShadowedLoop, sha256: str, why: str) -> None:
        """End a candidate: that in shadow, or one whose warm-up has failed."""
        self._warming = None
        ended = core.loop.give_up_one(sha256, why)
        self._note(ended or [_failed(why)])

    def _end_not_stored(self, core: ShadowedLoop) -> None:
        why, self._storing.refused = self._storing.refused, ""
        incoming = core.incoming
        if incoming is None or core.state.exchange == "back":
            # The way back stays open: the model is stored again with the next sample.
            if incoming is not None and why != self._back_waits_for:
                text = f"the way back waits: {why}; it is tried again with each sample"
                self._events.note(EventKind.ADOPT, text, {"ok": False, "action": "back", "by": "loop"})
                self._back_waits_for = why
            return
        self._end_one(
            core, incoming.compensation.model.sha256, f"{why}; the present one stays, and it is compared no more"
        )

    def _note(self, notes: list[Note] | tuple[Note, ...]) -> None:
        for note in notes:
            self._events.note(*note)


def _failed(why: str) -> Note:
    """Return the event of a cause outside of the loop that has ended no model in shadow."""
    return Note(EventKind.LOOP, why, LoopData(step=LoopAction.END, why=FAILED_OUTSIDE).table())
