"""After any end of the service: finds its last recording and brings the state to where it ended.

A clean stop, a kill and a power cut are the same here: whatever is whole on disk is used. The samples of the last file
run from the state that it opens with, and give the state after the last of them, bit for bit. Where the configuration
or the model has changed since, the recordings warm the new one up instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from compensator.config import Config, LoadedConfig
from compensator.errors import CompensatorError, DataError
from compensator.messages import number
from compensator.model.thermal_model import ThermalModel
from compensator.recording.reading import recordings
from compensator.service.compensation import Compensation
from compensator.service.offset_checkpoint import EarlyOffset
from compensator.service.retrace import opening_of, replayed, steps_of, warm_up
from compensator.service.state import CompensationState, decode_state


@dataclass(slots=True)
class Resumed:
    """A compensation that goes on where the last recording ends.

    Parameters
    ----------
    compensation : Compensation
        As it was, or at its first start.
    notes : list of (str, str, dict)
        Events: kind, text and data.
    """

    compensation: Compensation
    notes: list[tuple[str, str, dict[str, Any]]] = field(default_factory=list)

    def note(self, text: str, **data: Any) -> None:
        """Add an event."""
        self.notes.append(("restart", text, data))


@dataclass(slots=True)
class _Last:
    """The last file with a sample or a state, and what stands at its end."""

    path: Path
    opening: dict[str, bytes]
    state: CompensationState | None
    samples: int = 0
    #: What was published last, µm; a control that never got an offset applies none.
    offset_um: float = 0.0
    operator_hold: bool = False

    def read(self) -> None:
        """Read the file through; what it holds of a day at one sample a second is too much to be kept."""
        if self.state is not None:
            self.offset_um, self.operator_hold = self.state.offset_um, self.state.memory.operator_hold
        for step in steps_of(self.path):
            self.samples += 1
            if step.offset is not None and not math.isnan(number(step.offset.y_offset_um)):
                self.offset_um = number(step.offset.y_offset_um)
            for name, _ in step.commands:
                self.operator_hold = name == "hold" or (self.operator_hold and name != "resume")


def resume(loaded: LoadedConfig, model: ThermalModel, early: EarlyOffset | None = None) -> Resumed:
    """Bring a compensation to where the last recording ends.

    Parameters
    ----------
    loaded : LoadedConfig
        The present configuration.
    model : ThermalModel
        The present model.
    early : EarlyOffset, optional
        The last offset that was published while the disk did not take it.

    Returns
    -------
    Resumed
        Before the pause since then, which the first sample tells.
    """
    resumed = _from_disk(loaded, model)
    compensation = resumed.compensation
    if early is not None and early.seq > compensation.last[0]:
        compensation.go_on_from(early.y_offset_um, model_changed=compensation.is_under_way)
        resumed.note(
            f"goes on from the offset {early.y_offset_um:.3f} µm of sample {early.seq}, "
            "which was published while the disk did not take it",
            early_seq=early.seq,
            offset_um=early.y_offset_um,
        )
    return resumed


def _from_disk(loaded: LoadedConfig, model: ThermalModel) -> Resumed:
    config = loaded.config
    resumed = Resumed(Compensation(config, model))
    folder = loaded.resolve(config.recording.folder)
    last = _last(folder, config.machine.name, resumed)
    if last is None:
        return resumed
    changes = _changes(last, loaded, model)
    if not changes:
        try:
            _restore(resumed, last, config)
        except DataError as error:
            changes = [str(error)]
        else:
            return resumed
    _warm(resumed, last, folder, config, model, changes)
    return resumed


def _last(folder: Path, machine: str, resumed: Resumed) -> _Last | None:
    for path in reversed(recordings(folder, machine)):
        try:
            last = _Last(path, opening_of(path), None)
            if "state.json" in last.opening:
                last.state = _state(last, resumed)
            last.read()
        except CompensatorError as error:
            resumed.note(f"a recording cannot be used: {error}")
            continue
        if last.state is not None or last.samples:
            return last
    return None


def _state(last: _Last, resumed: Resumed) -> CompensationState | None:
    try:
        return decode_state(last.opening["state.json"])
    except DataError as error:
        resumed.note(f"{last.path.name}: {error}")
        return None


def _changes(last: _Last, loaded: LoadedConfig, model: ThermalModel) -> list[str]:
    """Say in words why the state of the recording is not that of this configuration and model."""
    if last.state is None:
        return ["the recording carries no state that can be used"]
    changes = []
    if last.opening.get("config.toml") != loaded.data:
        changes.append("the configuration has changed")
    if last.state.model_sha256 != model.sha256:
        changes.append(f"the model has changed from {last.state.model_sha256[:12]} to {model.sha256[:12]}")
    return changes


def _restore(resumed: Resumed, last: _Last, config: Config) -> None:
    compensation = Compensation(config, resumed.compensation.model)
    compensation.restore(last.opening["state.json"])
    outcome, differing = None, 0
    for step in steps_of(last.path):
        outcome = replayed(compensation, step)
        if step.offset is not None:
            # The daemon adds to the reasons when the disk fails; the numbers are the compensation's alone.
            made, was = number(outcome.offset.y_offset_um), number(step.offset.y_offset_um)
            differing += made != was and not (math.isnan(made) and math.isnan(was))
    if differing:
        resumed.note(
            f"{differing} offset(s) of {last.path.name} come out otherwise than they were published: audit it",
            file=last.path.name,
            differing=differing,
        )
    if outcome is not None:
        # Not what is worked out for a torn last sample, whose offset nobody got.
        compensation.go_on_from(last.offset_um, model_changed=compensation.is_under_way)
    seq, _ = compensation.last
    resumed.compensation = compensation
    resumed.note(
        f"goes on from {last.path.name}: {last.samples} sample(s) run again, the last one {seq}",
        file=last.path.name,
        samples=last.samples,
        last_seq=seq,
        offset_um=compensation.offset_um,
    )


def _warm(resumed: Resumed, last: _Last, folder: Path, config: Config, model: ThermalModel, changes: list[str]) -> None:
    why = " and ".join(changes)
    model_changed = last.state is None or last.state.model_sha256 != model.sha256
    try:
        warm = warm_up(folder, config, model)
    except DataError as error:
        resumed.compensation.go_on_from(last.offset_um, model_changed=model_changed)
        if last.operator_hold:
            resumed.compensation.hold()
        resumed.note(f"{why}; the state cannot be brought over ({error}): it begins anew", begun_anew=True)
        return
    resumed.compensation = warm.compensation
    resumed.compensation.go_on_from(last.offset_um, model_changed=model_changed)
    if last.operator_hold:
        resumed.compensation.hold()
    resumed.note(
        f"{why}; warmed up on {warm.samples} sample(s) of {warm.minutes / 60.0:.1f} h"
        + ("" if warm.known else ", which is too short to know the state"),
        samples=warm.samples,
        warm_up_min=warm.minutes,
        known=warm.known,
        std_um=warm.compensation.std_um,
    )
