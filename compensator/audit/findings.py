"""What an audit can find: codes, their words, and findings as text and as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum, StrEnum
from typing import Any

from compensator.reasons import explain

#: So many findings of one file are kept; the others are counted.
KEPT = 50


class _Explained(StrEnum):
    @property
    def words(self) -> tuple[str, str]:
        """What it means and what to do, from the table of words."""
        return explain(self) or ("", "")


class Kind(_Explained):
    """Kinds of findings; `compensator explain` has their words."""

    ALTERED = "altered"
    REMOVED = "removed"
    INSERTED = "inserted"
    REORDERED = "reordered"
    #: The end is missing, and not because the service was killed.
    TRUNCATED = "truncated"
    #: Values of the chain that do not belong together.
    BROKEN = "broken"
    #: Not MCAP from some byte on.
    DAMAGED = "damaged"
    MISSING_FILE = "missing_file"
    UNSIGNED = "unsigned"
    FALSE_SIGNATURE = "false_signature"
    #: The state that a file opens with is not that in which the one before ended.
    STATE = "state"
    #: Intact, but not what its schema says.
    UNREADABLE = "unreadable"
    #: The index leads not to all that is in the file, or elsewhere.
    INDEX = "index"


class End(_Explained):
    """How a file ends."""

    FINISHED = "finished"
    #: Torn, and finished at the next start.
    RECOVERED = "recovered"
    #: Without its end, all groups whole: still being written, the service was killed, or the end was cut off.
    OPEN = "open"
    #: The same within a group.
    TORN = "torn"
    #: A finished file without its end.
    TRUNCATED = "truncated"
    DAMAGED = "damaged"


class Fault(Enum):
    """Everything that can be wrong, with its kind and its sentence; names in braces are figures."""

    # The chain of one file.
    NO_CHAIN = (
        Kind.REMOVED,
        "the recorder writes it, but it is missing: nothing shows that the file is as it was written",
    )
    OPENING_UNREADABLE = Kind.ALTERED, "the first message of the chain cannot be read"
    OPENING_MISSING = Kind.REMOVED, "the first message of the chain is missing"
    PART_MISSING = Kind.REMOVED, "the recording began with it, but it is missing"
    PART_ADDED = Kind.INSERTED, "the recording did not begin with it"
    PART_CHANGED = Kind.ALTERED, "not what the recording began with"
    PARTS_REORDERED = Kind.REORDERED, "attachments or metadata stand in another order"
    NO_HASH = Kind.ALTERED, "a hash that is not one"
    OPENING_CHANGED = Kind.ALTERED, "differs from what follows from the file"
    OTHER_PREVIOUS = Kind.ALTERED, "names another last value of the previous file than the metadata"
    PART_LATE = Kind.INSERTED, "{what}"
    PART_CRC = Kind.ALTERED, "{what}"
    UNREADABLE_MESSAGE = Kind.ALTERED, "cannot be read"
    MESSAGE_CHANGED = Kind.ALTERED, "differs from what follows from the records"
    MESSAGE_MISSING = Kind.REMOVED, "the message of the chain is missing"
    VALUE_CHANGED = Kind.ALTERED, "its value of {name} is not that of the record"
    VALUES_BROKEN = (
        Kind.BROKEN,
        "the values before and after this message do not belong together: one side was rewritten",
    )
    RECORDS_MISSING = Kind.REMOVED, "{numbers} missing before it"
    RECORDS_MOVED = Kind.REORDERED, "{numbers} standing behind later ones"
    RECORDS_AGAIN = Kind.INSERTED, "{numbers} standing there again"
    NOT_LISTED = Kind.INSERTED, "the chain does not list it"
    LISTED_MISSING = Kind.REMOVED, "the chain lists it, but it is missing"
    EXCHANGED = Kind.REORDERED, "stands in the place of record {record}"
    MOVED = Kind.REORDERED, "stands in another place than before"
    RECORD_CHANGED = Kind.ALTERED, "does not match its value in the chain"
    BEHIND_CHAIN = Kind.INSERTED, "{count} record(s) behind the last message of the chain"
    NO_SEAL = Kind.REMOVED, "the file has its end, but not the seal before it"
    SEAL_CHANGED = Kind.ALTERED, "does not seal the records before it"
    FALSE_SIGNATURE = Kind.FALSE_SIGNATURE, "not signed by the key given"
    # The file as such.
    UNREADABLE = Kind.UNREADABLE, "{what}"
    NOT_REPLAYED = Kind.UNREADABLE, "its samples cannot be replayed: {what}"
    DAMAGED = Kind.DAMAGED, "byte {offset}: {what}"
    LENGTH_CHANGED = (
        Kind.DAMAGED,
        "byte {offset}: a record whose length leads beyond the end, but what stands there is whole",
    )
    CUT_OFF = Kind.TRUNCATED, "a finished file that ends at byte {offset}; its end is missing"
    INDEX = Kind.INDEX, "{what}"
    # Several files.
    RENAMED = Kind.REORDERED, "it has the name of another file: it was begun as {original}"
    END_UNSIGNED = Kind.UNSIGNED, "its end is not signed"
    NOTHING_SIGNED = Kind.UNSIGNED, "has no hash chain, so nothing is signed"
    MORE_WAS_THERE = Kind.TRUNCATED, "{next} goes on from records that are missing here: its end was cut off"
    FILE_MISSING = Kind.MISSING_FILE, "{previous}, from which it goes on, is {lost}; it stood behind {before}"
    FILES_REORDERED = Kind.REORDERED, "goes on from {previous}, but {before} stands between"
    FILES_BROKEN = Kind.BROKEN, "does not go on from the last value of {previous}: one of them was rewritten"
    NUMBERS_AGAIN = Kind.BROKEN, "sample numbers from {seq} on are also in {previous}"
    OTHER_STATE = Kind.STATE, "opens with another state than {previous} ends with"

    def __init__(self, kind: Kind, sentence: str) -> None:
        self.kind, self.sentence = kind, sentence


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that is wrong with a recording.

    Parameters
    ----------
    kind : Kind
        Its code.
    file : str
        Name of the file.
    text : str
        What is wrong.
    topic : str
        Channel without the slash, or the attachment or metadata; empty where it is the file.
    sequence : int, optional
        Number of the record.
    time_utc_ns : int, optional
        Its time, ns since 1970 UTC.
    """

    kind: Kind
    file: str
    text: str
    topic: str = ""
    sequence: int | None = None
    time_utc_ns: int | None = None

    @property
    def place(self) -> str:
        """Where in the file it is."""
        where = [f"/{self.topic}" if self.topic and " " not in self.topic else self.topic]
        where.append("" if self.sequence is None else f"record {self.sequence}")
        where.append("" if self.time_utc_ns is None else utc(self.time_utc_ns))
        return " ".join(filter(None, where))

    def line(self) -> str:
        """Return one line for people."""
        return ": ".join(filter(None, (self.file, self.kind, self.place, self.text)))

    def as_json(self) -> dict[str, Any]:
        """Return it as it stands in the result of `--json`."""
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
        What differs.
    """

    file: str
    topic: str
    seq: int
    time_utc_ns: int
    fields: tuple[Field, ...]

    def lines(self) -> list[str]:
        """Return it for people, field by field."""
        head = f"{self.file}: /{self.topic} of sample {self.seq}, {utc(self.time_utc_ns)}, differs:"
        rows = [f"  {f.name}: recorded {f.recorded!r}, recomputed {f.recomputed!r}" for f in self.fields]
        return [head, *rows]

    def as_json(self) -> dict[str, Any]:
        """Return it as it stands in the result of `--json`."""
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
