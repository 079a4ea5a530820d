"""Warm-up: a model that did not run gets the state that it would have had, from the recordings.

A restart with another configuration or model begins with it, and a model that is adopted.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from compensator.clock import NS
from compensator.config import Config
from compensator.errors import DataError
from compensator.messages import EstimateMessage, number
from compensator.model.thermal_model import ThermalModel
from compensator.recording.reading import decode, read_messages, recordings
from compensator.service.compensation import Compensation, Outcome
from compensator.service.replay import FreeRun, Step, opening_of, steps_of
from compensator.service.state import CompensationState, decode_state

#: Length of a warm-up at most, in slowest time constants: 0.03 % of what was before is left then.
WARM_UP = 8.0


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUp:
    """A compensation that was brought to the present by the recordings.

    Parameters
    ----------
    compensation : Compensation
        Its state after the last recorded sample.
    samples : int
        Number of samples that were run.
    minutes : float
        Time that they span, min.
    known : bool
        Whether they determine the state: they begin at a zero at rest, or reach back far enough.
    """

    compensation: Compensation
    samples: int
    minutes: float
    known: bool

    def figures(self) -> dict[str, Any]:
        """Return its extent for events and answers."""
        return {"warm_up_min": self.minutes, "warm_up_samples": self.samples, "state_known": self.known}


def warm_up(
    folder: Path, config: Config, model: ThermalModel, *, let_others: Callable[[], None] = lambda: None
) -> WarmUp:
    """Bring a new compensation to the end of the recordings, with the zero that is in force there.

    It begins at the last zero at rest, or, where that is longer ago, `WARM_UP` of the model's slowest time constants
    before the end (before the last zero on a warm machine, where there was one).

    Parameters
    ----------
    folder : pathlib.Path
        Recordings.
    config : Config
        Settings of the service.
    model : ThermalModel
        The new model.
    let_others : callable
        Called after each sample; a thread lets the service go first there.

    Raises
    ------
    DataError
        If there is no recording, or one of another sample period.
    """
    compensation = Compensation(config, model)
    compensation.begin_at_zero()
    window = _window(folder, config.machine.name, compensation.slowest_min, let_others)
    last, free = window.last, FreeRun(compensation)
    names = {channel.name for channel in config.channel}
    first_ns, samples, made = 0, 0, None

    def run(step: Step) -> None:
        nonlocal first_ns, samples, made
        if step.sample is not None:
            if step.zero is not None:
                compensation.zero(step.zero)
            channels = {name: channel for name, channel in step.sample.channels.items() if name in names}
            step = replace(step, sample=msgspec.structs.replace(step.sample, channels=channels))
        result = free.run(step, commands=False)
        if isinstance(result, Outcome):
            first_ns, samples, made = first_ns or free.time_ns, samples + 1, result.estimate

    absolute = number(last.t_q_ref_degc) == number(last.at_ref_degc) == 0.0
    if window.at_rest is not None:
        run(window.at_rest)
    elif absolute and model.inputs == "changes":
        raise DataError(f"{folder}: no zero on record, and the previous model used the temperatures as they are")
    else:
        compensation.begin(
            t_q_ref_degc=number(last.t_q_ref_degc),
            at_ref_degc=number(last.at_ref_degc),
            y_ref_um=number(last.y_ref_um),
            y_base_um=last.y_base_um,
        )
    for path in window.files:
        for step in steps_of(path):
            sample = step.sample
            if sample is None or (sample.seq > free.seq and sample.time_utc_ns >= window.from_ns):
                run(step)
            let_others()
    if made is None:
        raise DataError(f"{folder}: no recorded sample to warm the model up with")
    same = (last.t_q_ref_degc, last.at_ref_degc) == (made.t_q_ref_degc, made.at_ref_degc)
    if not same and model.inputs == "changes" and not absolute:
        raise DataError(f"{folder}: the recordings do not lead to the zero in force")
    minutes = (free.time_ns - first_ns) / (60.0 * NS)
    return WarmUp(compensation=compensation, samples=samples, minutes=minutes, known=not compensation.is_cold)


@dataclass(slots=True)
class _Window:
    """The part of the recordings that a warm-up uses."""

    last: EstimateMessage
    files: list[Path]
    from_ns: int
    at_rest: Step | None = None


def _window(folder: Path, machine: str, slowest_min: float, let_others: Callable[[], None]) -> _Window:
    """Look for the zero in force and for how far back the warm-up must begin."""
    files = recordings(folder, machine)
    last = _last_estimate(files)
    if last is None or math.isnan(number(last.t_q_ref_degc)):
        raise DataError(f"{folder}: no zero on record")
    span_ns = round(WARM_UP * slowest_min * 60 * NS)
    window = _Window(last=last, files=files, from_ns=last.time_utc_ns - span_ns)
    for path in reversed(files):
        if _opens_with_zero(path, last):
            continue  # the zero was set before this file
        zeros = []
        for step in steps_of(path):
            if step.zero is not None:
                zeros.append(step)
            let_others()
        for step in reversed(zeros):
            assert step.sample is not None
            if step.zero == "rest":
                window.at_rest = step
                window.from_ns = max(window.from_ns, step.sample.time_utc_ns)
                break
            # What the model predicts there is what the deformation counts from: it must be known there, too.
            window.from_ns = min(window.from_ns, step.sample.time_utc_ns - span_ns)
        if window.at_rest is not None:
            break
    window.files = files[_first_needed(files, window.from_ns) :]
    return window


def _first_needed(files: list[Path], from_ns: int) -> int:
    """Return the index of the last file that begins before a time."""
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


def _opens_with_zero(path: Path, last: EstimateMessage) -> bool:
    """Return whether a recording opens with the zero in force at the end."""
    state = _state_of(path)
    if state is None:
        return False
    reference = state.engine.reference
    pairs = (
        (reference.t_q_degc, last.t_q_ref_degc),
        (reference.at_degc, last.at_ref_degc),
        (state.zero.y_ref, last.y_ref_um),
        (state.zero.y_base, last.y_base_um),
    )
    return all(a == number(b) or (math.isnan(a) and math.isnan(number(b))) for a, b in pairs)


def _state_of(path: Path) -> CompensationState | None:
    try:
        return decode_state(opening_of(path).get("state.json", b""))
    except DataError:
        return None
