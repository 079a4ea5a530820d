"""Replay: runs recorded samples through a compensation again.

The audit, the comparison with another model, the restart and the warm-up of another model read and run recordings here.
`apply` repeats what the service did with one group of records. This suffices if the state comes from the file: each
file starts with the state before its first sample, after any pause. `ForeignRun` is for a compensation of another
model, whose state is in no file: it also accounts for the pauses.

A pause is a number of samples that the compensation did not receive. It cannot be derived from times, as the wall clock
may be set. A pause is therefore

- what the service has recorded (`PauseData`): at its start, where it may be of unknown length, or after samples that
  were not measured or not processed;
- otherwise, the numbers missing between two samples; the number of a held offset is not missing;
- if files in between were not given, the time between the two, because numbers do not show it across restarts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import msgspec

from compensator.clock import NS
from compensator.codes import ProbeCode
from compensator.config import Config, parse_config
from compensator.errors import DataError
from compensator.events import CommandName, EventKind, command_of, pause_of
from compensator.messages import EstimateMessage, Event, Offset, Probe, Sample
from compensator.messages_axes import AxisOffset, RecordedOffsets, further_values
from compensator.model.thermal_model import ThermalModel
from compensator.recording.container import Container, Contents, Damaged
from compensator.recording.reading import RawRecord, decode, decode_with, groups_of
from compensator.service.compensation import Compensation, Outcome, model_of
from compensator.service.probing import ReceivedProbe
from compensator.service.state import ZeroMode

_SAMPLE, _EVENT = msgspec.json.Decoder(Sample), msgspec.json.Decoder(Event)
_PROBE = msgspec.json.Decoder(Probe)
_OFFSET = msgspec.json.Decoder(Offset)


@dataclass(slots=True)
class RecordedStep:
    """One recorded group: a sample and its outcome, or an offset that was held without a sample.

    Parameters
    ----------
    file : str
        Name of the file.
    run : dict of str to str
        Metadata of the file.
    records : dict of str to RawRecord
        `sample`, `estimate` and `offset`, as far as present; a torn end lacks some.
    events : list of Event
        Events. Those with smaller numbers were delayed by a full disk and are already in the state of the file.
    sample : Sample or None
        The sample; None for a held offset or for events alone.
    probes : list of (RawRecord, Probe)
        Probes that were decided with it; those with smaller numbers are already in the state of the file.
    candidates : list of RawRecord
        What the models in shadow made of it.
    repeated : list of RawRecord
        Records of a topic of which the group has a later one: the recorder writes one of each.
    """

    file: str
    run: dict[str, str]
    records: dict[str, RawRecord]
    events: list[Event]
    sample: Sample | None
    probes: list[tuple[RawRecord, Probe]] = field(default_factory=list)
    candidates: list[RawRecord] = field(default_factory=list)
    repeated: list[RawRecord] = field(default_factory=list)

    def received_probes(self, *, checked: bool = False) -> list[ReceivedProbe]:
        """Return the probes of the sample as they arrived.

        With `checked` only those that passed the checks of the recording service, and without repeating these checks:
        another model has not published the offset that acted.
        """
        seq = self.sample.seq if self.sample is not None else -1
        found = []
        for _, probe in self.probes:
            received = ReceivedProbe.of(probe, is_checked=checked)
            passed = probe.taken or probe.code == ProbeCode.OUTLIER
            if received is not None and probe.seq == seq and (passed or not checked):
                found.append(received)
        return found

    @property
    def estimate(self) -> EstimateMessage | None:
        """The model's estimate for the sample."""
        record = self.records.get("estimate")
        return None if record is None else cast(EstimateMessage, decode(record, self.file))

    @property
    def offset(self) -> Offset | None:
        """The published offset."""
        record = self.records.get("offset")
        return None if record is None else decode_with(_OFFSET, record, self.file)

    @property
    def further(self) -> dict[str, float]:
        """The published values of further outputs by name, each in its unit; NaN where there was none.

        Nothing was published of a torn group, which lacks the offset of Y, the last record.
        """
        if "offset" not in self.records:
            return {}
        found = [decode(self.records[topic], self.file) for topic in ("offsets", "offset") if topic in self.records]
        axes = [one for part in found for one in (part.messages() if isinstance(part, RecordedOffsets) else [part])]
        return further_values(one for one in axes if isinstance(one, AxisOffset))

    @property
    def zero(self) -> ZeroMode | None:
        """Mode of the zero that was set with this sample; None if none was set."""
        sample = self.sample
        if sample is None or not any(e.kind == EventKind.ZERO and e.seq == sample.seq for e in self.events):
            return None
        estimate = self.estimate
        return None if estimate is None else "rest" if estimate.y_base_um == 0.0 else "warm"


def step_of(records: Sequence[RawRecord], contents: Contents, file: str) -> RecordedStep:
    """Read one group of records.

    Raises
    ------
    DataError
        If its sample, an event or a probe does not follow its schema.
    """
    found: dict[str, RawRecord] = {}
    events, probes, candidates, repeated = [], [], [], []
    for record in records:
        if record.topic == "event":
            events.append(decode_with(_EVENT, record, file))
        elif record.topic == "probe":
            probes.append((record, decode_with(_PROBE, record, file)))
        elif record.topic == "candidate":
            candidates.append(record)
        else:
            if record.topic in found:
                repeated.append(found[record.topic])
            found[record.topic] = record
    sample = decode_with(_SAMPLE, found["sample"], file) if "sample" in found else None
    return RecordedStep(file, contents.metadata.get("run", {}), found, events, sample, probes, candidates, repeated)


def steps_in(container: Container) -> Iterator[RecordedStep]:
    """Yield the groups of a recording as far as it can be read; the complete part of a torn group comes last.

    Raises
    ------
    DataError
        If it is not a recording of the service.
    """
    with suppress(Damaged):
        yield from steps_until_damage(container)


def steps_until_damage(container: Container) -> Iterator[RecordedStep]:
    """Yield the groups as `steps_in` does, and say why it cannot be read any further.

    Raises
    ------
    DataError
        If it is not a recording of the service.
    Damaged
        If its end is missing, or it is damaged.
    """
    for records, _, _ in groups_of(container):
        if records:
            yield step_of(records, container.contents, container.path.name)


def steps_of(path: Path) -> Iterator[RecordedStep]:
    """Yield the groups of a recording; see `steps_in`."""
    with Container(path) as container:
        yield from steps_in(container)


def opening_of(path: Path) -> dict[str, bytes]:
    """Return the attachments of a recording by name; none if it is torn before them.

    Raises
    ------
    DataError
        If it is not an MCAP file.
    """
    with Container(path) as container:
        return {name: attachment.data for name, attachment in container.survey(whole=False).attachments.items()}


def setup_of(contents: Contents, file: str) -> tuple[Config, ThermalModel]:
    """Return the configuration and the model in a recording.

    Raises
    ------
    CompensatorError
        If one of them is missing or cannot be used; the message names file and attachment.
    """
    config = parse_config(_attachment(contents, "config.toml", file), source=f"{file}: config.toml")
    return config, model_of(config, _attachment(contents, "model.toml", file), source=f"{file}: model.toml")


def _attachment(contents: Contents, name: str, file: str) -> bytes:
    found = contents.attachments.get(name)
    if found is None:
        there = ", ".join(contents.attachments) or "none"
        raise DataError(f"{file}: attachment {name} is missing (found: {there}); a replay needs it")
    return found.data


# ---------------------------------------------------------------------- what the service did


def execute(compensation: Compensation, name: str, arguments: dict[str, Any]) -> None:
    """Execute a command, live or recorded; those about models and `probe` are handled elsewhere, not here."""
    if name == CommandName.ZERO:
        mode = arguments.get("mode", "auto")
        compensation.zero(mode if mode in ("auto", "rest", "warm") else "auto")
    elif name == CommandName.HOLD:
        compensation.hold()
    elif name == CommandName.RESUME:
        compensation.resume()


def apply(
    compensation: Compensation,
    step: RecordedStep,
    *,
    commands: bool = True,
    since: int | None = None,
    checked: bool = False,
) -> Outcome | tuple[Offset, ...] | None:
    """Repeat what the service did with one recorded group: commands and errors of its number, then the sample.

    Parameters
    ----------
    compensation : Compensation
        In the state before the group.
    step : RecordedStep
        The group.
    commands : bool
        Whether commands, probes and errors are applied.
    since : int, optional
        Lowest number of the events that are applied; by default that of the group.
    checked : bool
        Whether the checks of the probes are taken from the recording, as for another model.

    Returns
    -------
    Outcome or tuple of Offset or None
        Outcome of the sample; the held offsets of all axes, that of Y first, if the group has no sample; None for
        events alone.

    Raises
    ------
    DataError
        If a message does not follow its schema, or the sample lacks a configured channel.
    """
    sample = step.sample
    held = step.offset if sample is None else None
    if sample is None and held is None:
        return None
    if commands and step.events:
        seq = (sample or held).seq  # type: ignore[union-attr]
        for event in step.events:
            if not (seq if since is None else since) <= event.seq <= seq:
                continue
            if event.kind == EventKind.COMMAND:
                execute(compensation, command_of(event), event.data)
            elif event.kind == EventKind.ERROR:
                compensation.fail()
    if sample is None:
        assert held is not None
        return compensation.held_axes(held.machine, held.seq, held.time_utc_ns)
    compensation.receive_probes(step.received_probes(checked=checked) if commands else ())
    try:
        # The guards set `quality` again, from `device_quality` alone.
        return compensation.process(sample)
    except (KeyError, AttributeError, TypeError) as error:
        raise DataError(
            f"{step.file}: /sample {sample.seq}: {type(error).__name__} {error}; expected the configured channels"
        ) from error


# ---------------------------------------------------------------------- another model


class ForeignRun:
    """Runs one file after the other through a compensation whose state they do not contain.

    Parameters
    ----------
    compensation : Compensation
        In its state before the first sample.
    """

    def __init__(self, compensation: Compensation) -> None:
        self.compensation = compensation
        #: Number and time of the last sample or held offset; −1 and 0 before the first.
        self.seq, self.time_ns = -1, 0
        self._file = ""
        #: Offset before the sample of a torn end, whose own offset was not published.
        self._before_torn_um: float | None = None
        self._further_before_torn: Mapping[str, float] = {}

    def run(self, step: RecordedStep, *, commands: bool = True) -> Outcome | tuple[Offset, ...] | None:
        """Run the next group, after the pause before it; see `apply`.

        Raises
        ------
        DataError
            As in `apply`, or if the sample period is not that of the model.
        """
        sample, compensation = step.sample, self.compensation
        if sample is not None:
            period_s = compensation.model.period_s
            if sample.period_s != period_s:
                raise DataError(
                    f"{step.file}: samples of {sample.period_s:g} s, expected those of the model, {period_s:g} s"
                )
            if self._before_torn_um is not None:
                compensation.take_offsets(self._before_torn_um, self._further_before_torn)
            if self.seq >= 0:
                self._pass_pause(step, sample)
            before = compensation.status.handover
            self._before_torn_um = before.offset_um if "offset" not in step.records else None
            self._further_before_torn = before.further
        elif self.seq >= 0 and step.offset is not None:
            # The first sample of a start failed: its group contains the pause and a held offset.
            self._pass_noted_pause(step, step.offset.seq)
        since = self.seq + 1 if self.seq >= 0 else None
        result = apply(compensation, step, commands=commands, since=since, checked=True)
        self._file = step.run.get("file", step.file)
        if isinstance(result, Outcome):
            self.seq, self.time_ns = result.sample.seq, result.sample.time_utc_ns
        elif result is not None and self.seq >= 0:
            self.seq, self.time_ns = result[0].seq, result[0].time_utc_ns
        return result

    def _pass_pause(self, step: RecordedStep, sample: Sample) -> None:
        if self._file not in (step.run.get("file", step.file), step.run.get("previous_file")):
            self.compensation.pause(round((sample.time_utc_ns - self.time_ns) / (sample.period_s * NS)) - 1)
            return
        if not self._pass_noted_pause(step, sample.seq):
            self.compensation.pause(sample.seq - self.seq - 1)

    def _pass_noted_pause(self, step: RecordedStep, seq: int) -> bool:
        """Account for the pause that a start has recorded; return whether there is one."""
        for event in step.events:
            pause = pause_of(event)
            if pause is None:
                continue
            # Recorded with the first sample of that start; samples that a full disk never accepted are added.
            missing = None if pause.missing is None else pause.missing + seq - event.seq
            self.compensation.pause(missing)
            return True
        return False
