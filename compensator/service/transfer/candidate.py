"""Warm-up: brings a new compensation to the present state with the recordings, then with live samples.

It is used at a restart with another configuration or model, and when a model is adopted.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from compensator.clock import NS
from compensator.config import Config
from compensator.errors import DataError
from compensator.events import EventKind
from compensator.messages import EstimateMessage
from compensator.model.thermal_model import ThermalModel
from compensator.recording.reading import decode, read_messages, recordings
from compensator.service.compensation import Compensation, Outcome, slowest_min
from compensator.service.replay import FreeRun, RecordedStep, opening_of, steps_of
from compensator.service.state import decode_state
from compensator.service.status import Zero

#: Longest warm-up, in slowest time constants: 0.03 % of the influence of earlier samples remains.
WARM_UP = 8.0


@dataclass(slots=True, kw_only=True)
class ModelCandidate:
    """A compensation that is ready to succeed another one.

    Parameters
    ----------
    compensation : Compensation
        The compensation in its state after the last sample.
    samples : int
        Number of recorded samples of the warm-up.
    minutes : float
        Their time span, min.
    """

    compensation: Compensation
    samples: int = 0
    minutes: float = 0.0
    #: Whether the recordings determine its state: they start at a zero at rest, or are long enough.
    is_known: bool = field(init=False)

    def __post_init__(self) -> None:
        self.is_known = self.compensation.status.is_known

    def update(self, outcome: Outcome) -> None:
        """Process a live sample, with the zero that was set with it; a sample of the recordings is skipped."""
        sample, last = outcome.sample, self.compensation.status.seq
        if sample.seq <= last:
            return
        if last >= 0:
            # The samples in between were not on disk in time for the warm-up.
            self.compensation.pause(sample.seq - last - 1)
        for note in outcome.notes:
            if note.kind == EventKind.ZERO:
                self.compensation.zero(note.data["mode"])
        self.compensation.process(sample)

    def figures(self) -> dict[str, Any]:
        """Return the extent of its warm-up for events and replies."""
        return {"warm_up_min": self.minutes, "warm_up_samples": self.samples, "state_known": self.is_known}


def warm_up(
    folder: Path, config: Config, model: ThermalModel, *, between_samples: Callable[[], None] = lambda: None
) -> ModelCandidate:
    """Run a new compensation up to the end of the recordings, with the zero that is current there.

    It starts at the last zero at rest, or, if that is longer ago, `WARM_UP` times the model's slowest time constant
    before the end (or before the last zero on a warm machine, if there was one).

    Parameters
    ----------
    folder : pathlib.Path
        Recordings.
    config : Config
        Settings of the service.
    model : ThermalModel
        The new model.
    between_samples : callable
        Called after each sample, so that a thread can yield to the service.

    Raises
    ------
    DataError
        If there is no usable recording, or one has another sample period.
    """
    compensation = Compensation(config, model)
    compensation.begin(None)
    window = _window(folder, config.machine.name, slowest_min(model), between_samples)
    zero, free = window.zero, FreeRun(compensation)
    names = {channel.name for channel in config.channel}
    first_ns, samples, newest = 0, 0, zero

    def run(step: RecordedStep) -> None:
        nonlocal first_ns, samples, newest
        if step.sample is not None:
            if step.zero is not None:
                compensation.zero(step.zero)
            channels = {name: channel for name, channel in step.sample.channels.items() if name in names}
            step = replace(step, sample=msgspec.structs.replace(step.sample, channels=channels))
        result = free.run(step, commands=False)
        if isinstance(result, Outcome):
            first_ns, samples = first_ns or free.time_ns, samples + 1
            newest = Zero.of_estimate(result.estimate)

    if window.at_rest is not None:
        run(window.at_rest)
    elif zero.is_absolute and model.inputs == "changes":
        raise DataError(f"{folder}: no recorded zero, and the previous model used absolute temperatures")
    else:
        compensation.begin(zero)
    for path in window.files:
        for step in steps_of(path):
            sample = step.sample
            if sample is None or (sample.seq > free.seq and sample.time_utc_ns >= window.from_ns):
                run(step)
            between_samples()
    if not samples:
        raise DataError(f"{folder}: no recorded samples for a warm-up")
    same = (zero.t_q_ref_degc, zero.at_ref_degc) == (newest.t_q_ref_degc, newest.at_ref_degc)
    if not same and model.inputs == "changes" and not zero.is_absolute:
        raise DataError(f"{folder}: the recordings do not contain the current zero")
    return ModelCandidate(compensation=compensation, samples=samples, minutes=(free.time_ns - first_ns) / (60.0 * NS))


@dataclass(slots=True)
class _Window:
    """The part of the recordings that a warm-up uses, and the current zero at their end."""

    zero: Zero
    files: list[Path]
    from_ns: int
    at_rest: RecordedStep | None = None


def _window(folder: Path, machine: str, slowest: float, between_samples: Callable[[], None]) -> _Window:
    """Find the current zero, and where the warm-up must start."""
    files = recordings(folder, machine)
    last = _last_estimate(files)
    if last is None or math.isnan((zero := Zero.of_estimate(last)).t_q_ref_degc):
        raise DataError(f"{folder}: no recorded zero")
    span_ns = round(WARM_UP * slowest * 60 * NS)
    window = _Window(zero=zero, files=files, from_ns=last.time_utc_ns - span_ns)
    for path in reversed(files):
        if _opens_with(path, zero):
            continue  # the zero was set before this file
        zeros = []
        for step in steps_of(path):
            if step.zero is not None:
                zeros.append(step)
            between_samples()
        for step in reversed(zeros):
            assert step.sample is not None
            if step.zero == "rest":
                window.at_rest = step
                window.from_ns = max(window.from_ns, step.sample.time_utc_ns)
                break
            # The deformation is relative to the model's prediction at this zero, so the state must be known there too.
            window.from_ns = min(window.from_ns, step.sample.time_utc_ns - span_ns)
        if window.at_rest is not None:
            break
    window.files = files[_first_needed(files, window.from_ns) :]
    return window


def _first_needed(files: list[Path], from_ns: int) -> int:
    """Return the index of the last file that starts before a time."""
    for i in range(len(files) - 1, 0, -1):
        first = next((step.sample for step in steps_of(files[i]) if step.sample is not None), None)
        if first is not None and first.time_utc_ns <= from_ns:
            return i
    return 0


def _last_estimate(files: list[Path]) -> EstimateMessage | None:
    for path in reversed(files):
        newest = deque(read_messages(path, ("estimate",)), maxlen=1)
        if newest:
            message = decode(newest[0], path)
            return message if isinstance(message, EstimateMessage) else None
    return None


def _opens_with(path: Path, zero: Zero) -> bool:
    """Return whether a zero was current at the start of a recording."""
    try:
        state = decode_state(opening_of(path).get("state.json", b""))
    except DataError:
        return False
    return Zero.of_references(state.engine.reference, state.zero).equals(zero)
