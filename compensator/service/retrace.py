"""Runs recorded samples through a compensation again.

A restart brings the state to the moment at which the recording ends; a model that is taken over is warmed up, so that
its state is what it would be had it run all the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from compensator.clock import NS
from compensator.config import Config
from compensator.errors import DataError
from compensator.messages import EstimateMessage, Event, Offset, Sample, number
from compensator.model.thermal_model import ThermalModel
from compensator.recording.container import Container
from compensator.recording.reading import Recorded, decode, read_messages, recordings
from compensator.service.compensation import Compensation, Outcome
from compensator.service.state import CompensationState, ZeroMode, decode_state

#: A warm-up goes back by so many of the slowest time constants at most: 0.03 % of what was before is left then.
WARM_UP = 8.0
_TOPICS = ("event", "sample", "estimate", "offset")


@dataclass(slots=True)
class Step:
    """One recorded sample with what belongs to it.

    Parameters
    ----------
    sample : Sample
        The sample.
    commands : list of (str, dict)
        Commands that were obeyed before it, and `fail` for an internal error.
    estimate : EstimateMessage, optional
        What was made of it; missing in a torn end.
    offset : Offset, optional
        What was decided; missing in a torn end.
    zeroed : bool
        Whether a zero was set with it.
    """

    sample: Sample
    commands: list[tuple[str, dict[str, object]]] = field(default_factory=list)
    estimate: EstimateMessage | None = None
    offset: Offset | None = None
    zeroed: bool = False

    @property
    def zero(self) -> ZeroMode | None:
        """How a zero was set with this sample, None where none was."""
        if not self.zeroed or self.estimate is None:
            return None
        return "rest" if self.estimate.y_base_um == 0.0 else "warm"


def opening_of(path: Path) -> dict[str, bytes]:
    """Return what travels in a recording, by name; nothing where it is torn before that.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    with Container(path) as container:
        return {name: attachment.data for name, attachment in container.survey(whole=False).attachments.items()}


def state_of(path: Path) -> CompensationState | None:
    """Return the state that a recording opens with, None where it carries none that can be read."""
    try:
        return decode_state(opening_of(path).get("state.json", b""))
    except DataError:
        return None


def steps_of(path: Path) -> Iterator[Step]:
    """Yield the samples of a recording with what belongs to each; a torn end gives every whole record.

    Raises
    ------
    DataError
        If it is no recording of ours.
    """
    step: Step | None = None
    events: list[Event] = []
    for record in read_messages(path, _TOPICS):
        message = decode(record, path)
        if isinstance(message, Event):
            events.append(message)
        elif isinstance(message, Sample):
            if step is not None:
                yield step
            # Events that a full disk held back belong to samples of before, and are in the file's state already.
            mine = [event for event in events if event.seq == message.seq]
            step = Step(
                message,
                commands=[_asked(event) for event in mine if event.kind in ("command", "error")],
                zeroed=any(event.kind == "zero" for event in mine),
            )
            events = []
        elif step is not None and isinstance(message, EstimateMessage) and message.seq == step.sample.seq:
            step.estimate = message
        elif step is not None and isinstance(message, Offset) and message.seq == step.sample.seq:
            step.offset = message
            yield step
            step = None
    if step is not None:
        yield step


def _asked(event: Event) -> tuple[str, dict[str, object]]:
    return (event.text, event.data) if event.kind == "command" else ("fail", {})


def obey(compensation: Compensation, name: str, arguments: dict[str, object]) -> None:
    """Let a compensation obey a command, live or recorded; those that are none of its own are left alone."""
    if name == "zero":
        mode = arguments.get("mode", "auto")
        compensation.zero(mode if mode in ("auto", "rest", "warm") else "auto")
    elif name == "hold":
        compensation.hold()
    elif name == "resume":
        compensation.resume()
    elif name == "fail":
        compensation.fail()


def replayed(compensation: Compensation, step: Step) -> Outcome:
    """Let a compensation take a recorded sample as it was taken: commands first."""
    for name, arguments in step.commands:
        obey(compensation, name, arguments)
    return compensation.process(step.sample)


def samples_between(before_ns: int, after_ns: int, period_s: float) -> int:
    """Return how many samples are missing between two; none where the clock was set back."""
    return max(round((after_ns - before_ns) / (period_s * NS)) - 1, 0)


# ---------------------------------------------------------------------- warm-up


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
    offset : Offset or None
        The last offset on record.
    """

    compensation: Compensation
    samples: int
    minutes: float
    known: bool
    offset: Offset | None


def warm_up(
    folder: Path, config: Config, model: ThermalModel, *, let_others: Callable[[], None] = lambda: None
) -> WarmUp:
    """Bring a new compensation to the end of the recordings, with the zero that stands there.

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
    absolute = number(window.last.t_q_ref_degc) == number(window.last.at_ref_degc) == 0.0
    run = _Run(compensation, config)
    if window.at_rest is not None:
        run.take(window.at_rest)
    elif absolute and model.inputs == "changes":
        raise DataError(f"{folder}: no zero on record, and the model before took the temperatures as they are")
    else:
        compensation.begin(
            t_q_ref_degc=number(window.last.t_q_ref_degc),
            at_ref_degc=number(window.last.at_ref_degc),
            y_ref_um=number(window.last.y_ref_um),
            y_base_um=window.last.y_base_um,
        )
    for path in window.files:
        run.new_file = True
        for step in steps_of(path):
            # A step without an offset is torn; its minute counts as missing.
            if step.offset is not None and step.sample.seq > run.seq and step.sample.time_utc_ns >= window.from_ns:
                run.take(step)
            let_others()
    last, made = window.last, run.estimate
    if made is None:
        raise DataError(f"{folder}: no recorded sample to warm the model up with")
    same = (last.t_q_ref_degc, last.at_ref_degc) == (made.t_q_ref_degc, made.at_ref_degc)
    if not same and model.inputs == "changes" and not absolute:
        raise DataError(f"{folder}: the recordings do not lead to the zero that stands")
    return WarmUp(
        compensation=compensation,
        samples=run.samples,
        minutes=run.minutes,
        known=not compensation.is_cold,
        offset=run.offset,
    )


class _Run:
    """Takes steps from one file after the other."""

    def __init__(self, compensation: Compensation, config: Config) -> None:
        self._compensation = compensation
        self._names = {channel.name for channel in config.channel}
        self._first_ns = 0
        self._last_ns = 0
        self.seq = -1
        self.samples = 0
        #: Whether the next step opens a file: only there can samples be missing that the service never took. Within a
        #: file a leap in time is that of a clock which was set.
        self.new_file = True
        self.estimate: EstimateMessage | None = None
        self.offset: Offset | None = None

    def take(self, step: Step) -> None:
        """Take one step."""
        sample = step.sample
        period_s = self._compensation.model.period_s
        if sample.period_s != period_s:
            raise DataError(f"recorded samples of {sample.period_s:g} s, the model's are of {period_s:g} s")
        if self.samples == 0:
            self._first_ns = sample.time_utc_ns
        elif self.new_file:
            self._compensation.pause(samples_between(self._last_ns, sample.time_utc_ns, period_s))
        if step.zero is not None:
            self._compensation.zero(step.zero)
        channels = {name: channel for name, channel in sample.channels.items() if name in self._names}
        self.estimate = self._compensation.process(msgspec.structs.replace(sample, channels=channels)).estimate
        self.offset = step.offset
        self.seq, self._last_ns, self.new_file = sample.seq, sample.time_utc_ns, False
        self.samples += 1

    @property
    def minutes(self) -> float:
        """Time that the steps span, min."""
        return (self._last_ns - self._first_ns) / (60.0 * NS)


@dataclass(slots=True)
class _Window:
    """The part of the recordings that a warm-up takes."""

    last: EstimateMessage
    files: list[Path]
    from_ns: int
    at_rest: Step | None = None


def _window(folder: Path, machine: str, slowest_min: float, let_others: Callable[[], None]) -> _Window:
    """Look for the zero that stands and for how far back the warm-up must begin."""
    files = recordings(folder, machine)
    last = _last_estimate(files)
    if last is None or math.isnan(number(last.t_q_ref_degc)):
        raise DataError(f"{folder}: no zero on record")
    span_ns = round(WARM_UP * slowest_min * 60 * NS)
    window = _Window(last=last, files=files, from_ns=last.time_utc_ns - span_ns)
    for path in reversed(files):
        if _has_same_zero(state_of(path), last):
            continue  # the zero was set before this file
        zeros = []
        for step in steps_of(path):
            if step.zero is not None:
                zeros.append(step)
            let_others()
        for step in reversed(zeros):
            if step.zero == "rest":
                window.at_rest = step
                window.from_ns = max(window.from_ns, step.sample.time_utc_ns)
                break
            # What the model predicts there is what the deformation counts from: it must be known there, too.
            window.from_ns = min(window.from_ns, step.sample.time_utc_ns - span_ns)
        if window.at_rest is not None:
            break
    later = [(path, next(steps_of(path), None)) for path in files]
    begins = [step.sample.time_utc_ns if step is not None else None for _, step in later]
    for i in range(len(files) - 1, 0, -1):
        begin = begins[i]
        if begin is not None and begin <= window.from_ns:
            window.files = files[i:]
            break
    return window


def _last_estimate(files: list[Path]) -> EstimateMessage | None:
    for path in reversed(files):
        found: Recorded | None = None
        for record in read_messages(path, ("estimate",)):
            found = record
        if found is not None:
            message = decode(found, path)
            return message if isinstance(message, EstimateMessage) else None
    return None


def _has_same_zero(state: CompensationState | None, last: EstimateMessage) -> bool:
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
