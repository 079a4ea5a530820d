"""Replays one file from the state at its start, and compares byte by byte."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Any

import msgspec

from compensator.audit.findings import Difference, Field
from compensator.audit.result import RecordingAudit
from compensator.codes import Reason
from compensator.errors import CompensatorError, DataError
from compensator.events import EventKind, Note, RecordingData, data_of, is_recorded
from compensator.messages import UNREADABLE, Event, Message, Offset, degraded, encode
from compensator.messages_axes import AxisOffset, recorded_offsets
from compensator.recording.container import Contents
from compensator.recording.reading import RawRecord
from compensator.service.compensation import Compensation, Outcome
from compensator.service.loop.core import Followed
from compensator.service.loop.replaying import decisions_in, hand_over_all, recorded_loop
from compensator.service.replay import RecordedStep, apply, setup_of, step_of

#: Reasons that the disk gives: only the offset itself shows that it was published before it was on disk.
_DISK_REASONS = tuple((reason, f'"{reason}"'.encode()) for reason in (Reason.RECORDING_FAILED, Reason.RECORDING_LATE))
#: Largest number of removed recordings that is read from one event.
_REMOVED = 1000


class ReplayCheck:
    """Replays the samples of one file.

    Parameters
    ----------
    contents : Contents
        Configuration, model and state in the file.
    result : RecordingAudit
        Result to which samples and differences are added.

    Raises
    ------
    CompensatorError
        If the contents cannot be used.
    """

    def __init__(self, contents: Contents, result: RecordingAudit) -> None:
        self._contents, self._result = contents, result
        self.compensation = Compensation(*setup_of(contents, result.file))
        state = contents.attachments.get("state.json")
        if state is not None:
            try:
                self.compensation.restore(state.data)
            except CompensatorError as error:
                raise DataError(f"{result.file}: state.json: {error}") from error
        result.model = self.compensation.model.sha256
        self._loop = recorded_loop(contents, self.compensation.model, result.file)
        #: A sample of which the estimate or the offset is missing, or either without it: a torn end, or a difference.
        self._incomplete: Difference | None = None

    def check(self, records: list[RawRecord]) -> None:
        """Replay one group.

        Parameters
        ----------
        records : list of RawRecord
            Events, sample, estimate and offset, as they were written together.

        Raises
        ------
        DataError
            If a message does not follow its schema.
        """
        if self._incomplete is not None:
            if not (records[0].topic == "seal" and b'"reason":"recovered"' in records[0].body):
                self._count(self._incomplete)
            self._incomplete = None
        step = step_of(records, self._contents, self._result.file)
        for event in step.events:
            self._follow(event)
        last_ns = self.compensation.status.time_utc_ns
        decided = hand_over_all(self._loop, step, last_ns) if self._loop is not None else []
        outcome = apply(self.compensation, step)
        if isinstance(outcome, Outcome):
            followed = self._loop.process(outcome) if self._loop is not None else Followed((), ())
            self._compare(step, outcome, Followed(followed.candidates, (*decided, *followed.notes)))
        elif outcome is not None:
            self._compare_held(step, outcome)
        else:
            self._incomplete = self._of_no_sample(step)

    def finish(self) -> None:
        """Add the results that are known only at the end."""
        if self._incomplete is not None:
            self._count(self._incomplete)

    def _follow(self, event: Event) -> None:
        result = self._result
        if event.kind == EventKind.START:
            result.restarted = result.restarted or not result.samples
        elif event.kind == EventKind.RECORDING and (data := data_of(event, RecordingData)) is not None:
            if data.published_early is not None:
                result.early_seqs.add(data.published_early)
            result.removed += data.removed[:_REMOVED]

    def _compare(self, step: RecordedStep, outcome: Outcome, followed: Followed) -> None:
        """Compare the messages of a sample, up to the first difference."""
        result, sample, records = self._result, outcome.sample, step.records
        if result.samples:
            result.skipped += max(0, sample.seq - result.last_seq - 1)
        else:
            result.first_seq, result.first_ns = sample.seq, sample.time_utc_ns
        result.last_seq, result.last_ns = sample.seq, sample.time_utc_ns
        result.samples += 1
        if self._has_repeated(step, sample) or not self._probes_match(step, outcome):
            return
        candidates = followed.candidates
        offsets = self._offsets((outcome.offset, *outcome.further), records)
        if self._has_unknown_axes(offsets, sample, records):
            return
        if len(step.candidates) > len(candidates):
            extra = step.candidates[len(candidates)].data
            self._count(self._difference("candidate", sample, _of_one_side(recorded=extra)))
            return
        messages: list[tuple[str, Message, RawRecord | None]] = [
            ("sample", sample, records.get("sample")),
            ("estimate", outcome.estimate, records.get("estimate")),
            *(("candidate", *pair) for pair in zip_longest(candidates, step.candidates)),
            *((topic, offset, records.get(topic)) for topic, offset in offsets.items()),
        ]
        for topic, message, record in messages:
            if record is None:
                self._incomplete = self._difference(topic, sample, _of_one_side(recomputed=message))
                return
            if not self._matches(topic, message, record, of=sample):
                return
        for note in (*outcome.notes, *followed.notes):
            if not any(is_recorded(note, event) for event in step.events):
                self._count(self._difference("event", sample, (_missing_note(note, step.events),)))
        result.decisions += sum(note.kind == EventKind.LOOP for note in followed.notes)
        for event in decisions_in(step) if self._loop is not None else ():
            if not any(is_recorded(note, event) for note in followed.notes):
                self._count(
                    self._difference("event", sample, (Field(name=event.kind, recorded=event.data, recomputed=None),))
                )

    def _compare_held(self, step: RecordedStep, held: Sequence[Offset]) -> None:
        """Compare the offsets of a sample that could not be processed, up to the first difference."""
        messages = self._offsets(held, step.records)
        if self._has_repeated(step, held[0]) or self._has_unknown_axes(messages, held[0], step.records):
            return
        for topic, message in messages.items():
            record = step.records.get(topic)
            if record is None:
                self._incomplete = self._difference(topic, held[0], _of_one_side(recomputed=message))
                return
            if not self._matches(topic, message, record, of=held[0]):
                return

    def _offsets(self, offsets: Sequence[Offset], records: Mapping[str, RawRecord]) -> dict[str, Any]:
        """Return the records of the offsets of a sample, as they were published if the disk was late."""
        first, *further = offsets
        found: dict[str, Any] = {}
        if further:
            own = records.get("offsets")
            published = [self._as_published(one, own.data) if own is not None else one for one in further]
            found["offsets"] = recorded_offsets(one for one in published if isinstance(one, AxisOffset))
        found["offset"] = self._as_published(first, records["offset"].data) if "offset" in records else first
        return found

    def _has_repeated(self, step: RecordedStep, of: Message) -> bool:
        """Count a message that is recorded twice for one sample: the replay gives one, whatever the other says."""
        for record in step.repeated[:1]:
            fields = _of_one_side("message recorded twice", recorded=record.data)
            self._count(self._difference(record.topic, of, fields))
        return bool(step.repeated)

    def _of_no_sample(self, step: RecordedStep) -> Difference | None:
        """Return the first message that belongs to a sample, in a group without one; a kill may leave it."""
        for record in (*step.records.values(), *step.candidates):
            if record.topic != "seal":
                return Difference(
                    file=self._result.file,
                    topic=record.topic,
                    seq=self._result.last_seq,
                    time_utc_ns=record.log_time_ns,
                    fields=_of_one_side(recorded=record.data),
                )
        return None

    def _has_unknown_axes(self, messages: Mapping[str, Any], of: Message, records: Mapping[str, RawRecord]) -> bool:
        """Count offsets that are recorded for axes that the machine has not."""
        if "offsets" not in records or "offsets" in messages:
            return False
        self._count(self._difference("offsets", of, _of_one_side(recorded=records["offsets"].data)))
        return True

    def _probes_match(self, step: RecordedStep, outcome: Outcome) -> bool:
        """Compare the verdicts on the probes of a sample, up to the first difference."""
        recorded = [raw for raw, probe in step.probes if probe.seq == outcome.sample.seq and probe.is_read]
        if len(recorded) != len(outcome.probes):  # the configuration does not use probes
            number = Field(name="number", recorded=len(recorded), recomputed=len(outcome.probes))
            self._count(self._difference("probe", outcome.sample, (number,)))
            return False
        pairs = zip(outcome.probes, recorded, strict=True)
        return all(self._matches("probe", probe, record) for probe, record in pairs)

    def _as_published(self, expected: Offset, recorded: bytes) -> Offset:
        """Return an offset with the disk's reason if it was published with one."""
        for reason, quoted in _DISK_REASONS:
            if quoted in recorded:
                self._result.early_seqs.add(expected.seq)
                return degraded(expected, reason)
        return expected

    def _matches(self, topic: str, message: Any, record: RawRecord, of: Message | None = None) -> bool:
        recorded, recomputed = record.data, encode(message)
        if recorded == recomputed:
            return True
        first = self._result.difference is None
        fields = tuple(differing_fields(recorded, recomputed)) if first else ()
        self._count(self._difference(topic, of or message, fields))
        return False

    def _difference(self, topic: str, message: Any, fields: tuple[Field, ...]) -> Difference:
        seq, time_ns = message.seq, message.time_utc_ns
        return Difference(file=self._result.file, topic=topic, seq=seq, time_utc_ns=time_ns, fields=fields)

    def _count(self, difference: Difference) -> None:
        self._result.differing += 1
        if self._result.difference is None:
            self._result.difference = difference


def _of_one_side(name: str = "message", *, recorded: bytes = b"", recomputed: Any = None) -> tuple[Field, ...]:
    """Return the field of a message that is recorded or recomputed only; offsets of several axes have one for each."""
    text = recorded.decode("utf-8", "replace") if recorded else None
    try:
        table = msgspec.json.decode(recorded) if recorded else msgspec.to_builtins(recomputed)
    except UNREADABLE:
        table = None
    if isinstance(table, dict) and table and all(isinstance(one, dict) for one in table.values()):
        sides = ((one, None) if recorded else (None, one) for one in table.values())
        return tuple(
            Field(name=f"{name} of {axis}", recorded=there, recomputed=here)
            for axis, (there, here) in zip(table, sides, strict=True)
        )
    return (Field(name=name, recorded=text, recomputed=None if recorded else table),)


def _missing_note(note: Note, events: list[Event]) -> Field:
    """Return how a note differs from the event of its kind: in its data, or in its text if it has no data."""
    event = next((event for event in events if event.kind == note.kind), None)
    if event is None or not event.data:
        return Field(name=note.kind, recorded=event.text if event else None, recomputed=note.text)
    return Field(name=note.kind, recorded=event.data, recomputed=msgspec.json.decode(msgspec.json.encode(note.data)))


def differing_fields(recorded: bytes, recomputed: bytes) -> Iterator[Field]:
    """Yield the fields in which two JSON messages differ, by their path."""
    try:
        there = msgspec.json.decode(recorded)
    except UNREADABLE:
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
