"""Works a recording out again: the same samples through the same compensation, compared byte by byte."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from compensator.audit.findings import Difference, Field
from compensator.audit.verification import Record
from compensator.config import Config, parse_config
from compensator.errors import CompensatorError, DataError
from compensator.messages import Event, Offset, Sample, degraded, encode
from compensator.model.model_file import parse_model
from compensator.model.thermal_model import ThermalModel
from compensator.reasons import Reason
from compensator.recording.container import PAYLOAD, Attachment, Contents
from compensator.service.compensation import Compensation
from compensator.service.retrace import obey

#: Reasons that the disk gives: only the offset itself can say that it was published before it was on disk.
_DISK_REASONS = (Reason.RECORDING_FAILED, Reason.RECORDING_LATE)

_SAMPLE = msgspec.json.Decoder(Sample)
_EVENT = msgspec.json.Decoder(Event)


def model_of(contents: Contents, name: str) -> tuple[Config, ThermalModel]:
    """Return configuration and model that travel in a recording.

    Raises
    ------
    CompensatorError
        If one of them is not there or cannot be used; the line names file and attachment.
    """
    config = parse_config(_attachment(contents, "config.toml", name).data, source=f"{name}: config.toml")
    model = parse_model(_attachment(contents, "model.toml", name).data, source=f"{name}: model.toml")
    if config.model.alternative:
        model = model.with_alternative(config.model.alternative)
    return config, model


def _attachment(contents: Contents, name: str, file: str) -> Attachment:
    found = contents.attachments.get(name)
    if found is None:
        there = ", ".join(contents.attachments) or "none"
        raise DataError(f"{file}: attachment {name} is missing, there is: {there}; it is needed to work it out again")
    return found


def raw_of(sample: Sample) -> Sample:
    """Return a recorded sample as the devices gave it: the guards' verdicts taken back."""
    channels = sample.channels
    for channel in channels.values():
        if channel.quality != channel.device_quality:
            break
    else:
        return sample
    replace = msgspec.structs.replace
    return replace(sample, channels={k: replace(c, quality=c.device_quality) for k, c in channels.items()})


def act(compensation: Compensation, event: Event) -> None:
    """Do what an event says was asked of the compensation."""
    if event.kind == "command":
        obey(compensation, event.text, event.data)
    elif event.kind == "error":
        compensation.fail()


class Recomputation:
    """Works the samples of one file out again.

    Parameters
    ----------
    contents : Contents
        Configuration, model and state that travel in the file.
    file : str
        Its name.

    Raises
    ------
    CompensatorError
        If they cannot be used.
    """

    def __init__(self, contents: Contents, file: str) -> None:
        self._file = file
        config, model = model_of(contents, file)
        self.compensation = Compensation(config, model)
        state = contents.attachments.get("state.json")
        if state is not None:
            try:
                self.compensation.restore(state.data)
            except CompensatorError as error:
                raise DataError(f"{file}: state.json: {error}") from error
        self.samples = self.differing = 0
        self.first: Difference | None = None
        #: Numbers and times of the first and last sample, and the number of samples that nobody recorded between.
        self.first_seq, self.last_seq, self.skipped = -1, -1, 0
        self.first_ns = self.last_ns = 0
        self.restarted = False
        #: Names of recordings that events say were removed by the limit of what is kept.
        self.removed: list[str] = []
        #: Numbers of samples whose offset was published before it was on disk.
        self.early: set[int] = set()
        #: A sample of which the estimate or the offset is missing: a torn end, or a difference.
        self._incomplete: Difference | None = None

    def group(self, records: list[Record]) -> None:
        """Work one group out again.

        Parameters
        ----------
        records : list of Record
            Events, sample, estimate and offset, as they were written together.

        Raises
        ------
        DataError
            If a message is not what its schema says.
        """
        if self._incomplete is not None:
            if not (records[0].topic == "seal" and b'"reason":"recovered"' in records[0].body):
                self._count(self._incomplete)
            self._incomplete = None
        sample: bytes | None = None
        estimate = offset = b""
        events: list[Event] = []
        for topic, sequence, _, body in records:
            if topic == "sample":
                sample = body[PAYLOAD:]
            elif topic == "estimate":
                estimate = body[PAYLOAD:]
            elif topic == "offset":
                offset = body[PAYLOAD:]
            elif topic == "event":
                event = self._decoded(_EVENT, body[PAYLOAD:], topic, sequence)
                events.append(event)
                self._event(event)
        if sample is not None:
            self._sample(sample, estimate, offset, events, records)
        elif offset:
            self._held(offset, events, records)

    def finish(self) -> None:
        """Count what can only be judged at the end."""
        if self._incomplete is not None:
            self._count(self._incomplete)

    def _act(self, events: list[Event], seq: int) -> None:
        """Do what was asked before this sample; what a full disk held back is in the file's state already."""
        for event in events:
            if event.seq == seq:
                act(self.compensation, event)

    def _event(self, event: Event) -> None:
        if event.kind == "start":
            self.restarted = self.restarted or not self.samples
        elif event.kind == "recording":
            early = event.data.get("published_early")
            if type(early) is int:
                self.early.add(early)
            removed = event.data.get("removed")
            if isinstance(removed, list):
                self.removed += [name for name in removed[:1000] if isinstance(name, str)]

    def _sample(self, data: bytes, estimate: bytes, offset: bytes, events: list[Event], records: list[Record]) -> None:
        sample = self._decoded(_SAMPLE, data, "sample", records[0].sequence)
        if events:
            self._act(events, sample.seq)
        try:
            outcome = self.compensation.process(raw_of(sample))
        except (KeyError, AttributeError, TypeError) as error:
            raise DataError(
                f"{self._file}: /sample {sample.seq}: {type(error).__name__} {error}; expected the channels of the "
                f"configuration"
            ) from error
        if self.samples:
            self.skipped += max(0, sample.seq - self.last_seq - 1)
        else:
            self.first_seq, self.first_ns = sample.seq, sample.time_utc_ns
        self.last_seq, self.last_ns = sample.seq, sample.time_utc_ns
        expected = self._as_published(outcome.offset, offset)
        self.samples += 1
        pairs = (
            ("sample", data, outcome.sample),
            ("estimate", estimate, outcome.estimate),
            ("offset", offset, expected),
        )
        for topic, recorded, message in pairs:
            if not recorded:
                nothing = (Field(name="message", recorded=None, recomputed=msgspec.to_builtins(message)),)
                self._incomplete = Difference(
                    file=self._file, topic=topic, seq=sample.seq, time_utc_ns=sample.time_utc_ns, fields=nothing
                )
                return
            if encode(message) != recorded:
                self._differs(topic, sample.seq, sample.time_utc_ns, recorded, encode(message))
                return
        for kind, text in outcome.notes:
            if not any(event.kind == kind and event.text == text for event in events):
                said = next((event.text for event in events if event.kind == kind), None)
                self._count(
                    Difference(
                        file=self._file,
                        topic="event",
                        seq=sample.seq,
                        time_utc_ns=sample.time_utc_ns,
                        fields=(Field(name=kind, recorded=said, recomputed=text),),
                    )
                )

    def _as_published(self, expected: Offset, recorded: bytes) -> Offset:
        """Return an offset with the reason of the disk where it was published with one."""
        for reason in _DISK_REASONS:
            if f'"{reason}"'.encode() in recorded:
                self.early.add(expected.seq)
                return degraded(expected, reason)
        return expected

    def _held(self, offset: bytes, events: list[Event], records: list[Record]) -> None:
        """Compare an offset that was published although its sample could not be worked on."""
        last = records[-1]
        try:
            said = msgspec.json.decode(offset, type=Offset)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            raise DataError(f"{self._file}: /offset record {last.sequence}: {error}") from error
        self._act(events, said.seq)
        held = self.compensation.held(said.machine, said.seq, said.time_utc_ns)
        expected = encode(self._as_published(held, offset))
        if expected != offset:
            self._differs("offset", said.seq, said.time_utc_ns, offset, expected)

    def _differs(self, topic: str, seq: int, time_ns: int, recorded: bytes, recomputed: bytes) -> None:
        fields: tuple[Field, ...] = ()
        if self.first is None:
            fields = tuple(differing_fields(recorded, recomputed))
        self._count(Difference(file=self._file, topic=topic, seq=seq, time_utc_ns=time_ns, fields=fields))

    def _count(self, difference: Difference) -> None:
        self.differing += 1
        if self.first is None:
            self.first = difference

    def _decoded(self, decoder: Any, data: bytes, topic: str, sequence: int) -> Any:
        try:
            return decoder.decode(data)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise DataError(f"{self._file}: /{topic} record {sequence}: {error}") from error


def differing_fields(recorded: bytes, recomputed: bytes) -> Iterator[Field]:
    """Yield the fields in which two JSON messages differ, by their path."""
    try:
        there = msgspec.json.decode(recorded) if recorded else None
    except (msgspec.MsgspecError, UnicodeDecodeError):
        there = repr(recorded[:80])
    found = list(_differing("", there, msgspec.json.decode(recomputed)))
    if found:
        yield from found
    else:
        yield Field(name="bytes", recorded=recorded.decode("utf-8", "replace"), recomputed=recomputed.decode())


def _differing(name: str, recorded: Any, recomputed: Any) -> Iterator[Field]:
    if isinstance(recorded, dict) and isinstance(recomputed, dict):
        for key in [*recorded, *(key for key in recomputed if key not in recorded)]:
            yield from _differing(f"{name}.{key}" if name else key, recorded.get(key), recomputed.get(key))
    elif recorded != recomputed or type(recorded) is not type(recomputed):
        yield Field(name=name or "message", recorded=recorded, recomputed=recomputed)
