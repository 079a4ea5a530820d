"""A machine's service and loop over recorded or simulated samples, without devices or files.

The same compensation, shadow and loop as in the service. A diagnosis is a function that is called when the loop wants
one; its result counts from the next sample on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence

import msgspec

from compensator.clock import HOUR_NS
from compensator.config import Config
from compensator.errors import CompensatorError, DataError
from compensator.events import EventKind, Note
from compensator.messages import UNREADABLE, Candidate, Sample
from compensator.model.effects.names import effect_names
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome, model_of
from compensator.service.loop.core import ShadowedLoop
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.place import role_of
from compensator.service.loop.weighing import Diagnosed, failed, without_effect
from compensator.service.outcome import sets_zero, sets_zero_at_rest
from compensator.service.probing import ReceivedProbe
from compensator.service.status import Zero
from compensator.service.transfer.shadow import Shadow
from compensator.service.transfer.warm_up import WARM_UP

__all__ = ["Diagnosed", "LoopStep", "OfflineLoop"]


class LoopStep(msgspec.Struct, frozen=True):
    """What a sample gave.

    Parameters
    ----------
    outcome : Outcome
        Of the present model.
    candidates : tuple of Candidate
        Records of the models in shadow.
    events : tuple of Note
        Events with this sample: those of the outcome, diagnoses, decisions and exchanges.
    model_sha256 : str
        Hash of the present model's file.
    """

    outcome: Outcome
    candidates: tuple[Candidate, ...]
    events: tuple[Note, ...]
    model_sha256: str


class _Saved(msgspec.Struct, kw_only=True):
    """State of a run."""

    model: bytes
    calibrated: bytes
    compensation: bytes
    attachments: dict[str, bytes]
    record: list[Outcome]
    pauses: dict[int, int | None] = {}
    at_rest: Outcome | None = None
    warm_utc_ns: int = 0


class OfflineLoop:
    """Runs the service and the loop of one machine.

    Parameters
    ----------
    config : Config
        Settings, with `[loop]`.
    model : bytes
        File of the calibrated model.
    diagnose : callable
        Returns what a diagnosis of the outcomes on record with a model file gives. All outcomes of the time that is
        diagnosed are handed over; `record.usable_table` leaves out what must not be used. An exception is a diagnosis
        that failed.

    Raises
    ------
    CompensatorError
        If the model cannot be used, or there is no `[loop]`.
    """

    def __init__(self, config: Config, model: bytes, diagnose: Callable[[Sequence[Outcome], bytes], Diagnosed]) -> None:
        self._config = config
        self._diagnose = diagnose
        self._calibrated = self._data = model
        self._compensation = Compensation(config, model_of(config, model, source="model"))
        self._core = ShadowedLoop(config, self._compensation.model, {})
        self._record: deque[Outcome] = deque()
        #: Pauses within the record, in samples, by the number of the sample before; see `pause`.
        self._pauses: dict[int, int | None] = {}
        #: The last zero at rest, and the time of a later one on a warm machine; 0 without one.
        self._at_rest: Outcome | None = None
        self._warm_ns = 0
        self._found: Diagnosed | None = None
        #: Events since the last sample.
        self._notes: list[Note] = []

    @property
    def compensation(self) -> Compensation:
        """The present compensation."""
        return self._compensation

    @property
    def phase(self) -> str:
        """What the shadow is for: `idle`, `shadow`, `proposed`, `watching`."""
        return self._core.state.phase

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects of the present model."""
        return tuple(effect_names(self._compensation.model.effects))

    def process(self, sample: Sample, probes: Sequence[ReceivedProbe] = ()) -> LoopStep:
        """Process a sample with the probes that arrived since the last one."""
        notes = self._between(self._compensation.status.time_utc_ns)
        self._compensation.receive_probes(probes)
        outcome = self._compensation.process(sample)
        followed = self._core.process(outcome)
        self._keep(outcome)
        wanted = self._core.loop.wanted
        if wanted is not None:
            record = [one for one in self._record if one.sample.time_utc_ns > wanted.from_utc_ns]
            self._found = self._diagnosed(record, wanted.without)
        events = (*notes, *outcome.notes, *followed.notes)
        return LoopStep(outcome, followed.candidates, events, outcome.offset.model_sha256)

    def pause(self, samples: int | None) -> None:
        """Account for samples that were not measured, as after a restart; see `Compensation.pause`."""
        # What follows from the last sample comes first: a model that is new stands before the pause, too.
        self._notes = self._between(self._compensation.status.time_utc_ns)
        if self._record and samples != 0:
            last = self._record[-1].sample.seq
            before = self._pauses.get(last, 0)
            self._pauses[last] = None if samples is None or before is None else before + samples
        self._compensation.pause(samples)
        self._core.pause(samples)

    def hold(self) -> None:
        """Freeze the offset, as an operator can."""
        self._compensation.hold()

    def resume(self) -> None:
        """Follow the model again, as an operator can."""
        self._compensation.resume()
        self._core.resume()

    def accept(self) -> None:
        """Adopt the candidate in shadow before the next sample, as an operator can; the event comes with that sample.

        Raises
        ------
        ServiceError
            If there is none.
        """
        self._notes += self._core.loop.accept()

    def dismiss(self) -> None:
        """End the candidate, as an operator can; the event comes with the next sample.

        Raises
        ------
        ServiceError
            If there is none.
        """
        self._notes += self._core.loop.dismiss(self._compensation.status.time_utc_ns)

    # ------------------------------------------------------------------ state

    def state(self) -> bytes:
        """Return what a kill now would leave: a result of a diagnosis that has not counted yet is lost."""
        saved = _Saved(
            model=self._data,
            calibrated=self._calibrated,
            compensation=self._compensation.state(),
            attachments=self._core.attachments(),
            record=list(self._record),
            pauses=self._pauses,
            at_rest=self._at_rest,
            warm_utc_ns=self._warm_ns,
        )
        return msgspec.json.encode(saved)  # as in a recording, a value that is missing is null

    def restore(self, state: bytes) -> None:
        """Start again from a state; `pause` then accounts for the time since.

        Raises
        ------
        CompensatorError
            If it cannot be used; nothing is changed then.
        """
        try:
            saved = msgspec.json.decode(state, type=_Saved)
        except UNREADABLE as error:
            raise DataError(f"state of a run: {error}") from error
        compensation = Compensation(self._config, model_of(self._config, saved.model, source="state of a run"))
        compensation.restore(saved.compensation)
        core = ShadowedLoop(self._config, compensation.model, saved.attachments)
        self._notes = core.loop.restarted()
        self._compensation, self._core = compensation, core
        self._data, self._calibrated = saved.model, saved.calibrated
        self._record, self._pauses, self._found = deque(saved.record), saved.pauses, None
        self._at_rest, self._warm_ns = saved.at_rest, saved.warm_utc_ns

    # ------------------------------------------------------------------ the loop

    def _between(self, now_ns: int) -> list[Note]:
        """Do what follows from the last sample before the next one."""
        core, notes, self._notes = self._core, self._notes, []
        core.drop_ended()
        if core.state.exchange:
            notes += self._exchange(now_ns)
        found, self._found = self._found, None
        if found is not None:
            weighed = core.weigh(found, calibrated=self._calibrated)
            notes.append(Note(EventKind.DIAGNOSIS, found.text, weighed.data.table()))
            notes += core.receive(weighed.data, now_ns)
            running = core.state.diagnosis
            if running is not None and weighed.candidate is not None:
                model = model_of(self._config, weighed.candidate, source="candidate")
                error = ErrorBlocks()
                warmed = warmed_on(self._config, model, list(self._record), self._at_rest, error, self._pauses)
                notes += core.loop.begin()
                if core.is_free:
                    core.begin_shadow(warmed, weighed.candidate, now_ns, role_of(weighed.data), error)
        return notes

    def _exchange(self, now_ns: int) -> list[Note]:
        self._compensation, self._data, notes = self._core.exchange(self._compensation, self._data, now_ns)
        return notes

    def _diagnosed(self, record: Sequence[Outcome], without: str) -> Diagnosed:
        try:
            if without:
                return without_effect(self._data, without, calibrated=self._calibrated)
            return self._diagnose(record, self._calibrated)
        except CompensatorError as error:
            return failed(str(error), without=without)

    def _keep(self, outcome: Outcome) -> None:
        """Keep what a diagnosis or a warm-up needs."""
        assert self._config.loop is not None
        self._record.append(outcome)
        if sets_zero_at_rest(outcome):
            self._at_rest, self._warm_ns = outcome, 0
        elif sets_zero(outcome):
            self._warm_ns = outcome.sample.time_utc_ns
        warm_up_h = WARM_UP * self._compensation.slowest_min / 60.0
        oldest_ns = outcome.sample.time_utc_ns - round(max(self._config.loop.record_h, warm_up_h) * HOUR_NS)
        if self._warm_ns:
            # The deformation counts from what the model predicts at that zero, so its state must be known there.
            oldest_ns = min(oldest_ns, self._warm_ns - round(warm_up_h * HOUR_NS))
        while self._record[0].sample.time_utc_ns <= oldest_ns:
            self._pauses.pop(self._record.popleft().sample.seq, None)


def warmed_on(
    config: Config,
    model: ThermalModel,
    record: Sequence[Outcome],
    at_rest: Outcome | None = None,
    error: ErrorBlocks | None = None,
    pauses: Mapping[int, int | None] | None = None,
) -> Compensation:
    """Return a compensation of another model in its state after recorded samples, with their zeros and probes.

    It starts with the last zero at rest, from which effects count their channels, also where the record begins later.

    Parameters
    ----------
    record : sequence of Outcome
        Outcomes in order; numbers that are missing between two of them are a pause.
    at_rest : Outcome, optional
        That of the last zero at rest before the record.
    error : ErrorBlocks, optional
        Gets its errors.
    pauses : mapping of int to int or None, optional
        Pauses that are known, in samples, by the number of the sample before. The numbers alone do not show those of a
        restart, nor do the times where the clock was set.
    """
    compensation = Compensation(config, model)
    compensation.begin(None)
    shadow = Shadow(compensation, b"")
    begin = max((i for i, outcome in enumerate(record) if sets_zero_at_rest(outcome)), default=-1)
    last = record[begin] if begin >= 0 else at_rest
    if last is not None:
        shadow.process(last)
    else:
        zero = next((found for outcome in record if (found := Zero.set_in(outcome.estimate)) is not None), None)
        if zero is not None:
            compensation.begin(zero)
    for outcome in record[begin + 1 :]:
        if last is not None:
            missing = outcome.sample.seq - last.sample.seq - 1
            compensation.pause((pauses or {}).get(last.sample.seq, missing))
        _, other = shadow.process(outcome)
        if error is not None:
            error.update(other)
        last = outcome
    return compensation
