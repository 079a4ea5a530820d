"""Findings of an audit: every fault with its code and sentence; findings as text and as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum
from typing import Any

from compensator.codes import AuditFinding

#: Number of findings of one file that are kept; the others are counted.
KEPT = 50


class Fault(Enum):
    """All faults, each with its code and its sentence; names in braces are replaced by figures."""

    # The chain of one file.
    NO_CHAIN = (
        AuditFinding.REMOVED,
        "missing, although the recorder writes it: nothing proves that the file is unchanged",
    )
    OPENING_UNREADABLE = AuditFinding.ALTERED, "the first message of the chain cannot be read"
    OPENING_MISSING = AuditFinding.REMOVED, "the first message of the chain is missing"
    PART_MISSING = AuditFinding.REMOVED, "the recording began with it, but it is missing"
    PART_ADDED = AuditFinding.INSERTED, "the recording did not begin with it"
    PART_CHANGED = AuditFinding.ALTERED, "not what the recording began with"
    PARTS_REORDERED = AuditFinding.REORDERED, "attachments or metadata are in another order"
    NO_HASH = AuditFinding.ALTERED, "not a valid hash"
    OPENING_CHANGED = AuditFinding.ALTERED, "differs from what follows from the file"
    OTHER_PREVIOUS = AuditFinding.ALTERED, "its last value of the previous file is not the one in the metadata"
    PART_LATE = AuditFinding.INSERTED, "{what}"
    PART_CRC = AuditFinding.ALTERED, "{what}"
    UNREADABLE_MESSAGE = AuditFinding.ALTERED, "cannot be read"
    MESSAGE_CHANGED = AuditFinding.ALTERED, "differs from what follows from the records"
    MESSAGE_MISSING = AuditFinding.REMOVED, "the message of the chain is missing"
    VALUE_CHANGED = AuditFinding.ALTERED, "its value of {name} is not that of the record"
    VALUES_BROKEN = (
        AuditFinding.BROKEN,
        "the values before and after this message do not match: one side was rewritten",
    )
    RECORDS_MISSING = AuditFinding.REMOVED, "{numbers} missing before it"
    RECORDS_MOVED = AuditFinding.REORDERED, "{numbers} after later ones"
    RECORDS_REPEATED = AuditFinding.INSERTED, "{numbers} repeated"
    NOT_LISTED = AuditFinding.INSERTED, "the chain does not list it"
    LISTED_MISSING = AuditFinding.REMOVED, "the chain lists it, but it is missing"
    EXCHANGED = AuditFinding.REORDERED, "is in the place of record {record}"
    MOVED = AuditFinding.REORDERED, "is in another place than before"
    RECORD_CHANGED = AuditFinding.ALTERED, "does not match its value in the chain"
    BEHIND_CHAIN = AuditFinding.INSERTED, "{count} record(s) after the last message of the chain"
    NO_SEAL = AuditFinding.REMOVED, "the file has its end, but the seal before it is missing"
    SEAL_CHANGED = AuditFinding.ALTERED, "does not seal the records before it"
    SEAL_NOT_WHOLE = (
        AuditFinding.ALTERED,
        "is not what was sealed: another time than the one it states, or bytes that are no part of a seal",
    )
    BEHIND_SEAL = AuditFinding.INSERTED, "nothing follows the seal of an end"
    FALSE_SIGNATURE = AuditFinding.FALSE_SIGNATURE, "not signed with the given key"
    # The file as a whole.
    UNREADABLE = AuditFinding.UNREADABLE, "{what}"
    NOT_REPLAYED = AuditFinding.UNREADABLE, "its samples cannot be replayed: {what}"
    DAMAGED = AuditFinding.DAMAGED, "byte {offset}: {what}"
    LENGTH_CHANGED = (
        AuditFinding.DAMAGED,
        "byte {offset}: the length of a record exceeds the file, but its content is complete",
    )
    NO_RECORDING = AuditFinding.DAMAGED, "not read: {what}"
    CUT_OFF = AuditFinding.TRUNCATED, "a finished file that ends at byte {offset}; its end is missing"
    INDEX = AuditFinding.INDEX, "{what}"
    # Several files.
    RENAMED = AuditFinding.REORDERED, "it has the name of another file: it was created as {original}"
    COPIED = AuditFinding.INSERTED, "is a copy of {other}: both were created as {original}"
    NOT_SIGNED = (
        AuditFinding.UNSIGNED,
        "no valid signature covers the last {records} record(s): {samples} sample(s), {minutes:.0f} min",
    )
    NOTHING_SIGNED = AuditFinding.UNSIGNED, "has no hash chain, so nothing is signed"
    MORE_WAS_THERE = AuditFinding.TRUNCATED, "{next} continues from records that are missing here: the end was cut off"
    NOTHING_PROVEN = AuditFinding.EMPTY, "{size} bytes without a sample and without a hash chain: nothing is proven"
    BEFORE_HEAD = (
        AuditFinding.TRUNCATED,
        "it does not contain the value that the head of the machine states: cut off or rewritten",
    )
    NEWEST_MISSING = AuditFinding.MISSING_FILE, "the newest recording by the head of the machine, {newest}, is missing"
    FILE_MISSING = AuditFinding.MISSING_FILE, "the previous file, {previous}, is {lost}; it followed {before}"
    FILES_REORDERED = AuditFinding.REORDERED, "continues from {previous}, but {before} is between them"
    FILES_BROKEN = AuditFinding.BROKEN, "does not continue from the last value of {previous}: one of them was rewritten"
    NUMBERS_REPEATED = AuditFinding.BROKEN, "sample numbers from {seq} on also occur in {previous}"
    OTHER_STATE = AuditFinding.STATE, "does not start with the state at the end of {previous}"

    def __init__(self, kind: AuditFinding, sentence: str) -> None:
        self.kind, self.sentence = kind, sentence


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """A finding of an audit.

    Parameters
    ----------
    kind : AuditFinding
        Its code.
    file : str
        Name of the file.
    text : str
        What is wrong.
    topic : str
        Channel without the slash, or attachment or metadata; empty for the file as a whole.
    sequence : int, optional
        Number of the record.
    time_utc_ns : int, optional
        Its time, ns since 1970 UTC.
    """

    kind: AuditFinding
    file: str
    text: str
    topic: str = ""
    sequence: int | None = None
    time_utc_ns: int | None = None

    @property
    def place(self) -> str:
        """Place of the finding in the file."""
        where = [f"/{self.topic}" if self.topic and " " not in self.topic else self.topic]
        where.append("" if self.sequence is None else f"record {self.sequence}")
        where.append("" if self.time_utc_ns is None else utc(self.time_utc_ns))
        return " ".join(filter(None, where))

    def line(self) -> str:
        """Return one line for people."""
        return ": ".join(filter(None, (self.file, self.kind, self.place, self.text)))

    def as_json(self) -> dict[str, Any]:
        """Return the finding or difference for `--json`."""
        return {
            "kind": self.kind,
            "file": self.file,
            "topic": self.topic or None,
            "record": self.sequence,
            "time_utc_ns": self.time_utc_ns,
            "text": self.text,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One field that differs; `None` where it is null or absent."""

    name: str
    recorded: Any
    recomputed: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A message that the replay does not reproduce.

    Parameters
    ----------
    file : str
        Name of the file.
    topic : str
        `sample`, `estimate`, `offset` or `event`.
    seq : int
        Number of the sample.
    time_utc_ns : int
        Its time, ns since 1970 UTC.
    fields : tuple of Field
        Fields that differ.
    """

    file: str
    topic: str
    seq: int
    time_utc_ns: int
    fields: tuple[Field, ...]

    def lines(self) -> list[str]:
        """Return the difference as text, field by field."""
        head = f"{self.file}: /{self.topic} of sample {self.seq}, {utc(self.time_utc_ns)}, differs:"
        rows = [f"  {f.name}: recorded {f.recorded!r}, recomputed {f.recomputed!r}" for f in self.fields]
        return [head, *rows]

    def as_json(self) -> dict[str, Any]:
        """Return the finding or difference for `--json`."""
        fields = [{"field": f.name, "recorded": f.recorded, "recomputed": f.recomputed} for f in self.fields]
        return {
            "file": self.file,
            "topic": self.topic,
            "seq": self.seq,
            "time_utc_ns": self.time_utc_ns,
            "fields": fields,
        }


def utc(time_ns: int) -> str:
    """Return a time as ISO 8601."""
    try:
        return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    except (OverflowError, ValueError, OSError):
        return f"{time_ns} ns"
