"""The loop with its shadow, as the service, a replay and a run without devices use it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import msgspec
from msgspec.structs import replace as replace_fields

from compensator.config import Config
from compensator.errors import DataError
from compensator.events import ComparisonData, DiagnosisData, EventKind, Note
from compensator.messages import SCHEMA, Candidate
from compensator.model.effects.names import effect_names
from compensator.model.thermal_model import ThermalModel
from compensator.service.compensation import Compensation, Outcome
from compensator.service.loop.decisions import LoopDecisions
from compensator.service.loop.level import ErrorBlocks
from compensator.service.loop.state import LoopState, Role, decode_loop
from compensator.service.loop.weighing import Diagnosed, Weighed, weigh, without_candidate
from compensator.service.status import Handover
from compensator.service.transfer.second_opinion import described
from compensator.service.transfer.shadow import Shadow

#: Attachment of a recording: state of the loop.
LOOP_STATE = "loop.json"


def shadow_files(state: LoopState) -> dict[str, tuple[str, str]]:
    """Return the attachments of each model in shadow, by its hash: model file and state.

    Examples
    --------
    >>> from compensator.service.loop.state import InShadow
    >>> places = [InShadow(sha256=sha, effects=[], role="candidate", since_utc_ns=1) for sha in "ab"]
    >>> list(shadow_files(LoopState(found=places)).values())
    [('candidate.toml', 'candidate_state.json'), ('candidate_2.toml', 'candidate_2_state.json')]
    """
    names = ["before"] if state.watched is not None else []
    names += [f"candidate_{number}" if number > 1 else "candidate" for number in range(1, len(state.found) + 1)]
    return {
        place.sha256: (f"{name}.toml", f"{name}_state.json") for place, name in zip(state.taken, names, strict=True)
    }


class Followed(msgspec.Struct, frozen=True):
    """What the loop made of a sample: the records of the models in shadow, and events."""

    candidates: tuple[Candidate, ...]
    notes: tuple[Note, ...]


class ShadowedLoop:
    """The loop of one machine, with the compensations of the models in shadow.

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
        self.loop = LoopDecisions(config.loop, present.period_s, effect_names(present.effects), state)
        #: The models in shadow, by hash; one without a place has ended, and goes before the next sample.
        self.shadows: dict[str, Shadow] = {}
        for sha256, files in shadow_files(self.state).items():
            if not attachments.keys() >= set(files):
                raise DataError(f"loop.json names a model in shadow, but {' or '.join(files)} is missing")
            self.shadows[sha256] = Shadow.of(config, *(attachments[file] for file in files), source=files[0])

    @property
    def state(self) -> LoopState:
        """State of the loop."""
        return self.loop.state

    @property
    def incoming(self) -> Shadow | None:
        """The model that replaces the present one before the next sample; None without an exchange."""
        return self.shadows.get(self.state.incoming) if self.state.exchange else None

    def attachments(self) -> dict[str, bytes]:
        """Return what a recording must begin with."""
        found = {LOOP_STATE: msgspec.json.encode(self.state)}
        for sha256, files in shadow_files(self.state).items():
            shadow = self.shadows[sha256]
            found |= zip(files, (shadow.data, shadow.compensation.state()), strict=True)
        return found

    # ------------------------------------------------------------------ one sample

    def process(self, outcome: Outcome) -> Followed:
        """Process a sample after the present compensation."""
        places = self.state.taken
        if not places:
            return Followed((), tuple(self.loop.step(outcome, {})))
        present, others = outcome, dict[str, Outcome]()
        for place in places:
            present, others[place.sha256] = self.shadows[place.sha256].process(outcome)
        notes = self.loop.step(present, others)
        # What a status shows comes last.
        shown = self.state.shown
        messages = tuple(
            _message(
                present,
                others[place.sha256],
                place.role,
                place.verdict,
                self.loop.compared(place).judged_h,
                len(place.comparison.probes),
            )
            for place in sorted(places, key=lambda place: place is shown)
        )
        return Followed(messages, tuple(notes))

    def resume(self) -> None:
        """Acknowledge exchanged sensors, as the present compensation does at an operator's `resume`."""
        for shadow in self.shadows.values():
            shadow.compensation.resume()

    def pause(self, samples: int | None) -> None:
        """Account for samples that were not measured, as the present compensation does."""
        self.loop.pause(samples)
        for shadow in self.shadows.values():
            shadow.compensation.pause(samples)

    # ------------------------------------------------------------------ between two samples

    def weigh(self, found: Diagnosed, *, calibrated: bytes) -> Weighed:
        """Return what follows from a diagnosis; `receive` decides by it."""
        weighed = weigh(found, self._config, calibrated=calibrated, present=self.present)
        return self._of_its_time(weighed)

    def plain(self, found: Diagnosed) -> Weighed:
        """Return a diagnosis from which nothing follows."""
        return self._of_its_time(Weighed(without_candidate(found), None))

    def _of_its_time(self, weighed: Weighed) -> Weighed:
        running = self.state.diagnosis
        if running is None:
            return weighed
        data = replace_fields(weighed.data, from_utc_ns=running.from_utc_ns, to_utc_ns=running.to_utc_ns)
        return dataclasses.replace(weighed, data=data)

    def receive(self, found: DiagnosisData, now_ns: int) -> list[Note]:
        """Decide what follows from a diagnosis."""
        is_current = found.present_sha256 in ("", self.present.sha256)
        return self.loop.receive(found, now_ns, is_current=is_current)

    @property
    def is_free(self) -> bool:
        """Whether what is warmed up gets its place now."""
        return self.state.has_next and not self.state.exchange

    def begin_shadow(
        self, compensation: Compensation, data: bytes, now_ns: int, role: Role, error: ErrorBlocks
    ) -> None:
        """Begin to compare what a diagnosis has found, in its state after the last sample."""
        model = compensation.model
        self.shadows[model.sha256] = Shadow(compensation, data)
        self.loop.shadow_begins(model.sha256, effect_names(model.effects), now_ns, role, error=error)
        self.drop_ended()

    def offset_change_um(self, present: Compensation, sha256: str) -> float | None:
        """Return by how much the offset would move if a candidate was adopted now, µm; None if that is unknown."""
        candidate = self.state.place(sha256)
        if candidate is None:
            return None
        shadow = self.shadows[sha256]
        new = Compensation(self._config, shadow.compensation.model)
        new.restore(shadow.compensation.state())
        new.raise_level(self.loop.compared(candidate).level_at_adoption_um)
        new.continue_from(_handed_over(present))
        difference = new.status.target_um - present.status.target_um
        return difference if math.isfinite(difference) else None

    def exchange(self, present: Compensation, data: bytes, now_ns: int) -> tuple[Compensation, bytes, list[Note]]:
        """Let a model in shadow continue from the present one; that goes into shadow, or ends after a way back.

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
        Compensation, bytes, list of Note
            The compensation for the next sample, its model file, and the events: the exchange, and what ended with it.
        """
        state, incoming = self.state, self.state.place(self.state.incoming)
        assert incoming is not None
        action, verdict, level_um = state.exchange, incoming.verdict, state.level_um
        new = self.shadows.pop(state.incoming)
        handover = present.status.handover
        new.compensation.raise_level(level_um)
        new.compensation.continue_from(_handed_over(present))
        ended = self.loop.exchanged(now_ns, present.model.sha256)
        self.present = new.compensation.model
        # What holds the published offset concerns the new one only.
        present.continue_from(replace_fields(handover, operator_hold=False, internal_error=False, probing=None))
        if self.state.place(present.model.sha256) is not None:
            self.shadows[present.model.sha256] = Shadow(present, data)
        self.drop_ended()
        note = _exchange_note(action, present, new.compensation, verdict, level_um)
        return new.compensation, new.data, [note, *ended]

    def drop_ended(self) -> bool:
        """Let go of what is in shadow no longer; return whether there was something."""
        ended = self.shadows.keys() - {place.sha256 for place in self.state.taken}
        for sha256 in ended:
            del self.shadows[sha256]
        return bool(ended)


def _handed_over(present: Compensation) -> Handover:
    """Return what another model continues from."""
    return replace_fields(present.status.handover, model_changed=present.status.zero is not None)


def _exchange_note(action: str, old: Compensation, new: Compensation, verdict: ComparisonData, level_um: float) -> Note:
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
        "effects": effect_names(new.model.effects),
        "state_known": after.is_known,
        "difference_um": difference,
        "level_um": level_um,
        "y_std_um": after.std_um,
        "comparison": verdict.table(),
    }
    return Note(EventKind.ADOPT, text, data)


def _message(
    present: Outcome, other: Outcome, role: Role, verdict: ComparisonData, judged_h: float, probes: int
) -> Candidate:
    """Return the message of a sample."""
    return Candidate(
        schema=SCHEMA,
        machine=present.sample.machine,
        seq=present.sample.seq,
        time_utc_ns=present.sample.time_utc_ns,
        model_sha256=other.offset.model_sha256,
        role=role,
        y_pred_um=other.estimate.y_pred_um,
        y_std_um=other.estimate.y_std_um,
        residual_um=other.estimate.residual_um,
        present_residual_um=present.estimate.residual_um,
        innovations_um=[probe.innovation_um for probe in other.probes],
        reasons=other.offset.reasons,
        verdict=verdict.verdict,
        present_rms_um=verdict.present_rms_um,
        candidate_rms_um=verdict.candidate_rms_um,
        deviations=verdict.deviations,
        hours=judged_h,
        probes=probes,
    )
