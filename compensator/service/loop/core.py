"""The loop with its shadow, as the service, a replay and a run without devices use it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
from msgspec.structs import replace as replace_fields

from compensator.clock import NS
from compensator.config import Config
from compensator.errors import DataError
from compensator.events import ComparisonData, DiagnosisData, EventKind, Note
from compensator.messages import Candidate
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.loop import Loop
from compensator.service.loop.shadow import Role, Shadow, candidate_message
from compensator.service.loop.state import LoopState, decode_loop
from compensator.service.loop.weighing import Diagnosed, Weighed, effect_names, weigh, without_candidate
from compensator.service.status import Zero
from compensator.service.transfer.second_opinion import described

#: Attachments of a recording: state of the loop, and model file and state of the shadow.
LOOP_STATE, SHADOW_MODEL, SHADOW_STATE = "loop.json", "candidate.toml", "candidate_state.json"


@dataclass(frozen=True, slots=True)
class Followed:
    """What the loop made of a sample: the record of the shadow, if there is one, and events."""

    candidate: Candidate | None
    notes: tuple[Note, ...]


class ModelLoop:
    """The loop of one machine, with the shadow's compensation.

    Parameters
    ----------
    config : Config
        Settings, with `[loop]`.
    present : ThermalModel
        The present model.
    attachments : mapping of str to bytes
        Those of a recording to continue from; empty at the first start.

    Raises
    ------
    DataError
        If the attachments cannot be used.
    """

    def __init__(self, config: Config, present: ThermalModel, attachments: Mapping[str, bytes]) -> None:
        if config.loop is None:
            raise DataError("the configuration has no table [loop]")
        self._config = config
        #: The present model.
        self.present = present
        data = attachments.get(LOOP_STATE)
        state = decode_loop(data) if data is not None else None
        self.loop = Loop(config.loop, present.period_s, effect_names(present), state)
        self.shadow: Shadow | None = None
        if self.state.shadow is not None:
            if not {SHADOW_MODEL, SHADOW_STATE} <= attachments.keys():
                raise DataError(f"loop.json names a shadow, but {SHADOW_MODEL} or {SHADOW_STATE} is missing")
            self.shadow = Shadow.of(config, attachments[SHADOW_MODEL], attachments[SHADOW_STATE])

    @property
    def state(self) -> LoopState:
        """State of the loop."""
        return self.loop.state

    def attachments(self) -> dict[str, bytes]:
        """Return what a recording must begin with."""
        found = {LOOP_STATE: msgspec.json.encode(self.state)}
        if self.shadow is not None and self.state.shadow is not None:
            found |= {SHADOW_MODEL: self.shadow.data, SHADOW_STATE: self.shadow.compensation.state()}
        return found

    # ------------------------------------------------------------------ one sample

    def process(self, outcome: Outcome) -> Followed:
        """Process a sample after the present compensation."""
        compared = self.state.shadow
        if self.shadow is None or compared is None:
            return Followed(None, tuple(self.loop.step(outcome, None)))
        present, other = self.shadow.process(outcome)
        notes = self.loop.step(present, other)
        verdict, probes = self.state.verdict, len(self.state.comparison.probes)
        message = candidate_message(present, other, compared.role, verdict, self.loop.judged_h, probes)
        return Followed(message, tuple(notes))

    def resume(self) -> None:
        """Acknowledge exchanged sensors, as the present compensation does at an operator's `resume`."""
        if self.shadow is not None:
            self.shadow.compensation.resume()

    def pause(self, samples: int | None) -> None:
        """Account for samples that were not measured, as the present compensation does."""
        if self.shadow is not None:
            self.shadow.compensation.pause(samples)

    # ------------------------------------------------------------------ between two samples

    def weigh(self, found: Diagnosed, *, calibrated: bytes) -> Weighed:
        """Return what follows from a diagnosis; `receive` decides by it."""
        shadow = self.shadow.compensation.model if self.shadow is not None and self.state.shadow is not None else None
        weighed = weigh(found, self._config, calibrated=calibrated, present=self.present, shadow=shadow)
        return self._of_its_time(weighed)

    def plain(self, found: Diagnosed) -> Weighed:
        """Return a diagnosis from which nothing follows."""
        return self._of_its_time(Weighed(without_candidate(found), None))

    def _of_its_time(self, weighed: Weighed) -> Weighed:
        running = self.state.diagnosis
        if running is None:
            return weighed
        data = replace_fields(weighed.data, from_utc_ns=running.from_utc_ns, to_utc_ns=running.to_utc_ns)
        return replace(weighed, data=data)

    def receive(self, found: DiagnosisData, now_ns: int) -> list[Note]:
        """Decide what follows from a diagnosis."""
        return self.loop.receive(found, now_ns)

    def begin_shadow(
        self, compensation: Compensation, data: bytes, now_ns: int, role: Role, error: ErrorBlocks
    ) -> None:
        """Begin to compare another model that is in its state after the last sample, with its error on the record."""
        if self.shadow is None or self.shadow.compensation.model.sha256 != compensation.model.sha256:
            self.shadow = Shadow(compensation, data)
        model = compensation.model
        self.loop.shadow_begins(model.sha256, effect_names(model), now_ns, role, error=error)

    def exchange(self, present: Compensation, data: bytes, now_ns: int) -> tuple[Compensation, bytes]:
        """Let the shadow continue from the present compensation; that one becomes the shadow, or ends after a way back.

        Parameters
        ----------
        present : Compensation
            The present compensation.
        data : bytes
            Its model file.
        now_ns : int
            Time of the last sample, ns since 1970 UTC.

        Returns
        -------
        Compensation, bytes
            The compensation for the next sample, and its model file.
        """
        assert self.shadow is not None
        new = self.shadow
        handover = present.status.handover
        new.compensation.raise_level(self.state.level_um)
        new.compensation.continue_from(replace(handover, model_changed=present.status.zero is not None))
        self.loop.exchanged(now_ns, present.model.sha256)
        self.present = new.compensation.model
        # What holds the published offset concerns the new one only.
        present.continue_from(replace(handover, operator_hold=False, internal_error=False, probing=None))
        self.shadow = Shadow(present, data) if self.state.shadow is not None else None
        return new.compensation, new.data

    def drop_ended(self) -> bool:
        """Let go of a shadow that has ended; return whether there was one."""
        if self.shadow is None or self.state.shadow is not None:
            return False
        self.shadow = None
        return True


def exchange_note(action: str, old: Compensation, new: Compensation, verdict: ComparisonData, level_um: float) -> Note:
    """Return the event of an exchange that the loop has made, after it."""
    before, after = old.status, new.status
    difference = after.target_um - before.target_um
    named = [f"{one.model.name} ({one.model.sha256[:12]})" for one in (new, old)]
    text = f"model {named[0]} replaces {named[1]}, the offset moves by {difference:+.2f} µm; {described(verdict)}"
    data = {
        "ok": True,
        "action": action,
        "by": "loop",
        "old_sha256": old.model.sha256,
        "new_sha256": new.model.sha256,
        "effects": effect_names(new.model),
        "state_known": after.is_known,
        "difference_um": difference,
        "level_um": level_um,
        "y_std_um": after.std_um,
        "comparison": verdict.table(),
    }
    return Note(EventKind.ADOPT, text, data)


def warmed_on(
    config: Config,
    model: ThermalModel,
    record: Sequence[Outcome],
    at_rest: Outcome | None = None,
    error: ErrorBlocks | None = None,
) -> Compensation:
    """Return a compensation of another model in its state after recorded samples, with their zeros and probes.

    It starts with the last zero at rest, from which effects count their channels, also where the record begins later.

    Parameters
    ----------
    record : sequence of Outcome
        Outcomes in order; what is missing between two of them is a pause.
    at_rest : Outcome, optional
        That of the last zero at rest before the record.
    error : ErrorBlocks, optional
        Gets its error on the record.
    """
    compensation = Compensation(config, model)
    compensation.begin(None)
    shadow = Shadow(compensation, b"")
    begin = max((i for i, outcome in enumerate(record) if is_rest(outcome)), default=-1)
    last = record[begin] if begin >= 0 else at_rest
    if last is not None:
        shadow.process(last)
    else:
        zero = next((found for outcome in record if (found := Zero.set_in(outcome.estimate)) is not None), None)
        if zero is not None:
            compensation.begin(zero)
    for outcome in record[begin + 1 :]:
        if last is not None:
            apart = (outcome.sample.time_utc_ns - last.sample.time_utc_ns) / (outcome.sample.period_s * NS)
            compensation.pause(round(apart) - 1)
        _, other = shadow.process(outcome)
        if error is not None:
            error.update(other)
        last = outcome
    return compensation


def is_rest(outcome: Outcome) -> bool:
    """Return whether a zero at rest was set with a sample."""
    return any(note.kind == EventKind.ZERO and note.data["mode"] == "rest" for note in outcome.notes)
