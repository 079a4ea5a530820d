"""The start of the service: finds the last recording and restores the state at its end.

A clean stop, a kill and a power cut are treated alike: everything that is complete on disk is used. The samples of the
last file are replayed from the state at its start, which gives the state after the last of them, bit for bit. If the
configuration or the model has changed since, a new compensation is warmed up on the recordings instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from compensator.codes import Reason
from compensator.config import LoadedConfig, parse_config
from compensator.errors import CompensatorError, DataError
from compensator.events import CommandName, EventKind, Note, command_of
from compensator.messages import number
from compensator.model.thermal_model import ThermalModel
from compensator.recording.reading import recordings
from compensator.service.compensation import Compensation, Outcome, model_of
from compensator.service.offset_checkpoint import CheckpointedOffset
from compensator.service.probing import ProbingHandover
from compensator.service.replay import RecordedStep, apply, opening_of, steps_of
from compensator.service.state import CompensationState, decode_state
from compensator.service.status import Handover
from compensator.service.transfer.warm_up import warm_up


@dataclass(slots=True)
class Resumed:
    """A compensation that continues from the end of the last recording, with events that describe how."""

    compensation: Compensation
    notes: list[Note] = field(default_factory=list)

    def note(self, text: str, **data: Any) -> None:
        """Add an event."""
        self.notes.append(Note(EventKind.RESTART, text, data))


@dataclass(slots=True)
class _LastFile:
    """The last file with a sample or a state, and the values at its end."""

    path: Path
    opening: dict[str, bytes]
    state: CompensationState | None = None
    samples: int = 0
    handover: Handover = field(default_factory=Handover)

    def read_state(self, resumed: Resumed) -> None:
        """Read the state at the start of the file; add an event if it cannot be used."""
        try:
            state = decode_state(self.opening["state.json"])
        except DataError as error:
            resumed.note(f"{self.path.name}: {error}")
            return
        self.state = state
        self.handover = Handover(
            offset_um=state.offset_um,
            operator_hold=state.memory.operator_hold,
            internal_error=state.memory.internal_error,
            further={name: one.offset for name, one in (state.axes or {}).items()},
        )

    def add(self, step: RecordedStep) -> float:
        """Process one group; return the offset that was published with it, µm; NaN if there was none."""
        offset, values = step.offset, step.further  # nothing of a group counts with a record that cannot be read
        self.samples += step.sample is not None
        offset_um, held, failed = self.handover.offset_um, self.handover.operator_hold, self.handover.internal_error
        for event in step.events:
            command = command_of(event) if event.kind == EventKind.COMMAND else ""
            held = command == CommandName.HOLD or (held and command != CommandName.RESUME)
            failed = event.kind == EventKind.ERROR or (failed and command != CommandName.RESUME)
        published = number(offset.y_offset_um) if offset is not None else math.nan
        # Without a state only the offsets show a hold from an earlier file.
        reasons = offset.reasons if offset is not None else []
        further = {name: value for name, value in values.items() if not math.isnan(value)}
        self.handover = Handover(
            offset_um=offset_um if math.isnan(published) else published,
            operator_hold=held or Reason.OPERATOR_HOLD in reasons,
            internal_error=failed or Reason.INTERNAL_ERROR in reasons,
            further={**self.handover.further, **further},
        )
        return published


def resume(loaded: LoadedConfig, model: ThermalModel, checkpointed: CheckpointedOffset | None = None) -> Resumed:
    """Return a compensation in its state at the end of the last recording.

    Parameters
    ----------
    loaded : LoadedConfig
        The present configuration.
    model : ThermalModel
        The present model.
    checkpointed : CheckpointedOffset, optional
        The last offset that was published while the disk failed.

    Returns
    -------
    Resumed
        The state before the pause since then; the first sample shows its length.
    """
    resumed = _from_disk(loaded, model)
    if checkpointed is not None and checkpointed.seq > resumed.compensation.status.seq:
        resumed.compensation.take_offsets(checkpointed.y_offset_um, checkpointed.further)
        resumed.compensation.take_holds(
            operator_hold=checkpointed.operator_hold, internal_error=checkpointed.internal_error
        )
        resumed.note(
            f"continues from the offset {checkpointed.y_offset_um:.3f} µm of sample {checkpointed.seq}, "
            "which was published while the disk failed",
            early_seq=checkpointed.seq,
            offset_um=checkpointed.y_offset_um,
        )
    return resumed


def _from_disk(loaded: LoadedConfig, model: ThermalModel) -> Resumed:
    config = loaded.config
    resumed = Resumed(Compensation(config, model))
    for path in reversed(recordings(loaded.resolve(config.recording.folder), config.machine.name)):
        try:
            last = _LastFile(path, opening_of(path))
            if "state.json" in last.opening:
                last.read_state(resumed)
            changes = _changes(last, loaded, model)
            compensation = Compensation(config, model)
            differing, why = _run_again(last, compensation, resumed, restore=not changes)
        except CompensatorError as error:
            resumed.note(f"a recording cannot be used: {error}")
            continue
        if last.state is None and not last.samples:
            continue
        if changes or why:
            _warm(resumed, last, loaded, model, " and ".join(changes or [why]))
        else:
            _continue(resumed, last, compensation, differing)
        break
    return resumed


def _changes(last: _LastFile, loaded: LoadedConfig, model: ThermalModel) -> list[str]:
    """Return why the state of the recording does not fit this configuration and model, as texts."""
    if last.state is None:
        return ["the recording contains no state that can be used"]
    changes = []
    if last.opening.get("config.toml") != loaded.data:
        changes.append("the configuration has changed")
    if last.state.model_sha256 != model.sha256:
        changes.append(f"the model has changed from {last.state.model_sha256[:12]} to {model.sha256[:12]}")
    return changes


def _run_again(last: _LastFile, compensation: Compensation, resumed: Resumed, *, restore: bool) -> tuple[int, str]:
    """Read the last file; with `restore`, replay it from its state.

    A record that no service wrote ends it, as a torn end does: what came before it was published.

    Returns
    -------
    int
        Number of offsets that are not reproduced as published.
    str
        Why it could not be replayed; empty if it was.
    """
    differing, why = 0, ""
    try:
        if restore:
            compensation.restore(last.opening["state.json"])
    except DataError as error:
        why = str(error)
    try:
        for step in steps_of(last.path):
            published = last.add(step)
            if not restore or why:
                continue
            try:
                result = apply(compensation, step)
            except DataError as error:
                why = str(error)
                continue
            if isinstance(result, Outcome) and "offset" in step.records:
                # The daemon adds reasons when the disk fails; only the numbers are the compensation's.
                computed = number(result.offset.y_offset_um)
                differing += computed != published and not (math.isnan(computed) and math.isnan(published))
    except DataError as error:
        if not last.samples:
            raise
        resumed.note(f"a recording is used up to a record that cannot be: {error}")
    return differing, why


def _continue(resumed: Resumed, last: _LastFile, compensation: Compensation, differing: int) -> None:
    """Continue with a compensation that has replayed the last file."""
    if differing:
        resumed.note(
            f"{differing} offset(s) of {last.path.name} are not reproduced as published: audit it",
            file=last.path.name,
            differing=differing,
        )
    resumed.compensation = compensation
    if last.samples:
        # The offset of a torn last sample was computed but not published.
        compensation.take_offsets(last.handover.offset_um, last.handover.further)
    status = compensation.status
    resumed.note(
        f"continues from {last.path.name}: {last.samples} sample(s) run again, the last one {status.seq}",
        file=last.path.name,
        samples=last.samples,
        last_seq=status.seq,
        offset_um=status.handover.offset_um,
    )


def _probing_of(last: _LastFile) -> ProbingHandover:
    """Return what the probes had shown at the end of a file, replayed with the configuration and model in it."""
    nothing = ProbingHandover()
    if last.state is None or last.state.probing is None:
        return nothing
    try:
        config = parse_config(last.opening.get("config.toml", b""), source=f"{last.path.name}: config.toml")
        model = model_of(config, last.opening.get("model.toml", b""), source=f"{last.path.name}: model.toml")
        compensation = Compensation(config, model)
        compensation.restore(last.opening["state.json"])
        for step in steps_of(last.path):
            apply(compensation, step)
    except CompensatorError:
        return nothing
    return compensation.status.handover.probing or nothing


def _warm(resumed: Resumed, last: _LastFile, loaded: LoadedConfig, model: ThermalModel, why: str) -> None:
    """Warm up a new compensation on the recordings; if that fails it starts as at the first start."""
    config = loaded.config
    try:
        candidate = warm_up(loaded.resolve(config.recording.folder), config, model)
    except DataError as error:
        resumed.note(f"{why}; the state cannot be restored ({error}): starting as at the first start", state_lost=True)
    else:
        resumed.compensation = candidate.compensation
        resumed.note(
            f"{why}; warmed up on {candidate.samples} sample(s) of {candidate.minutes / 60.0:.1f} h"
            + ("" if candidate.is_known else ", which is too short to determine the state"),
            samples=candidate.samples,
            warm_up_min=candidate.minutes,
            known=candidate.is_known,
            std_um=candidate.compensation.status.std_um,
        )
    resumed.compensation.continue_from(
        msgspec.structs.replace(
            last.handover,
            waiting_zero=resumed.compensation.status.handover.waiting_zero,
            model_changed=last.state is None or last.state.model_sha256 != model.sha256,
            probing=_probing_of(last),
        )
    )
