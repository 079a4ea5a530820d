"""Replays one file from the state at its start, and compares byte by byte."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from compensator.audit.findings import Difference, Field
from compensator.audit.result import RecordingAudit
from compensator.codes import Reason
from compensator.errors import CompensatorError, DataError
from compensator.events import EventKind, Note, RecordingData, data_of, is_recorded
from compensator.messages import Event, Offset, degraded, encode
from compensator.recording.container import Contents
from compensator.recording.reading import RawRecord
from compensator.service.compensation import Compensation, Outcome
from compensator.service.loop.core import Followed
from compensator.service.loop.replaying import decisions_in, recorded_loop
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
        self._loop = recorded_loop(contents, self.compensation, result.file)
        #: A sample of which the estimate or the offset is missing: a torn end, or a difference.
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
        decided = self._loop.apply_inputs(step) if self._loop is not None else []
        outcome = apply(self.compensation, step)
        if isinstance(outcome, Outcome):
            followed = self._loop.process(outcome) if self._loop is not None else Followed(None, ())
            self._compare(step, outcome, Followed(followed.candidate, (*decided, *followed.notes)))
        elif outcome is not None:
            expected = self._as_published(outcome, step.records["offset"].data)
            self._matches("offset", expected, step.records["offset"])

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
        if not self._probes_match(step, outcome):
            return
        offset = outcome.offset
        if "offset" in records:
            offset = self._as_published(offset, records["offset"].data)
        messages = {"sample": sample, "estimate": outcome.estimate, "candidate": followed.candidate, "offset": offset}
        if "candidate" in records and followed.candidate is None:
            recorded = Field(
                name="message", recorded=records["candidate"].data.decode("utf-8", "replace"), recomputed=None
            )
            self._count(self._difference("candidate", sample, (recorded,)))
            return
        for topic, message in messages.items():
            if message is None:
                continue
            record = records.get(topic)
            if record is None:
                nothing = Field(name="message", recorded=None, recomputed=msgspec.to_builtins(message))
                self._incomplete = self._difference(topic, message, (nothing,))
                return
            if not self._matches(topic, message, record):
                return
        for note in (*outcome.notes, *followed.notes):
            if not any(is_recorded(note, event) for event in step.events):
                self._count(self._difference("event", sample, (_missing_note(note, step.events),)))
        for event in decisions_in(step) if self._loop is not None else ():
            if not any(is_recorded(note, event) for note in followed.notes):
                self._count(
                    self._difference("event", sample, (Field(name=event.kind, recorded=event.data, recomputed=None),))
                )

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

    def _matches(self, topic: str, message: Any, record: RawRecord) -> bool:
        recorded, recomputed = record.data, encode(message)
        if recorded == recomputed:
            return True
        first = self._result.difference is None
        fields = tuple(differing_fields(recorded, recomputed)) if first else ()
        self._count(self._difference(topic, message, fields))
        return False

    def _difference(self, topic: str, message: Any, fields: tuple[Field, ...]) -> Difference:
        seq, time_ns = message.seq, message.time_utc_ns
        return Difference(file=self._result.file, topic=topic, seq=seq, time_utc_ns=time_ns, fields=fields)

    def _count(self, difference: Difference) -> None:
        self._result.differing += 1
        if self._result.difference is None:
            self._result.difference = difference


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
