"""Warm-up: brings a new compensation to the present state with the recordings, then with live samples.

It is used at a restart with another configuration or model, and when a model is adopted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from compensator.clock import NS
from compensator.config import Config
from compensator.errors import DataError
from compensator.events import CommandName, EventKind, command_of
from compensator.messages import EstimateMessage, Event
from compensator.model.thermal_model import ThermalModel
from compensator.recording.reading import RawRecord, decode, files_since, messages, read_messages, recordings
from compensator.service.compensation import Compensation, Outcome, slowest_min
from compensator.service.replay import ForeignRun, RecordedStep, opening_of, steps_of
from compensator.service.state import CompensationState, decode_state
from compensator.service.status import Zero
from compensator.service.transfer.shadow import Shadow

#: Longest warm-up, in slowest time constants: 0.03 % of the influence of earlier samples remains.
WARM_UP = 8.0
#: So many of the newest estimates are looked at for one that can be read.
_NEWEST = 100


@dataclass(slots=True, kw_only=True)
class Successor:
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

    def follow(self, outcome: Outcome) -> None:
        """Process a live sample, with the zero that was set with it; a sample of the recordings is skipped."""
        Shadow(self.compensation, b"").follow(outcome, probes=False)

    def figures(self) -> dict[str, Any]:
        """Return the extent of its warm-up for events and replies."""
        return {"warm_up_min": self.minutes, "warm_up_samples": self.samples, "state_known": self.is_known}


def warm_up(
    folder: Path,
    config: Config,
    model: ThermalModel,
    *,
    between_samples: Callable[[], None] = lambda: None,
    probes: bool = False,
    seen: Callable[[Outcome], None] = lambda _: None,
) -> Successor:
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
    probes : bool
        Whether recorded probes correct its prediction.
    seen : callable
        Called with each outcome.

    Raises
    ------
    DataError
        If there is no usable recording, or one has another sample period.
    """
    compensation = Compensation(config, model)
    compensation.begin(None)
    window = window_of(folder, config.machine.name, slowest_min(model), between_samples)
    zero, run = window.zero, RecordedRun(config, compensation, probes=probes)
    if window.at_rest is not None:
        run.process(window.at_rest)
    elif zero.is_absolute and model.inputs == "changes":
        raise DataError(f"{folder}: no recorded zero, and the previous model used absolute temperatures")
    else:
        compensation.begin(zero)
    run.begin_at_level(window)
    for path in window.files:
        for step in usable_steps(path):
            sample = step.sample
            if sample is None or (sample.seq > run.seq and sample.time_utc_ns >= window.from_ns):
                outcome = run.process(step)
                if outcome is not None:
                    seen(outcome)
            between_samples()
    if not run.samples:
        raise DataError(f"{folder}: no recorded samples for a warm-up")
    newest = run.zero or zero
    same = (zero.t_q_ref_degc, zero.at_ref_degc) == (newest.t_q_ref_degc, newest.at_ref_degc)
    if not same and model.inputs == "changes" and not zero.is_absolute:
        raise DataError(f"{folder}: the recordings do not contain the current zero")
    return Successor(compensation=compensation, samples=run.samples, minutes=run.minutes)


class RecordedRun:
    """Runs recorded samples through the compensation of another model, with the zeros of the record.

    Parameters
    ----------
    config : Config
        Settings of the service; recorded channels that it does not name are left out.
    compensation : Compensation
        In its state before the first sample.
    probes : bool
        Whether recorded probes that passed the checks correct its prediction, as they did in the service.
    """

    def __init__(self, config: Config, compensation: Compensation, *, probes: bool = False) -> None:
        self.compensation = compensation
        self.samples = 0
        #: The zero with the newest sample; None before the first.
        self.zero: Zero | None = None
        self._foreign = ForeignRun(compensation)
        #: Names of the channels that it processes.
        self.channels = frozenset(channel.name for channel in config.channel)
        self._probes = probes
        self._first_ns = 0

    @property
    def seq(self) -> int:
        """Number of the last sample or held offset; −1 before the first."""
        return self._foreign.seq

    @property
    def minutes(self) -> float:
        """Time from the first sample to the last, min."""
        return (self._foreign.time_ns - self._first_ns) / (60.0 * NS)

    def begin_at_level(self, window: Window) -> None:
        """Take the level at which the model was in force before the window."""
        self._raise_to(window.levels_um.get(self.compensation.model.sha256, 0.0))

    def process(self, step: RecordedStep) -> Outcome | None:
        """Process one recorded group; return the outcome of its sample.

        Raises
        ------
        DataError
            As in `ForeignRun.run`.
        """
        if step.sample is not None:
            with suppress(DataError):
                self._take_level(step)
            if step.zero is not None:
                self.compensation.zero(step.zero)
            channels = {name: channel for name, channel in step.sample.channels.items() if name in self.channels}
            # The zero is set above; of the other events only the pauses concern another model, and that a person has
            # seen to the couples: it must not wait for this again.
            if self.compensation.waits_for_resume and any(map(_is_resume, step.events)):
                self.compensation.resume()
            events = [event for event in step.events if event.kind == EventKind.RESTART]
            sample = msgspec.structs.replace(step.sample, channels=channels)
            step = replace(step, sample=sample, events=events)
        result = self._foreign.run(step, commands=self._probes and step.sample is not None)
        if not isinstance(result, Outcome):
            return None
        # An offset that cannot be read says nothing of them.
        with suppress(DataError):
            if self.compensation.waits_for_resume and step.offset is not None:
                self.compensation.believe_as_in_force(step.offset.reasons)
        self._first_ns, self.samples = self._first_ns or self._foreign.time_ns, self.samples + 1
        self.zero = Zero.of_estimate(result.estimate)
        return result

    def _take_level(self, step: RecordedStep) -> None:
        """Take the level at which the loop had adopted this very model, where the model was in force."""
        offset, estimate = step.offset, step.estimate
        if offset is None or estimate is None or offset.model_sha256 != self.compensation.model.sha256:
            return
        self._raise_to(estimate.level_um or 0.0)

    def _raise_to(self, level_um: float) -> None:
        raised_um = level_um - self.compensation.level_um
        if raised_um:
            self.compensation.raise_level(raised_um)


def _is_resume(event: Event) -> bool:
    return event.kind == EventKind.COMMAND and command_of(event) == CommandName.RESUME


@dataclass(slots=True)
class Window:
    """The part of the recordings that a run uses.

    Parameters
    ----------
    zero : Zero
        The zero at their end.
    files : list of pathlib.Path
        The files.
    from_ns, end_ns : int
        Where the run must start, and the last sample, ns since 1970 UTC.
    at_rest : RecordedStep or None
        The zero at rest with which it starts; None if there is none.
    levels_um : dict of str to float
        The last level at which each model was in force between the current zero and the window, by its hash, µm.
    """

    zero: Zero
    files: list[Path]
    from_ns: int
    end_ns: int
    at_rest: RecordedStep | None = None
    levels_um: dict[str, float] = field(default_factory=dict)


def window_of(
    folder: Path, machine: str, slowest: float, between_samples: Callable[[], None], *, compared_ns: int = 0
) -> Window:
    """Find the current zero, and where a run must start so that its state is known.

    Parameters
    ----------
    folder : pathlib.Path
        Recordings.
    machine : str
        Name of the machine.
    slowest : float
        Slowest time constant, min.
    between_samples : callable
        Called after each sample that is read.
    compared_ns : int
        How long before the end the state must be known, ns.

    Raises
    ------
    DataError
        If there is no recorded zero.
    """
    files = recordings(folder, machine)
    last = _last_estimate(files)
    zero = Zero.set_in(last)
    if last is None or zero is None:
        raise DataError(f"{folder}: no recorded zero")
    span_ns, known_ns = round(WARM_UP * slowest * 60 * NS), last.time_utc_ns - compared_ns
    window = Window(zero=zero, files=files, from_ns=known_ns - span_ns, end_ns=last.time_utc_ns)
    is_current, passed = True, list[Path]()  # a level begins with a file
    for path in reversed(files):
        state = _opening_state(path)
        opening = _zero_of(state)
        passed.append(path)
        if is_current and state is not None and state.memory.time_utc_ns < window.from_ns:
            is_current = _note_level(window, state, passed)
        if opening is not None and opening.equals(zero):
            continue  # the zero was set before this file
        zeros = []
        for step in usable_steps(path):
            if step.zero is not None:
                zeros.append(step)
            between_samples()
        for step in reversed(zeros):
            assert step.sample is not None
            at_ns = step.sample.time_utc_ns
            if step.zero == "rest" and at_ns <= known_ns:
                window.at_rest = step
                window.from_ns = max(window.from_ns, at_ns)
                break
            # The deformation is relative to the model's prediction at a zero on a warm machine, so the state must be
            # known there too.
            window.from_ns = min(window.from_ns, at_ns - span_ns)
            # The run sees all that was in force since the current zero.
            window.levels_um, is_current = {}, False
        if window.at_rest is not None:
            break
        zero = opening or zero
    window.files = files_since(files, window.from_ns)
    return window


def usable_steps(path: Path) -> Iterator[RecordedStep]:
    """Yield the groups of a recording, up to a record that no service wrote: what came before it was published.

    What has the name of a recording and is none has no group: it must not keep a model from its state.
    """
    with suppress(DataError):
        yield from steps_of(path)


def _last_estimate(files: list[Path]) -> EstimateMessage | None:
    for path in reversed(files):
        newest: deque[RawRecord] = deque(maxlen=_NEWEST)
        with suppress(DataError):
            newest.extend(read_messages(path, ("estimate",)))
        for record in reversed(newest):
            with suppress(DataError):
                message = decode(record, path)
                return message if isinstance(message, EstimateMessage) else None
    return None


def _note_level(window: Window, state: CompensationState, passed: list[Path]) -> bool:
    """Note the level of the model in force, the newest of each; return whether no zero was set in the files passed."""
    if state.model_sha256 in window.levels_um:
        return True
    # Two zeros of a machine at rest may have the same values.
    if state.zero.level and any(map(_sets_zero, passed)):
        return False
    window.levels_um[state.model_sha256] = state.zero.level
    return True


def _opening_state(path: Path) -> CompensationState | None:
    """Return the state at the start of a recording; None if it cannot be read."""
    try:
        return decode_state(opening_of(path).get("state.json", b""))
    except DataError:
        return None


def _zero_of(state: CompensationState | None) -> Zero | None:
    return None if state is None else Zero.of_references(state.engine, state.zero, state.axes or {})


def _sets_zero(path: Path) -> bool:
    """Return whether a zero was set within a recording."""
    with suppress(DataError):
        return any(event.kind == EventKind.ZERO for event in messages(path, ("event",)))
    return False
